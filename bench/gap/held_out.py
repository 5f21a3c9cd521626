"""Held-out runs: models on runs of which nothing but initial states is fitted.

Of n samples, with f initial states that the data fix, the merit of a model with log likelihood L is
that of G. Schwarz (Ann. Stat. 6(2), 461, 1978, doi:10.1214/aos/1176344136):

    M = 2 log L - f log n                                                                      (1)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from bench.gap.model.fit import Fitter
from bench.gap.model.models import freedom
from bench.gap.model.noise import Mask, Noise, likelihood
from bench.gap.model.problem import Fit, Start
from bench.gap.model.world import World
from sims.base import Array

STAGES = ((0.2, 6), (0.45, 6), (0.7, 6), (1.0, 10))
"""Shares of a run over which its initial state is fitted one after another, and steps of each."""
FOLLOWED = ((1.0, 6),)
"""The same of a robot whose runs a filter has followed: they begin near their best states."""
FAR = 1.5
"""Mean square, in units of the noise, from which the nearest model is fitted in stages too."""
BENT = 0.3
"""RMS, in units of the noise, by which a motion may miss what derivatives by its initial states
make of it, before these are taken anew.
"""
NEARER = 3.0
"""Decrease of the sum of squares, in units of the noise, by which fits are led on."""
TWICE = 2.0
"""Models this much farther from held-out runs than the nearest one, as a sum of squares, are fitted
there once more.
"""


@dataclass(frozen=True)
class Measured:
    """Runs simulated with parameters that were fitted to other runs.

    Attributes:
        simulated: (R, T, C); NaN if the simulation failed.
        merit: (1), minus infinity if the simulation failed.
        states: (R, s) initial states, fitted to these runs.
        freedom: effective number of these states, the f of (1).
    """

    simulated: Array
    merit: float
    states: Array
    freedom: float = 0.0


class Validation(Protocol):
    """Predict runs with models that were fitted to other runs: on held-out runs, or by
    cross-validation (`bench.gap.cross_validation`).

    Attributes:
        world: the runs that are predicted.
        noise: weighs the channels.
        seen: (R, T, C) samples that exist.
        is_cross_validation: whether the runs are also those that the reported model is fitted to.
    """

    world: World
    noise: Noise
    seen: Mask
    is_cross_validation: bool

    @property
    def simulations(self) -> int:
        """Number of simulations made for the validation alone."""
        ...

    def validate(self, fits: Sequence[Fit]) -> list[Measured]:
        """Predict the runs with each model, given by its fit to the runs for fitting."""
        ...

    def close(self) -> None:
        """Release what the simulators hold."""
        ...


class HeldOutRuns:
    """Runs on which nothing is fitted but their initial states.

    Args:
        world: the runs, with the effects of the fitted model in the same places.
        noise: weighs the channels.
    """

    is_cross_validation = False

    def __init__(self, world: World, noise: Noise) -> None:
        self.world = world
        self.noise = noise
        self.seen: Mask = np.isfinite(world.observed)

    @property
    def simulations(self) -> int:
        """Number of simulations of the held-out runs."""
        return self.world.simulations

    def close(self) -> None:
        """Release what the simulator holds."""
        self.world.close()

    def validate(self, fits: Sequence[Fit]) -> list[Measured]:
        """Predict the held-out runs with each model; as `measure`."""
        return self.measure([fit.theta for fit in fits])

    def measure(self, thetas: Sequence[Array]) -> list[Measured]:
        """Simulate with each parameter vector (P,), initial states estimated run by run.

        Least squares may end in another minimum for one model than for its neighbour, and luck
        would then decide between them: every model is fitted again from the states of the nearest
        one, and the better fit counts.
        """
        guess = self.world.guess
        begun = [Start((), theta, guess) for theta in thetas]
        followed = self.world.followed is not None
        fits = self._fitted(begun, FOLLOWED if followed else STAGES)
        count = max(int(self.seen.sum()), 1)
        # A run that amplifies where it begins is followed from its beginning on.
        if followed and not _nearest(fits).cost < FAR * count:
            fits = _each_nearer(fits, self._fitted(begun, STAGES))
            followed = False
        if not followed and self._bends(_nearest(fits)):
            fits = self._led(begun, fits)
        nearest = _nearest(fits)
        # Asked this way round, since a fit that failed has a cost that is no number.
        limit = TWICE * nearest.cost
        apart = [i for i, fit in enumerate(fits) if not fit.cost < limit]
        starts = [replace(fits[i].start(), states=nearest.states) for i in apart]
        # These states are good over the first share of the runs already.
        again = self._fitted(starts, FOLLOWED if followed else STAGES[1:])
        for i, fit in zip(apart, again, strict=True):
            fits[i] = _nearest([fits[i], fit])
        return [self._measured(fit) for fit in fits]

    def _fitted(self, starts: Sequence[Start], stages: Sequence[tuple[float, int]]) -> list[Fit]:
        """Initial states fitted over longer and longer parts of the runs."""
        fits: list[Fit] = []
        if not starts:
            return fits
        watch = self.world.watch
        models = "one model" if len(starts) == 1 else f"{len(starts)} models"
        watch.stage(f"simulating held-out runs with {models}", len(stages))
        for share, iterations in stages:
            fitter = Fitter(self.world, self.noise, share=share, parameters=False)
            fits = fitter.fit(starts, iterations)
            starts = [fit.start() for fit in fits]
            watch.advance()
        return fits

    def _bends(self, fit: Fit) -> bool:
        """Whether the motion is no longer what a robot's derivatives by initial states, which are
        taken once for all models, make of it. One that is chaotic leaves them where its guess is
        off by no more than the noise.
        """
        world = self.world
        if not world.linear or not np.isfinite(fit.cost):
            return False
        runs = len(world.guess)
        lanes = np.tile(fit.theta, (runs, 1))
        begun = world.simulate(lanes, np.arange(runs), world.guess)
        moved = fit.states - world.guess
        # A guess that explodes is infinite, or NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            missed = fit.simulated - begun - np.einsum("rtcs,rs->rtc", fit.jacobian, moved)
            sizes = (missed / self.noise.sigma)[self.seen]
            rms = float(np.sqrt(np.square(sizes).mean()))
        # Asked this way round, since NaN compares with nothing.
        return not rms < BENT

    def _led(self, starts: Sequence[Start], fits: Sequence[Fit]) -> list[Fit]:
        """The fits with derivatives about the nearest of them; where these lead any nearer, fitted
        from the starts again with derivatives that are taken anew before each stage.
        """
        found = _each_nearer(fits, self._about(fits, STAGES[-1:]))
        if _nearest(fits).cost - _nearest(found).cost < NEARER:
            return found
        led = self._fitted(starts, STAGES[:1])
        for stage in (*STAGES[1:], STAGES[-1]):
            led = self._about(led, [stage])
        return _each_nearer(found, led)

    def _about(self, fits: Sequence[Fit], stages: Sequence[tuple[float, int]]) -> list[Fit]:
        """The fits led on, with derivatives about the nearest of them."""
        # loaded where there is a robot alone
        from bench.gap.model.tangents import begun

        nearest = _nearest(fits)
        begun(self.world, nearest.theta, nearest.states, anew=True)
        return self._fitted([fit.start() for fit in fits], stages)

    def _measured(self, fit: Fit) -> Measured:
        if not np.isfinite(fit.cost):
            nothing = np.full_like(self.world.observed, np.nan)
            return Measured(nothing, -np.inf, fit.states)
        # Only initial states were fitted here, so they alone count as free.
        free = freedom(self.world, fit, self.noise)
        merit = merit_of(self.world.observed, fit.simulated, free)
        return Measured(fit.simulated, merit, fit.states, free)


def merit_of(observed: Array, simulated: Array, free: float) -> float:
    """Merit (1) of predictions (R, T, C) with so many free initial states."""
    seen = np.isfinite(observed)
    residual = np.where(seen, observed - simulated, 0.0)
    price = float(np.log(max(int(seen.sum()), 2)))
    return likelihood(residual, seen, free).value - free * price  # (1)


def _nearest(fits: Iterable[Fit]) -> Fit:
    """The fit that leaves the least."""
    return min(fits, key=lambda fit: fit.cost)


def _each_nearer(fits: Sequence[Fit], others: Sequence[Fit]) -> list[Fit]:
    """Of each model the nearer of two fits."""
    return [_nearest(pair) for pair in zip(fits, others, strict=True)]
