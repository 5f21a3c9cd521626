"""Simulates and scores proposals against one target's observation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sims.base import Array

if TYPE_CHECKING:
    from bench.problem.problem import Problem
    from bench.problem.recorded import Side


class Evaluator:
    """Unit-cube points -> observations and losses; remembers the squared errors of what it
    simulated.

    The loss of simulated y against observed o, over C channels of scale s and the N_c present
    samples of each, is the root mean square

        L^2 = 1/C sum_c 1/(N_c s_c^2) S_c,   S_c = sum_t (y_tc - o_tc)^2        (1)
        RMSE_c^2 = S_c / N_c                                                    (2)
    """

    def __init__(self, problem: Problem, side: Side) -> None:
        self._problem = problem
        self._scenarios = side.scenarios
        missing = np.isnan(side.observed)
        self._missing = missing if missing.any() else None
        self._observed = np.where(missing, 0.0, side.observed)
        # A channel without a single sample has no error, and must not divide by nothing.
        present = np.maximum((~missing).sum(axis=0), 1)
        self._per_sample = 1.0 / present  # (2)
        self._per_loss = 1.0 / (present * problem.scale**2 * len(problem.scale))  # (1)
        self._only_per_loss = float(self._per_loss[0])
        self._seen: list[Array] = []

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Observations (n, T, C) and losses (n,) of `points` (n, dim); NaN and infinite where the
        simulation failed.
        """
        observations = self._problem.simulate(points, self._scenarios)
        single = observations.shape[0] == observations.shape[2] == 1
        if single and self._missing is None:
            return observations, self._one_loss(observations)
        squares = self._squares(observations)
        self._seen.append(squares)
        losses: Array = np.sqrt(squares @ self._per_loss)  # (1)
        # What failed is worse than anything: NaN would compare as neither.
        if not all(map(math.isfinite, losses.tolist())):
            losses[~np.isfinite(losses)] = np.inf
        return observations, losses

    def _one_loss(self, observations: Array) -> Array:
        """The loss (1,) of one observation of one channel: most evaluations, so worth a third of
        the general way.
        """
        difference = (observations - self._observed).ravel()
        square = float(difference.dot(difference))  # S of (1)
        self._seen.append(np.array([[square]]))
        loss = square * self._only_per_loss
        return np.array([math.sqrt(loss) if math.isfinite(loss) else math.inf])

    def _squares(self, observations: Array) -> Array:
        """Sums (n, C) of squared errors over present samples, in squared channel units."""
        difference = observations - self._observed
        if self._missing is not None:
            difference[:, self._missing] = 0.0
        # In place: observations of a large batch would not fit twice.
        difference *= difference
        sums: Array = np.add.reduce(difference, axis=1)
        return sums

    def rmse(self, proposals: Array, recommendations: Array) -> Array:
        """Root-mean-square errors (k, C), in channel units, of recommended points (k, dim).

        Points among `proposals`, the points simulated so far in their order, are looked up; the
        others are simulated, outside the tuner's budget, since they only measure it.
        """
        known = {point.tobytes(): row for point, row in zip(proposals, self._rows(), strict=True)}
        result = np.empty((len(recommendations), len(self._per_sample)))
        for i, point in enumerate(recommendations):
            # Bytes and not numbers: a point is known only if it is the very one.
            key = point.tobytes()
            if key not in known:
                known[key] = self._squares(self._problem.simulate(point[None], self._scenarios))[0]
            result[i] = known[key]
        errors: Array = np.sqrt(result * self._per_sample)  # (2)
        return errors

    def _rows(self) -> Array:
        return np.concatenate(self._seen) if self._seen else np.empty((0, len(self._per_sample)))
