"""Levenberg-Marquardt step for shared parameters and initial states, and its difference steps.

Run i has the residual r_i. The shared parameters x change it by A_i, and the initial state z_i of
the run changes it by B_i. The prior of z_i has mean g_i and standard deviation π. The cost is

    F = Σ_i |r_i|² + Σ_i |d_i|²,   d_i = (z_i - g_i) / π                                         (1)

A Gauss-Newton step linearises r. The initial state of a run does not influence other runs, so the
normal equations have arrowhead structure (B. Triggs et al., Bundle adjustment, 2000,
doi:10.1007/3-540-44480-7_21, section 6), here with U = Σ A_iᵀ A_i, W_i = A_iᵀ B_i and V_i = B_iᵀ
B_i + π⁻²:

    U δx + Σ_i W_i δz_i = a,          a = Σ A_iᵀ r_i                                             (2)
    W_iᵀ δx + V_i δz_i = b_i,         b_i = B_iᵀ r_i - d_i / π                                   (3)

Levenberg-Marquardt damping adds λ times the diagonal of U to U, and for each initial state its own
λ times the diagonal of V_i to V_i (J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed.,
section 10.3). Initial states are eliminated run by run. This leaves the Schur complement for the
shared parameters, from which the initial states follow:

    (U - Σ W_i V_i⁻¹ W_iᵀ) δx = a - Σ W_i V_i⁻¹ b_i                                              (4)
    δz_i = V_i⁻¹ b_i - V_i⁻¹ W_iᵀ δx                                                             (5)

The work therefore grows linearly with the number of runs. If r were linear, (1) would decrease by

    Σ |r_i|² - |r_i - A_i δx - B_i δz_i|² + Σ |d_i|² - |d_i + δz_i / π|²                         (6)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import Indices
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from sims.core.simulator import Array

MIN_DIAGONAL = 1e-12
"""Minimum diagonal element of U, so that unknowns without any response are damped."""
RIDGE_SHARE = 1e-9
"""Share of its diagonal that is always added to U.

