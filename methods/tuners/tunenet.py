"""TuneNet: residual tuning, Allevato et al., CoRL 2019, arXiv 1907.11200, Eq. 1 and Algorithm 1.

A network h estimates the difference of parameters from two observations, o_P of the proposed
simulation and o_T of the target. Algorithm 1 repeats

    (1)  zeta_k = zeta_{k-1} + h(o_P, o_T)

which stops at a root of h as a function of zeta, wherever that is. Here the root is sought by
Broyden's method (Math. Comp. 19, 1965), with the slope B of h, a step s and the change y of h:

    (2)  s = -B^-1 h,  at first B = -1, which is (1)
    (3)  B <- B + (y - B s) s^T / (s^T s)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.input_features import FeatureConfig
from methods.learning.pair_network import PUBLISHED_DESIGN, PairNetworkDesign
from methods.learning.pair_tuner import PairTuner
from methods.tuner import Array, Proposal, Task, TunerGenerator


@dataclass(eq=False)
class TuneNet(PairTuner):
    """Network that estimates the parameter difference from two observations.

    It is trained on pairs of simulations.

    Algorithm 1 adds that estimate to the guess, simulates the new guess, and repeats; it recommends
    its newest guess.

    The default differs from the published method in what the network sees
    (`learning.observation_features`), in its training (`pair_network.PairNetworkDesign`), in
    h(o, o) = 0 by construction, and in the step: the estimates are read as the residuals of an
    equation h = 0, solved by Broyden's method (Math. Comp. 19, 1965; in one dimension the secant),
    which starts as Algorithm 1 does and converges where the network's scale is wrong, as outside
    its training range.

    Attributes:
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1); every two of them are a training
            pair.
        points: points to which each run is resampled; L in Algorithm 1.
        inputs: inputs kept of those an observation offers.
        strictness: see `methods.learning.observation_features.make_weighted_features`.
        noise: sensor noise that a second network prepares for, 1 sigma, in units of each channel's
            standard deviation in training; used where the target is rougher than the simulations. 0
            for no second network.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        told: read what is known of the scenario too, where scenarios differ in it
            (`methods.learning.input_features`).
        channels: first and last channel that is read, by number, where targets do not show the
            others; None for all.
        clean: whether targets may be as clean as simulations. False for a sensor whose errors last
            for many samples: a smooth target is no clean one then, and there is one network,
            trained with `noise`.
        broyden: solve h = 0; without it each step is that of Algorithm 1.
    """

    name: ClassVar[str] = "tunenet"

    scenarios: int = 100
    each: int = 8
    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    epochs: int = 300
    rate: float = 3e-3
    weight_decay: float = 1e-5
    told: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True
    broyden: bool = True

    def make_network_design(self) -> PairNetworkDesign:
        """Return the design of the network."""
        return PairNetworkDesign(epochs=self.epochs, rate=self.rate, weight_decay=self.weight_decay)

    def choose_training_layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios and the number of simulations in each."""
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Run Algorithm 1, with one simulation per iteration.

        Each guess is the last one plus the network's estimate of the difference to the target (1),
        or a step of Broyden's method (2) with `broyden`, which ends when the guess no longer
        changes.

        Args:
            task: task of the target.
            rng: not used.
        """
        estimate = self.get_trained_network().select_for(task).make_estimator(task)
        search = BroydenSearch(task)
        guess = task.start
        while True:
            evaluation = yield Proposal(guess, recommend=guess)
            point = evaluation.proposals[0]
            residual = estimate(evaluation.observations)
            if self.broyden:
                guess = search.propose_next(point, residual)
                if np.abs(guess - search.best).max() <= MIN_STEP:
                    return "the estimate no longer changes"
            else:
                # This is (1); a failed simulation gives no information, and its point is repeated.
                guess = np.clip(point + np.nan_to_num(residual), 0.0, 1.0)


@dataclass(eq=False)
class TuneNetPublished(PairTuner):
    """TuneNet as published: network, training, data and steps of the authors' code.

    Attributes:
        points: points to which each run is resampled; L in Algorithm 1.
    """

    name: ClassVar[str] = "tunenet-published"
    known_failures: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("check_easy_problem_is_improved", "check_beats_random_search"),
        "240 training simulations in raw units are too few "
        "for 200 epochs of plain gradient descent",
    )

    points: int = 400

    def make_network_design(self) -> PairNetworkDesign:
        """Return the published design of the network."""
        return PUBLISHED_DESIGN

    def make_feature_config(self) -> FeatureConfig:
        """Return the configuration of the inputs."""
        return FeatureConfig(self.points, noise=0.0, raw=True)

    def choose_training_layout(self, dim: int) -> tuple[int, int]:  # noqa: ARG002 (the contract's signature)
        """Return the maximum number of training scenarios and the number of simulations in each."""
        return 800, 2

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Run Algorithm 1; guesses are limited to non-negative values only, as published.

        Each step is zeta_k = zeta_{k-1} + h(o_P, o_T) (1), with the network h, the observation o_P
        of the proposed simulation and o_T of the target.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: unused; the method is deterministic.
        """
        estimate = self.get_trained_network().select_for(task).make_estimator(task)
        guess = task.start
        while True:
            evaluation = yield Proposal(guess, recommend=guess)
            residual = np.nan_to_num(estimate(evaluation.observations))
            guess = np.maximum(evaluation.proposals[0] + residual, 0.0)  # (1)


