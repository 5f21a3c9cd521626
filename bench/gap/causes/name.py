"""Names the cause: which effects the search found, what else would do as well, and which of six
verdicts that makes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.gap.causes.candidates import neighbours
from bench.gap.causes.score_test import tail
from bench.gap.causes.search import ALPHA, SWITCH, Search
from bench.gap.causes.structure import Remains, remains
from bench.gap.measure import HeldOut, Measured, covariance
from bench.gap.model.models import Model, Names
from bench.gap.model.noise import Noise
from sims.base import Array
from sims.simulated import effect_parameters

EXPLAINED = 0.7
"""Share of the gap that the effects must close to be taken for its explanation."""
VAGUE = 0.5
"""A base parameter is not fixed by the data if its 1 sigma is more than this share of its bounds.
"""
STRANGE = 0.5
"""Held-out runs whose RMS exceeds the noise by more than this share show something that the fitted
runs do not.
"""
NOTICED, HELPS = 0.5, 0.1
"""Where held-out runs exceed the noise by more than the first, an effect must take the second share
off the excess.
"""
SIMILAR = 1.2
"""Where structure is left, causes are alike that leave no more than so many times the same excess
over the noise.
"""
NEAR = 30.0
"""Rivals this near in twice the log likelihood are fitted once more before they are judged."""


@dataclass(frozen=True)
class Cause:
    """One effect that was found.

    Attributes:
        effect: its name.
        alternatives: effects that would explain the same as well, the most plausible first.
        p_value: chance of a gain like its own if it were not there.
        gain: twice the log likelihood lost without it.
        preferred: which of the set should stand for it: the likeliest, held-out runs included, of
            those whose coefficients are plausible.
    """

    effect: str
    alternatives: tuple[str, ...]
    p_value: float
    gain: float
    preferred: str = ""


@dataclass(frozen=True)
class Finding:
    """What was found.

    Attributes:
        verdict: one of DESIGN's six words.
        model: the extended model; the base model where nothing was found.
        base: the base model.
        causes: strongest first.
        remains: what the extended model leaves.
        vague: base parameters that the data do not fix.
        measured: models on held-out runs, by their effects; None where there are none.
    """

    verdict: str
    model: Model
    base: Model
    causes: tuple[Cause, ...]
    remains: Remains
    vague: tuple[str, ...] = ()
    measured: Mapping[Names, Measured] | None = None


def name(search: Search, held_out: HeldOut | None) -> Finding:
    """Search, check on held-out runs, collect alternatives, and judge.

    Args:
        search: with the base model entered.
        held_out: the runs for measuring; None if there are none.
    """
    base = search.models[frozenset()]
    vague = unfixed(search, base)
    if vague:
        return Finding("unidentifiable", base, base, (), remains(search, base), vague)
    model = settled(search, search.run())
    measured = _measured(search, model, held_out)
    model = _kept(search, model, measured, held_out)
    left = remains(search, model)
    judge = _Judge(search, measured, held_out, left)
    causes = judge.causes(model)
    preferred = search.models.get(frozenset(cause.preferred for cause in causes), model)
    if preferred is not model:
        model, causes = preferred, judge.causes(preferred)
    if measured is not None and held_out is not None and model.names not in measured:
        measured[model.names] = held_out.measure([model.fit.theta])[0]
    verdict = _verdict(search, model, causes, left)
    if (
        measured is not None
        and held_out is not None
        and verdict in ("named", "ambiguous", "adequate")
    ):
        lost = _loses(held_out, measured, model, left)
        verdict = ("partial" if causes else "unknown") if lost else verdict
    return Finding(verdict, model, base, causes, left, (), measured)


def unfixed(search: Search, base: Model) -> tuple[str, ...]:
    """Base parameters that shape the data and are not fixed by them."""
    spread = np.sqrt(np.maximum(np.diagonal(covariance(search, base)), 0.0))
    parameters = search.world.parameters
    found = []
    for place, sd in zip(base.fit.free.tolist(), spread.tolist(), strict=True):
        low, high = parameters[place].bounds
        if not sd < VAGUE * (high - low):
            found.append(parameters[place].name)
    return tuple(found)


def settled(search: Search, model: Model) -> Model:
    """The best model after it and its rivals of the same size, all that are promising, were fitted
    to the end.

    By generalised least squares where what is left is noise; by ordinary ones where structure is
    left, which is none and would pull the fit away from the data.
    """
    size, known = len(model.names), set(search.models)
    search.extend([search.without(model, name) for name in model.names], len(search.world.library))
    asked = [m for key, m in search.models.items() if key not in known and len(key) == size]
    model = max([model, *asked], key=lambda m: m.merit)
    names = set(model.names)
    around = list(neighbours(search.world, model.fit))
    if around:  # what repeats has minima by the dozen
        search.from_pieces(size)
    near = [
        m for m in search.models.values() if len(m.names) == size and _is_near(search, m, model)
    ]
    parts = [m for m in search.models.values() if len(m.names) == size - 1 and set(m.names) < names]
    noise, noisy = None, not remains(search, model).structure
    if noisy:
        noise = Noise(
            np.maximum(model.likelihood.sigma, 1e-300), np.maximum(model.likelihood.phi, 0.0)
        )
    rivals = [m for m in near if noisy and abs(model.merit - m.merit) < NEAR] or [model]
    search.refit([*(m.fit.start() for m in (*near, *parts)), *around], noise)
    return max((search.models[frozenset(m.names)] for m in rivals), key=lambda m: m.merit)


def _is_near(search: Search, other: Model, model: Model) -> bool:
    return abs(model.merit - other.merit) < NEAR or search.excess(other) < 1.5 * search.excess(
        model
    )


def _measured(
    search: Search, model: Model, held_out: HeldOut | None
) -> dict[Names, Measured] | None:
    """On held-out runs: the base model, the best ones with one effect, and all that are near the
    one found.
    """
    if held_out is None:
        return None
    base = search.models[frozenset()]
    near = [
        m
        for m in search.models.values()
        if len(m.names) == len(model.names) and _is_near(search, m, model)
    ]
    parts = [m for m in search.models.values() if set(m.names) < set(model.names)]
    singles = sorted(
        (m for m in search.models.values() if len(m.names) == 1), key=lambda m: -m.merit
    )[:SHOWN]
    chosen = {m.names: m for m in [base, model, *near, *parts, *singles]}
    return dict(zip(chosen, held_out.measure([m.fit.theta for m in chosen.values()]), strict=True))


SHOWN = 6


def _kept(
    search: Search,
    model: Model,
    measured: Mapping[Names, Measured] | None,
    held_out: HeldOut | None,
) -> Model:
    """The model without effects that make held-out runs worse, or hardly better while much is left
    of the gap.
    """
    if measured is None or held_out is None:
        return model
    while model.names and model.names in measured:
        smaller = [m for m in search.models.values() if len(m.names) == len(model.names) - 1]
        smaller = [m for m in smaller if set(m.names) < set(model.names) and m.names in measured]
        idle = [
            m for m in smaller if not _helps(held_out, measured[m.names], measured[model.names])
        ]
        if not idle:
            return model
        model = max(idle, key=lambda m: measured[m.names].merit)
    return model


def _helps(held_out: HeldOut, without: Measured, having: Measured) -> bool:
    """Whether an effect makes held-out runs better, and clearly so while they are far from the
    noise.
    """
    before, after = (
        _excess(held_out, part.simulated, held_out.noise.sigma) for part in (without, having)
    )
    return having.merit > without.merit and (before < NOTICED or after < (1.0 - HELPS) * before)


def _excess(held_out: HeldOut, simulated: Array, sigma: Array) -> float:
    """RMS of held-out residuals in units of the noise, less one."""
    left = (held_out.world.observed - simulated) / sigma
    return float(np.sqrt(np.square(left[held_out.seen]).mean())) - 1.0


@dataclass(frozen=True)
class _Judge:
    """Collects what would explain the same as well."""

    search: Search
    measured: Mapping[Names, Measured] | None
    held_out: HeldOut | None
    left: Remains

    def causes(self, model: Model) -> tuple[Cause, ...]:
        """The model's effects, strongest first."""
        return tuple(
            sorted(
                (self._cause(model, name) for name in model.names), key=lambda cause: -cause.gain
            )
        )

    def _cause(self, model: Model, effect: str) -> Cause:
        search, rest = self.search, self.search.without(model, effect)
        key = frozenset(rest.names)
        gain = model.likelihood.value - rest.likelihood.value
        scores = search.scanned[key][1] if key in search.scanned else search.scan(rest)
        chance = dict(zip(scores.effects, scores.chance.tolist(), strict=True)).get(effect, 0.0)
        p_value = min(search.tests.get(key, 1.0), tail(scores.by_chance, np.array([gain - chance])))
        rivals = [(0.0, effect)]
        for other in list(search.models.values()):
            added = set(other.names) - set(rest.names)
            if (
                len(other.names) == len(model.names)
                and set(rest.names) < set(other.names)
                and effect not in added
            ):
                behind = self._behind(model, other)
                if behind < SWITCH:
                    rivals.append((behind, added.pop()))
        ordered = [
            n for _, n in sorted(rivals, key=lambda rival: (not _in_range(search, rival[1]), rival))
        ]
        alternatives = tuple(n for n in ordered if n != effect)
        first = (
            effect if self.left.structure else ordered[0]
        )  # alike is not as likely, where structure is left
        return Cause(effect, alternatives, float(np.clip(p_value, 0.0, 1.0)), float(gain), first)

    def _behind(self, model: Model, other: Model) -> float:
        """How far another model is behind, in twice the log likelihood; negative if it is ahead.

        Where structure is left that neither has, likelihoods compare nothing but how each mimics
        it; then what counts is how much of the gap is left.
        """
        both = (
            self.measured is not None
            and other.names in self.measured
            and model.names in self.measured
        )
        if not self.left.structure:
            behind = model.merit - other.merit
            if both and self.measured is not None:
                behind += self.measured[model.names].merit - self.measured[other.names].merit
            return behind
        ratios = [max(self.search.excess(other), 0.1) / max(self.search.excess(model), 0.1)]
        if both and self.measured is not None and self.held_out is not None:
            sides = [
                _excess(self.held_out, self.measured[m.names].simulated, self.held_out.noise.sigma)
                for m in (other, model)
            ]
            ratios.append(max(sides[0], 0.1) / max(sides[1], 0.1))
        return SWITCH * float(np.mean(np.log(ratios))) / float(np.log(SIMILAR))


