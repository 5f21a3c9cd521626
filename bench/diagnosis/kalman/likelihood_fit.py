"""Maximum likelihood estimates of robot parameters from innovations, by Gauss-Newton steps.

A simulation that starts far from the right parameters leaves the data within a second, and a fit to
it has many local minima. A filter stays near the data for any parameters, so its innovations are
nearly linear in them (L. Ljung, System Identification, 2nd ed., 1999, chapter 10). Its estimates
are the initial values of a fit by simulation.

Derivatives follow from differences of the model's own steps. Responses about the measured
accelerations contain the noise of the innovations that they should explain, which biases a step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import bound_of, get_bounds_by_index
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.base_fit import Bounds, compute_range_around, use_bounds
from bench.diagnosis.kalman.candidate_responses import FollowedRuns
from sims.core.simulator import Array

Follow: TypeAlias = Callable[[Array, FollowedRuns], FollowedRuns]

MAX_BASE_ITERATIONS = 8
"""Maximum number of Gauss-Newton steps for base parameters."""
DIFFERENCE_SHARE = 1e-3
"""Finite-difference step of a parameter, as a share of its plausible range."""
MIN_STEP_GAIN = 1.0
"""Minimum gain in log-likelihood by a step for which another step follows."""
MAX_HALVINGS = 3
"""Maximum number of times that a step without gain is halved."""
RESISTANCE = ("friction.coulomb", "drag.linear", "force.bias")
"""Effects at a joint that are fitted together with base parameters."""
MAX_JOINTS = 3
"""Maximum number of joints at which resisting effects are fitted with base parameters."""
RIDGE = 1e-9
"""Ridge of the normal equations, as a share of each parameter's sum of squares."""
MIN_BASE_GAIN = 2.0
"""Minimum gain in log-likelihood of base parameters over the nominal ones."""


def identify_base(
    evaluator: RunEvaluator, noise: NoiseModel, followed: FollowedRuns, is_resisted: bool = False
) -> tuple[FollowedRuns, dict[str, Bounds]]:
    """Identify the base parameters of a robot from the innovations of a filter.

    If they leave a force missing, friction and constant forces at the joints are fitted with them
    and then set to zero again. Without these effects, a mass would be overestimated.

    Args:
        evaluator: the runs for fitting; ranges that do not contain an estimate are replaced.
        noise: sensor noise.
        followed: the runs, filtered with the nominal parameters.
        is_resisted: whether friction is certain, so that the parameters are not tried without it.

    Returns:
        The runs, filtered with the estimates, and the new ranges by name. If the likelihood gains
        nothing, an estimate is at its widest bound, or the search has to end, the filter with
        nominal parameters.
    """
    search_control = evaluator.search_control

    def follow(theta: Array, best: FollowedRuns) -> FollowedRuns:
        search_control.begin_stage("identifying the base parameters")
        return FollowedRuns.follow(evaluator, theta, noise, force=best.force)

    base_indices = evaluator.base_indices.tolist()
    limits = {i: compute_range_around(evaluator, i) for i in base_indices}
    resisting_bounds = get_bounds_by_index(evaluator, _list_resisting_effects(followed))
    accepted = []
    for further_bounds in [resisting_bounds] if is_resisted else [{}, resisting_bounds]:
        try:
            fitted = maximise_innovation_likelihood(
                followed, limits | further_bounds, MAX_BASE_ITERATIONS, follow
            )
        except SearchStoppedError:
            search_control.record_abandoned_fit(True)
            return followed, {}
        bounds_reached = [bound_of(float(fitted.theta[i]), *bounds) for i, bounds in limits.items()]
        if fitted.has_expected_innovations and not any(bounds_reached):
            accepted.append(fitted)
        # The base parameters alone leave no force missing, so friction is not needed.
        if accepted and not fitted.has_missing_force:
            break
    best = max(accepted, key=lambda one: one.log_likelihood, default=followed)
    if best.log_likelihood - followed.log_likelihood < MIN_BASE_GAIN:
        return followed, {}
    values = {i: float(best.theta[i]) for i in base_indices}
    wider_bounds = {}
    for i, value in values.items():
        low, high = evaluator.parameters[i].bounds
        if not low <= value <= high:
            wider_bounds[evaluator.parameters[i].name] = compute_range_around(evaluator, i, value)
    use_bounds(evaluator, wider_bounds)
    theta = followed.theta.copy()
    theta[base_indices] = best.theta[base_indices]
    return follow(theta, best), wider_bounds


def _list_resisting_effects(followed: FollowedRuns) -> list[str]:
    """Return effects that resist the motion of the joints with the largest missing forces."""
    evaluator = followed.evaluator
    coordinates = evaluator.simulator.system.coordinates
    joints = [coordinates[j].removeprefix("q.") for j in followed.joints_by_loss[:MAX_JOINTS]]
    names = [f"{effect}@{joint}" for joint in joints for effect in RESISTANCE]
    return [name for name in names if name in evaluator.coefficient_slices]


