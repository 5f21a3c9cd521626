"""Levenberg-Marquardt fit of shared parameters and initial states: step, damping and convergence.

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

For a step with predicted decrease p that changed the cost from F to F', the gain ratio is

    ρ = (F - F') / p                                                                             (7)

The damping λ follows ρ by Nielsen's rule (H. B. Nielsen, Damping parameter in Marquardt's method,
IMM-REP-1999-05), but it changes faster in both directions: the original minimum factor is 1/3, the
original growth is ν λ.

    λ ← λ max(0.1, 1 - (2ρ - 1)³),   ν ← 2        if F' < F, and the step is accepted            (8)
    λ ← 2ν λ,                        ν ← 2ν       otherwise                                      (9)

The cost of a robot is rough, and a step may be wrong at one joint of one run only, such as a joint
with a stiff servo, whose first velocity the samples hardly show. If only initial states are fitted,
each of them has its own damping, which follows the squared residual of the channels of its joint by
the same rule, and each run takes its own steps, since no run influences another.

Expensive derivatives J may be used for several steps. They are updated with the unpredicted part of
the change by a step δ, along the step only; D are the scales of the unknowns (C. G. Broyden, Math.
Comp. 19, 577, 1965, doi:10.1090/S0025-5718-1965-0198670-6; for this method: K. Madsen, H. B.
Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004, section 3.3):

    J ← J + (y(x + δ) - y(x) - J δ) δᵀ D⁻² / (δᵀ D⁻² δ)                                         (10)

They are recomputed when predictions become poor: when ρ is far from 1, or F has increased.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import Indices
from sims.core.simulator import Array

MIN_DIAGONAL = 1e-12
"""Minimum diagonal element of U, so that unknowns without any response are damped."""
RIDGE_SHARE = 1e-9
"""Share of its diagonal that is always added to U, or to the normal matrix of `solve_damped`.

Without it, parameters with the same response would make U singular if there is no damping.
"""

INITIAL_DAMPING = 1e-3
"""Initial damping λ of (8)."""
MIN_DAMPING = 1e-10
"""Minimum damping λ; a damping of zero could not grow again."""
MAX_DAMPING = 1e8
"""Maximum damping λ; above it no step decreases the cost, however short."""
INITIAL_DAMPING_GROWTH = 2.0
"""Initial growth factor ν of (9), and the factor by which ν itself grows."""
MIN_DAMPING_FACTOR = 0.1
"""Minimum factor of (8) by which the damping changes after an accepted step."""
MAX_LOSS_SHARE = 0.75
"""Maximum difference of a predicted and an actual decrease of a squared residual, as a share of the
predicted one, at which the damping of a state does not grow.
"""

JACOBIAN_REUSE_TOLERANCE = 0.5
"""Maximum deviation of ρ from 1 at which derivatives are used for another step."""
SHARED_RENEWALS = 2
"""Number of recomputed Jacobians after which a fit gets its own derivatives by initial states.

It applies to models near the data; other models share these derivatives.
"""

CONVERGENCE_TOLERANCE = 0.02
"""Convergence threshold: minimum decrease of the sum of squares by a step, in units of the noise.

A share of the sum of squares, `RELATIVE_CONVERGENCE_TOLERANCE` or `COARSE_SHARE`, is added to it.
"""
RELATIVE_CONVERGENCE_TOLERANCE = 1e-4
"""Convergence threshold as a share of the sum of squares, added to `CONVERGENCE_TOLERANCE`."""
FINAL_CONVERGENCE_TOLERANCE, ROUGH_FINAL_TOLERANCE = 0.002, 0.01
"""Convergence thresholds of fits whose parameters are reported, in units of the noise.

Parameters are then within a twentieth of a standard error of the optimum. The second threshold is
for a cost that is not smooth: within a tenth of a standard error.
"""

# The cost of a robot fit is not smooth: a joint that sticks one integration step later changes it
# by more than the fit can still gain. These constants end such fits.
COARSE_SHARE = 1e-3
"""Convergence threshold as a share of the sum of squares, if the model is far from the data."""
FAR_MEAN_SQUARE = 2.0
"""Mean squared residual, in units of the noise, above which a model is far from the data."""
UNRELIABLE_MEAN_SQUARES = (1.05, 10.0)
"""Mean squared residuals, in units of the noise, that wrong first positions may leave."""
STAGNANT_RATIO = 0.3
"""Maximum gain ratio (7) of a step that ends a fit far from the data."""
STAGNANT_SHARE = 5e-3
"""Maximum gain of a step that ends a fit far from the data, as a share of the sum of squares."""
ROUGHNESS = 3.0
"""Maximum predicted decrease, in units of the noise, at which a bad step ends a rough fit.

