"""Fit coefficients of a robot on the ground by simulations that begin with settled contacts.

The residual r of the simulated pieces, in units of the noise, is projected on what no first state
explains (variable projection; G. Golub, V. Pereyra, Inverse Problems 19, 2003,
doi:10.1088/0266-5611/19/2/201), with Q of `FirstStateFactors`:

    P r,    P = I - Q Q^T                                                                      (1)

The simulated motion jumps slightly where a contact opens or closes, so that the derivative by a
coefficient depends on the size of the difference: a small one shows jumps, which no data confirm.
Reported coefficients c_k therefore have difference quotients over a wide change h_k, with the first
states s fitted anew on both sides,

    J_k = (y(c + h_k e_k, s+) - y(c - h_k e_k, s-)) / (2 h_k)                                  (2)

and a Gauss-Newton step solves J d = r (implicit filtering; C. T. Kelley, Implicit Filtering, 2011,
doi:10.1137/1.9781611971903, chapter 4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import Bounds, get_bounds_by_index
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.kalman.settled_first_states import FirstStateFitter
from bench.diagnosis.prediction_error.effects_at_joints import has_series
from sims.core.simulator import Array
from sims.robot.dynamics.contact_equilibrium import KnownJacobians

DIFFERENCE_SHARE = 0.02
"""Finite change of a coefficient, as a share of its plausible range."""
MAX_REFINEMENTS = 3
"""Maximum number of Gauss-Newton steps of the coefficients before a fit."""
MIN_DECREASE = 0.02
"""Minimum relative decrease of the sum of squares for another Gauss-Newton step."""
TARGET_RESPONSE = 20.0
"""Half the change of the simulation by a wide difference (2), as a norm in units of the noise.

