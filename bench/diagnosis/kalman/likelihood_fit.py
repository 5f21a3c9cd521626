"""Maximum likelihood estimates of robot parameters from innovations, by Gauss-Newton steps.

A simulation that starts far from the right parameters leaves the data within a second, and a fit to
it has many local minima. A filter stays near the data for any parameters, so its innovations are
nearly linear in them (L. Ljung, System Identification, 2nd ed., 1999, chapter 10). Its estimates
are the initial values of a fit by simulation.

Derivatives follow from differences of the model's own steps. Responses about the measured
accelerations contain the noise of the innovations that they should explain, which biases a step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import Bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.candidate_responses import compute_parameter_responses
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from sims.core.simulator import Array

Follow: TypeAlias = Callable[[Array, FollowedRuns], FollowedRuns]

DIFFERENCE_SHARE = 1e-3
"""Finite-difference step of a parameter, as a share of its plausible range."""
MIN_STEP_GAIN = 1.0
"""Minimum gain in log-likelihood by a step for which another step follows."""
MAX_HALVINGS = 3
"""Maximum number of times that a step without gain is halved."""
RIDGE = 1e-9
"""Ridge of the normal equations, as a share of each parameter's sum of squares."""


class Information(NamedTuple):
    """Fisher information of parameters.

    Attributes:
        indices: indices of the n parameters in theta.
        matrix: (n, n) information.
    """

    indices: list[int]
    matrix: Array

    def select(self, indices: list[int]) -> Information:
        """Return the information of some of the parameters if the others are known.

        Args:
            indices: indices of these parameters in theta.
        """
        rows = [self.indices.index(i) for i in indices]
        return Information(indices, self.matrix[np.ix_(rows, rows)])


def maximise_innovation_likelihood(
    followed: FollowedRuns,
    bounds: Mapping[int, Bounds],
    iterations: int,
    follow: Follow,
    min_gain: float = MIN_STEP_GAIN,
) -> FollowedRuns:
    """Maximise the likelihood of the innovations by Gauss-Newton steps with step halving.

    Innovations are the differences between the readings and their predictions by the Kalman filter
    of the runs. A step that does not increase their likelihood is halved a few times. The fit ends
    when a step is predicted to gain, or gains, less than `min_gain`.

    Args:
        followed: the runs, filtered with the initial parameters.
        bounds: lower and upper bounds of the fitted parameters, by index in theta.
        iterations: maximum number of steps.
        follow: filters the runs with other parameters (its first argument); its second argument is
            the best filter so far, whose motion may be reused.
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
        # The whole step first, then the halved ones.
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

    The whitened innovations after a change x are e - J x, to first order, so x solves J'J x = J'e.
    Columns of J are scaled to unit length and a small ridge is added, which keeps the solution well
    conditioned.

    Args:
        followed: the runs, filtered with the present parameters.
        bounds: lower and upper bounds of the n parameters that change, by index in theta; they
            limit the step. There may be none.

    Returns:
        The change of all parameters (P,), zero for those without bounds, and the gain in
        log-likelihood, e'J x - x'J'J x / 2, that is predicted for linear innovations.
    """
    indices = list(bounds)
    if not indices:
        return np.zeros_like(followed.theta), 0.0
    # J, J'J and J'e; rows of J are all samples of all channels and runs.
    derivatives = _compute_derivatives(followed, bounds)
    information = derivatives.T @ derivatives
    cross = derivatives.T @ followed.filtered.whitened.reshape(-1)
    # Lengths of the columns of J; a column of zeros must not be divided by zero.
    scale = np.maximum(np.sqrt(np.diagonal(information)), 1e-300)
    normal = information / scale / scale[:, None] + RIDGE * np.eye(len(indices))
    values = followed.theta[indices]
    low, high = np.array(list(bounds.values())).T
    # The change x, after which the parameters are within their bounds.
    change = np.clip(values + np.linalg.solve(normal, cross / scale) / scale, low, high) - values
    step = np.zeros_like(followed.theta)
    step[indices] = change
    return step, float(change @ cross - 0.5 * change @ information @ change)


def compute_information(followed: FollowedRuns, bounds: Mapping[int, Bounds]) -> Information:
    """Return the Fisher information of some parameters in the innovations.

    It is J'J with the derivatives J of the whitened innovations by the parameters. Its inverse is
    their covariance.

    Args:
        followed: the runs, filtered with the present parameters.
        bounds: bounds of the n parameters, by index.
    """
    derivatives = _compute_derivatives(followed, bounds)
    return Information(list(bounds), derivatives.T @ derivatives)


def compute_wald_statistics(
    evaluator: RunEvaluator, theta: Array, names: Sequence[str], information: Information
) -> dict[str, float]:
    """Return the loss in twice the log-likelihood without each effect of a set (Wald statistic).

    It is c' V^-1 c for the k coefficients c of the effect and their covariance V, a block of the
    inverse Fisher information, which contains the uncertainty by all other parameters. So no fit
    without the effect is needed. Pseudo-inverses allow parameters that the data do not determine.

    Args:
        evaluator: the runs, with the indices of the coefficients in theta.
        theta: (P,) parameters of the model with the effects.
        names: names of the effects.
        information: Fisher information of all fitted parameters, also those of no effect.

    Returns:
        The loss for each effect, by name.
    """
    covariance = np.linalg.pinv(information.matrix, hermitian=True)
    statistics = {}
    for name in names:
        indices = evaluator.get_coefficient_indices(name)
        rows = [information.indices.index(i) for i in indices]
        # V^-1
        inverse = np.linalg.pinv(covariance[np.ix_(rows, rows)], hermitian=True)
        coefficients = theta[indices]
        statistics[name] = float(coefficients @ inverse @ coefficients)
    return statistics


def _compute_derivatives(followed: FollowedRuns, bounds: Mapping[int, Bounds]) -> Array:
    """Return minus the derivatives (R T C, n) of the whitened innovations by n parameters.

    The sign makes them the derivatives of what the model predicts. They are one-sided differences
    that stay within the bounds. The derivative by a parameter whose bounds are equal is zero. Rows
    are the T samples of C channels of R runs.

    Args:
        followed: the runs, followed with the present parameters.
        bounds: lower and upper bound of each of the n parameters, by its index in theta.
    """
    differences = np.array(
        [_compute_difference(followed, index, limits) for index, limits in bounds.items()]
    )
    # Columns of the parameters whose bounds differ; those with equal bounds stay zero.
    columns = np.flatnonzero(differences)
    parameters = np.array(list(bounds), dtype=np.intp)[columns]
    responses = compute_parameter_responses(followed, parameters.tolist(), differences[columns])
    derivatives = np.zeros((*responses.shape[:3], len(bounds)))
    derivatives[..., columns] = responses
    return derivatives.reshape(-1, len(bounds))


def _compute_difference(followed: FollowedRuns, index: int, bounds: Bounds) -> float:
    """Return the finite difference of a parameter, in its unit, which stays within the bounds.

    It is zero if the bounds are equal, and negative if the parameter is decreased.

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
    # More dry friction than in the model file (a positive value) acts otherwise than less of it, so
    # the difference does not cross zero.
    is_upward = value + size <= high and (value >= 0.0 or value - size < low)
    return size if is_upward else -size