A bad step has derivatives of the present point, and is rejected or gains far more or less than
predicted.
"""
EXACT_ROUGHNESS = 1.0
"""Value that replaces `ROUGHNESS` in fits whose parameters are reported."""


class KnownJacobian(NamedTuple):
    """Known derivatives of the runs by some of the parameters, about a nearby point.

    Attributes:
        free_indices: (q,) indices of these parameters in theta.
        jacobian: (R, T, C, q) derivatives.
        is_at_start: whether they are those at the start itself, so that a fit that has converged
            there need not compute them again.
    """

    free_indices: Indices
    jacobian: Array
    is_at_start: bool = False

    def drop_parameters(self, indices: Collection[int]) -> KnownJacobian:
        """Return the derivatives without the columns of some parameters (indices in theta).

        It is used for a model with fewer effects than the one whose derivatives are known.
        """
        kept_columns = [
            j for j, index in enumerate(self.free_indices.tolist()) if index not in indices
        ]
        return KnownJacobian(self.free_indices[kept_columns], self.jacobian[..., kept_columns])

    def add_parameters(self, indices: Sequence[int], jacobian: Array) -> KnownJacobian:
        """Return the derivatives together with those by further parameters.

        Shapes: R runs, T samples, C channels.

        Args:
            indices: (k,) indices of the further parameters in theta.
            jacobian: (R, T, C, k) derivatives by them.
        """
        free = np.concatenate([self.free_indices, np.array(indices, dtype=np.intp)])
        return KnownJacobian(free, np.concatenate([self.jacobian, jacobian], axis=3))


@dataclass(frozen=True)
class FitStart:
    """Start of a fit.

    Attributes:
        effects: names of the active effects.
        theta: (P,) parameters.
        initial_states: (R, s) initial states.
        known_jacobian: derivatives that are known near the start, if any.
        state_jacobian: (R, T, C, s) derivatives by initial states about a model near the start;
            None to use those that all models share.
    """

    effects: tuple[str, ...]
    theta: Array
    initial_states: Array
    known_jacobian: KnownJacobian | None = None
    state_jacobian: Array | None = None


@dataclass(frozen=True)
class TrajectoryFit:
    """A fitted model.

    Attributes:
        effects: names of the active effects.
        theta: (P,) parameters and coefficients.
        initial_states: (R, s) initial states.
        free_indices: (q,) indices of the fitted elements of theta.
        simulated: (R, T, C) simulated observations.
        jacobian: (R, T, C, q + s) derivatives of `simulated`, initial states last.
        cost: sum of squares of the whitened residual.
        is_own_jacobian: whether the derivatives were computed at exactly this point.
    """

    effects: tuple[str, ...]
    theta: Array
    initial_states: Array
    free_indices: Indices
    simulated: Array
    jacobian: Array
    cost: float
    is_own_jacobian: bool = True

    @property
    def parameter_jacobian(self) -> Array:
        """Derivatives (R, T, C, q) of the simulated observations by the fitted parameters."""
        return self.jacobian[..., : self.free_indices.size]

    @property
    def state_jacobian(self) -> Array:
        """Derivatives (R, T, C, s) of the simulated observations by the initial states."""
        return self.jacobian[..., self.free_indices.size :]

    def get_known_jacobian(self) -> KnownJacobian:
        """Return the derivatives by the parameters, for reuse in fits that start nearby."""
        return KnownJacobian(self.free_indices, self.parameter_jacobian)

    def make_start(self) -> FitStart:
        """Return a start with which another fit continues from this one."""
        return FitStart(self.effects, self.theta, self.initial_states)

    def make_start_with_derivatives(self) -> FitStart:
        """Return a start that also has the derivatives by the parameters, if they are its own."""
        start = self.make_start()
        if not self.is_own_jacobian:
            return start
        return replace(start, known_jacobian=self.get_known_jacobian()._replace(is_at_start=True))


@dataclass(frozen=True)
class FitPoint:
    """A point of a fit and its simulation; attributes as those of `TrajectoryFit`."""

    start: FitStart
    simulated: Array
    jacobian: Array
    cost: float


@dataclass
class FitState:
    """State of the fit of one model.

    Attributes:
        point: best point so far.
        free_indices: (q,) indices of the fitted elements of theta.
        low: (q,) lower bounds of the fitted parameters.
        high: (q,) upper bounds of the fitted parameters.
        widths: (q,) widths of the plausible ranges of the parameters.
        steps: (q + s,) step sizes of finite differences.
        channels_of_states: (C, s) mask of the channels whose residuals show each state.
        state_damping: (R, s) λ of the initial states if `fits_rough_states`; otherwise they have
            that of the parameters.
        state_growth: (R, s) ν of the initial states.
        damping: λ of the parameters.
        growth: ν of the parameters.
        predicted_decrease: predicted decrease of the cost by the last step.
        predicted_decreases: (R, C) predicted decrease of the squared residual of each channel.
        is_finished: whether the fit has converged or was eliminated.
        has_own_jacobian: whether the derivatives were computed at the present point, and not at
            another one.
        is_jacobian_stale: whether the derivatives must be recomputed before the next step.
        is_waiting: whether recomputing can wait until the fit is known not to be far behind others.
        is_final_fit: whether the fit continues to the threshold `FINAL_CONVERGENCE_TOLERANCE`.
        has_rough_cost: whether the cost is not smooth at the scale of the noise.
        sample_count: number of samples that count.
        jacobian_renewals: number of times the derivatives were recomputed.
        own_state_jacobian: (R, T, C, s) derivatives by initial states about this model; None to use
            those that all models share.
        own_state_cost: cost at which these derivatives were computed; infinite if they were not.
        can_stick: whether effects of the model may hold a joint at rest.
        has_unreliable_states: whether a step failed, or the fit converged, with derivatives by
            initial states that may be wrong.
    """

    point: FitPoint
    free_indices: Indices
    low: Array
    high: Array
    widths: Array
    steps: Array
    channels_of_states: Mask
    state_damping: Array
    state_growth: Array
    predicted_decreases: Array
    damping: float = INITIAL_DAMPING
    growth: float = INITIAL_DAMPING_GROWTH
    predicted_decrease: float = np.inf
    is_finished: bool = False
    has_own_jacobian: bool = True
    is_jacobian_stale: bool = False
    is_waiting: bool = False
    is_final_fit: bool = False
    has_rough_cost: bool = False
    sample_count: int = 0
    jacobian_renewals: int = 0
    own_state_jacobian: Array | None = None
    own_state_cost: float = np.inf
    can_stick: bool = False
    has_unreliable_states: bool = False

    def compute_state_damping(self) -> Array:
        """Return the damping (R, s) of each initial state for the next step.

        A state has its own damping only if nothing but initial states of a robot is fitted.
        """
        if self.fits_rough_states:
            return self.state_damping
        return np.full_like(self.state_damping, self.damping)

    @property
    def fits_rough_states(self) -> bool:
        """True for the fit of a robot's initial states alone."""
        return self.has_rough_cost and not self.free_indices.size

    @property
    def needs_own_state_jacobian(self) -> bool:
        """True if the derivatives by initial states that all models share are not good enough.

        This is the case if the model is near the data, but its derivatives by parameters had to be
        recomputed several times, or if those by initial states may be wrong
        (`has_unreliable_states`).
        """
        is_slow = (
            self.has_rough_cost
            and self.own_state_jacobian is None
            and self.jacobian_renewals >= SHARED_RENEWALS
        )
        return self.has_unreliable_states or (is_slow and not self._is_far(self.point.cost))

    def _mark_unreliable_state_jacobian(self) -> bool:
        """Mark the derivatives by initial states as unreliable if the shared ones may be wrong.

        Then the fit computes its own about its present model before the next step. Where a joint
        sticks, it keeps an error of its initial position, but the derivatives that all models share
        let this error decay. They may be wrong if

        * the model has dry friction, so that joints may stick;
        * the residual is neither pure noise nor very large, so that this error may be the cause;
        * the fit has improved since its own derivatives were computed.

        Returns:
            Whether the derivatives were marked.
        """
        low, high = UNRELIABLE_MEAN_SQUARES
        is_unreliable = low < self.point.cost / max(self.sample_count, 1) < high
        # The cost at the last own derivatives is infinite if the fit has none yet.
        has_improved = self.point.cost < self.own_state_cost - self.get_tolerance(self.point.cost)
        self.has_unreliable_states = self.can_stick and is_unreliable and has_improved
        if self.has_unreliable_states:
            self.is_jacobian_stale = True
        return self.has_unreliable_states

    def end(self) -> None:
        """End the fit, unless derivatives by initial states about its own model may improve it."""
        self.is_finished = not self._mark_unreliable_state_jacobian()

    def get_tolerance(self, cost: float) -> float:
        """Return the decrease of the cost by a step below which the fit has converged.

        It has an absolute part in units of the noise variance, and a share of the `cost` (the sum
        of squares), which is larger if the model is far from the data. A fit whose parameters are
        reported has only a smaller absolute part.

        Args:
            cost: cost after the step, eq. (1) of the module docstring.
        """
        if self.is_final_fit:
            return ROUGH_FINAL_TOLERANCE if self.has_rough_cost else FINAL_CONVERGENCE_TOLERANCE
        cost_share = COARSE_SHARE if self._is_far(cost) else RELATIVE_CONVERGENCE_TOLERANCE
        return CONVERGENCE_TOLERANCE + cost_share * cost

    def _is_far(self, cost: float) -> bool:
        """Return whether a fit is far from the data and has a rough cost (only robots do).

        The cost of such a fit changes by jumps that are larger than the remaining gain.
        """
        return self.has_rough_cost and cost > FAR_MEAN_SQUARE * self.sample_count

    def _is_rough_at(self, decrease: float) -> bool:
        """Return whether the cost is not smooth at the scale of a decrease (only that of robots).

        It has small jumps, for example where a joint sticks one integration step later.
        """
        return self.has_rough_cost and decrease < (
            EXACT_ROUGHNESS if self.is_final_fit else ROUGHNESS
        )

    def make_fit(self) -> TrajectoryFit:
        """Return the best point so far as a fitted model."""
        point = self.point
        return TrajectoryFit(
            effects=point.start.effects,
            theta=point.start.theta,
            initial_states=point.start.initial_states,
            free_indices=self.free_indices,
            simulated=point.simulated,
            jacobian=point.jacobian,
            cost=point.cost,
            is_own_jacobian=self.has_own_jacobian,
        )

    def compute_inward_steps(self, theta: Array) -> Array:
        """Return signed finite-difference steps (q + s,), which stay within the bounds.

        Steps are positive, except that of a parameter at its upper bound, which points inward.

        Shapes: P parameters, q fitted parameters, s states of a run.

        Args:
            theta: (P,) parameters at which derivatives are computed.
        """
        steps = self.steps.copy()
        parameter_steps = steps[: self.free_indices.size]
        parameter_steps[theta[self.free_indices] + parameter_steps > self.high] *= -1.0
        return steps

    def update_jacobian(self, new_point: FitPoint) -> Array:
        """Return the Jacobian (R, T, C, q + s) at a new point by Broyden's update.

        For the simulation y, a step delta of the unknowns x and their scales D (the difference
        steps), J <- J + (y(x + delta) - y(x) - J delta) delta' D^-2 / (delta' D^-2 delta), eq. (10)
        of the module docstring. Each run is updated separately.

        Shapes: R runs, T samples, C channels, q fitted parameters.

        Args:
            new_point: point that the step has reached, with its simulation.
        """
        point = self.point
        # Samples after the end of a shorter run are NaN, and count as unchanged.
        observed_change = np.nan_to_num(new_point.simulated - point.simulated)
        parameter_change = (new_point.start.theta - point.start.theta)[self.free_indices]
        state_changes = new_point.start.initial_states - point.start.initial_states
        # Step of all unknowns of each run (R, q + s).
        displacement = np.concatenate(
            [
                np.broadcast_to(parameter_change, (len(state_changes), parameter_change.size)),
                state_changes,
            ],
            axis=1,
        )
        scaled_displacement = displacement / np.square(self.steps)
        squared_length = np.sum(scaled_displacement * displacement, axis=1)
        # A run in which nothing was moved gives no information; the infinite divisor makes its
        # update zero.
        broyden_weights = (
            scaled_displacement / np.where(squared_length > 0, squared_length, np.inf)[:, None]
        )
        prediction_error = observed_change - np.einsum("rtcq,rq->rtc", point.jacobian, displacement)
        updated_jacobian: Array = (
            point.jacobian + prediction_error[..., None] * broyden_weights[:, None, None, :]
        )  # (10)
        return updated_jacobian

    def mark_converged(self) -> None:
        """End the fit, which hardly gains any more, if its derivatives belong to the present point.

        Otherwise it waits for new derivatives, which are computed once it is known that the fit is
        not far behind others.
        """
        if self.has_own_jacobian:
            self.end()
        else:
            self.is_jacobian_stale = self.is_waiting = True

    def accept_step(self, decrease: float, cost: float, is_own_jacobian: bool) -> None:
        """Update the damping and the convergence state after a step that has decreased the cost.

        With the gain ratio rho (actual by predicted decrease), the damping becomes lambda max(0.1,
        1 - (2 rho - 1)^3), and its growth factor nu = 2, eq. (8). The fit ends if it has converged,
        stagnates far from the data, or if the cost is too rough to predict.

        Args:
            decrease: decrease of the cost by this step.
            cost: cost after the step.
            is_own_jacobian: whether the derivatives were computed at the point where the step
                began.
        """
        # The minimum avoids a division by zero.
        gain_ratio = decrease / max(self.predicted_decrease, 1e-300)  # (7)
        is_predicted = abs(gain_ratio - 1.0) <= JACOBIAN_REUSE_TOLERANCE
        # `has_own_jacobian` is about the new point. It is false if its derivatives were updated and
        # not computed; such derivatives serve for another step only if this step was predicted
        # well.
        self.is_jacobian_stale = not self.has_own_jacobian and not is_predicted
        self.damping = float(reduce_damping(self.damping, gain_ratio))
        self.growth = INITIAL_DAMPING_GROWTH
        # Far from the data, a fit whose steps gain much less than predicted, and little of the
        # cost, is not worth continuing.
        is_stagnant = gain_ratio < STAGNANT_RATIO and decrease < STAGNANT_SHARE * cost
        if is_own_jacobian and not self.is_final_fit and is_stagnant and self._is_far(cost):
            self.is_finished = True
        # Even derivatives of the point where the step began did not predict it: the cost is too
        # rough at the scale of the remaining gain.
        largest = max(decrease, self.predicted_decrease)
        if is_own_jacobian and not is_predicted and self._is_rough_at(largest):
            self.end()
        # With derivatives of the present point the fit has converged; with others it may have.
        if decrease < self.get_tolerance(cost):
            self.mark_converged()

    def adapt_state_damping(self, decreases: Array, is_moved: Mask) -> None:
        """Update the damping of each initial state after a step of initial states alone.

        The channels of a state are those that show it best: position and velocity of its joint. If
        their squared residual decreased far less than predicted, the damping lambda of the state
        becomes 2 nu lambda with its growth factor nu, which is doubled, eq. (9). Otherwise lambda
        follows the gain ratio (actual by predicted decrease), eq. (8), if the run takes the step.

        Shapes: R runs, C channels, s states of a run.

        Args:
            decreases: (R, C) decrease of the squared residual of each channel by the step.
            is_moved: (R,) mask of the runs that take the step.
        """
        # Sums (R, s) of the decreases over the channels of each state.
        predicted = self.predicted_decreases @ self.channels_of_states
        actual = decreases @ self.channels_of_states
        # A simulation that was abandoned or diverged has no finite decrease.
        with np.errstate(all="ignore"):
            loss = predicted - actual
            # Negated, so that a loss that is NaN also counts as bad.
            is_bad = ~(loss <= MAX_LOSS_SHARE * np.abs(predicted) + CONVERGENCE_TOLERANCE)
            gain_ratios = np.clip(actual / np.maximum(predicted, 1e-300), 0.0, 1.0)
        is_reduced = (predicted > 0.0) & is_moved[:, None]
        reduced = np.where(
            is_reduced, reduce_damping(self.state_damping, gain_ratios), self.state_damping
        )
        grown = INITIAL_DAMPING_GROWTH * self.state_growth
        self.state_damping = np.where(is_bad, self.state_damping * grown, reduced)
        self.state_growth = np.where(is_bad, grown, INITIAL_DAMPING_GROWTH)

    def reject_step(self) -> None:
        """React to a step that did not decrease the cost.

        1. If the derivatives belong to another point, or those by initial states may be wrong, they
           may have caused the bad step, so they are recomputed.
        2. Otherwise a fit with a rough cost ends if it can hardly gain anything.
        3. Otherwise the next step is shorter: the damping lambda becomes 2 nu lambda, and its
           growth factor nu becomes 2 nu, eq. (9).
        """
        # 1. Derivatives.
        if not self.has_own_jacobian:
            self.is_jacobian_stale = True
            return
        # This marks the derivatives by initial states for recomputing if they may be wrong.
        if self._mark_unreliable_state_jacobian():
            return
        # 2. Rough cost.
        if self._is_rough_at(self.predicted_decrease):
            self.is_finished = True
            return
        # 3. Damping.
        self.damping = self.damping * INITIAL_DAMPING_GROWTH * self.growth
        self.growth = INITIAL_DAMPING_GROWTH * self.growth

    def find_blocked_parameters(self, residual: Array, jacobian: Array) -> Mask:
        """Return the mask (q,) of parameters at a bound that the data push against.

        A step along the descent of the cost would move them beyond the bound.

        Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

        Args:
            residual: (R, T, C) whitened residual.
            jacobian: (R, T, C, q + s) whitened derivatives.
        """
        # Direction of steepest descent of the cost, as the residual is observed minus simulated.
        descent = np.einsum("rtc,rtcq->q", residual, jacobian[..., : self.free_indices.size])
        values = self.point.start.theta[self.free_indices]
        is_blocked_below = (values <= self.low) & (descent < 0)
        is_blocked_above = (values >= self.high) & (descent > 0)
        is_blocked: Mask = is_blocked_below | is_blocked_above
        return is_blocked


