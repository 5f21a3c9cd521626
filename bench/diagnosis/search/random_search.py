"""Random search of coefficients and initial states of runs whose geoms touch.

Where a contact begins or ends, slides or sticks, the sum of squares has steps, at which
Gauss-Newton steps end; between them, it hardly depends on the initial states. Coefficients and
initial states are therefore sampled together and the samples move to the best ones (cross-entropy
method; R. Y. Rubinstein, D. P. Kroese, The Cross-Entropy Method, 2004,
doi:10.1007/978-1-4757-4321-0). Given the coefficients c, the runs r do not depend on each other.
Their initial states x are minimised for each sample of the coefficients:

    J(c) = sum_r min_x J_r(c, x)                                                               (1)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.cubature_filter import (
    FIRST_STATE_MARGIN,
    SmoothedStart,
    compute_root,
)
from sims.core.simulator import Array

COEFFICIENT_SAMPLES = 12
"""Number of samples of the coefficients in a round."""
STATE_SAMPLES = 10
"""Number of initial states of each run that are simulated for a sample of the coefficients."""
BEST_COEFFICIENTS = 4
"""Number of best samples of the coefficients whose spread is that of the next round."""
BEST_STATES = 15
"""Number of best initial states of a run whose covariance is that of the next round."""
SPREAD_FACTOR = 1.5
"""Ratio of the standard deviation of new coefficients to that of the best ones."""
KEPT_SHARE = 0.15
"""Share of the former covariance of the initial states in the new one."""
MIN_COST_DECREASE = 0.1
"""Minimum relative decrease of the cost in a round after which there is another one."""
MAX_ROUNDS = 6
"""Maximum number of rounds."""
EXPLAINED_SQUARES = 1.05
"""Mean square of the residual, in units of the noise, at which the search ends."""


class FoundValues(NamedTuple):
    """Best sample of a search.

    Attributes:
        theta: (P,) parameters.
        states: (R, s) initial states.
        mean_square: mean square of the residual, in units of the noise.
    """

    theta: Array
    states: Array
    mean_square: float


class RandomSearch:
    """Search about given coefficients and smoothed first states of all runs.

    Args:
        evaluator: the runs.
        sigma: (C,) standard deviation of the noise of each channel.
        smoothed: first states of the runs with their covariances.
        rng: random generator.
    """

    def __init__(
        self,
        evaluator: RunEvaluator,
        sigma: Array,
        smoothed: Sequence[SmoothedStart],
        rng: np.random.Generator,
    ) -> None:
        """Begin with the smoothed states, whose deviates are normalised by their covariances.

        Initial states are sampled as mean plus root times deviate, so deviates are standard normal
        at first.

        Args:
            evaluator: Run evaluator of the recording.
            sigma: (C,) standard deviation of the noise of each channel.
            smoothed: Smoothed initial state of each run, mean and covariance.
            rng: Random generator.
        """
        self._evaluator, self._sigma, self._rng = evaluator, sigma, rng
        self._means = [one.mean for one in smoothed]
        self._roots = [compute_root(one.covariance[None])[0] for one in smoothed]
        self._deviates = [np.zeros(mean.size) for mean in self._means]
        self._covariances = [np.eye(mean.size) for mean in self._means]
        self._is_recorded = np.isfinite(evaluator.observed)

    def run(
        self, theta: Array, indices: Sequence[int], widths: Array, bounds: Array
    ) -> FoundValues:
        """Search coefficients and initial states at random, and return the best sample.

        It minimises J(c) = sum over runs r of min_x J_r(c, x), eq. (1), with the coefficients c and
        the initial state x of each run, by the cross-entropy method. Each round has these steps:

        1. Sample coefficients about the best ones.
        2. Sample initial states of each run for each sample of the coefficients.
        3. Keep the best sample.
        4. Stop if the cost hardly decreases, or the runs are explained.
        5. Adapt the widths of the next samples to the best samples of this round.

        Shapes: P parameters.

        Args:
            theta: (P,) parameters.
            indices: indices of the K coefficients that are varied.
            widths: (K,) standard deviations of these coefficients in the first round.
            bounds: (K, 2) lower and upper bounds of these coefficients.
        """
        sample_count = int(self._is_recorded.sum())
        best_theta, centre, lowest_cost = theta.copy(), theta[list(indices)], np.inf
        spread = widths.astype(np.float64)
        for _ in range(MAX_ROUNDS):
            self._evaluator.search_control.check_not_stopped()
            # 1. Coefficients.
            deviates = self._rng.standard_normal((COEFFICIENT_SAMPLES, len(indices)))
            deviates[0] = 0.0
            values = np.clip(centre + spread * deviates, bounds[:, 0], bounds[:, 1])
            samples = np.repeat(theta[None], COEFFICIENT_SAMPLES, axis=0)
            samples[:, list(indices)] = values
            # 2. Initial states.
            sampled_states = [self._sample_states(run, samples) for run in range(len(self._means))]
            totals = np.sum([costs.min(axis=1) for _, costs in sampled_states], axis=0)  # (1)
            # 3. Best sample.
            index, previous_lowest = int(np.argmin(totals)), lowest_cost
            if totals[index] < lowest_cost:
                lowest_cost = float(totals[index])
                best_theta = samples[index]
                centre = values[index]
                for run, (states, costs) in enumerate(sampled_states):
                    self._deviates[run] = states[index, np.argmin(costs[index])]
            # 4. Convergence.
            if not lowest_cost < (1.0 - MIN_COST_DECREASE) * previous_lowest:
                break
            if not lowest_cost > EXPLAINED_SQUARES * sample_count:
                break
            # 5. Widths of the next round.
            order = np.argsort(totals)[:BEST_COEFFICIENTS]
            deviation = np.sqrt(np.square(values[order] - centre).mean(axis=0))
            spread = np.minimum(spread, SPREAD_FACTOR * deviation)
            for run, (states, costs) in enumerate(sampled_states):
                self._move_covariance(run, states, costs)
        sampled_initial_states = [
            mean + root @ deviate
            for mean, root, deviate in zip(self._means, self._roots, self._deviates, strict=True)
        ]
        evaluator = self._evaluator
        states = np.where(
            evaluator.known_state_mask, evaluator.initial_state_guesses, sampled_initial_states
        )
        return FoundValues(best_theta, states, lowest_cost / max(sample_count, 1))

    def _sample_states(self, run: int, samples: Array) -> tuple[Array, Array]:
        """Simulate one run from random initial states, with each of N samples of the parameters.

        A cost is the sum of squares of the residual plus that of the deviates, which penalises
        initial states far from the smoothed ones. Returned are the deviates (N, M, s) of M initial
        states, and their costs (N, M).

        Shapes: P parameters, s states of a run.

        Args:
            run: Index of the run.
            samples: (N, P) samples of the parameters.

        Returns:
            Deviates (N, M, s) of the initial states, and costs (N, M): sums of squares of the
            residual and of the deviates, which are as uncertain as the prior of the fit.
        """
        mean, root = self._means[run], self._roots[run]
        shape = (len(samples), STATE_SAMPLES, mean.size)
        spread = compute_root(self._covariances[run][None])[0]
        deviates = self._deviates[run] + self._rng.standard_normal(shape) @ spread.T
        deviates[:, 0] = self._deviates[run]
        states = np.where(
            self._evaluator.known_state_mask[run],
            self._evaluator.initial_state_guesses[run],
            mean + deviates.reshape(-1, mean.size) @ root.T,
        )
        simulated = self._evaluator.simulate(
            np.repeat(samples, STATE_SAMPLES, axis=0), np.full(len(states), run), states
        )
        residual = simulated - self._evaluator.observed[run]
        scaled = np.where(self._is_recorded[run], residual, 0.0) / self._sigma
        squares = np.square(scaled).sum(axis=(1, 2)).reshape(shape[:2])
        costs = squares + np.square(deviates / FIRST_STATE_MARGIN).sum(axis=2)
        return deviates, np.where(np.isfinite(costs), costs, np.inf)

    def _move_covariance(self, run: int, deviates: Array, costs: Array) -> None:
        """Take the covariance of the best deviates (N, M, s) about the best one.

        A share of the previous covariance is kept. N values of the parameters are combined with M
        initial states with s components.
        """
        order = np.argsort(costs, axis=None)[:BEST_STATES]
        differences = deviates.reshape(-1, deviates.shape[2])[order] - self._deviates[run]
        covariance = differences.T @ differences / len(order)
        self._covariances[run] = (1.0 - KEPT_SHARE) * covariance + KEPT_SHARE * self._covariances[
            run
        ]
