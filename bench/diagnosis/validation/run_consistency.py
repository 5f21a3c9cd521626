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
from math import atan, cos, erfc, pi, sin, sqrt
from typing import Literal, NamedTuple

import numpy as np

from bench.benchmark.statistics.chi_squared import chi_squared_tail
from bench.diagnosis.evaluation.noise_model import whiten
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.trajectory_fit import compute_state_prior
from bench.diagnosis.validation.gain_and_intervals import (
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
    """Yield the covariates of each run that do not depend on its motion.

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
        columns = [run.extra.get(name, np.empty(0)) for run in evaluator.runs]
        means = [float(np.nanmean(v)) if np.isfinite(v).any() else np.nan for v in columns]
        yield RunCovariate("other", name, np.array(means))


def _compute_motion_covariates(
    evaluator: RunEvaluator, model: FittedModel, number: str
) -> Iterator[RunCovariate]:
    """Yield covariates of the simulated motion of each run, at the joint of a parameter.

    A covariate is a quantity that may explain why a parameter differs between runs. They are the
    amplitude (standard deviation), the RMS speed, the direction of motion (-1 to 1), and the mean
    position. Nothing is yielded if the position is not recorded.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        model: model that simulates them.
        number: name of the parameter, ``NAME@JOINT`` for that of a joint.
    """
    system = evaluator.simulator.system
    if not system.coordinates:
        return
    joint_coordinate = f"q.{number.partition('@')[2]}"
    name = (
        joint_coordinate
        if joint_coordinate in system.coordinates
        else system.coordinates[system.primary]
    )
    if name not in evaluator.channels:
        return
    column = evaluator.channels.index(name)
    run_covariates = []
    for run_data, simulated in zip(evaluator.prepared_runs, model.fit.simulated, strict=True):
        times = run_data.scenario.times
        positions = simulated[: times.size, column]
        velocities = np.gradient(positions, times)
        mean_direction = float(velocities.sum() / max(np.abs(velocities).sum(), 1e-300))
        run_covariates.append(
            (
                float(positions.std()),
                compute_rms(velocities),
                mean_direction,
                positions.mean(),
            )
        )
    amplitude, speed, direction, position = np.array(run_covariates).T
    yield RunCovariate("amplitude", "the amplitude", amplitude)
    yield RunCovariate("speed", "the speed", speed)
    yield RunCovariate("direction", "the direction of motion", direction)
    yield RunCovariate("position", "the position", position)


def _varies_between_runs(values: Array) -> bool:
    """Return whether a covariate differs enough between runs to test a trend with it."""
    return bool(
        np.isfinite(values).all() and np.ptp(values) > MIN_RELATIVE_VARIATION * np.abs(values).max()
    )


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
    consistencies = [
        (grouping, consistency)
        for grouping in groupings
        for consistency in _test_parameters(evaluator, model, grouping, curvatures, gradients)
    ]
    level = SIGNIFICANCE_LEVEL / max(len(consistencies), 1)
    assessed = [
        (grouping, _assess_parameter(consistency, level)) for grouping, consistency in consistencies
    ]
    return tuple(
        consistency
        if consistency.is_consistent
        else replace(
            consistency,
            trend_covariate=_find_trend_covariate(evaluator, model, grouping, consistency),
        )
        for grouping, consistency in assessed
    )


def _find_trend_covariate(
    evaluator: RunEvaluator,
    model: FittedModel,
    grouping: _RunGrouping,
    consistency: ParameterConsistency,
) -> TrendCovariate | None:
    """Find the covariate, such as load or temperature, with which a parameter changes.

    Groups by a constant have this constant as their covariate. For runs and logs, a line is fitted
    for every covariate; the one with a significant trend and the smallest scatter about the line is
    returned, with others that fit about as well. Return None if no trend is significant.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        model: fitted model: its effects, parameters, initial states and likelihood.
        grouping: the groups of runs, such as logs.
        consistency: estimates of the parameter from each group.
    """
    # Groups by a constant.
    if grouping.by not in ("run", "log"):
        if consistency.trend is None or consistency.trend.p_value >= SIGNIFICANCE_LEVEL:
            return None
        return TrendCovariate(
            classify_constant(evaluator, grouping.by), grouping.by, consistency.trend
        )
    runs_by_group = {
        name: list(runs) for name, runs in zip(grouping.names, grouping.runs, strict=True)
    }
    trends = []
    for covariate in compute_run_covariates(evaluator, model, consistency.number):
        values = np.array(
            [
                covariate.values[runs_by_group[part.group]].mean()
                for part in consistency.group_estimates
            ]
        )
        trend = (
            _fit_trend(consistency.group_estimates, values)
            if len(consistency.group_estimates) >= MIN_GROUPS_FOR_TREND
            else None
        )
        if trend is not None:
            # The mean square about the line is at least that of the errors, 1.
            trends.append((max(trend.mean_square, 1.0), covariate, trend))
    significant_trends = [
        entry for entry in trends if entry[2].p_value < SIGNIFICANCE_LEVEL / len(trends)
    ]
    if not significant_trends:
        return None
    lowest_scatter, best, trend = min(significant_trends, key=lambda entry: entry[0])
    # A covariate that fits about as well cannot be distinguished from the best one.
    similar_covariates = [
        covariate.name
        for residual_scatter, covariate, _ in significant_trends
        if covariate is not best and residual_scatter < COVARIATE_TIE_FACTOR * lowest_scatter
    ]
    return TrendCovariate(best.kind, best.name, trend, tuple(similar_covariates))


def _assess_parameter(consistency: ParameterConsistency, level: float) -> ParameterConsistency:
    """Mark a parameter as consistent if its scatter is small or not significant at `level`."""
    is_scatter_small = consistency.scatter < MIN_RELEVANT_SCATTER * abs(consistency.value)
    return replace(consistency, is_consistent=is_scatter_small or consistency.p_value >= level)


def _list_groupings(runs: Sequence[Run]) -> Iterator[_RunGrouping]:
    """Yield the ways to group the runs: by log, by each differing constant, by single run.

    Each grouping has the labels of its groups, the indices of the runs in each, and, where they
    have an order, the values by which a trend can be tested.
    """
    logs = tuple(dict.fromkeys(run.log for run in runs))
    if len(logs) > 1:
        run_indices = tuple(
            tuple(i for i, run in enumerate(runs) if run.log == log) for log in logs
        )
        yield _RunGrouping("log", logs, run_indices, tuple(map(float, range(len(logs)))))
    for name in dict.fromkeys(name for run in runs for name in run.constants):
        values = [run.constants.get(name, np.nan) for run in runs]
        unique_values = sorted(set(values))
        if len(unique_values) > 1 and np.isfinite(unique_values).all():
            run_indices = tuple(
                tuple(i for i, v in enumerate(values) if v == unique_value)
                for unique_value in unique_values
            )
            # Runs with an equal value of the constant, such as a load, form a group.
            yield _RunGrouping(
                name,
                tuple(f"{unique_value:g}" for unique_value in unique_values),
                run_indices,
                tuple(unique_values),
            )
    if len(runs) > 1:
        yield _RunGrouping(
            "run", tuple(run.name for run in runs), tuple((i,) for i in range(len(runs)))
        )


def _compute_run_normal_equations(models: ModelSet, model: FittedModel) -> tuple[Array, Array]:
    """Compute the normal equations of the q parameters for each run.

    They show by how much each run alone would change the joint fit, without fitting it again. They
    are the curvatures H (R, q, q) and the gradients g (R, q), after the initial states of the run
    are eliminated: eq. (1) of the module docstring, where the derivatives of the parameters, A, and
    of the initial states, B, are defined.

    Shapes: R runs.

    Args:
        models: the models, with the runs.
        model: fitted model: its effects, parameters, initial states and likelihood.
    """
    evaluator, fit = models.evaluator, model.fit
    q = fit.free_indices.size
    fisher_blocks = compute_fisher_blocks(models, model)
    residual = whiten(models.compute_residual(fit), models.observed_mask, fisher_blocks.noise)
    gradients_by_unknown = np.einsum(
        "rnk,rn->rk", fisher_blocks.jacobian, residual.reshape(len(residual), -1)
    )
    gradients_by_unknown[:, q:] += compute_state_prior(evaluator) ** -2.0 * (
        evaluator.initial_state_guesses - fit.initial_states
    )
    gradients_by_unknown[:, q:] *= ~evaluator.known_state_mask
    right_hand_sides = np.concatenate(
        [fisher_blocks.cross.transpose(0, 2, 1), gradients_by_unknown[:, q:, None]], 2
    )
    state_solutions = np.linalg.solve(fisher_blocks.states, right_hand_sides)
    curvatures = fisher_blocks.parameters - np.matmul(
        fisher_blocks.cross, state_solutions[..., :-1]
    )
    gradients = (
        gradients_by_unknown[:, :q]
        - np.matmul(fisher_blocks.cross, state_solutions[..., -1:])[..., 0]
    )  # (1)
    return curvatures, gradients


def _test_parameters(
    evaluator: RunEvaluator,
    model: FittedModel,
    grouping: _RunGrouping,
    curvatures: Array,
    gradients: Array,
) -> Iterator[ParameterConsistency]:
    """Test for each parameter whether the groups of runs agree on it.

    Each group G alone would change the joint fit by the Gauss-Newton step d_G of eq. (2). A group
    whose interval is too wide is left out, and a parameter needs at least two groups.

    The step of group G is d_G = H_G^-1 g_G with covariance H_G^-1, where H_G and g_G are sums over
    its runs (2).

    Shapes: R runs, q fitted parameters.

    Args:
        evaluator: Run evaluator of the runs.
        model: Joint fit of all runs.
        grouping: Groups of runs, for example one for each load.
        curvatures: (R, q, q) H_r of eq. (1), the information of each run on the parameters.
        gradients: (R, q) g_r of eq. (1).
    """
    joint_covariance = _invert(curvatures)
    steps, group_errors = [], []
    for runs in grouping.runs:
        group_covariance = _invert(curvatures[list(runs)])
        steps.append(group_covariance @ gradients[list(runs)].sum(axis=0))  # (2)
        group_errors.append(np.sqrt(np.maximum(np.diagonal(group_covariance), 0.0)))
    for column, index in enumerate(model.fit.free_indices.tolist()):
        parameter, value = evaluator.parameters[index], float(model.fit.theta[index])
        low, high = parameter.bounds
        size = max(high - low, abs(value))
        group_estimates, covariate_values = [], []
        for group, name in enumerate(grouping.names):
            error = float(group_errors[group][column])
            if error > 0 and 2.0 * Z95 * error < MAX_INTERVAL_WIDTH * size:
                group_estimates.append(
                    GroupEstimate(name, value + float(steps[group][column]), error)
                )
                covariate_values.append(grouping.numbers[group] if grouping.numbers else 0.0)
        if len(group_estimates) < 2:
            continue
        error = float(np.sqrt(max(joint_covariance[column, column], 0.0)))
        scatter, p_value = _estimate_heterogeneity(group_estimates)
        trend = (
            _fit_trend(group_estimates, np.array(covariate_values)) if grouping.numbers else None
        )
        yield ParameterConsistency(
            number=parameter.name,
            unit=parameter.unit,
            by=grouping.by,
            value=value,
            error=error,
            group_estimates=tuple(group_estimates),
            scatter=scatter,
            p_value=p_value,
            # The level depends on the number of all tests, so the caller decides.
            is_consistent=True,
            trend=trend,
        )


def _invert(curvatures: Array) -> Array:
    """Invert the sum of the curvatures (R, q, q) of runs; see `invert_scaled`."""
    curvature = curvatures.sum(axis=0)
    return invert_scaled(curvature, curvature)


def _weigh(group_estimates: Sequence[GroupEstimate]) -> tuple[Array, Array]:
    """Return the values of the groups, and their weights: the squares of the inverse errors."""
    values = np.array([part.value for part in group_estimates])
    return values, np.array([part.error for part in group_estimates]) ** -2.0


def _estimate_heterogeneity(group_estimates: Sequence[GroupEstimate]) -> tuple[float, float]:
    """Estimate by how much groups differ beyond their errors: tau of eq. (4), and the p-value.

    The method is that of DerSimonian and Laird, with Cochran's Q.

    Q = sum w (x - mean)^2 with w = 1 / var (3), and tau^2 = (Q - (n - 1)) / (sum w - sum w^2 / sum
    w) for n groups (4).

    Args:
        group_estimates: Estimate and standard error of each group.
    """
    values, weights = _weigh(group_estimates)
    weighted_mean = float(weights @ values / weights.sum())
    q = float(weights @ (values - weighted_mean) ** 2)  # (3)
    degrees_of_freedom = len(group_estimates) - 1
    scale = float(weights.sum() - (weights @ weights) / weights.sum())
    tau = np.sqrt(max(q - degrees_of_freedom, 0.0) / scale) if scale > 0 else 0.0  # (4)
    return float(tau), chi_squared_tail(degrees_of_freedom, q)


def _fit_trend(group_estimates: Sequence[GroupEstimate], covariate_values: Array) -> Trend | None:
    """Fit a line to the group estimates over covariate values, weighted by 1 / error².

    Return None for fewer than three groups, or if the covariate is the same in all.

    The error of the slope is multiplied by the square root of the reduced chi-squared, if this is
    above 1 (Birge ratio).

    Args:
        group_estimates: Estimate and standard error of each group.
        covariate_values: Value of the covariate in each group, such as the load.
    """
    if len(group_estimates) < 3 or not np.ptp(covariate_values) > 0:
        return None
    values, weights = _weigh(group_estimates)
    centred = covariate_values - weights @ covariate_values / weights.sum()
    spread = float(weights @ centred**2)
    slope = float(weights @ (centred * values)) / spread
    residual = values - weights @ values / weights.sum() - slope * centred
    degrees_of_freedom = len(group_estimates) - 2
    mean_square = float(weights @ residual**2) / degrees_of_freedom
    error = float(np.sqrt(max(mean_square, 1.0) / spread))
    # If the scatter agrees with the errors, these are known; otherwise they are estimated.
    t_statistic = abs(slope) / error
    return Trend(
        slope,
        error,
        erfc(t_statistic / sqrt(2.0))
        if mean_square <= 1.0
        else _compute_student_p_value(t_statistic, degrees_of_freedom),
        mean_square,
    )


def _compute_student_p_value(size: float, freedom: int) -> float:
    """Return the two-sided p-value of Student's t distribution, to an absolute error of 1e-15.

    The finite series for whole degrees of freedom is used (M. Abramowitz, I. A. Stegun, Handbook of
    Mathematical Functions, 1964, equations 26.7.3 and 26.7.4), because importing scipy.special
    takes 0.1 s.

    Args:
        size: absolute value of the statistic t.
        freedom: degrees of freedom.
    """
    angle = atan(size / sqrt(freedom))
    is_odd = freedom % 2
    term = sin(angle) * (cos(angle) if is_odd else 1.0)
    inside = 0.0
    for power in range(1 + is_odd, freedom, 2):
        inside += term
        term *= cos(angle) ** 2 * power / (power + 1.0)
    if is_odd:
        inside = 2.0 / pi * (angle + inside)
    return max(1.0 - inside, 0.0)
