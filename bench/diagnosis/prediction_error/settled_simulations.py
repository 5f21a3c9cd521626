"""Fit coefficients of a robot on the ground by simulations that begin with settled contacts.

The residual r of the simulated pieces, in units of the noise, is projected on what no first state
explains (variable projection; G. Golub, V. Pereyra, Inverse Problems 19, 2003,
doi:10.1088/0266-5611/19/2/201), with Q of `FirstStateFactors`:

    P r,    P = I - Q Q^T                                                                      (1)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import get_bounds_by_index
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.kalman.candidate_responses import FollowedRuns
from sims.core.simulator import Array
from sims.robot.dynamics.contact_states import KnownJacobians

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
        followed: linearised model of the pieces.
        states: (R, 2 D) first positions and velocities of D coordinates in R pieces.
    """

    followed: FollowedRuns
    states: Array

    @cached_property
    def _known_jacobians(self) -> list[KnownJacobians]:
        """Derivatives of the contacts at the first states, for each piece.

        A small change of the model leaves them nearly as they are.
        """
        return [{} for _ in self.states]

    def refine(self, start: FitStart) -> FitStart:
        """Return a start with coefficients that minimise the projected residual (1).

        Args:
            start: start whose coefficients are improved by Gauss-Newton steps.
        """
        theta = start.theta
        bounds = get_bounds_by_index(self.followed.evaluator, start.effects)
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
        residual = self.followed.simulate_residuals(theta, self._settle(theta))
        return self.project(residual[..., None]).reshape(-1)

    def get_difference(self, place: int) -> float:
        """Return the finite change of a coefficient, by its index in theta."""
        low, high = self.followed.evaluator.parameters[place].bounds
        return DIFFERENCE_SHARE * (float(high) - float(low))

    def simulate_settled(self, theta: Array) -> Array:
        """Simulate all pieces (R, T, C) from first states whose contacts are settled.

        Args:
            theta: (P,) parameters of the model.
        """
        return self.followed.simulate(theta, self._settle(theta))

    def _settle(self, theta: Array) -> Array:
        """Return the first states (R, 2 D), settled for a model that may have another geometry."""
        return self.followed.settle(theta, self.states, True, self._known_jacobians)

    def project(self, values: Array) -> Array:
        """Return P v of (1), (R, n, K), for values v (R, T, C, K) in units of the noise."""
        bases = self.followed.first_state_factors.q
        runs, samples, channels, count = values.shape
        rows = np.zeros((runs, bases.shape[1], count))
        rows[:, : samples * channels] = values.reshape(runs, -1, count)
        projected: Array = rows - bases @ (bases.transpose(0, 2, 1) @ rows)
        return projected
