"""Fits the base model: parameters that the system has anyway, and initial states, from anywhere in
the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.gap.model.fit import Fit, Fitter, Start
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from sims.base import Array, Parameter

STARTS, KEPT = 15, 3
HORIZONS = ((0.2, 6), (0.45, 6), (1.0, 20))
"""Shares of each run that are fitted one after another, and steps of each: the end of a run depends
on its beginning in ways that only a nearly fitted model follows."""
TOUCHED = 1.0
"""A parameter that changes the observations by less than this many sigmas in all, moved across its
bounds, is not touched by the data."""
LOGARITHMIC = 5.0


@dataclass(frozen=True)
class Base:
    """The fitted base model: its fit, and which parameters the data do not touch, which stay
    nominal.
    """

    fit: Fit
    untouched: frozenset[int]


def fit_base(world: World, noise: Noise, given: Array | None = None) -> Base:
    """Fit parameters and initial states.

    Args:
        world: the runs.
        noise: weighs the channels.
        given: (b,) base parameters to start from, those of a tuner; else a grid of starts over the
            bounds.
    """
    starts = [Start((), theta, world.guess) for theta in _starts(world, given)]
    if len(starts) > KEPT:
        costs = _costs(world, noise, starts)
        starts = [starts[i] for i in np.argsort(costs, kind="stable")[:KEPT]]
    fits: list[Fit] = []
    for share, iterations in HORIZONS:
        fitter = Fitter(world, noise, share=share)
        fits = fitter.fit(starts, iterations)
        starts = [fit.start() for fit in fits]
    best = min(fits, key=lambda fit: fit.cost)
    untouched = frozenset(int(i) for i in world.base if not _touched(world, best, int(i), noise))
    if untouched:
        theta = best.theta.copy()
        theta[list(untouched)] = world.nominal()[list(untouched)]
        best = Fitter(world, noise, untouched).fit([replace(best.start(), theta=theta)], 10)[0]
    return Base(best, untouched)


def _starts(world: World, given: Array | None) -> list[Array]:
    nominal = world.nominal()
    if given is not None:
        nominal[world.base] = given
        return [nominal]
    parameters = [world.parameters[i] for i in world.base]
    result = [nominal]
    for row in evenly(STARTS, len(parameters)) if parameters else ():
        theta = nominal.copy()
        theta[world.base] = [_between(p, share) for p, share in zip(parameters, row, strict=True)]
        result.append(theta)
    return result


def evenly(count: int, dim: int) -> Array:
    """Points (count, dim) spread evenly over the unit cube: an additive recurrence with the
    generalised golden ratio.

    M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018.
    """
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (dim + 1))
    points: Array = (
        0.5 + np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1.0, dim + 1)
    ) % 1.0
    return points


def _between(parameter: Parameter, share: float) -> float:
    low, high = parameter.bounds
    if low > 0 and high / low > LOGARITHMIC:
        return float(low * (high / low) ** share)
    return float(low + (high - low) * share)


def _costs(world: World, noise: Noise, starts: Sequence[Start]) -> Array:
    """Sums of squares of each start over the first samples of the runs."""
    runs = len(world.tracks)
    theta = np.repeat([s.theta for s in starts], runs, axis=0)
    states = np.concatenate([s.states for s in starts])
    share = HORIZONS[0][0]
    seen = world.simulate(theta, np.tile(np.arange(runs), len(starts)), states, share)
    seen = seen.reshape(len(starts), runs, *seen.shape[1:])
    counted = world.counted(share)
    residual = np.where(counted, np.nan_to_num(world.observed - seen, nan=1e3), 0.0) / noise.sigma
    costs: Array = np.square(residual).sum(axis=(1, 2, 3))
    return costs


def _touched(world: World, fit: Fit, place: int, noise: Noise) -> bool:
    where = np.flatnonzero(fit.free == place)
    if not where.size:
        return False
    low, high = world.parameters[place].bounds
    change = fit.jacobian[..., where[0]] * (high - low) / noise.sigma
    return float(np.sqrt(np.square(change[np.isfinite(world.observed)]).sum())) > TOUCHED
