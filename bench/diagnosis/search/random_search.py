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


class BestSample(NamedTuple):
    """Best sample of a search.

    Attributes:
        theta: (P,) parameters.
        states: (R, s) initial states.
        mean_square: mean square of the residual, in units of the noise.
    """

    theta: Array
    states: Array
    mean_square: float


class RandomStartSearch:
    """Random search of coefficients, and of the initial states of all runs.

    The initial state of a run is its smoothed mean plus a root of its covariance times a deviate,
    so that deviates are standard normal at first.

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
        """Begin at the smoothed initial states, with deviates zero and covariance one.

        Args:
            evaluator: run evaluator of the recording.
            sigma: (C,) standard deviation of the noise of each channel.
            smoothed: smoothed initial state of each run, mean and covariance.
            rng: random generator.
        """
        self._evaluator, self._sigma, self._rng = evaluator, sigma, rng
        self._means = [start.mean for start in smoothed]
        # `compute_root` takes a batch of matrices; here a batch of one.
        self._roots = [compute_root(start.covariance[None])[0] for start in smoothed]
        # Of each run with s initial states: the best deviate so far (s,), and the covariance (s, s)
        # of the next deviates. An initial state is its mean plus the root times a deviate.
        self._deviates = [np.zeros(mean.size) for mean in self._means]
        self._covariances = [np.eye(mean.size) for mean in self._means]
        self._is_recorded = np.isfinite(evaluator.observed)

    def run(self, theta: Array, indices: Sequence[int], widths: Array, bounds: Array) -> BestSample:
        """Search coefficients and initial states at random, and return the best sample.

        It minimises J(c) = sum over runs r of min_x J_r(c, x), eq. (1), with the coefficients c and
        the initial state x of each run, by the cross-entropy method. Each round has these steps:

        1. Sample coefficients about the best ones.
        2. Sample initial states of each run for each sample of the coefficients.
        3. Keep the best sample.
        4. Stop if the cost hardly decreases, or the runs are explained.
        5. Adapt the widths of the next samples to the best samples of this round.

        Args:
            theta: (P,) parameters, with the coefficients from which the search starts.
            indices: indices in theta of the K coefficients that are varied; empty to vary the
                initial states only.
            widths: (K,) standard deviations of these coefficients in the first round.
            bounds: (K, 2) lower and upper bounds of these coefficients.
        """
        # Number of readings, for the mean square.
        sample_count = int(self._is_recorded.sum())
        best_theta, centre, lowest_cost = theta.copy(), theta[list(indices)], np.inf
        spread = widths.astype(np.float64)
        for _ in range(MAX_ROUNDS):
            self._evaluator.search_control.check_not_stopped()
            # 1. Coefficients.
            deviates = self._rng.standard_normal((COEFFICIENT_SAMPLES, len(indices)))
            # The best coefficients so far are tried again, with other initial states.
            deviates[0] = 0.0
            values = np.clip(centre + spread * deviates, bounds[:, 0], bounds[:, 1])
            samples = np.repeat(theta[None], COEFFICIENT_SAMPLES, axis=0)
            samples[:, list(indices)] = values
            # 2. Initial states.
            # For each run, the deviates (N, M, s) of M initial states for each of the N samples of
            # the coefficients, and their costs (N, M).
            sampled_states = [self._sample_states(run, samples) for run in range(len(self._means))]
            # Cost J(c) of each sample of the coefficients.
            totals = np.sum([costs.min(axis=1) for _, costs in sampled_states], axis=0)  # (1)
            # 3. Best sample.
            best, previous_lowest = int(np.argmin(totals)), lowest_cost
            if totals[best] < lowest_cost:
                lowest_cost = float(totals[best])
                best_theta = samples[best]
                centre = values[best]
                for run, (state_deviates, costs) in enumerate(sampled_states):
                    self._deviates[run] = state_deviates[best, np.argmin(costs[best])]
            # 4. Convergence.
            if not lowest_cost < (1.0 - MIN_COST_DECREASE) * previous_lowest:
                break
            if not lowest_cost > EXPLAINED_SQUARES * sample_count:
                break
            # 5. Widths of the next round, which do not increase.
            order = np.argsort(totals)[:BEST_COEFFICIENTS]
            deviation = np.sqrt(np.square(values[order] - centre).mean(axis=0))
            spread = np.minimum(spread, SPREAD_FACTOR * deviation)
            for run, (state_deviates, costs) in enumerate(sampled_states):
                self._update_covariance(run, state_deviates, costs)
        best_states = [
            mean + root @ deviate
            for mean, root, deviate in zip(self._means, self._roots, self._deviates, strict=True)
        ]
        evaluator = self._evaluator
        # Known states keep their values.
        states = np.where(evaluator.known_state_mask, evaluator.initial_state_guesses, best_states)
        return BestSample(best_theta, states, lowest_cost / max(sample_count, 1))

    def _sample_states(self, run: int, samples: Array) -> tuple[Array, Array]:
        """Simulate one run from random initial states, with each of N samples of the parameters.

        An initial state is mean + root @ deviate, with the mean and the root of the covariance of
        the smoothed initial state. For each sample of the parameters, the best deviate so far is
        tried, and M - 1 random ones about it. States that are known are not varied.

        Shapes: P parameters, s states of a run.

        Args:
            run: index of the run.
            samples: (N, P) samples of the parameters.

        Returns:
            Deviates (N, M, s), and costs (N, M): sums of squares of the residual, in units of the
            noise, and of the deviates, in standard deviations of the prior of the fit. The prior is
            wider than the smoothed covariance by `FIRST_STATE_MARGIN`. A failed simulation has an
            infinite cost.
        """
        mean, root = self._means[run], self._roots[run]
        # N samples of the parameters, M initial states of each, s components.
        shape = (len(samples), STATE_SAMPLES, mean.size)
        spread = compute_root(self._covariances[run][None])[0]
        deviates = self._deviates[run] + self._rng.standard_normal(shape) @ spread.T
        # The first one is the best so far.
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

    def _update_covariance(self, run: int, deviates: Array, costs: Array) -> None:
        """Adapt the covariance of the next deviates of a run to the best deviates of this round.

        It becomes the covariance of the best deviates about the best one of all rounds. A share of
        the previous covariance is added, so that the search does not become too narrow.

        Args:
            run: index of the run.
            deviates: (N, M, s) deviates of M initial states for each of N samples of the
                parameters.
            costs: (N, M) their costs.
        """
        order = np.argsort(costs, axis=None)[:BEST_STATES]
        best_deviates = deviates.reshape(-1, deviates.shape[2])[order]
        differences = best_deviates - self._deviates[run]
        covariance = differences.T @ differences / len(order)
        previous = self._covariances[run]
        self._covariances[run] = (1.0 - KEPT_SHARE) * covariance + KEPT_SHARE * previous
