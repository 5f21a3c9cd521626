"""Fits the base model: parameters that the system has anyway, and initial states, from anywhere in
the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.gap.model.fit import Fitter
from bench.gap.model.noise import Noise
from bench.gap.model.problem import Fit, Start
from bench.gap.model.world import World
from bench.runs.standalone import evenly
from sims.base import Array, Parameter

STARTS = 15
"""Starts over the bounds, beside the nominal one."""
KEPT = 3
"""So many of them are fitted: those nearest to the data."""
LAST_STEPS = 10
"""Steps of the fit that follows when parameters have been found untouched."""
TOUCHED = 1.0
"""A parameter that changes the observations by less than this many sigmas in all, moved across its
bounds, is not touched by the data."""
LOGARITHMIC = 5.0
"""Bounds whose ratio is larger are searched by their logarithm."""
LOST = 1e3
"""Residual, in the channel's unit, that a sample counts which a start could not simulate."""


class Horizon(NamedTuple):
    """A first share of each run that is fitted, and how many steps of it."""

    share: float
    iterations: int


FOLLOWED = (Horizon(1.0, 6),)
"""The same of a robot whose runs a filter has followed: they begin near their best states."""
HORIZONS = (Horizon(0.2, 6), Horizon(0.45, 6), Horizon(1.0, 20))
"""Fitted one after another: the end of a run depends on its beginning in ways that only a nearly
fitted model follows.
"""


@dataclass(frozen=True)
class Base:
    """The fitted base model: its fit, and which parameters stay nominal, since the data do not
    touch them, or do not fix them beside the others.
    """

    fit: Fit
    untouched: frozenset[int]
    vague: frozenset[int] = frozenset()

    @property
    def frozen(self) -> frozenset[int]:
        """All parameters that stay nominal."""
        return self.untouched | self.vague


def fit_base(world: World, noise: Noise, given: Array | None = None) -> Base:
    """Fit parameters and initial states.

    Args:
        world: the runs.
        noise: weighs the channels.
        given: (b,) base parameters to start from, those of a tuner; else a grid of starts over the
            bounds.
    """
    thetas = _starts(world, given)
    starts = [Start((), theta, world.guess) for theta in thetas]
    # to simulate a start costs far less than to fit it, so the field is thinned first
    world.watch.tell(f"base fit from {len(starts)} starts")
    if len(starts) > KEPT:
        order = np.argsort(costs_of_starts(world, noise, starts), kind="stable")
        starts = [starts[i] for i in order[:KEPT]]

    fits: list[Fit] = []
    for horizon in HORIZONS if world.followed is None else FOLLOWED:
        world.watch.tell(f"base fit, first {horizon.share:.0%} of the runs")
        fits = Fitter(world, noise, share=horizon.share).fit(starts, horizon.iterations)
        starts = [fit.start() for fit in fits]
    best = min(fits, key=lambda fit: fit.cost)
    if world.linear and world.followed is None:
        # what was taken about the first start is taken about the fitted model, for all that follow
        # loaded where there is a robot alone
        from bench.gap.model.tangents import begun

        begun(world, best.theta, best.states, anew=True)
        best = Fitter(world, noise).fit([best.start()], LAST_STEPS)[0]

    # what the data do not touch stands wherever the search left it: nominal says more
    places = world.base.tolist()
    untouched = frozenset(i for i in places if not _touched(world, best, i, noise))
    if untouched:
        kept = list(untouched)
        theta = best.theta.copy()
        theta[kept] = world.nominal()[kept]
        start = replace(best.start(), theta=theta)
        best = Fitter(world, noise, untouched).fit([start], LAST_STEPS)[0]
    return Base(best, untouched)


def without_step(world: World, noise: Noise, base: Base) -> Base:
    """The base model of a robot, without what the engine's own step leaves of it."""
    # loaded where there is a robot alone
    from bench.gap.model.tangents import correct

    correct(world, noise, base.fit.theta, base.fit.states)
    if world.correction is None:
        return base
    fit = Fitter(world, noise, base.frozen).fit([base.fit.start()], LAST_STEPS)[0]
    return replace(base, fit=fit)


def _starts(world: World, given: Array | None) -> list[Array]:
    """Parameter vectors (P,) to begin with: the given one, or the nominal one and a grid."""
    nominal = world.nominal()
    if given is not None:
        nominal[world.base] = given
        return [nominal]
    parameters = [world.parameters[i] for i in world.base]
    starts = [nominal]
    # a simulator may have nothing to tune: its base fit is that of initial states
    if not parameters:
        return starts
    for shares in evenly(STARTS, len(parameters)):
        theta = nominal.copy()
        for place, parameter, share in zip(world.base, parameters, shares, strict=True):
            theta[place] = _between(parameter, share)
        starts.append(theta)
    return starts


def _between(parameter: Parameter, share: float) -> float:
    """The value at a share of a parameter's bounds."""
    low, high = parameter.bounds
    if low > 0 and high / low > LOGARITHMIC:
        return float(low * (high / low) ** share)
    return float(low + (high - low) * share)


def misfit_of_starts(world: World, noise: Noise, share: float) -> float:
    """The lowest sum of squares of the starts of a base fit before they are fitted, over the first
    share of each run; infinite where none of them can be simulated.
    """
    starts = [Start((), theta, world.guess) for theta in _starts(world, None)]
    return float(costs_of_starts(world, noise, starts, share, np.inf).min())


def costs_of_starts(
    world: World,
    noise: Noise,
    starts: Sequence[Start],
    share: float = HORIZONS[0].share,
    lost: float = LOST,
) -> Array:
    """Return the sums of squares of each start over the first samples of the runs.

    Args:
        world: the runs.
        noise: weighs the channels.
        starts: parameters and initial states.
        share: only this first share of each run counts.
        lost: residual of a sample that could not be simulated.
    """
    count, runs = len(starts), len(world.tracks)
    thetas = [s.theta for s in starts]
    theta = np.repeat(thetas, runs, axis=0)
    states = np.concatenate([s.states for s in starts])
    lanes = np.tile(np.arange(runs), count)
    simulated = world.simulate(theta, lanes, states, share)
    simulated = simulated.reshape(count, runs, *simulated.shape[1:])

    # a start that was given up has no samples: it must not seem to fit them
    left = np.nan_to_num(world.observed - simulated, nan=lost)
    residuals = np.where(world.counted(share), left, 0.0) / noise.sigma
    costs: Array = np.square(residuals).sum(axis=(1, 2, 3))
    return costs


def _touched(world: World, fit: Fit, place: int, noise: Noise) -> bool:
    """Whether the data tell anything of a parameter."""
    # one that was frozen has no column
    columns = np.flatnonzero(fit.free == place)
    if not columns.size:
        return False
    low, high = world.parameters[place].bounds
    change = fit.jacobian[..., columns[0]] * (high - low) / noise.sigma
    # only where a sample could show it
    shown = change[np.isfinite(world.observed)]
    sigmas = np.sqrt(np.square(shown).sum())
    return float(sigmas) > TOUCHED