def _in_range(search: Search, effect: str) -> bool:
    """Whether the coefficients with which an effect explains the gap are what one would expect."""
    world = search.world
    with_it = [m for m in search.models.values() if effect in m.names]
    if not with_it:
        return False
    best = max(with_it, key=lambda m: m.merit)
    parameters = effect_parameters(world.effects[effect], world.simulator.system, world.channels)
    values = best.fit.theta[world.slots[effect]]
    return all(p.bounds[0] <= v <= p.bounds[1] for p, v in zip(parameters, values, strict=True))


def _loses(
    held_out: HeldOut, measured: Mapping[Names, Measured], model: Model, left: Remains
) -> bool:
    """Whether held-out runs show a gap that the model does not close: something acts there that it
    has not learnt.
    """
    noise = np.maximum(
        held_out.noise.sigma, np.where(left.structure, 0.0, np.nan_to_num(model.likelihood.sigma))
    )
    before, after = (
        _excess(held_out, measured[names].simulated, noise) for names in ((), model.names)
    )
    return not after < STRANGE or (
        before > STRANGE and before - max(after, 0.0) < EXPLAINED * before
    )


def closed(search: Search, base: Model, model: Model, floor: Array) -> float:
    """Share of the gap on the fitted runs that a model closes, all channels in units of their
    noise.
    """
    before, after = (_loud(search, m, floor) for m in (base, model))
    return (before - max(after, 1.0)) / (before - 1.0) if before > 1.0 + 1e-9 else 0.0


def _loud(search: Search, model: Model, floor: Array) -> float:
    left = search.residual(model.fit) / floor
    return float(np.sqrt(np.square(left[search.seen]).mean()))


def _verdict(search: Search, model: Model, causes: Sequence[Cause], left: Remains) -> str:
    base = search.models[frozenset()]
    floor = np.where(
        np.isfinite(model.likelihood.sigma) & ~left.structure,
        model.likelihood.sigma,
        search.noise.sigma,
    )
    unexplained = left.structure or search.tests.get(frozenset(model.names), 1.0) < ALPHA
    if not causes:
        return "unknown" if unexplained else "adequate"
    if closed(search, base, model, np.maximum(floor, search.noise.sigma)) < EXPLAINED:
        return "unknown"
    if unexplained:
        return "partial"
    return "ambiguous" if any(cause.alternatives for cause in causes) else "named"
