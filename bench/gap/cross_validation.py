"""Cross-validation over runs: refit each model without one run, and predict that run.

Leave-one-out cross-validation with a run as the unit (M. Stone, J. R. Stat. Soc. B 36(2), 111,
1974, doi:10.1111/j.2517-6161.1974.tb00994.x), since samples of one run depend on each other. It
replaces held-out runs where a recording has too few runs to spare one: the model that is reported
is fitted to all runs, and its error is measured on predictions of runs that no fit has seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.gap.held_out import HeldOutRuns, Measured, merit_of
from bench.gap.model.fit import Fitter
from bench.gap.model.noise import Mask, Noise
from bench.gap.model.problem import Fit, Known, Start
from bench.gap.model.world import Indices, World
from sims.base import Array

MAX_STEPS = 8
"""Maximum number of Levenberg-Marquardt steps of a refit, which starts from the fit to all runs."""
SHOWN = 1.0
"""Change of a fold's runs, as the norm of all samples in standard deviations of the noise, below
which these runs do not show an effect.
"""


class CrossValidation:
    """Predict each run with models that are refitted to the other runs.

    Args:
        world: all runs, each with the number of its fold.
        noise: weighs the channels.

    Attributes:
        world, noise: as given.
        seen: (R, T, C) samples that exist.
    """

    is_cross_validation = True

    def __init__(self, world: World, noise: Noise) -> None:
        self.world = world
        self.noise = noise
        self.seen: Mask = np.isfinite(world.observed)

    @property
    def simulations(self) -> int:
        """Number of simulations made for the folds alone."""
        if "_folds" not in self.__dict__:
            return 0
        return sum(fold.fitting.simulations + fold.left_out.simulations for fold in self._folds)

    def close(self) -> None:
        """Release what the simulators of the folds hold; the world of all runs stays open."""
        if "_folds" in self.__dict__:
            for fold in self._folds:
                fold.fitting.close()
                fold.left_out.close()

    def validate(self, fits: Sequence[Fit]) -> list[Measured]:
        """Predict each run with every model, refitted to the other runs.

        Initial states of the predicted run are estimated from it, nothing else. An effect that the
        other runs do not show is switched off for the prediction: they cannot support it.

        Args:
            fits: models as fitted to all runs.
        """
        shape = self.world.observed.shape
        simulated = np.full((len(fits), *shape), np.nan)
        states = np.stack([fit.states for fit in fits])
        free = np.zeros(len(fits))
        for number, fold in enumerate(self._folds):
            self.world.watch.stage(f"cross-validation, fold {number + 1} of {len(self._folds)}")
            thetas = self._refitted(fold, fits)
            predicted = HeldOutRuns(fold.left_out, self.noise).measure(thetas)
            for i, one in enumerate(predicted):
                simulated[i, fold.rows, : one.simulated.shape[1]] = one.simulated
                states[i, fold.rows] = one.states
                free[i] += one.freedom
        return [
            self._measured(*result) for result in zip(simulated, states, free.tolist(), strict=True)
        ]

    def _measured(self, simulated: Array, states: Array, free: float) -> Measured:
        if not np.isfinite(simulated[self.seen]).all():
            return Measured(np.full_like(simulated, np.nan), -np.inf, states)
        merit = merit_of(self.world.observed, simulated, free)
        return Measured(simulated, merit, states, free)

    @cached_property
    def _folds(self) -> list[_Fold]:
        """The folds; each simulates its own runs, with the parameters of the world of all runs."""
        numbers = np.array([run.fold for run in self.world.runs])
        folds = []
        for number in sorted(set(numbers.tolist())):
            rows = np.flatnonzero(numbers == number)
            others = np.flatnonzero(numbers != number)
            folds.append(_Fold(rows, others, self._of_runs(others), self._of_runs(rows)))
        return folds

    def _of_runs(self, rows: Indices) -> World:
        """A world of some of the runs."""
        world = self.world.over([self.world.runs[row] for row in rows])
        length = world.observed.shape[1]
        if self.world.correction is not None:
            world.correction = self.world.correction[rows, :length]
        if self.world.derivatives is not None:
            world.derivatives = self.world.derivatives[rows, :length]
        # Workers that are started for one fold know the others, too.
        world.crew.join(world)
        return world

    def _refitted(self, fold: _Fold, fits: Sequence[Fit]) -> list[Array]:
        """Parameters (P,) of each model, refitted to the runs that a fold keeps."""
        base = set(self.world.base.tolist())
        # All models of a search leave the same parameters at their nominal values.
        frozen = frozenset(base - set(fits[0].free.tolist()))
        length = fold.fitting.observed.shape[1]
        starts = []
        for fit in fits:
            jacobian = fit.jacobian[fold.others, :length, :, : fit.free.size]
            known = Known(fit.free, jacobian)
            starts.append(Start(fit.effects, fit.theta, fit.states[fold.others], known))
        refits = Fitter(fold.fitting, self.noise, frozen).fit(starts, MAX_STEPS)
        return self._without_unsupported(fold.fitting, refits)

    def _without_unsupported(self, world: World, fits: Sequence[Fit]) -> list[Array]:
        """Parameters (P,) of each model, effects that the runs of a world do not show set to 0."""
        thetas = [fit.theta.copy() for fit in fits]
        trials = [(i, name) for i, fit in enumerate(fits) for name in fit.effects]
        if not trials:
            return thetas
        runs = len(world.tracks)
        lanes = np.stack([fits[i].theta for i, _ in trials])
        for lane, (_, name) in zip(lanes, trials, strict=True):
            lane[world.places(name)] = 0.0
        without = world.simulate(
            np.repeat(lanes, runs, axis=0),
            np.tile(np.arange(runs), len(trials)),
            np.concatenate([fits[i].states for i, _ in trials]),
        ).reshape(len(trials), *world.observed.shape)
        seen = np.isfinite(world.observed)
        for (i, name), simulated in zip(trials, without, strict=True):
            change = ((fits[i].simulated - simulated) / self.noise.sigma)[seen]
            # A motion that cannot be simulated without the effect shows it: NaN is not below.
            if np.linalg.norm(change) < SHOWN:
                thetas[i][world.places(name)] = 0.0
        return thetas


@dataclass(frozen=True)
class _Fold:
    """A part of the runs that is left out of the fits, and predicted.

    Attributes:
        rows: numbers of the runs that are left out.
        others: numbers of the runs that are fitted.
        fitting: simulates these.
        left_out: simulates those that are left out.
    """

    rows: Indices
    others: Indices
    fitting: World
    left_out: World
