"""Fit coefficients of a robot on the ground by simulations that begin with settled contacts.

With the residual r of the simulated pieces, its derivatives H by the first states, both divided by
the noise, and the prior standard deviations p of first states, the projected residual is

    P r,    P = I - Q Q^T,    Q R = [H; diag(1 / p)]                                           (1)

so that only what no first state explains counts (variable projection; G. Golub, V. Pereyra, Inverse
Problems 19, 2003, doi:10.1088/0266-5611/19/2/201).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import get_bounds_by_index
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.kalman.candidate_responses import FollowedRuns
from sims.core.simulator import Array

DIFFERENCE_SHARE = 0.02
"""Finite change of a coefficient, as a share of its plausible range."""
MAX_REFINEMENTS = 3
"""Maximum number of Gauss-Newton steps of the coefficients before a fit."""
MIN_DECREASE = 0.02
"""Minimum relative decrease of the sum of squares for another Gauss-Newton step."""


@dataclass(frozen=True)
class SettledSimulations:
    """Simulations of the pieces of a robot on the ground from settled first states.

    Attributes:
        evaluator: the pieces.
        followed: linearised model of the pieces.
        states: (R, 2 D) first positions and velocities of D coordinates in R pieces.
    """

    evaluator: RunEvaluator
    followed: FollowedRuns
    states: Array

    def refine(self, start: FitStart) -> FitStart:
        """Return a start with coefficients that minimise the projected residual (1).

        Args:
            start: start whose coefficients are improved by Gauss-Newton steps.
        """
        theta = start.theta
        bounds = get_bounds_by_index(self.evaluator, start.effects)
        residual = self.compute_residual(theta)
        for _ in range(MAX_REFINEMENTS):
            columns = []
            for place, (_, high) in bounds.items():
                step = self.get_difference(place)
                changed = theta.copy()
                changed[place] += step if theta[place] + step <= high else -step
                difference = self.compute_residual(changed) - residual
                columns.append(difference / (changed[place] - theta[place]))
            if not np.isfinite(columns).all():
                break
            change = np.linalg.lstsq(np.stack(columns, axis=1), -residual, rcond=None)[0]
            changed = theta.copy()
            for (place, (low, high)), value in zip(bounds.items(), change.tolist(), strict=True):
                changed[place] = np.clip(theta[place] + value, low, high)
            new_residual = self.compute_residual(changed)
            before, after = residual @ residual, new_residual @ new_residual
            if not after < before:
                break
            theta, residual = changed, new_residual
            if after > (1.0 - MIN_DECREASE) * before:
                break
        return replace(start, theta=theta)

    def compute_cost(self, theta: Array) -> float:
        """Return the sum of squares of the projected residual (1); infinite if it diverges.

        Args:
            theta: (P,) parameters of the model.
        """
        residual = self.compute_residual(theta)
        cost = float(residual @ residual)
        return cost if np.isfinite(cost) else np.inf

    def compute_residual(self, theta: Array) -> Array:
        """Return the projected residual (1) of a simulation from settled first states, (n,).

        Args:
            theta: (P,) parameters of the model.
        """
        residual = self.evaluator.observed - self.simulate_settled(theta)
        return self.project(residual[..., None]).reshape(-1)

    def get_difference(self, place: int) -> float:
        """Return the finite change of a coefficient, by its index in theta."""
        low, high = self.evaluator.parameters[place].bounds
        return DIFFERENCE_SHARE * (float(high) - float(low))

    def simulate_settled(self, theta: Array) -> Array:
        """Simulate all pieces (R, T, C) from first states whose contacts are settled.

        Args:
            theta: (P,) parameters of the model.
        """
        return self.simulate(
            theta, self.followed.settle(theta, self.states, is_other_geometry=True)
        )

    def simulate(self, theta: Array, states: Array) -> Array:
        """Simulate all pieces (R, T, C) from first states (R, 2 D) as they are.

        Args:
            theta: (P,) parameters of the model.
            states: first positions and velocities.
        """
        runs = len(states)
        return self.evaluator.simulate(np.tile(theta, (runs, 1)), np.arange(runs), states)

    def project(self, values: Array) -> Array:
        """Return P v of (1), (R, n, K), for values v (R, T, C, K) of the readings.

        Unrecorded samples count as zero.
        """
        followed = self.followed
        runs, samples, channels, count = values.shape
        with np.errstate(all="ignore"):
            scaled = values / followed.noise.sigma[:, None]
        scaled[~followed.runs.recorded] = 0.0
        rows = np.zeros((runs, len(self._bases[0]), count))
        rows[:, : samples * channels] = scaled.reshape(runs, -1, count)
        projected: Array = np.array(
            [
                run_rows - basis @ (basis.T @ run_rows)
                for basis, run_rows in zip(self._bases, rows, strict=True)
            ]
        )
        return projected

    @cached_property
    def _bases(self) -> list[Array]:
        """Q of (1) for each run; the rows are readings, then the prior of first states."""
        followed = self.followed
        derivatives = followed.compute_state_sensitivities() / followed.noise.sigma[:, None]
        derivatives[~followed.runs.recorded] = 0.0
        prior = followed.get_state_prior()
        assert prior is not None
        size = derivatives.shape[3]
        return [
            np.linalg.qr(np.concatenate([rows.reshape(-1, size), np.diag(1.0 / prior)]))[0]
            for rows in derivatives
        ]