It is so large that jumps of contacts hardly contribute, and so small that the change is linear.
"""
MIN_RESPONSE, MAX_RESPONSE = 10.0, 40.0
"""Range of this half change in which a difference is not chosen anew."""
MAX_TRIED_DIFFERENCES = 3
"""Maximum number of differences that are tried for one coefficient."""
MAX_DIFFERENCE_RATIO = 5.0
"""Maximum ratio of one tried difference to the one before."""
MAX_WIDE_STEPS = 2
"""Maximum number of Gauss-Newton steps with the difference quotients (2)."""


@dataclass(frozen=True)
class SettledSimulations:
    """Simulations of the pieces of a robot on the ground from settled first states.

    Attributes:
        fitter: simulates the pieces, and settles their first states.
        states: (R, 2 D) first positions and velocities of D coordinates in R pieces.
    """

    fitter: FirstStateFitter
    states: Array

    @cached_property
    def _known_jacobians(self) -> list[KnownJacobians]:
        """Derivatives of the contacts at the first states, for each piece.

        A small change of the model leaves them nearly as they are.
        """
        return [{} for _ in self.states]

    def refine(self, start: FitStart) -> FitStart:
        """Return a start with coefficients that minimise the projected residual (1).

        They are improved by a few Gauss-Newton steps with difference quotients, until a step does
        not decrease the sum of squares much. A step that increases it is not made.

        Args:
            start: start of a fit; its first states are kept.
        """
        theta = start.theta
        bounds = get_bounds_by_index(self.fitter.evaluator, start.effects)
        residual = self.compute_residual(theta)
        for _ in range(MAX_REFINEMENTS):
            # Derivatives of the residual by each coefficient.
            columns = []
            for index, (_, high) in bounds.items():
                step = self.get_difference(index)
                changed = theta.copy()
                changed[index] += step if theta[index] + step <= high else -step
                difference = self.compute_residual(changed) - residual
                columns.append(difference / (changed[index] - theta[index]))
            # A simulation may diverge.
            if not np.isfinite(columns).all():
                break
            # The columns are derivatives of the residual itself, so the step cancels it.
            change = np.linalg.lstsq(np.stack(columns, axis=1), -residual, rcond=None)[0]
            changed = theta.copy()
            for (index, (low, high)), value in zip(bounds.items(), change.tolist(), strict=True):
                changed[index] = np.clip(theta[index] + value, low, high)
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
        residual = self.fitter.simulate_residuals(theta, self._settle(theta))
        return self.project(residual[..., None]).reshape(-1)

    def get_difference(self, index: int) -> float:
        """Return the finite change of a coefficient, by its index in theta."""
        low, high = self.fitter.evaluator.parameters[index].bounds
        return DIFFERENCE_SHARE * (float(high) - float(low))

    def simulate_settled(self, theta: Array) -> Array:
        """Simulate all pieces (R, T, C) from first states whose contacts are settled.

        Args:
            theta: (P,) parameters of the model.
        """
        return self.fitter.simulate(theta, self._settle(theta))

    def _settle(self, theta: Array) -> Array:
        """Return the first states (R, 2 D), settled for a model that may have another geometry."""
        return self.fitter.settle(theta, self.states, True, self._known_jacobians)

    def project(self, values: Array) -> Array:
        """Return values without what first states explain, P v of (1).

        Args:
            values: v (R, T, C, K), K changes of the readings in units of the noise, for T samples
                of C channels in R pieces.

        Returns:
            The projected values (R, n, K). The first T C of the n rows are the readings.
        """
        # Orthonormal columns (R, n, 2 D) that span what first states explain, Q of (1).
        bases = self.fitter.factors.q
        runs, samples, channels, count = values.shape
        # The rows after the readings are those of the prior of first states, and stay zero.
        rows = np.zeros((runs, bases.shape[1], count))
        rows[:, : samples * channels] = values.reshape(runs, -1, count)
        projected: Array = rows - bases @ (bases.transpose(0, 2, 1) @ rows)
        return projected


def estimate_settled_start(evaluator: RunEvaluator, noise: NoiseModel, start: FitStart) -> FitStart:
    """Return a start with first states for its parameters, and derivatives by these states.

    For a robot on the ground, another radius or mass has contacts of another depth, and the
    derivatives depend on which contacts are closed. First states are estimated by a filter with the
    start's parameters, then coefficients, then states again. A fit of both together would leave the
    states in which contacts are in equilibrium, and stop there. The improved coefficients and
    states are used if their residual is smaller.

    Args:
        evaluator: the runs of a robot on the ground.
        noise: noise of the channels.
        start: start of a fit.

    Returns:
        The start; the given one for elastic joints, or if the filter diverges.
    """
    # Elastic joints have states that no reading shows, and a filter does not follow them.
    if has_series(evaluator, start.effects):
        return start
    # The first states of the base model are biased by what is missing.
    followed = FollowedRuns.follow(evaluator, start.theta, noise, max_linearisations=1)
    if not followed.has_expected_innovations:
        return start
    states, fitter = followed.improved_first_states, followed.first_state_fitter
    # First the coefficients with these first states, then the first states again.
    refined = SettledSimulations(fitter, states).refine(start)
    refined_states = fitter.fit_settled_states(refined.theta, states)
    cost = fitter.compute_squares(start.theta, states).sum()
    if fitter.compute_squares(refined.theta, refined_states).sum() < cost:
        start, states = refined, refined_states
    return replace(
        start, initial_states=states, state_jacobian=followed.compute_state_sensitivities()
    )


def refine_with_wide_differences(
    fitter: FirstStateFitter, fit: TrajectoryFit, bounds: Mapping[int, Bounds]
) -> TrajectoryFit:
    """Refine the coefficients of a robot on the ground by wide difference quotients (2).

    The simulated motion jumps where contacts open or close. Derivatives by small differences of the
    coefficients show these jumps; differences over a wide change hardly do. A few Gauss-Newton
    steps are made with them, each with first states fitted anew, while they decrease the sum of
    squares.

    Args:
        fitter: simulates the pieces, and fits first states with a linearisation near the fit.
        fit: fit with derivatives by small differences.
        bounds: bounds of the refined coefficients, by index in theta.

    Returns:
        The fit with the difference quotients (2) as derivatives by these coefficients. Its
        parameters and first states are those with the lowest sum of squares; its cost is not
        computed anew. The given fit is returned if a simulation fails.
    """
    theta = fit.theta
    states = fitter.fit_settled_states(theta, fit.initial_states)
    residual = fitter.simulate_residuals(theta, states)
    squares = _sum_squares(residual)
    jacobian = fit.jacobian.copy()
    # Quotients in units of the noise, and the indices in theta of their coefficients.
    columns, indices = list[Array](), list[int]()
    for column, index in enumerate(fit.free_indices.tolist()):
        # Other parameters keep their derivatives by small differences.
        if index not in bounds:
            continue
        indices.append(index)
        # The derivative by small differences tells about how wide the change must be.
        norm = np.sqrt(_sum_squares(fitter.scale_by_noise(fit.parameter_jacobian[..., column])))
        quotient = _compute_wide_quotient(fitter, theta, states, index, bounds[index], norm)
        if not np.isfinite(quotient[np.isfinite(fitter.evaluator.observed)]).all():
            return fit
        jacobian[..., column] = quotient
        columns.append(np.nan_to_num(fitter.scale_by_noise(quotient)).reshape(-1))
    if not columns or not np.isfinite(squares):
        return fit
    # (n, k) for all n samples and k coefficients. The residual is the readings minus the simulated
    # ones, so that the step d solves J d = r.
    derivatives = np.stack(columns, axis=1)
    for _ in range(MAX_WIDE_STEPS):
        step = np.linalg.lstsq(derivatives, np.nan_to_num(residual).reshape(-1), rcond=None)[0]
        tried = theta.copy()
        for index, change in zip(indices, step.tolist(), strict=True):
            tried[index] = np.clip(theta[index] + change, *bounds[index])
        tried_states = fitter.fit_settled_states(tried, states)
        tried_residual = fitter.simulate_residuals(tried, tried_states)
        if not _sum_squares(tried_residual) < squares:
            break
        theta, states, residual = tried, tried_states, tried_residual
        squares = _sum_squares(residual)
    # First states with settled contacts may be worse than those of the fit.
    if squares > _sum_squares(fitter.scale_by_noise(fitter.evaluator.observed - fit.simulated)):
        return replace(fit, jacobian=jacobian, is_own_jacobian=True)
    return replace(
        fit,
        theta=theta,
        initial_states=states,
        simulated=fitter.simulate(theta, states),
        jacobian=jacobian,
        is_own_jacobian=True,
    )


def _compute_wide_quotient(
    fitter: FirstStateFitter, theta: Array, states: Array, index: int, bounds: Bounds, norm: float
) -> Array:
    """Compute the difference quotient (2) of the readings by one coefficient.

    It is the change of the simulated readings between an increased and a decreased coefficient,
    with first states fitted anew on both sides, divided by the change of the coefficient. The width
    is adapted until the readings change by about `TARGET_RESPONSE` on either side.

    Args:
        fitter: simulates the pieces, and fits their first states.
        theta: (P,) parameters.
        states: (R, 2 D) first states.
        index: index of the coefficient in theta.
        bounds: bounds of the coefficient; the difference ends at them.
        norm: norm of the derivative by small differences, in units of the noise, as a first guess.

    Returns:
        The quotient (R, T, C) for T samples of C channels in R pieces, in the unit of each channel
        per unit of the coefficient.
    """
    low, high = bounds
    # Half the change of the coefficient, with which a response of this norm reaches the target; at
    # most the whole range.
    half = float(TARGET_RESPONSE / max(norm, TARGET_RESPONSE / (high - low)))
    for _ in range(MAX_TRIED_DIFFERENCES):
        ends, simulated = [], []
        for sign in (1.0, -1.0):
            changed = theta.copy()
            changed[index] = np.clip(theta[index] + sign * half, low, high)
            ends.append(changed[index])
            simulated.append(fitter.simulate(changed, fitter.fit_settled_states(changed, states)))
        difference = simulated[0] - simulated[1]
        # The smallest number avoids a division by zero if the bounds are equal.
        quotient: Array = difference / max(ends[0] - ends[1], np.finfo(float).tiny)
        response = 0.5 * np.sqrt(_sum_squares(fitter.scale_by_noise(difference)))
        if MIN_RESPONSE < response < MAX_RESPONSE or not np.isfinite(response):
            break
        # The width is divided by the clipped ratio, because the response may be zero.
        ratio = np.clip(
            response / TARGET_RESPONSE, 1.0 / MAX_DIFFERENCE_RATIO, MAX_DIFFERENCE_RATIO
        )
        half /= float(ratio)
    return quotient


def _sum_squares(values: Array) -> float:
    """Return the sum of squares over all samples that are present; infinite if it overflows."""
    total = float(np.nansum(np.square(values)))
    return total if np.isfinite(total) else np.inf
