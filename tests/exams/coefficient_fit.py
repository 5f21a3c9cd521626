"""Fit the coefficients of a cause to a residual, by simulations of the exam's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sims.core.simulator import Array

FIRST_DAMPING = 1e-3  # first damping factor of the Levenberg-Marquardt method
MAX_DAMPING_TRIALS = 8  # maximum number of damping factors tried in one step
CONVERGED_STEP = 1e-4  # step at which a fit has converged, in scaled units
FINITE_DIFFERENCE_STEP = 1e-3  # in scaled units


def fit_coefficients(
    compute_residual: Callable[[Array], Array], start: Array, low: Array, high: Array, steps: int
) -> Array:
    """Minimise a sum of squares within bounds by the Levenberg-Marquardt method.

    Each step solves the damped normal equations with a Jacobian by finite differences. A step that
    makes the residual larger is tried again with more damping; the fit ends if no damping helps.

    Args:
        compute_residual: residual (N,) as a function of the scaled coefficients.
        start: scaled coefficients at which the fit begins, (P,).
        low: lower bounds, (P,).
        high: upper bounds, (P,).
        steps: maximum number of steps.

    Returns:
        The fitted coefficients, (P,).
    """
    coefficients, residual, damping = start, compute_residual(start), FIRST_DAMPING
    for _ in range(steps):
        columns = [
            (compute_residual(coefficients + FINITE_DIFFERENCE_STEP * unit) - residual)
            / FINITE_DIFFERENCE_STEP
            for unit in np.eye(coefficients.size)
        ]
        jacobian = np.stack(columns, axis=1)
        normal_matrix, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        # The small number keeps columns of zeros solvable.
        scaling = np.diag(np.diag(normal_matrix) + 1e-12)
        for _ in range(MAX_DAMPING_TRIALS):
            step = np.linalg.solve(normal_matrix + damping * scaling, gradient)
            trial = np.clip(coefficients - step, low, high)
            trial_residual = compute_residual(trial)
            # The comparison is false for values that are not finite.
            if trial_residual @ trial_residual <= residual @ residual:
                break
            damping *= 8
        else:
            return coefficients
        damping /= 5
        has_converged = np.abs(trial - coefficients).max() < CONVERGED_STEP
        coefficients, residual = trial, trial_residual
        if has_converged:
            break
    return coefficients