def reduce_damping(damping: Array | float, gain_ratio: Array | float) -> Array:
    """Return the damping after an accepted step with a gain ratio, eq. (8) of the module docstring.

    Args:
        damping: damping λ; a number or any shape.
        gain_ratio: gain ratio ρ of the same shape.
    """
    factor = np.maximum(MIN_DAMPING_FACTOR, 1.0 - (2.0 * np.asarray(gain_ratio) - 1.0) ** 3)
    reduced: Array = np.maximum(damping * factor, MIN_DAMPING)
    return reduced


def combine_runs(last: FitPoint, trial: FitPoint, is_moved: Mask, costs: Array) -> FitPoint:
    """Return the trial point in some runs, and the last point in the others.

    Both points have the same parameters, so that no run influences another one.

    Args:
        last: the point before the step.
        trial: the point after the step.
        is_moved: (R,) mask of those of the R runs that have the trial point.
        costs: (R,) costs of the combined runs.
    """
    states = np.where(is_moved[:, None], trial.start.initial_states, last.start.initial_states)
    return replace(
        trial,
        start=replace(trial.start, initial_states=states),
        simulated=np.where(is_moved[:, None, None], trial.simulated, last.simulated),
        cost=float(costs.sum()),
    )


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

        # Step (q,) of the parameters; blocked ones do not move.
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