Without it, parameters with the same response would make U singular if there is no damping.
"""


@dataclass(frozen=True)
class GaussNewtonStep:
    """A step to try.

    Attributes:
        parameter_step: (q,) step of the shared parameters.
        state_steps: (R, s) step of the initial states.
        predicted_decrease: predicted decrease of the cost.
        predicted_decreases: (R, C) predicted decrease of the squared residual of each channel.
    """

    parameter_step: Array
    state_steps: Array
    predicted_decrease: float
    predicted_decreases: Array


@dataclass(frozen=True)
class _ArrowheadEquations:
    """The normal equations, eqs. (2) and (3), of R runs, q shared parameters and s initial states.

    Attributes:
        shared: (q, q) U.
        cross: (R, q, s) all W_i.
        inner: (R, s, s) all V_i.
        gradient: (q,) a.
        pull: (R, s) all b_i.
    """

    shared: Array
    cross: Array
    inner: Array
    gradient: Array
    pull: Array

    def solve(self, blocked_mask: Mask) -> tuple[Array, Array]:
        """Solve the normal equations for one damped step, by the Schur complement.

        The equations are U dx + sum W_i dz_i = a and, for each run i, W_i' dx + V_i dz_i = b_i,
        for the step dx of the shared parameters and the steps dz_i of the initial states. The
        initial states of a run influence only this run, so they are eliminated first. The step of
        the parameters follows from (U - sum W_i V_i^-1 W_i') dx = a - sum W_i V_i^-1 b_i, eq. (4),
        and that of the initial states of run i from dz_i = V_i^-1 b_i - V_i^-1 W_i' dx, eq. (5).
        The fields `shared`, `cross`, `inner`, `gradient` and `pull` are U, W, V, a and b.

        Shapes: R runs, q fitted parameters, s states of a run.

        Args:
            blocked_mask: (q,) mask of parameters that do not move, because they are at a bound.

        Returns:
            The steps of the shared parameters (q,) and of the initial states (R, s); NaN if the
            derivatives give no usable step.
        """
        # The matrix of (4), and V⁻¹ Wᵀ of all runs.
        schur, inverse_cross = compute_schur_complement(self.shared, self.cross, self.inner)
        # V⁻¹ b of all runs.
        columns = self.pull[:, :, None]
        inverse_pull = np.linalg.solve(self.inner, columns)[:, :, 0]

        # Right-hand side of (4).
        right_hand_side = self.gradient - np.einsum("rqs,rs->q", self.cross, inverse_pull)

        parameter_step = np.zeros(len(right_hand_side))
        is_free = ~blocked_mask
        if is_free.any():
            free = schur[np.ix_(is_free, is_free)]
            # Scale the parameters: curvatures of an outlet of 1e-6 m^2 and of a lag of seconds
            # differ by more than double precision resolves, and the smaller one would be treated as
            # zero.
            scale = np.sqrt(np.maximum(np.diagonal(self.shared)[is_free], MIN_DIAGONAL))
            scaled = free / np.outer(scale, scale)
            # Derivatives of an unstable motion give no usable step.
            if not np.isfinite(scaled).all():
                return np.full(len(right_hand_side), np.nan), np.full(self.pull.shape, np.nan)
            # Least squares takes the shortest step if parameters have the same response.
            solution = np.linalg.lstsq(scaled, right_hand_side[is_free] / scale, rcond=None)
            parameter_step[is_free] = solution[0] / scale

        state_steps = inverse_pull - np.einsum("rsq,q->rs", inverse_cross, parameter_step)  # (5)
        return parameter_step, state_steps


def compute_schur_complement(shared: Array, cross: Array, inner: Array) -> tuple[Array, Array]:
    """Eliminate the initial states of every run from the normal equations.

    The normal equations are U dx + sum_i W_i dz_i = a and W_i' dx + V_i dz_i = b_i, for the steps
    dx of the shared parameters and dz_i of the initial state of run i. The Schur complement U -
    sum_i W_i V_i^-1 W_i' is the matrix of eq. (4) of the module docstring, the equations of the
    shared parameters alone.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        shared: (q, q) matrix U of the shared parameters.
        cross: (R, q, s) matrix W_i of each run, which couples parameters and initial states.
        inner: (R, s, s) matrix V_i of the initial states of each run.

    Returns:
        The Schur complement (q, q), and all V_i⁻¹ W_iᵀ (R, s, q).
    """
    transposed = cross.transpose(0, 2, 1)
    inverse_cross = np.asarray(np.linalg.solve(inner, transposed), dtype=np.float64)
    products = np.matmul(cross, inverse_cross)
    schur_complement: Array = shared - products.sum(axis=0)
    return schur_complement, inverse_cross


def hold_known_states(inner: Array, cross: Array, known_mask: Mask) -> tuple[Array, Array]:
    """Fix known initial states in the normal equations of a Gauss-Newton step.

    The equation of a known state becomes: its step is zero. No parameter and no other state is
    coupled to it. The caller sets the right-hand side of this equation to zero.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        inner: (R, s, s) matrix V_i of the initial states of each run.
        cross: (R, q, s) matrix W_i of each run, which couples parameters and initial states.
        known_mask: (R, s) mask of known initial states.

    Returns:
        The changed V_i and W_i.
    """
    # Elements in the row or the column of a known state become those of the identity matrix.
    is_coupled = known_mask[:, :, None] | known_mask[:, None, :]
    decoupled = np.where(is_coupled, np.eye(inner.shape[1]), inner)
    return decoupled, np.where(known_mask[:, None, :], 0.0, cross)


def compute_gauss_newton_step(
    residual: Array,
    jacobian: Array,
    q: int,
    drift: Array,
    prior: Array,
    known_mask: Mask,
    damping: float,
    state_damping: Array,
    blocked_mask: Mask,
) -> GaussNewtonStep:
    """Compute one damped Gauss-Newton step of parameters and initial states.

    1. Assemble the normal equations, and add the damping.
    2. Solve them.
    3. Predict the decrease of the cost, with which the damping is adapted later.

    Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

    Args:
        residual: (R, T, C) whitened residual, observed minus simulated.
        jacobian: (R, T, C, q + s) whitened derivatives of the simulation; initial states last.
        q: number q of shared parameters.
        drift: (R, s) deviations d of the initial states from their guesses, in units of the prior.
        prior: (s,) standard deviation π of each initial state about its guess, eq. (1).
        known_mask: (R, s) mask of initial states that do not move, because they are known.
        damping: Levenberg-Marquardt damping λ of the parameters.
        state_damping: (R, s) damping of each initial state.
        blocked_mask: (q,) mask of parameters that do not move, because they are at a bound.
    """
    runs, size = len(residual), jacobian.shape[3]
    run_jacobians = jacobian.reshape(runs, -1, size)
    run_residuals = residual.reshape(runs, -1)
    # 1. Equations.
    equations = _apply_damping(
        _assemble_normal_equations(run_jacobians, run_residuals, q, drift, prior),
        damping,
        state_damping,
        known_mask,
    )
    # 2. Solution.
    parameter_step, state_steps = equations.solve(blocked_mask)
    # 3. Decrease.
    decreases = _predict_decreases(residual, jacobian, parameter_step, state_steps)
    remaining_drift = drift + state_steps / prior
    predicted_decrease = decreases.sum() + (drift**2 - remaining_drift**2).sum()  # (6)
    return GaussNewtonStep(parameter_step, state_steps, float(predicted_decrease), decreases)


def _assemble_normal_equations(
    jacobian: Array,
    residual: Array,
    q: int,
    drift: Array,
    prior: Array,
) -> _ArrowheadEquations:
    """Assemble the normal equations, eqs. (2) and (3), of all runs, without damping.

    They are U dx + sum_i W_i dz_i = a and W_i' dx + V_i dz_i = b_i, for the step dx of the
    parameters and the step dz_i of the initial state of each run. With the derivatives A_i by the
    parameters, B_i by the initial state, and the residual r_i: U = sum A_i'A_i, W_i = A_i'B_i, V_i
    = B_i'B_i + 1 / pi^2, a = sum A_i'r_i, b_i = B_i'r_i - d_i / pi.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        jacobian: (R, n, q + s) whitened derivatives, those by initial states last; n samples.
        residual: (R, n) whitened residuals.
        q: number q of shared parameters.
        drift: (R, s) deviations d of the initial states from their guesses, eq. (1).
        prior: (s,) standard deviation π of each initial state about its guess, eq. (1).
    """
    state_columns = slice(q, jacobian.shape[2])
    # One product contains all AᵀA, AᵀB and BᵀB, another one all Aᵀr and Bᵀr.
    transposed = jacobian.transpose(0, 2, 1)
    normal = np.matmul(transposed, jacobian)
    residuals = residual[:, :, None]
    right_hand_side = np.matmul(transposed, residuals)[:, :, 0]
    return _ArrowheadEquations(
        shared=normal[:, :q, :q].sum(axis=0),  # U
        cross=normal[:, :q, state_columns].copy(),  # W
        inner=normal[:, state_columns, state_columns] + np.diag(1.0 / prior**2),  # V
        gradient=right_hand_side[:, :q].sum(axis=0),  # a
        pull=right_hand_side[:, state_columns] - drift / prior,  # b
    )


def _apply_damping(
    equations: _ArrowheadEquations, damping: float, state_damping: Array, known_mask: Mask
) -> _ArrowheadEquations:
    """Add the damping to the normal equations, and hold known initial states fixed.

    A small ridge is always added to U, so that it can be inverted if two parameters have the same
    response.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        equations: normal equations with the blocks U of the parameters and V of the initial states.
        damping: damping λ of the parameters, without unit; it is multiplied by the diagonal of U.
        state_damping: (R, s) damping of each initial state, for the diagonal of V.
        known_mask: (R, s) mask of the known initial states.
    """
    # Diagonals of all V, (R, s).
    diagonal = np.einsum("rii->ri", equations.inner)
    added = state_damping * diagonal
    inner = equations.inner + added[:, :, None] * np.eye(equations.inner.shape[1])
    inner, cross = hold_known_states(inner, equations.cross, known_mask)
    pull = np.where(known_mask, 0.0, equations.pull)

    # Diagonal of U, (q,).
    scale = np.maximum(np.diagonal(equations.shared), MIN_DIAGONAL)
    shared = equations.shared + np.diag(damping * scale + RIDGE_SHARE * scale + MIN_DIAGONAL)
    return _ArrowheadEquations(shared, cross, inner, equations.gradient, pull)


def _predict_decreases(
    residual: Array, jacobian: Array, parameter_step: Array, state_steps: Array
) -> Array:
    """Return by how much a step would decrease the squared residuals (R, C) if they were linear.

    Their sum is the first part of eq. (6): for run i, |r_i|^2 - |r_i - A_i dx - B_i dz_i|^2 with
    the derivatives A_i by the parameters and B_i by the initial state. The damping is adapted to
    how well the actual decreases agree with them.

    Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

    Args:
        residual: (R, T, C) whitened residuals r.
        jacobian: (R, T, C, q + s) whitened derivatives, those by initial states last.
        parameter_step: (q,) step dx of the shared parameters.
        state_steps: (R, s) steps dz of the initial states.
    """
    repeated = np.tile(parameter_step, (len(residual), 1))
    steps = np.concatenate([repeated, state_steps], axis=1)
    remaining = residual - np.matmul(jacobian, steps[:, None, :, None])[..., 0]
    decreases: Array = (residual**2 - remaining**2).sum(axis=1)
    return decreases


TARGET_RESPONSE_SIGMAS = 0.1
"""Target RMS change of the observations by a finite-difference step, in units of the noise."""
INITIAL_PARAMETER_STEP = 1e-4
"""Initial finite-difference step of a parameter, as a share of its range."""
INITIAL_STATE_STEP = 1e-5
"""Initial finite-difference step of an initial state, SI units."""
MAX_STEP = 1e-2
"""Maximum finite-difference step: a share of the range of a parameter; SI units for a state."""
MIN_STEP_RATIO = 1e-5
"""Minimum finite-difference step, as a share of the maximum; smaller steps suffer from rounding."""
MAX_RESPONSE = 1e30
"""Maximum magnitude of a usable derivative; its square is still finite.

Larger values come from an unstable motion, which says nothing about motions near the data.
"""


def is_finite_response(changes: Array) -> Mask:
    """Return a mask of usable changes: not NaN, and of a magnitude below `MAX_RESPONSE`."""
    # Two comparisons avoid the modulus, which would copy one of the largest arrays.
    is_finite: Mask = (changes > -MAX_RESPONSE) & (changes < MAX_RESPONSE)
    return is_finite


def build_displaced_inputs(
    start: FitStart, free: Indices, steps: Array, state_indices: Indices
) -> tuple[Array, Array]:
    """Return the parameters and initial states to simulate for a finite-difference Jacobian.

    The first entry is not displaced. Each further entry has one unknown displaced by its step. An
    initial state is displaced in all runs at once, because it influences only its own run: one
    simulation of all runs gives all its derivatives.

    Shapes: R runs, P parameters, q fitted parameters, s states of a run.

    Args:
        start: point at which the Jacobian is computed.
        free: (q,) indices of the fitted parameters.
        steps: (q + s,) displacements.
        state_indices: (n,) indices of the initial states to displace.

    Returns:
        Parameters (1 + q + n, P) and initial states (1 + q + n, R, s).
    """
    q, state_count = free.size, state_indices.size
    theta = np.tile(start.theta, (1 + q + state_count, 1))
    states = np.tile(start.initial_states, (1 + q + state_count, 1, 1))
    for entry, parameter_index in enumerate(free, start=1):
        theta[entry, parameter_index] += steps[entry - 1]
    for entry, state_index in enumerate(state_indices, start=1 + q):
        states[entry, :, state_index] += steps[q + state_index]
    return theta, states


def compute_difference_steps(jacobian: Array, noise: NoiseModel, widths: Array) -> Array:
    """Return steps (q + s,) that change the observations by `TARGET_RESPONSE_SIGMAS` of the noise.

    The steps are for q parameters and s initial states. With smaller steps, rounding dominates the
    difference quotient; with larger ones, curvature does. The responses come from the previous
    Jacobian.

    Shapes: R runs, T samples, C channels, q fitted parameters.

    Args:
        jacobian: (R, T, C, q + s) derivatives from earlier finite differences.
        noise: noise of each channel.
        widths: (q,) widths of the parameter ranges.
    """
    squares = np.square(jacobian / noise.sigma[:, None])
    responses = np.sqrt(np.mean(squares, axis=(0, 1, 2)))
    max_state_steps = np.full(len(responses) - len(widths), MAX_STEP)
    max_steps = np.concatenate([MAX_STEP * widths, max_state_steps])
    # An unknown without any response gets the maximum step.
    with np.errstate(divide="ignore"):
        target_steps = TARGET_RESPONSE_SIGMAS / np.where(responses > 0, responses, 1e-300)
    steps: Array = np.clip(target_steps, MIN_STEP_RATIO * max_steps, max_steps)
    return steps
