"""Detection limits: how large each absent effect would have to be for the data to reveal it.

The limits are computed at a fitted model. A are the whitened derivatives by the parameters of the
model, and d the derivatives by one more coefficient; the initial states of each run are projected
out of both (`bench.gap.measure`). The remaining information on the coefficient, after A is
projected out too, is

    power = d'd - d'A (A'A)^-1 A'd                                                              (1)

Its 95 % interval extends 1.96 / sqrt(power) to both sides (E. Walter, L. Pronzato, Identification
of Parametric Models from Experimental Data, 1997, chapter 4). With the residual e of the model, one
Gauss-Newton step from zero would give the coefficient the value

    c = (d'e - d'A (A'A)^-1 A'e) / power                                                        (2)

The noise is the residual of the model with its autocorrelation (AR(1)). With a lack of fit it is
larger than the sensor noise, and (2) may be far from zero although the effect is not a cause.
The effect of a limit or backlash is not proportional to its size. It is detectable at the sizes at
which it changes the runs by at least the smallest detectable amount (`bench.gap.identify`).
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
"""Minimum correlation for which the coefficient of an effect counts as equivalent to that of a
simpler effect.
"""


HALVED = 5
"""Number of times that the smallest backlash of the search is halved."""
PART = 0.1
"""Minimum share of the largest contribution for a parameter to be reported as confounded."""


@dataclass(frozen=True)
class Reach:
    """Detection limit of one coefficient.

    Attributes:
        size: Half its 95 % interval; for a limit or backlash the size at which it is detectable;
            infinite if the data are insensitive to it.
        leaning: Estimate after one Gauss-Newton step from zero, (2); zero for a limit or backlash.
        limit: ``above`` for backlash, which is detectable from that size on; ``below`` for a limit,
            which is detectable up to it; empty for proportional effects.
        mixed: Parameters of the model that are confounded with it.
        vague: Whether it could be larger than all plausible values.
    """

    size: float
    leaning: float = 0.0
    limit: str = ""
    mixed: tuple[str, ...] = ()
    vague: bool = False

    @property
    def leans(self) -> bool:
        """Return whether its estimate would differ from zero if it were fitted."""
        return abs(self.leaning) > self.size


@dataclass(frozen=True)
class Shown:
    """Detection limits and parameter uncertainty at a fitted model.

    Attributes:
        free: Names of the fitted parameters of the model.
        covariance: (q, q) covariance of these parameters.
        reaches: Detection limits of absent effects, by effect and coefficient.
        another: Half the 95 % interval of a parameter in a log, or a run, that is not yet recorded,
            by name; only for parameters that several groups identify.
    """

    free: tuple[str, ...]
    covariance: Array
    reaches: Mapping[tuple[str, str], Reach]
    another: Mapping[str, float]


def shown(world: World, extended: Extended, names: Sequence[str]) -> Shown:
    """Compute the detection limits of effects that an extended simulator does not contain.

    Args:
        world: Run evaluator of the runs, with the effects of the simulator and the absent ones.
        extended: Extended simulator.
        names: Absent effects.

    Raises:
        InputError: The simulation fails on the runs.
    """
    floor = noise_floor(world, world.recording)
    white = Noise(floor.sigma, np.zeros(len(floor.sigma)))
    fit = _fitted(world, extended, white)
    if not np.isfinite(fit.simulated[np.isfinite(world.observed)]).all():
        raise InputError(f"{world.recording.path}: the simulation of it fails")
    # The random stream is not used, because there is no search.
    models = Models(world, white, frozenset(), rng_for("sheet"), floor.stated)
    model = models.enter(fit)
    left = model.likelihood
    # The residual of the model is taken as the noise, whatever the recording specifies.
    noise = Noise(np.maximum(left.sigma, 1e-300), left.phi)
    found = _with_small_gaps(world, fit, directions(world, fit, names))
    about = _Shown(world, noise, derived(models, fit), found, models.residual(fit))
    return about.shown(_another(spreads(models, model)))


def _another(found: Sequence[Spread]) -> dict[str, float]:
    """Return half the prediction interval of each parameter for a new log, or else a new run."""
    by_run = {one.number: Z95 * one.total for one in found if one.by == "run"}
    return by_run | {one.number: Z95 * one.total for one in found if one.by == "log"}


def _with_small_gaps(world: World, fit: Fit, found: Directions) -> Directions:
    """Add directions with smaller backlash than a search tries, to find the detection limit."""
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
    """Evaluate the simulator on the runs with derivatives; only initial states are fitted."""
    theta = theta_of(world, extended)
    (measured,) = HeldOutRuns(world, noise).measure([theta])
    own = [extended.parameters.get(p.name) for p in world.parameters[: world.own]]
    # A parameter without an interval was not fitted.
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
        """Compute the detection limit of each coefficient, at the shape that is detected best."""
        shapes: dict[tuple[str, int], list[int]] = {}
        for k in np.argsort(-self.powers, kind="stable").tolist():
            probe = self.found.probes[k]
            if not probe.fixed:
                shapes.setdefault((probe.effect, probe.place), []).append(k)
        best = {key: places[0] for key, places in shapes.items()}
        limits = dict.fromkeys(probe.effect for probe in self.found.probes if probe.fixed)
        reaches = {}
        for (name, place), places in shapes.items():
            # At that shape a richer law may be equivalent to a simpler one that it contains.
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
        # The interval exceeds all plausible values, so the data say nothing about the coefficient.
        if 2.0 * size > UNBOUNDED * (high - low):
            return Reach(float(size), mixed=self._mixed(k), vague=True)
        return Reach(float(size), float(self.leaning[k]), mixed=self._mixed(k))

    def _place(self, probe: Probe) -> int:
        return self.world.places(probe.effect)[probe.place]

    def _mixed(self, k: int) -> tuple[str, ...]:
        """Return the parameters of the model that together have nearly the same influence."""
        i = self.q + k
        if self.powers[k] > (1.0 - MIXED**2) * self.left[i, i]:
            return ()
        # Contributions are relative to the largest one.
        parts = np.abs(self.along[k]) * np.sqrt(np.diagonal(self.left)[: self.q])
        parts /= max(float(parts.max(initial=0.0)), 1e-300)
        order = np.argsort(-parts).tolist()
        return tuple(self.free[j] for j in order if parts[j] > PART)

    def _told_already(self, name: str, k: int, best: Mapping[tuple[str, int], int]) -> bool:
        """Return whether a simpler effect that this effect contains has an equivalent coefficient.

        The simpler effect may be in the model or not.
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
        # A limit has more influence the smaller it is, and backlash the larger it is.
        least, most = (self.left[self.q + k, self.q + k] for _, k in (sized[0], sized[-1]))
        below = bool(least > most)
        if not sizes:
            return Reach(np.inf, limit="below" if below else "above")
        return Reach(max(sizes), limit="below") if below else Reach(min(sizes), limit="above")
