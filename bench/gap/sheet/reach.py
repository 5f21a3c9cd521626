"""What logs would have shown: about a model that was fitted, how large each number that is not in
it would have to be to stand out.

With A the whitened derivatives by the numbers that the model has, d those by one more, both
without what the initial states of each run absorb (`bench.gap.measure`), what is left of d beside
the others is

    power = d'd - d'A (A'A)^-1 A'd                                                              (1)

and its 95 % interval reaches 1.96 / sqrt(power) to either side (E. Walter, L. Pronzato,
Identification of Parametric Models from Experimental Data, 1997, chapter 4). One step of Gauss and
Newton from zero, by what the model leaves, e, would take it to

    c = (d'e - d'A (A'A)^-1 A'e) / power                                                        (2)

The noise is what the model leaves, with its memory: where structure is left, it is larger than that
of the sensor, and (2) may be far from zero without being a cause.
A limit or a gap is no matter of proportion: it shows at the sizes at which it changes the runs by
as much as can just be told to be there (`bench.gap.identify`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.gap.apart import Spread, spreads
from bench.gap.causes.candidates import LIMITED, Directions, Probe, changes_by, directions
from bench.gap.held_out import HeldOutRuns
from bench.gap.identify import FAINT, MIXED
from bench.gap.measure import UNBOUNDED, Z95, curvature, derived, inverted
from bench.gap.model.arrow import schur_complement
from bench.gap.model.fit import Fitter
from bench.gap.model.floor import noise_floor
from bench.gap.model.models import Models
from bench.gap.model.noise import Noise
from bench.gap.model.problem import Fit, Start
from bench.gap.model.world import World
from bench.gap.score_model import theta_of
from bench.problem.seeds import rng_for
from sims.base import Array, InputError
from sims.extended import Extended

ALIKE = 0.999
"""Correlation from which a coefficient of a richer effect is one of a simpler one."""


HALVED = 5
"""How often the smallest gap that a search tries is halved."""
PART = 0.1
"""Share of the largest part from which a number is one of those that do the same together."""


@dataclass(frozen=True)
class Reach:
    """How small a number these data would have shown.

    Attributes:
        size: half its 95 % interval; of a limit or gap, where it begins to show; infinite where
            these data do not touch it.
        leaning: where one step from zero would take it, (2); zero of a limit or gap.
        limit: ``above`` of a gap, which shows from that size on; ``below`` of a limit, which shows
            up to it; empty for what is a matter of proportion.
        mixed: numbers of the model that it is mixed up with.
        vague: whether it could be larger than all that is plausible.
    """

    size: float
    leaning: float = 0.0
    limit: str = ""
    mixed: tuple[str, ...] = ()
    vague: bool = False

    @property
    def leans(self) -> bool:
        """Whether it would not be zero, if it were fitted."""
        return abs(self.leaning) > self.size


@dataclass(frozen=True)
class Shown:
    """What runs show about a fitted model.

    Attributes:
        free: names of the numbers of the model that were fitted.
        covariance: (q, q) of them.
        reaches: by effect and coefficient, of what is not in it.
        another: by name, half the 95 % interval of a number of the model in a log, or a run, not
            yet recorded; of those of which several say something.
    """

    free: tuple[str, ...]
    covariance: Array
    reaches: Mapping[tuple[str, str], Reach]
    another: Mapping[str, float]


def shown(world: World, extended: Extended, names: Sequence[str]) -> Shown:
    """What runs show about an extended simulator.

    Args:
        world: the runs; it has the effects of the simulator, and those in question.
        extended: the simulator.
        names: effects in question, none of which it has.

    Raises:
        InputError: it does not follow the runs at all.
    """
    floor = noise_floor(world, world.recording)
    white = Noise(floor.sigma, np.zeros(len(floor.sigma)))
    fit = _fitted(world, extended, white)
    if not np.isfinite(fit.simulated[np.isfinite(world.observed)]).all():
        raise InputError(f"{world.recording.path}: the simulation of it fails")
    # Nothing is drawn from the stream, as nothing is searched.
    models = Models(world, white, frozenset(), rng_for("sheet"), floor.stated)
    model = models.enter(fit)
    left = model.likelihood
    # What the model leaves is the noise, whatever the recording states of it.
    noise = Noise(np.maximum(left.sigma, 1e-300), left.phi)
    found = _with_small_gaps(world, fit, directions(world, fit, names))
    about = _Shown(world, noise, derived(models, fit), found, models.residual(fit))
    return about.shown(_another(spreads(models, model)))


def _another(found: Sequence[Spread]) -> dict[str, float]:
    """By name, the interval of a number in a group not yet recorded: a log, or else a run."""
    by_run = {one.number: Z95 * one.total for one in found if one.by == "run"}
    return by_run | {one.number: Z95 * one.total for one in found if one.by == "log"}


def _with_small_gaps(world: World, fit: Fit, found: Directions) -> Directions:
    """The directions with gaps smaller than a search tries: what is searched is to be found, and
    here is asked what would have been.
    """
    least: dict[str, Probe] = {}
    for probe in found.probes:
        gap = probe.fixed and world.effects[probe.effect].coefficients[0].of not in LIMITED
        if gap and (probe.effect not in least or probe.c[0] < least[probe.effect].c[0]):
            least[probe.effect] = probe
    more = [replace(p, c=p.c * 0.5**n) for p in least.values() for n in range(1, HALVED + 1)]
    if not more:
        return found
    values = np.nan_to_num(changes_by(world, fit, [(probe.effect, probe.c) for probe in more]))
    return Directions(
        (*found.probes, *more), np.concatenate([found.values, np.moveaxis(values, 0, -1)], axis=3)
    )


def _fitted(world: World, extended: Extended, noise: Noise) -> Fit:
    """The simulator on the runs, with derivatives; initial states are fitted, nothing else."""
    theta = theta_of(world, extended)
    (measured,) = HeldOutRuns(world, noise).measure([theta])
    own = [extended.parameters.get(p.name) for p in world.parameters[: world.own]]
    # What has no interval was not fitted.
    frozen = {i for i, number in enumerate(own) if number is None or number.low is None}
    start = Start(tuple(extended.effects), theta, measured.states)
    return Fitter(world, noise, frozenset(frozen)).fit([start], iterations=0)[0]


class _Shown:
    def __init__(
        self, world: World, noise: Noise, fit: Fit, found: Directions, residual: Array
    ) -> None:
        self.world, self.found = world, found
        self.q = fit.free.size
        self.places = fit.free.tolist()
        self.free = tuple(world.parameters[i].name for i in fit.free.tolist())
        own, states = fit.jacobian[..., : self.q], fit.jacobian[..., self.q :]
        columns = np.concatenate([own, found.values, residual[..., None], states], axis=3)
        curved = curvature(world, columns, columns.shape[3] - states.shape[3], noise)
        own_sum = curved.own.sum(axis=0)
        self.left, _ = schur_complement(own_sum, curved.cross, curved.inner)
        inner = slice(0, self.q)
        self.covariance = inverted(own_sum[inner, inner], self.left[inner, inner])
        beside = self.left[self.q : -1, : self.q]
        self.along = along = beside @ self.covariance
        raw = np.diagonal(self.left)[self.q : -1]
        self.powers = np.maximum(raw - np.einsum("kq,kq->k", along, beside), 0.0)  # (1)
        pull = self.left[self.q : -1, -1] - along @ self.left[: self.q, -1]
        self.leaning = pull / np.maximum(self.powers, 1e-300)  # (2)

    def shown(self, another: Mapping[str, float]) -> Shown:
        """Of each coefficient that scales, at the shape that shows best."""
        shapes: dict[tuple[str, int], list[int]] = {}
        for k in np.argsort(-self.powers, kind="stable").tolist():
            probe = self.found.probes[k]
            if not probe.fixed:
                shapes.setdefault((probe.effect, probe.place), []).append(k)
        best = {key: places[0] for key, places in shapes.items()}
        limits = dict.fromkeys(probe.effect for probe in self.found.probes if probe.fixed)
        reaches = {}
        for (name, place), places in shapes.items():
            # At the shape that shows best a richer law may be the simpler one that it contains.
            own = [k for k in places if not self._told_already(name, k, best)]
            if name not in limits and own:
                reaches[name, self._coefficient(name, place)] = self._proportional(own[0])
        for name in limits:
            reaches[name, self._coefficient(name, 0)] = self._limit(name)
        return Shown(self.free, self.covariance, reaches, another)

    def _coefficient(self, effect: str, place: int) -> str:
        return self.world.effects[effect].on(self.world.simulator.system)[place].name

    def _proportional(self, k: int) -> Reach:
        power = self.powers[k]
        size = Z95 / np.sqrt(power) if power > 0 else np.inf
        parameter = self.world.parameters[self._place(self.found.probes[k])]
        low, high = parameter.bounds
        # Beyond all that is plausible these data say nothing of it.
        if 2.0 * size > UNBOUNDED * (high - low):
            return Reach(float(size), mixed=self._mixed(k), vague=True)
        return Reach(float(size), float(self.leaning[k]), mixed=self._mixed(k))

    def _place(self, probe: Probe) -> int:
        return self.world.places(probe.effect)[probe.place]

    def _mixed(self, k: int) -> tuple[str, ...]:
        """Numbers of the model that do nearly the same as it together."""
        i = self.q + k
        if self.powers[k] > (1.0 - MIXED**2) * self.left[i, i]:
            return ()
        # What each does of it, as a share.
        parts = np.abs(self.along[k]) * np.sqrt(np.diagonal(self.left)[: self.q])
        parts /= max(float(parts.max(initial=0.0)), 1e-300)
        order = np.argsort(-parts).tolist()
        return tuple(self.free[j] for j in order if parts[j] > PART)

    def _told_already(self, name: str, k: int, best: Mapping[tuple[str, int], int]) -> bool:
        """Whether a simpler effect that this one contains has the same coefficient, in the model or
        not.
        """
        simpler = set(self.world.effects[name].contains)
        others = [self.q + j for (other, _), j in best.items() if other in simpler]
        for other in simpler & set(self.world.slots):
            there = self.world.places(other)
            others += [j for j, place in enumerate(self.places) if place in there]
        i = self.q + k
        for j in others:
            scale = np.sqrt(self.left[i, i] * self.left[j, j])
            if scale > 0 and abs(self.left[i, j]) / scale > ALIKE:
                return True
        return False

    def _limit(self, name: str) -> Reach:
        probes = [(k, p) for k, p in enumerate(self.found.probes) if p.effect == name and p.fixed]
        sized = sorted((float(p.c[0]), k) for k, p in probes)
        sizes = [size for size, k in sized if np.sqrt(self.powers[k]) >= FAINT]
        # A limit acts the more the smaller it is, a gap the larger it is.
        least, most = (self.left[self.q + k, self.q + k] for _, k in (sized[0], sized[-1]))
        below = bool(least > most)
        if not sizes:
            return Reach(np.inf, limit="below" if below else "above")
        return Reach(max(sizes), limit="below") if below else Reach(min(sizes), limit="above")