def maximise_innovation_likelihood(
    followed: FollowedRuns,
    bounds: Mapping[int, Bounds],
    iterations: int,
    follow: Follow,
    min_gain: float = MIN_STEP_GAIN,
) -> FollowedRuns:
    """Maximise the likelihood of the innovations by Gauss-Newton steps with step halving.

    Args:
        followed: the runs, filtered with the initial parameters.
        bounds: bounds of the fitted parameters, by index.
        iterations: maximum number of steps.
        follow: filters the runs with other parameters; its second argument is the best filter.
        min_gain: minimum gain in log-likelihood by a step for which another step follows.

    Returns:
        The runs, filtered with the likeliest parameters.

    Raises:
        SearchStoppedError: the search has to end.
    """
    best = followed
    for _ in range(iterations):
        step, predicted_gain = compute_likelihood_step(best, bounds)
        if predicted_gain < min_gain:
            break
        gain = 0.0
        for _ in range(1 + MAX_HALVINGS):
            followed.evaluator.search_control.check_not_stopped()
            trial = follow(best.theta + step, best)
            gain = trial.log_likelihood - best.log_likelihood
            if gain > 0:
                best = trial
                break
            step = step / 2.0
        if gain < min_gain:
            break
    return best


def compute_likelihood_step(
    followed: FollowedRuns, bounds: Mapping[int, Bounds]
) -> tuple[Array, float]:
    """Compute the Gauss-Newton step of some parameters on the innovations.

    Args:
        followed: the runs, filtered with the present parameters.
        bounds: bounds of the parameters that change, by index; they limit the step. A set
            without effects has none.

    Returns:
        The change of all parameters (P,), and the predicted gain in log-likelihood for linear
        innovations.
    """
    indices = list(bounds)
    if not indices:
        return np.zeros_like(followed.theta), 0.0
    derivatives, target = _compute_derivatives(followed, bounds), followed.filtered.whitened
    gram, cross = derivatives.T @ derivatives, derivatives.T @ target.reshape(-1)
    scale = np.maximum(np.sqrt(np.diagonal(gram)), 1e-300)
    normal = gram / scale / scale[:, None] + RIDGE * np.eye(len(indices))
    values = followed.theta[indices]
    low, high = np.array(list(bounds.values())).T
    change = np.clip(values + np.linalg.solve(normal, cross / scale) / scale, low, high) - values
    step = np.zeros_like(followed.theta)
    step[indices] = change
    return step, float(change @ cross - 0.5 * change @ gram @ change)


def compute_information(followed: FollowedRuns, bounds: Mapping[int, Bounds]) -> Array:
    """Return the Fisher information (n, n) of some parameters in the innovations.

    Args:
        followed: the runs, filtered with the present parameters.
        bounds: bounds of the n parameters, by index.
    """
    rows = _compute_derivatives(followed, bounds)
    information: Array = rows.T @ rows
    return information


def _compute_derivatives(followed: FollowedRuns, bounds: Mapping[int, Bounds]) -> Array:
    """Return minus the derivatives (R T C, n) of the whitened innovations by n parameters.

    They are one-sided differences that stay within the bounds. A parameter without a range has no
    derivative.

    Args:
        followed: the runs, followed with the present parameters.
        bounds: lower and upper bound of each of the n parameters, by its index in theta.
    """
    sizes = np.array(
        [_compute_difference(followed, index, limits) for index, limits in bounds.items()]
    )
    moved = np.flatnonzero(sizes)
    places = np.array(list(bounds), dtype=np.intp)[moved]
    responses = followed.compute_parameter_responses(places.tolist(), sizes[moved])
    derivatives = np.zeros((*responses.shape[:3], len(bounds)))
    derivatives[..., moved] = responses
    return derivatives.reshape(-1, len(bounds))


def _compute_difference(followed: FollowedRuns, index: int, bounds: Bounds) -> float:
    """Return the finite difference of a parameter, which stays within the bounds.

    It is zero if the parameter has no range.

    Args:
        followed: the runs, followed with the present parameters.
        index: index of the parameter in theta.
        bounds: lower and upper bound of the fit, in the unit of the parameter.
    """
    low, high = bounds
    plausible_low, plausible_high = followed.evaluator.parameters[index].bounds
    size = DIFFERENCE_SHARE * min(plausible_high - plausible_low, high - low)
    if not size > 0:
        return 0.0
    value = float(followed.theta[index])
    # Dry friction above that of the file has another form, so the difference stays on one side.
    is_up = value + size <= high and (value >= 0.0 or value - size < low)
    return size if is_up else -size
