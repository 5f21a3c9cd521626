"""Simulate proposals, and score them against one target's observation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sims.core.simulator import Array

if TYPE_CHECKING:
    from bench.benchmark.problem.recorded_runs import ObservedRuns
    from bench.benchmark.problem.tuning_problem import TuningProblem


class ProposalEvaluator:
    """Evaluator of unit-cube points: simulates them, and computes and stores their errors.

    The loss of simulated y against observed o, over C channels of scale s and the N_c present
    samples of each, is the root mean square

        L^2 = 1/C sum_c 1/(N_c s_c^2) S_c,   S_c = sum_t (y_tc - o_tc)^2        (1)
        RMSE_c^2 = S_c / N_c                                                    (2)

    Args:
        problem: tuning problem.
        side: runs of the target with their observations.
    """

    def __init__(self, problem: TuningProblem, side: ObservedRuns) -> None:
        """Prepare factors that convert sums of squared errors to the loss (1) and to the RMSE (2).

        `_missing` marks missing samples (T, C), or is None. `_mean_factors` and
        `_loss_factors` (C,) are the factors 1/N_c of (2) and 1/(C N_c s_c^2) of (1), for C channels
        with N_c samples and the scale s_c. `_evaluated_squares` collects
        the sums of squares (n, C) of all batches, from which `compute_rmse` looks up points.
        """
        self._problem = problem
        self._scenarios = side.scenarios
        missing = np.isnan(side.observed)
        self._missing = missing if missing.any() else None
        self._observed = np.where(missing, 0.0, side.observed)
        # For a channel without samples the divisor must not be zero.
        sample_counts = np.maximum((~missing).sum(axis=0), 1)
        self._mean_factors = 1.0 / sample_counts  # (2)
        self._loss_factors = 1.0 / (sample_counts * problem.scale**2 * len(problem.scale))  # (1)
        self._single_loss_factor = float(self._loss_factors[0])
        self._evaluated_squares: list[Array] = []

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Simulate points and compute their losses.

        Args:
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, T, C) and losses (n,); NaN and infinite if the simulation failed.
        """
        observations = self._problem.simulate(points, self._scenarios)
        single = observations.shape[0] == observations.shape[2] == 1
        if single and self._missing is None:
            return observations, self._compute_single_loss(observations)
        squares = self._sum_squared_errors(observations)
        self._evaluated_squares.append(squares)
        losses: Array = np.sqrt(squares @ self._loss_factors)  # (1)
        # The loss of a failed simulation is infinite, because comparisons with NaN are always
        # false.
        if not all(map(math.isfinite, losses.tolist())):
            losses[~np.isfinite(losses)] = np.inf
        return observations, losses

    def _compute_single_loss(self, observations: Array) -> Array:
        """Compute the loss (1,) of one observation of one channel without missing samples.

        Most evaluations are of this kind, and this takes a third of the time of the general case.
        """
        difference = (observations - self._observed).ravel()
        square = float(difference.dot(difference))  # S of (1)
        self._evaluated_squares.append(np.array([[square]]))
        loss = square * self._single_loss_factor
        return np.array([math.sqrt(loss) if math.isfinite(loss) else math.inf])

    def _sum_squared_errors(self, observations: Array) -> Array:
        """Compute sums (n, C) of squared errors over present samples, in squared channel units."""
        difference = observations - self._observed
        if self._missing is not None:
            difference[:, self._missing] = 0.0
        # Squared in place, because the observations of a large batch would not fit in memory twice.
        difference *= difference
        sums: Array = np.add.reduce(difference, axis=1)
        return sums

    def compute_rmse(self, proposals: Array, recommendations: Array) -> Array:
        """Compute the RMS errors of recommended points, in channel units.

        Points among `proposals` are looked up. The others are simulated outside the tuner's budget,
        because these simulations only measure the error.

        Args:
            proposals: (m, dim) points simulated so far, in their order.
            recommendations: (k, dim) recommended points.

        Returns:
            (k, C) root-mean-square errors.
        """
        rows_by_point = {
            point.tobytes(): row
            for point, row in zip(proposals, self._stack_evaluated_rows(), strict=True)
        }
        result = np.empty((len(recommendations), len(self._mean_factors)))
        for i, point in enumerate(recommendations):
            # Points are compared by their bytes, so that only an identical point is looked up.
            key = point.tobytes()
            if key not in rows_by_point:
                rows_by_point[key] = self._sum_squared_errors(
                    self._problem.simulate(point[None], self._scenarios)
                )[0]
            result[i] = rows_by_point[key]
        errors: Array = np.sqrt(result * self._mean_factors)  # (2)
        return errors

    def _stack_evaluated_rows(self) -> Array:
        return (
            np.concatenate(self._evaluated_squares)
            if self._evaluated_squares
            else np.empty((0, len(self._mean_factors)))
        )
