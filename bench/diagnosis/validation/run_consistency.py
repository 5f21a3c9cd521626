"""Run consistency: whether runs, logs or loads agree on each parameter, and on what it depends.

They are the amplitude, speed, direction and position of the motion, the size of each input, the
order of the runs, and the extra columns of the recording, such as a temperature.

A parameter of a joint is compared with the motion of that joint, any other parameter with the
primary coordinate of the system. The motion is taken from the fitted model because it has no noise.

The test works at the joint fit. J_r = [A_r B_r] are the whitened derivatives of run r with respect
to the parameters and to the initial states of the run, e_r is the residual, and sigma_0 is the
prior standard deviation of the initial states:

    H_r = A_r' A_r - A_r' B_r S_r^-1 B_r' A_r,    S_r = B_r' B_r + diag sigma_0^-2
    g_r = A_r' e_r - A_r' B_r S_r^-1 (B_r' e_r + prior)                                          (1)

A group G of runs alone would change the parameters by one Gauss-Newton step,

    d_G = H_G^-1 g_G,    cov_G = H_G^-1,    H_G = sum_r H_r,  g_G = sum_r g_r                    (2)

The groups that identify a parameter x agree on it according to Cochran's Q (W. Cochran, Biometrics
10, 101, 1954), which follows a chi-squared distribution with one degree of freedom less than the
number n of groups:

    Q = sum_G w_G (x_G - mean)^2,    w_G = 1 / var_G,    Q ~ chi^2 with n - 1                    (3)

The variance between groups beyond their errors is (R. DerSimonian, N. Laird, Control. Clin. Trials
7, 177, 1986)

    tau^2 = (Q - (n - 1)) / (sum w - sum w^2 / sum w)                                            (4)

The variance of a parameter for a run that is not yet recorded is therefore

    var = var_joint + tau^2                                                                      (5)

The trend with a covariate z of the groups, such as a load or the order of logs, is the slope of
weighted least squares. Its error is enlarged by the scatter about the line (R. Birge, Phys. Rev.
40, 207, 1932).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import erfc, sqrt
from typing import Literal, NamedTuple

import numpy as np

from bench.benchmark.statistics.chi_squared import chi_squared_tail
from bench.benchmark.statistics.student_t import student_p_value
from bench.diagnosis.evaluation.noise_model import whiten
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.trajectory_fit import compute_state_prior
from bench.diagnosis.validation.confidence_intervals import (
    Z95,
    compute_fisher_blocks,
    invert_scaled,
)
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array
from sims.recording.recording import Run

CovariateKind = Literal[
    "load", "supply", "amplitude", "speed", "direction", "position", "command", "time", "other"
]
LOAD_UNITS = ("kg", "kg*m^2", "N", "N*m")
"""Units by which a constant is recognised as a load."""
MIN_RELATIVE_VARIATION = 1e-3
"""Minimum variation of a covariate between runs, as a fraction of its largest magnitude."""
SIGNIFICANCE_LEVEL = 0.01
"""Significance level of test (3), divided by the number of tests for all parameters together."""
MIN_RELEVANT_SCATTER = 1e-3
"""Scatter below which groups count as consistent at any p-value, as a fraction of the value."""
MIN_GROUPS_FOR_TREND = 4
"""Minimum number of groups for which a trend covariate is searched."""
COVARIATE_TIE_FACTOR = 2.0
"""Maximum ratio of the mean square about the line to the smallest one, for a covariate that counts
as indistinguishable from the best.
"""
MAX_INTERVAL_WIDTH = 4.0
"""Maximum width of a group's 95 % interval, as a multiple of the parameter's range or value, for
the group to be used.
"""


class RunCovariate(NamedTuple):
    """Quantity that differs between runs.

    Attributes:
        kind: Category of the quantity.
        name: Quantity in words; for an extra column its name.
        values: (R,) value of each run, in any unit.
    """

    kind: CovariateKind
    name: str
    values: Array


def compute_run_covariates(
    evaluator: RunEvaluator, model: FittedModel, number: str
) -> list[RunCovariate]:
    """List the quantities that differ between the runs and may explain a trend of a parameter.

    Args:
        evaluator: Run evaluator with the runs.
        model: Fitted model whose simulated motion is used.
        number: Name of the parameter, ``parameter`` or ``parameter@joint``.
    """
    covariates = [
        *_list_non_motion_covariates(evaluator),
        *_compute_motion_covariates(evaluator, model, number),
    ]
    return [covariate for covariate in covariates if _varies_between_runs(covariate.values)]


def classify_constant(evaluator: RunEvaluator, name: str) -> CovariateKind:
    """Return the category of a constant that differs between runs, from its unit.

    A mass, inertia, force or torque is a load, a voltage a supply.

    Args:
        evaluator: Run evaluator; its simulator declares the constants.
        name: Name of the constant.
    """
    units = {constant.name: constant.unit for constant in evaluator.kind.constants}
    unit = units.get(name, "")
    if unit in LOAD_UNITS:
        return "load"
    return "supply" if unit == "V" else "other"


def _list_non_motion_covariates(evaluator: RunEvaluator) -> Iterator[RunCovariate]:
    """Yield the covariates that do not depend on the motion, each with a value for every run.

    A covariate is a quantity that may explain why a parameter differs between runs. They are the
    order of the runs, the root mean square of each command, and the mean of each recorded signal
    that the simulator does not use, such as a temperature.

    Args:
        evaluator: Run evaluator of the recording.
    """
    yield RunCovariate(
        "time", "the order of runs", np.arange(len(evaluator.runs), dtype=np.float64)
    )
    for name in evaluator.runs[0].inputs:
        sizes = [compute_rms(run.inputs[name]) for run in evaluator.runs]
        yield RunCovariate("command", f"the size of {name}", np.array(sizes))
    for name in evaluator.runs[0].extra:
        signals = [run.extra.get(name, np.empty(0)) for run in evaluator.runs]
        means = [
            float(np.nanmean(signal)) if np.isfinite(signal).any() else np.nan for signal in signals
        ]
        yield RunCovariate("other", name, np.array(means))


def _compute_motion_covariates(
    evaluator: RunEvaluator, model: FittedModel, number: str
) -> Iterator[RunCovariate]:
    """Yield covariates of the simulated motion of each run, at the joint of a parameter.

    A covariate is a quantity that may explain why a parameter differs between runs. They are the
    amplitude (standard deviation), the RMS speed, the direction of motion (-1 to 1), and the mean
    position. A parameter that does not belong to a joint has those of the primary coordinate.
    Nothing is yielded if the position is not recorded.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        model: model that simulates them.
        number: name of the parameter, ``NAME@JOINT`` for that of a joint.
    """
    system = evaluator.simulator.system
    if not system.coordinates:
        return
    _, _, joint = number.partition("@")
    coordinate = f"q.{joint}"
    if coordinate not in system.coordinates:
        coordinate = system.coordinates[system.primary]
    if coordinate not in evaluator.channels:
        return
    channel_index = evaluator.channels.index(coordinate)
    amplitudes, speeds, directions, mean_positions = [], [], [], []
    for run_data, simulated in zip(evaluator.prepared_runs, model.fit.simulated, strict=True):
        times = run_data.scenario.times
        positions = simulated[: times.size, channel_index]
        velocities = np.gradient(positions, times)
        amplitudes.append(positions.std())
        speeds.append(compute_rms(velocities))
        directions.append(velocities.sum() / max(np.abs(velocities).sum(), 1e-300))
        mean_positions.append(positions.mean())
    yield RunCovariate("amplitude", "the amplitude", np.array(amplitudes))
    yield RunCovariate("speed", "the speed", np.array(speeds))
    yield RunCovariate("direction", "the direction of motion", np.array(directions))
    yield RunCovariate("position", "the position", np.array(mean_positions))


def _varies_between_runs(values: Array) -> bool:
    """Return whether a covariate differs enough between runs to test a trend with it."""
    return bool(
        np.isfinite(values).all() and np.ptp(values) > MIN_RELATIVE_VARIATION * np.abs(values).max()
    )


@dataclass(frozen=True)
class GroupEstimate:
    """Estimate of one parameter from one group of runs: its value and its standard error."""

    group: str
    value: float
    error: float


@dataclass(frozen=True)
class Trend:
    """Linear trend of a parameter over the groups.

    Attributes:
        slope: Slope.
        error: Its standard error.
        p_value: Its p-value.
        mean_square: Mean square of the estimates about the line, in units of their errors.
    """

    slope: float
    error: float
    p_value: float
    mean_square: float


@dataclass(frozen=True)
class TrendCovariate:
    """Covariate with which a parameter moves between groups.

    Attributes:
        kind: Category of the covariate (`bench.diagnosis.validation.run_consistency`).
        name: Name of the covariate.
        trend: Trend of the parameter with the covariate.
        indistinguishable_covariates: Names of other covariates that explain the trend about as
            well.
    """

    kind: CovariateKind
    name: str
    trend: Trend
    indistinguishable_covariates: tuple[str, ...] = ()


@dataclass(frozen=True)
class ParameterConsistency:
    """Consistency of one parameter between groups of runs.

    Attributes:
        number: Name of the parameter; for a coefficient of a cause, it includes the effect.
        unit: Unit of the parameter.
        by: Criterion of the groups: ``run``, ``log`` or a constant that differs between runs.
        value: Estimate of the joint fit.
        error: Standard error of the joint estimate, from the curvature.
        group_estimates: Estimates of the groups that identify the parameter.
        scatter: Tau of eq. (4), the standard deviation between groups beyond their errors.
        p_value: P-value of Cochran's Q test, eq. (3) of the module docstring.
        is_consistent: Whether the groups are consistent.
        trend: Trend with a constant or with the order of logs; None by run or with fewer than three
            groups.
        trend_covariate: Significant trend covariate; None if there is none or the groups agree.
    """

    number: str
    unit: str
    by: str
    value: float
    error: float
    group_estimates: tuple[GroupEstimate, ...]
    scatter: float
    p_value: float
    is_consistent: bool
    trend: Trend | None = None
    trend_covariate: TrendCovariate | None = None

    @property
    def prediction_sigma(self) -> float:
        """Standard error for a run that is not yet recorded, eq. (5) of the module docstring.

        The variance is var_joint + tau^2 (5): that of the joint fit and that between groups.
        """
        return float(np.hypot(self.error, self.scatter))


@dataclass(frozen=True)
class ConsistencySummary:
    """Consistency of parameters between groups of runs.

    Attributes:
        before: Parameters of the base model.
        after: Parameters of the extended model.
        alternative_effect: Coefficients of the best single effect that is not part of the
            diagnosis.
    """

    before: tuple[ParameterConsistency, ...] = ()
    after: tuple[ParameterConsistency, ...] = ()
    alternative_effect: tuple[ParameterConsistency, ...] = ()


@dataclass(frozen=True)
class _RunGrouping:
    """Runs in groups: the criterion, names and run indices, and the value of each group if any."""

    by: str
    names: tuple[str, ...]
    runs: tuple[tuple[int, ...], ...]
    numbers: tuple[float, ...] | None = None


def assess_consistency(models: ModelSet, model: FittedModel) -> tuple[ParameterConsistency, ...]:
    """Assess the consistency of each parameter of a fitted model between runs, logs and loads.

    A correct model needs the same parameters in every group of runs. For each grouping and
    parameter, the estimates of the groups are compared; where they differ significantly (with
    Bonferroni's correction for the number of tests), the covariate is sought with which they
    change.

    Args:
        models: Models of the runs.
        model: Model that is fitted to all runs.

    Returns:
        One entry for each parameter and grouping; empty without groups or free parameters.
    """
    evaluator = models.evaluator
    groupings = list(_list_groupings(evaluator.runs))
    if not groupings or not model.fit.free_indices.size:
        return ()
    curvatures, gradients = _compute_run_normal_equations(models, model)
    tested = [
        (grouping, consistency)
        for grouping in groupings
        for consistency in _test_parameters(evaluator, model, grouping, curvatures, gradients)
    ]
    level = SIGNIFICANCE_LEVEL / max(len(tested), 1)
    assessed = []
    for grouping, consistency in tested:
        consistency = _assess_parameter(consistency, level)
        if not consistency.is_consistent:
            covariate = _find_trend_covariate(evaluator, model, grouping, consistency)
            consistency = replace(consistency, trend_covariate=covariate)
        assessed.append(consistency)
    return tuple(assessed)


def compute_prediction_half_widths(
    consistencies: Sequence[ParameterConsistency],
) -> dict[str, float]:
    """Return half the prediction interval of each parameter for a new log, or else a new run.

    Prediction intervals have the variation between logs (or runs) in them, in addition to the error
    of the joint fit.

    Args:
        consistencies: Consistency of each parameter between runs, and between logs if there are
            several.

    Returns:
        Half the width of the 95 % prediction interval by name of the parameter, in its unit.
    """
    # A new log is more general than a new run, so that it comes later and replaces it. Groups by a
    # constant, such as a load, are not used.
    return {
        consistency.number: Z95 * consistency.prediction_sigma
        for grouping in ("run", "log")
        for consistency in consistencies
        if consistency.by == grouping
    }


def _find_trend_covariate(
    evaluator: RunEvaluator,
    model: FittedModel,
    grouping: _RunGrouping,
    consistency: ParameterConsistency,
) -> TrendCovariate | None:
    """Find the covariate, such as load or temperature, with which a parameter changes.

    1. Groups by a constant have this constant as their covariate.
    2. For runs and logs, a line is fitted for every covariate, if there are enough groups. Of those
       with a significant trend, the one with the smallest scatter about the line is returned, with
       others that fit about as well.

    Return None if no trend is significant.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        model: fitted model: its effects, parameters, initial states and likelihood.
        grouping: the groups of runs, such as logs.
        consistency: estimates of the parameter from each group.
    """
    # 1. Groups by a constant. Their trend with it is known already.
    if grouping.by not in ("run", "log"):
        trend = consistency.trend
        if trend is None or trend.p_value >= SIGNIFICANCE_LEVEL:
            return None
        return TrendCovariate(classify_constant(evaluator, grouping.by), grouping.by, trend)
    # 2. Runs or logs.
    if len(consistency.group_estimates) < MIN_GROUPS_FOR_TREND:
        return None
    covariates = compute_run_covariates(evaluator, model, consistency.number)
    trends = _fit_covariate_trends(covariates, grouping, consistency.group_estimates)
    # The level is corrected for the number of covariates.
    significant_trends = [
        (covariate, trend)
        for covariate, trend in trends
        if trend.p_value < SIGNIFICANCE_LEVEL / len(trends)
    ]
    if not significant_trends:
        return None

    def get_scatter(candidate: tuple[RunCovariate, Trend]) -> float:
        """Return the mean square of the estimates about the line, in units of their errors."""
        _, trend = candidate
        # A mean square below 1, that of the errors alone, is chance, so such covariates are equal.
        return max(trend.mean_square, 1.0)

    best = min(significant_trends, key=get_scatter)
    covariate, trend = best
    # A covariate that fits about as well cannot be distinguished from the best one.
    similar_covariates = [
        other_covariate.name
        for other_covariate, other_trend in significant_trends
        if other_covariate is not covariate
        and get_scatter((other_covariate, other_trend)) < COVARIATE_TIE_FACTOR * get_scatter(best)
    ]
    return TrendCovariate(covariate.kind, covariate.name, trend, tuple(similar_covariates))


def _fit_covariate_trends(
    covariates: Sequence[RunCovariate],
    grouping: _RunGrouping,
    group_estimates: Sequence[GroupEstimate],
) -> list[tuple[RunCovariate, Trend]]:
    """Fit the trend of a parameter with each covariate, whose value in a group is a mean over runs.

    Args:
        covariates: covariates with a value for each run.
        grouping: the groups, with the indices of their runs.
        group_estimates: estimate of the parameter from each group that identifies it.

    Returns:
        Each covariate with its trend; without those that are equal in all groups.
    """
    runs_by_group = {
        name: list(runs) for name, runs in zip(grouping.names, grouping.runs, strict=True)
    }
    trends = []
    for covariate in covariates:
        values = [covariate.values[runs_by_group[part.group]].mean() for part in group_estimates]
        trend = _fit_trend(group_estimates, np.array(values))
        if trend is not None:
            trends.append((covariate, trend))
    return trends


def _assess_parameter(consistency: ParameterConsistency, level: float) -> ParameterConsistency:
    """Mark a parameter as consistent if its scatter is small or not significant at `level`."""
    is_scatter_small = consistency.scatter < MIN_RELEVANT_SCATTER * abs(consistency.value)
    return replace(consistency, is_consistent=is_scatter_small or consistency.p_value >= level)


def _list_groupings(runs: Sequence[Run]) -> Iterator[_RunGrouping]:
    """Yield the ways to group the runs: by log, by each differing constant, by single run.

    Each grouping has the labels of its groups, the indices of the runs in each, and, where they
    have an order, the values by which a trend can be tested. A grouping has at least two groups.

    Args:
        runs: the runs; each names its log and its constants, such as a load.
    """
    # Logs, in their order.
    logs = tuple(dict.fromkeys(run.log for run in runs))
    if len(logs) > 1:
        run_indices = tuple(
            tuple(i for i, run in enumerate(runs) if run.log == log) for log in logs
        )
        yield _RunGrouping("log", logs, run_indices, tuple(map(float, range(len(logs)))))
    # Runs with an equal value of a constant, such as a load, form a group.
    for name in dict.fromkeys(name for run in runs for name in run.constants):
        values = [run.constants.get(name, np.nan) for run in runs]
        group_values = tuple(sorted(set(values)))
        if len(group_values) > 1 and np.isfinite(group_values).all():
            labels = tuple(f"{group_value:g}" for group_value in group_values)
            run_indices = tuple(
                tuple(i for i, value in enumerate(values) if value == group_value)
                for group_value in group_values
            )
            yield _RunGrouping(name, labels, run_indices, group_values)
    # Single runs.
    if len(runs) > 1:
        run_indices = tuple((i,) for i in range(len(runs)))
        yield _RunGrouping("run", tuple(run.name for run in runs), run_indices)


def _compute_run_normal_equations(models: ModelSet, model: FittedModel) -> tuple[Array, Array]:
    """Compute the normal equations of the q parameters for each run.

    They show by how much each run alone would change the joint fit, that of all runs together,
    without fitting it again. They are the curvatures H (R, q, q) and the gradients g (R, q), after
    the initial states of the run are eliminated (1):

        H = A'A - A'B S^-1 B'A,    g = A'e - A'B S^-1 (B'e + prior),    S = B'B + diag sigma_0^-2

    with the whitened derivatives A by parameters and B by initial states, the whitened residual e,
    and the prior standard deviation sigma_0 of the initial states.

    Shapes: R runs.

    Args:
        models: the models, with the runs.
        model: fitted model: its effects, parameters, initial states and likelihood.

    Returns:
        Curvatures H and gradients g; H^-1 g is the step to which a run alone would lead.
    """
    evaluator, fit = models.evaluator, model.fit
    q = fit.free_indices.size
    fisher_blocks = compute_fisher_blocks(models, model)
    residual = whiten(models.compute_residual(fit), models.observed_mask, fisher_blocks.noise)
    # A'e and B'e of each run; the latter gets the part of the prior below.
    all_gradients = np.einsum(
        "rnk,rn->rk", fisher_blocks.jacobian, residual.reshape(len(residual), -1)
    )
    parameter_gradients, state_gradients = all_gradients[:, :q], all_gradients[:, q:]
    state_gradients += compute_state_prior(evaluator) ** -2.0 * (
        evaluator.initial_state_guesses - fit.initial_states
    )
    # A known initial state is not fitted.
    state_gradients *= ~evaluator.known_state_mask
    # One solution for S^-1 B'A and S^-1 (B'e + prior), which is the last column.
    right_hand_sides = np.concatenate(
        [fisher_blocks.cross.transpose(0, 2, 1), state_gradients[..., None]], axis=2
    )
    solutions = np.linalg.solve(fisher_blocks.states, right_hand_sides)
    cross = fisher_blocks.cross
    curvatures = fisher_blocks.parameters - np.matmul(cross, solutions[..., :-1])
    gradients = parameter_gradients - np.matmul(cross, solutions[..., -1:])[..., 0]  # (1)
    return curvatures, gradients


def _test_parameters(
    evaluator: RunEvaluator,
    model: FittedModel,
    grouping: _RunGrouping,
    curvatures: Array,
    gradients: Array,
) -> Iterator[ParameterConsistency]:
    """Test for each parameter whether the groups of runs agree on it.

    Each group G alone would change the fit of all runs together (the joint fit) by the Gauss-Newton
    step d_G = H_G^-1 g_G, with the covariance H_G^-1, where H_G and g_G are sums over its runs (2).
    A group whose interval is too wide is left out, and a parameter needs at least two groups. The
    results are not yet marked as inconsistent, because the significance level depends on the number
    of all tests.

    Shapes: R runs, q fitted parameters.

    Args:
        evaluator: Run evaluator of the runs.
        model: Joint fit of all runs.
        grouping: Groups of runs, for example one for each load.
        curvatures: (R, q, q) H_r, the information of each run on the parameters.
        gradients: (R, q) g_r, the gradient of each run's log-likelihood by the parameters.

    Yields:
        The estimates of the groups, their scatter, its p-value and, for ordered groups, the trend,
        for each parameter that two groups identify.
    """
    joint_errors = _compute_errors(_invert_total(curvatures))
    # Step and standard errors (q,) of each group.
    steps, errors = [], []
    for runs in grouping.runs:
        group_covariance = _invert_total(curvatures[list(runs)])
        steps.append((group_covariance @ gradients[list(runs)].sum(axis=0)).tolist())  # (2)
        errors.append(_compute_errors(group_covariance))
    # Value of the covariate, such as the load. Groups without an order have no such values, and
    # these zeros are not used.
    covariate_of_group = grouping.numbers or (0.0,) * len(grouping.names)
    for column, index in enumerate(model.fit.free_indices.tolist()):
        parameter, value = evaluator.parameters[index], float(model.fit.theta[index])
        low, high = parameter.bounds
        # Scale of the parameter, to which the width of an interval is compared.
        size = max(high - low, abs(value))
        # Groups whose interval is narrow enough.
        group_estimates, covariate_values = [], []
        for name, group_steps, group_errors, covariate_value in zip(
            grouping.names, steps, errors, covariate_of_group, strict=True
        ):
            error = group_errors[column]
            if error > 0 and 2.0 * Z95 * error < MAX_INTERVAL_WIDTH * size:
                group_estimates.append(GroupEstimate(name, value + group_steps[column], error))
                covariate_values.append(covariate_value)
        if len(group_estimates) < 2:
            continue
        scatter, p_value = _estimate_heterogeneity(group_estimates)
        trend = None
        if grouping.numbers:
            trend = _fit_trend(group_estimates, np.array(covariate_values))
        yield ParameterConsistency(
            number=parameter.name,
            unit=parameter.unit,
            by=grouping.by,
            value=value,
            error=joint_errors[column],
            group_estimates=tuple(group_estimates),
            scatter=scatter,
            p_value=p_value,
            is_consistent=True,
            trend=trend,
        )


def _invert_total(curvatures: Array) -> Array:
    """Invert the sum of the curvatures (R, q, q) of runs; see `invert_scaled`."""
    curvature = curvatures.sum(axis=0)
    return invert_scaled(curvature, curvature)


def _compute_errors(covariance: Array) -> list[float]:
    """Return the standard errors of the parameters; rounding may make a variance negative."""
    errors: list[float] = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).tolist()
    return errors


def _list_values_and_weights(group_estimates: Sequence[GroupEstimate]) -> tuple[Array, Array]:
    """Return the values of the groups, and their weights: the squares of the inverse errors."""
    values = np.array([part.value for part in group_estimates])
    return values, np.array([part.error for part in group_estimates]) ** -2.0


def _estimate_heterogeneity(group_estimates: Sequence[GroupEstimate]) -> tuple[float, float]:
    """Estimate by how much groups differ beyond their errors, and test if they differ at all.

    For n groups with the estimates x and the weights w = 1 / var, Cochran's Q is compared with a
    chi-squared distribution with n - 1 degrees of freedom, and tau is the standard deviation
    between groups (DerSimonian and Laird):

        Q = sum w (x - mean)^2                                          (3)
        tau^2 = max(Q - (n - 1), 0) / (sum w - sum w^2 / sum w)         (4)

    Args:
        group_estimates: Estimate and standard error of each group.

    Returns:
        tau, in the unit of the parameter, and the p-value of the hypothesis of equal groups.
    """
    values, weights = _list_values_and_weights(group_estimates)
    weighted_mean = float(weights @ values / weights.sum())
    q = float(weights @ (values - weighted_mean) ** 2)  # (3)
    degrees_of_freedom = len(group_estimates) - 1
    scale = float(weights.sum() - (weights @ weights) / weights.sum())
    tau = np.sqrt(max(q - degrees_of_freedom, 0.0) / scale) if scale > 0 else 0.0  # (4)
    return float(tau), chi_squared_tail(degrees_of_freedom, q)


def _fit_trend(group_estimates: Sequence[GroupEstimate], covariate_values: Array) -> Trend | None:
    """Fit a line to the group estimates over covariate values, weighted by 1 / error².

    Return None for fewer than three groups, or if the covariate is the same in all.

    - If the scatter about the line agrees with the errors of the groups, these are taken as known,
      and the p-value of the slope is that of a normal distribution.
    - If it is larger, the error of the slope is multiplied by the square root of the reduced
      chi-squared (Birge ratio). It is then estimated, so the p-value is that of Student's t.

    With the weights w, the estimates x, and the covariate z minus its weighted mean, the slope is
    sum w z x / sum w z^2.

    Args:
        group_estimates: Estimate and standard error of each group.
        covariate_values: Value of the covariate in each group, such as the load.
    """
    if len(group_estimates) < 3 or not np.ptp(covariate_values) > 0:
        return None
    values, weights = _list_values_and_weights(group_estimates)
    centred = covariate_values - weights @ covariate_values / weights.sum()
    spread = float(weights @ centred**2)
    slope = float(weights @ (centred * values)) / spread
    # Scatter about the line.
    weighted_mean = weights @ values / weights.sum()
    residual = values - weighted_mean - slope * centred
    degrees_of_freedom = len(group_estimates) - 2
    mean_square = float(weights @ residual**2) / degrees_of_freedom
    error = float(np.sqrt(max(mean_square, 1.0) / spread))
    statistic = abs(slope) / error
    if mean_square <= 1.0:
        p_value = erfc(statistic / sqrt(2.0))
    else:
        p_value = student_p_value(statistic, degrees_of_freedom)
    return Trend(slope, error, p_value, mean_square)
