"""Collects what would explain the same as well, effect by effect.

A model with effects N stands beside every model of the same size that shares all of N but one. The
effect by which they differ is an alternative if that model is not behind by odds of 33 to 1, fitted
and held-out runs together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.gap.causes.moves import NEARER
from bench.gap.causes.rules import behind_in_excess, is_alike, ratio_of
from bench.gap.causes.score_test import tail
from bench.gap.causes.search import Search
from bench.gap.causes.trial import Trial
from bench.gap.model.models import Model


@dataclass(frozen=True)
class Evidence:
    """One effect that was found, and what speaks for it.

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
class Alternatives:
    """Collects them for the effects of a model.

    Attributes:
        search: with every model that was fitted.
        trial: the models on held-out runs; None where there are none.
        structure: whether the model leaves structure that no effect accounts for.
        simulates: False where what has been fitted and scored by now must do.
    """

    search: Search
    trial: Trial | None
    structure: bool
    simulates: bool = True

    def evidence(self, model: Model) -> tuple[Evidence, ...]:
        """The model's effects, strongest first."""
        effects = [self._evidence(model, name) for name in model.names]
        return tuple(sorted(effects, key=lambda evidence: -evidence.gain))

    def _evidence(self, model: Model, effect: str) -> Evidence:
        rest = self._rest(model, effect)
        gain = model.likelihood.value - rest.likelihood.value
        p_value = self._p_value(rest, effect, gain)
        rivals = self._rivals(model, effect)
        # What explains the data with a coefficient that nobody would expect comes last in its set.
        rivals.sort(key=lambda rival: (not self._is_plausible(rival[1]), rival))
        ordered = [name for _, name in rivals]
        alternatives = tuple(name for name in ordered if name != effect)
        # Alike is not as likely where structure is left, so there the effect found stands.
        preferred = effect if self.structure and effect in ordered else ordered[0]
        return Evidence(
            effect=effect,
            alternatives=alternatives,
            p_value=float(np.clip(p_value, 0.0, 1.0)),
            gain=float(gain),
            preferred=preferred,
        )

    def _rest(self, model: Model, effect: str) -> Model:
        """The model without the effect; the base model where that would have to be fitted."""
        if self.simulates:
            return self.search.without(model, effect)
        rest = frozenset(model.names) - {effect}
        return self.search.models.get(rest, self.search.base)

    def _p_value(self, rest: Model, effect: str, gain: float) -> float:
        """Chance of such a gain, or of the best score of all, about the model without it."""
        search = self.search
        key = frozenset(rest.names)
        known = search.scored.get(key)
        if known is None and not self.simulates:
            return search.tests.get(key, 1.0)
        scores = known or search.scan(rest)
        chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        # The score is linear and the gain of a fit is not; either may see more.
        excess = gain - chances.get(effect, 0.0)
        by_refit = tail(scores.by_chance, np.array([excess]))
        by_score = search.tests.get(key, 1.0)
        return min(by_score, by_refit)

    def _rivals(self, model: Model, effect: str) -> list[tuple[float, str]]:
        """How far behind, and the name, of each effect that does as well in place of this one."""
        shared = set(model.names) - {effect}
        rivals = [(0.0, effect)]
        for other in list(self.search.models.values()):
            names = set(other.names)
            same_size = len(names) == len(model.names)
            # Only a model that differs in this one effect says what would do in its place.
            if not same_size or not shared < names:
                continue
            (added,) = names - shared
            # The model itself, and other fits of its effects.
            if added == effect:
                continue
            behind = self._behind(model, other)
            if is_alike(behind) and not self._buys_nothing(effect, added, behind):
                rivals.append((behind, added))
        return self._without_richer(rivals)

    def _buys_nothing(self, effect: str, other: str, behind: float) -> bool:
        """Whether another effect takes more numbers to leave as much: where structure is left, and
        likelihoods do not count them, each of them must come nearer, as a richer law must.
        """
        if not self.structure:
            return False
        slots = self.search.world.slots
        mine, others = (int(slots[name].stop - slots[name].start) for name in (effect, other))
        further = others - mine
        return further > 0 and behind > further * behind_in_excess([NEARER])

    def _without_richer(self, rivals: list[tuple[float, str]]) -> list[tuple[float, str]]:
        """The rivals without those that contain another one: a family of which one member does as
        well, a richer law of which the plain one does.
        """
        effects = self.search.world.effects
        names = {name for _, name in rivals}
        return [
            (behind, name) for behind, name in rivals if not names & set(effects[name].contains)
        ]

    def _behind(self, model: Model, other: Model) -> float:
        """How far another model is behind, in twice the log likelihood; negative if it is ahead.

        Where structure is left that neither has, likelihoods compare nothing but how each mimics
        it; then what counts is how much of the gap is left.
        """
        trial = self.trial
        # Only where both were tried do held-out runs compare them.
        if trial is not None and not {model.names, other.names} <= trial.measured.keys():
            trial = None
        if self.structure:
            left = self.search.excess(other)
            ratios = [ratio_of(left, self.search.excess(model))]
            if trial is not None:
                left = trial.excess(other.names)
                ratios.append(ratio_of(left, trial.excess(model.names)))
            return behind_in_excess(ratios)
        behind = self._merit(model) - self._merit(other)
        # Held-out runs are further data, so their likelihoods multiply.
        if trial is not None:
            mine = trial.measured[model.names]
            others = trial.measured[other.names]
            behind += mine.merit - others.merit
        return behind

    def _merit(self, model: Model) -> float:
        """Of a robot's model, without what its effects might gain by chance where they have but one
        shape: what differs between two of those is that one may not be negative, say, and where
        commands have one sign a dead band is a bias.
        """
        world = self.search.world
        if not world.linear:
            return model.merit
        lucky = 0.0
        for name in model.names:
            parameters = world.parameters[world.slots[name]]
            if not any(parameter.bounds[0] > 0 for parameter in parameters):
                lucky += self.search.chance_of(name)
        return model.merit + lucky

    def _is_plausible(self, effect: str) -> bool:
        """Whether an effect explains the gap with coefficients that one would expect."""
        world = self.search.world
        having = [m for m in self.search.models.values() if effect in m.names]
        if not having:
            return False
        best = max(having, key=lambda m: m.merit)
        parameters = world.parameters[world.slots[effect]]
        values = best.fit.theta[world.slots[effect]]
        for parameter, value in zip(parameters, values, strict=True):
            low, high = parameter.bounds
            if not low <= value <= high:
                return False
        return True
