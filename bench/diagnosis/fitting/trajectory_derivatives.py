"""Derivatives of the simulated runs, by finite differences and by linearised robot dynamics.

Finite differences displace one parameter, or one initial state in all runs, and divide the change
of the observations by the displacement. A fit uses one-sided differences, and covariances use
central ones. For a robot, the dynamics linearised along each run give the derivatives by initial
states (`sims.robot.dynamics.linearisation_about_simulation`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import Indices, RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation

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


@dataclass(frozen=True)
class CandidateDirection:
    """Direction in which an effect changes the simulated runs, scaled by one coefficient.

    Attributes:
        effect: name of the effect.
        grid_point: number of the grid point; directions of one group act together.
        coefficient_index: index of the coefficient that scales it.
        coefficients: (k,) coefficients that are simulated.
        can_be_negative: whether the scaling coefficient may be negative.
        is_single_size: whether the direction is valid only at this size.
        is_only_proposed: whether the effect is proposed with this size for a fit alone, and not
            selected together with others.
    """

    effect: str
    grid_point: int
    coefficient_index: int
    coefficients: Array
    can_be_negative: bool
    is_single_size: bool = False
    is_only_proposed: bool = False


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


def compute_difference_quotients(
    simulated: Array, steps: Array, state_indices: Indices, known_state_mask: Mask
) -> Array:
    """Compute the Jacobian (R, T, C, q + s) of a fit by one-sided finite differences.

    It is zero for known initial states, which therefore absorb nothing of the residual.

    Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

    Args:
        simulated: (1 + q + n, R, T, C) simulation of the inputs of `build_displaced_inputs`.
        steps: (q + s,) displacements of all unknowns, parameters first.
        state_indices: (n,) indices of the initial states that are displaced.
        known_state_mask: (R, s) mask of known initial states.
    """
    q = steps.size - known_state_mask.shape[1]
    columns = np.concatenate([np.arange(q), q + state_indices])
    # An abandoned batch element is NaN, so the derivative by its unknown is not known, and zero.
    with np.errstate(all="ignore"):
        quotients = np.moveaxis(simulated[1:] - simulated[0], 0, -1) / steps[columns]
    jacobian: Array = np.where(is_finite_response(quotients), quotients, 0.0)
    if columns.size == steps.size:
        return jacobian
    # Some states are not displaced, because they are known in all runs; others in some runs.
    full_jacobian = np.zeros((*simulated.shape[1:], steps.size))
    full_jacobian[..., columns] = jacobian
    full_jacobian[..., q:] *= ~known_state_mask[:, None, None, :]
    return full_jacobian


def is_finite_response(changes: Array) -> Mask:
    """Return a mask of usable changes: not NaN, and of a magnitude below `MAX_RESPONSE`."""
    # Two comparisons avoid the modulus, which would copy one of the largest arrays.
    is_finite: Mask = (changes > -MAX_RESPONSE) & (changes < MAX_RESPONSE)
    return is_finite


def compute_central_jacobian(
    evaluator: RunEvaluator, fit: TrajectoryFit, noise: NoiseModel
) -> TrajectoryFit:
    """Compute the Jacobian of a fit by central differences.

    One-sided differences suffice for the steps of a fit, but their curvature makes parameters look
    distinguishable that are not.

    Args:
        evaluator: run evaluator of the runs.
        fit: fit with a one-sided Jacobian.
        noise: noise that weights the channels.

    Returns:
        The fit with the new Jacobian.
    """
    parameter_count = fit.free_indices.size
    bounds = _widen_bounds(evaluator, fit)
    ranges = bounds[:, 1] - bounds[:, 0]
    steps = compute_difference_steps(fit.jacobian, noise, ranges)
    # A robot's derivatives by initial states come from a linearisation and not from differences, so
    # they are kept, and only parameters are displaced.
    if evaluator.has_linearisation:
        steps = steps[:parameter_count]
    theta, states = _displace_both_sides(fit, steps, bounds)

    # One call simulates both sides and all runs, because the engine steps a batch at once.
    simulated = evaluator.simulate_all_runs(
        theta.reshape(-1, fit.theta.size), states.reshape(-1, *fit.initial_states.shape)
    )
    lower_side, upper_side = simulated.reshape(2, steps.size, *fit.simulated.shape)

    # Distances between both sides. A parameter at a bound moves by less than its step. Row j has
    # changed parameter j, so its distance is on the diagonal of these (q, q) values of both sides.
    lower, upper = theta[:, :parameter_count, fit.free_indices]
    parameter_widths = np.diagonal(upper - lower)
    widths = np.concatenate([parameter_widths, 2.0 * steps[parameter_count:]])
    jacobian = np.moveaxis(upper_side - lower_side, 0, -1) / widths
    # A simulation that failed on one side gives no slope.
    jacobian = np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)
    if evaluator.has_linearisation:
        jacobian = np.concatenate([jacobian, fit.jacobian[..., parameter_count:]], axis=3)
    return replace(fit, jacobian=jacobian)


def _displace_both_sides(fit: TrajectoryFit, steps: Array, bounds: Array) -> tuple[Array, Array]:
    """Build the parameters (2, n, P) and initial states (2, n, R, s) of the central differences.

    The first axis is the lower and the upper side. Row j of the second axis has number j of the n
    parameters and initial states moved by its step (the initial state in all runs), and all others
    unchanged. A row is simulated to get one column of the Jacobian.

    Shapes: R runs, P parameters, s states of a run.

    Args:
        fit: the fit, with q free parameters.
        steps: (n,) steps of the q parameters, then of the s initial states if they are moved too.
        bounds: (q, 2) bounds of the parameters.
    """
    parameter_count = fit.free_indices.size
    theta = np.tile(fit.theta, (2, len(steps), 1))
    initial_states = np.tile(fit.initial_states, (2, len(steps), 1, 1))
    for side, sign in enumerate((-1.0, 1.0)):
        shifts = sign * steps
        for j, index in enumerate(fit.free_indices):
            # At a bound the step is one-sided; the caller divides by the actual difference.
            theta[side, j, index] = np.clip(fit.theta[index] + shifts[j], *bounds[j])
        for state_index, shift in enumerate(shifts[parameter_count:]):
            initial_states[side, parameter_count + state_index, :, state_index] += shift
    return theta, initial_states


def _widen_bounds(evaluator: RunEvaluator, fit: TrajectoryFit) -> Array:
    """Return the bounds (q, 2) of the fitted parameters, widened to contain the fit.

    Coefficients may be outside their plausible range.

    Args:
        evaluator: the runs, with the bounds of all parameters.
        fit: the fit, with q free parameters.
    """
    values = fit.theta[fit.free_indices]
    bounds = [evaluator.parameters[i].bounds for i in fit.free_indices]
    # The shape is set explicitly because there may be no parameters.
    low, high = np.array(bounds).reshape(-1, 2).T
    return np.stack([np.minimum(low, values), np.maximum(high, values)], axis=1)


def compute_state_jacobian(
    evaluator: RunEvaluator, theta: Array, states: Array, is_recomputed: bool = False
) -> Array:
    """Return derivatives (R, T, C, s) of the runs by their initial states.

    They are those about the first requested model, or about this one if `is_recomputed` is set.
    Initial states act similarly in all models near the data, and a fit with derivatives of another
    such model converges to the same result.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs of a robot.
        theta: (P,) parameters.
        states: (R, s) initial states.
        is_recomputed: whether to recompute the derivatives about this model and store them.
    """
    if evaluator.state_derivatives is None or is_recomputed:
        evaluator.state_derivatives = compute_initial_state_derivatives(evaluator, theta, states)
    return evaluator.state_derivatives


def compute_initial_state_derivatives(
    evaluator: RunEvaluator, theta: Array, states: Array
) -> Array:
    """Compute the derivatives (R, T, C, s) of the runs by their initial states about one model.

    Each run is linearised in a worker. Derivatives that are not finite are set to zero.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs of a robot.
        theta: (P,) parameters of the model.
        states: (R, s) initial states of the model.
    """
    runs, length, channels = evaluator.observed.shape
    result = np.zeros((runs, length, channels, len(evaluator.state_names)))
    calls = [(run, theta, states[run]) for run in range(runs)]
    for run, values in evaluator.worker_pool.map_unordered(
        evaluator, _compute_run_derivatives, calls
    ):
        result[run, : values.shape[1]] = np.moveaxis(values, 0, -1)
    result[~is_finite_response(result)] = 0.0
    return result


def _compute_run_derivatives(
    evaluator: RunEvaluator, run: int, theta: Array, states: Array
) -> Array:
    """Compute the derivatives (s, T, C) of one run by its initial states; runs in a worker.

    Shapes: T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        run: index of the run.
        theta: (P,) parameters.
        states: (s,) initial state about which the run is linearised.
    """
    return get_linearisation(evaluator, run, theta, states).compute_initial_state_responses()


def get_linearisation(
    evaluator: RunEvaluator, run: int, theta: Array, states: Array
) -> RunLinearisation:
    """Return the dynamics of a robot linearised along one run, at given parameters.

    The most recently used linearisations are cached in the evaluator, as many as there are runs,
    because most are used more than once.

    Shapes: P parameters, s states of a run.

    Args:
        evaluator: run evaluator of all runs.
        run: index of the run.
        theta: (P,) parameters.
        states: (s,) initial state: positions first, then velocities.
    """
    key = run, theta.tobytes(), states.tobytes()
    cache = evaluator.cached_linearisations
    linearisation: RunLinearisation | None = cache.pop(key, None)
    if linearisation is None:
        # This import is needed for robots only.
        from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation

        coordinate_count = len(evaluator.state_names) // 2
        scenario = evaluator.prepared_runs[run].scenario
        linearisation = RunLinearisation(
            evaluator.simulator,
            theta,
            scenario,
            states[:coordinate_count],
            states[coordinate_count:],
        )
    cache[key] = linearisation
    # A used entry was removed above and is added again at the end, so the cache is ordered by the
    # last use. Drop the linearisations unused for the longest time.
    for oldest_key in list(cache)[: -len(evaluator.prepared_runs)]:
        del cache[oldest_key]
    return linearisation