MIN_STEP = 1e-10
"""Step length in the unit cube below which a step is rounding."""


_MAX_BROYDEN_STEP_RATIO = 2.0
"""Maximum length of a Broyden step, in multiples of the step of Algorithm 1."""
_MAX_BISECTION_STEP_RATIO = 10.0
"""Maximum length of a bisection step, in multiples of the step of Algorithm 1."""


class BroydenSearch:
    """Broyden's method for h(simulation of x, target) = 0.

    The initial slope is -1, so that the first step is that of Algorithm 1.

    Attributes:
        best: (dim,) point with the smallest estimated difference so far.
    """

    def __init__(self, task: Task) -> None:
        """Begin at the start of the task, with slope -1 in every direction.

        `_slope` (dim, dim) estimates dh/dx. `_last` is the last point with its estimate h,
        `_residual` the estimate at `best`, and `_setbacks` counts the points since then that were
        not better. `_fallback` is the middle of the training range, used if the first simulation
        fails.

        Args:
            task: task of the target.
        """
        self._slope = -np.eye(task.dim)
        self._fallback = task.training.mean(axis=0)
        self._last: tuple[Array, Array] | None = None
        self._residual: Array | None = None
        self._setbacks = 0
        # In one dimension: the largest point known to be too low, and the smallest known too high.
        self._low = -np.inf
        self._high = np.inf
        self.best = task.start

    def propose_next(self, point: Array, residual: Array) -> Array:
        """Compute the next guess from the best point so far, its residual and the residuals' slope.

        Args:
            point: (dim,) simulated point.
            residual: (dim,) estimate h at this point; NaN if the simulation failed.

        Returns:
            (dim,) point of the unit cube.
        """
        if not np.isfinite(residual).all():
            # The simulation failed: go half the way to the best point, or to the middle of the
            # training range.
            fallback = self._fallback if self._residual is None else self.best
            return (point + fallback) / 2.0
        if self._last is not None:
            self._update_slope(point - self._last[0], residual - self._last[1])
        self._last = point, residual
        if self._residual is None or residual @ residual < self._residual @ self._residual:
            self.best = point
            self._residual = residual
            self._setbacks = 0
        else:
            self._setbacks += 1
        guess: Array = np.clip(self.best + self._compute_step(self._residual), 0.0, 1.0)
        return self._limit_to_bracket(guess, point, residual) if len(point) == 1 else guess

    def _update_slope(self, step: Array, change: Array) -> None:
        """Correct the slope B by Broyden's update, B + (y - B s) s^T / (s^T s) (3).

        Then B explains the last step. A step of length zero is ignored.

        Args:
            step: (dim,) s, the difference of two points.
            change: (dim,) y, the difference of the network's estimates h at these points.
        """
        square = step @ step
        if square > 0.0:
            prediction_error = change - self._slope @ step
            self._slope = self._slope + np.outer(prediction_error, step) / square

    def _compute_step(self, residual: Array) -> Array:
        """Compute Broyden's step from the best point, at most twice as long as Algorithm 1's.

        If it points against the estimate, Algorithm 1's step is used. After the first setback the
        updated slope is enough; after each further one the step is halved.

        It is s = -B^-1 h (2), with the slope B of the network's estimate h; B = -1 at first.
        """
        try:
            step = np.linalg.solve(self._slope, -residual)  # (2)
        except np.linalg.LinAlgError:
            step = residual
        # If the step points against the estimate, the slope is wrong, because h is trained to have
        # the right direction.
        if not step @ residual > 0.0:
            step = residual
        length = max(float(np.linalg.norm(step)), 1e-300)
        longest = _MAX_BROYDEN_STEP_RATIO * float(np.linalg.norm(residual)) / length
        share = min(1.0, longest) / 2.0 ** max(self._setbacks - 1, 0)
        return np.asarray(step * share, dtype=np.float64)

    def _limit_to_bracket(self, guess: Array, point: Array, residual: Array) -> Array:
        """Limit the guess in one dimension to the interval between a low and a high point.

        This is done after a setback. The step to the middle of the interval is limited, because the
        middle is far away if the other end is one of the first points; a guess that is already
        close would be lost if the estimates are inaccurate.

        Args:
            guess: (1,) the next point, in the unit cube.
            point: (1,) the present point.
            residual: (1,) estimated step from the present point to the target.
        """
        if residual[0] > 0.0:
            self._low = max(self._low, point[0])
        elif residual[0] < 0.0:
            self._high = min(self._high, point[0])
        # Inaccurate estimates may contradict each other; then there is no interval.
        has_bracket = np.isfinite([self._low, self._high]).all() and self._low < self._high
        if self._setbacks and has_bracket and not self._low < guess[0] < self._high:
            max_step = 1.0
            if self._residual is not None:
                max_step = _MAX_BISECTION_STEP_RATIO * float(np.abs(self._residual).max())
            halfway = np.array([(self._low + self._high) / 2.0])
            limited_guess: Array = np.clip(halfway, self.best - max_step, self.best + max_step)
            return limited_guess
        return guess