def hold_known_states(inner: Array, cross: Array, known_mask: Mask) -> tuple[Array, Array]:
    """Fix known initial states in the normal equations of a Gauss-Newton step.

    The equation of a known state becomes dz = 0: no parameter and no other state is coupled to its
    step dz. The caller sets the right-hand side of this equation to zero.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        inner: (R, s, s) matrix V_i of the initial states of each run.
        cross: (R, q, s) matrix W_i of each run, which couples parameters and initial states.
        known_mask: (R, s) mask of known initial states.

    Returns:
        The changed V_i and W_i.
    """
    # Elements in the row or the column of a known state become those of the identity matrix, so
    # that V stays invertible.
    is_coupled = known_mask[:, :, None] | known_mask[:, None, :]
    decoupled = np.where(is_coupled, np.eye(inner.shape[1]), inner)
    return decoupled, np.where(known_mask[:, None, :], 0.0, cross)


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


def solve_damped(block: Array, residual: Array, damping: float) -> Array:
    """Return the step (k,) of damped (Levenberg-Marquardt) least squares.

    It solves (J'J + λ diag(J'J) + small ridge) x = J'r. The ridge, a small share of the largest
    diagonal element, is needed for columns without any influence.

    Args:
        block: J (m, k), derivatives of m samples by k parameters.
        residual: r (m,).
        damping: λ.
    """
    normal = block.T @ block
    diagonal = np.diag(normal)
    ridge = damping * diagonal + RIDGE_SHARE * diagonal.max(initial=0.0)
    step, *_ = np.linalg.lstsq(normal + np.diag(ridge), block.T @ residual, rcond=None)
    return np.asarray(step)
