"""Identify the model of a long recording by one-step prediction errors, without simulating runs.

A model of a real robot is never complete. Simulated over a long run without feedback, the forces
that it lacks add up to a drift, so a fit of the simulation is biased, and every trial is slow. A
filter attributes these forces to process noise and keeps the state near the data: its estimates are
close to those of inverse dynamics (M. Gautier, A. Janot and P.-O. Vandanjon, IEEE Trans. Control
Syst. Technol. 21, 428, 2013, doi:10.1109/TCST.2012.2185697).

    1. Put the standard joint model and the inertia of every body into the filter's model, and
       maximise the likelihood of the innovations.
    2. Add effects of the library, chosen by regression of the innovations, while each pays and
       predicts left-out runs better.
    3. Remove effects that do not pay.

If the filter then lacks no force, the model may be complete, and simulation decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import (
    Bounds,
    compute_range_around,
    get_bounds_by_index,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.kalman.candidate_responses import Columns
from bench.diagnosis.kalman.likelihood_fit import (
    MIN_STEP_GAIN,
    compute_information,
    compute_wald_statistics,
    maximise_innovation_likelihood,
)
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet
from bench.diagnosis.prediction_error.regression_columns import (
    build_regression_about,
    group_coefficients,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    MAX_IMPROVED_SIZE,
    MIN_FURTHER_GAIN_SHARE,
)
from bench.diagnosis.search.fit_starts import add_effect_to_start

MIN_SECONDS = 8.0
"""Minimum duration in seconds of each run of a long recording."""
MIN_EXCESS = 100.0
"""Minimum excess of the base model, in units of the noise, that such a model may leave.

A smaller discrepancy is explained by simulation.
"""
MAX_JOINTS = 3
"""Maximum number of joints; more of them have too many coefficients for finite differences."""
TEXTBOOK_EFFECTS = ("friction.coulomb", "drag.linear", "inertia.scale")
"""Effects that are in the model from the start, at every place that has them.

The inertia of a body that moves along a straight line has no influence, and is removed.
"""
MAX_ADDED = 3
"""Maximum number of effects that are added to the textbook model."""
NEGLIGIBLE_FORCE_SHARE = 0.1
"""Maximum missing forces, as a share of those of the base model, at which no effect is added."""
MAX_SET_ITERATIONS = 6
"""Maximum number of Gauss-Newton steps of a set."""
MIN_STEP_GAIN_SHARE = 0.003
"""Minimum gain by a Gauss-Newton step for which another step follows, as a share of the gain so
far."""
MAX_STATE_ITERATIONS = 4
"""Maximum number of iterations for the initial states of the simulated runs."""


@dataclass(frozen=True)
class IdentifiedSet:
    """A set of effects identified together with the base parameters.

    Attributes:
        model: the set, simulated with these parameters.
        gains: loss in twice the log-likelihood without each effect, by name: of the innovations, or
            of the positions of a servo's joint.
        is_residual_tested: whether the innovations can show which force the set lacks.
    """

    model: FittedModel
    gains: dict[str, float]
    is_residual_tested: bool = True


def identify_incomplete(context: SearchContext) -> IdentifiedSet | None:
    """Identify the effects and the base parameters of a long recording by prediction errors.

    Prediction errors are the innovations of a Kalman filter. The textbook effects (Coulomb
    friction, drag, inertia of the bodies) are fitted in the filter's model, and those that gain too
    little are removed. Then up to `MAX_ADDED` further effects are added, each with the largest gain
    by regression, until the missing forces are negligible or no effect gains enough. The result is
    simulated, but not fitted by simulation: an incomplete model drifts away over a long run.

    Args:
        context: search, filters and regressions of the recording.

    Returns:
        The identified set; None if the runs are short or nearly explained, if no effect pays, or
        if the set lacks no force, so that a simulation can be fitted.
    """
    evaluator, filters = context.evaluator, context.filters
    # RMS residual of the base model in units of the noise, minus one.
    excess = context.search.compute_excess_residual(context.search.base_model)
    if not is_long(evaluator) or not excess > MIN_EXCESS or evaluator.search_control.is_over():
        return None
    evaluator.search_control.begin_stage("identifying the joints and bodies")
    textbook = [
        name
        for name in evaluator.library
        if name.partition("@")[0] in TEXTBOOK_EFFECTS and not name.endswith("@*")
    ]
    current, gains = _prune_set(context, _fit_set(context, filters.base, textbook))
    columns: Columns | None = None
    for _ in range(MAX_ADDED):
        if _is_negligible(context, current):
            break
        columns = columns or _list_single_effects(context)
        larger = _add_next_effect(context, current, columns)
        if larger is None:
            break
        current, gains = _prune_set(context, larger)
        # The new effect was removed at once.
        if larger.names[-1] not in current.names:
            break
    # A set that lacks no force may be complete, and is then fitted by simulation.
    if not current.names or not current.followed.has_missing_force:
        return None
    states = context.filters.estimate_first_states(current.followed)
    start = FitStart(current.names, current.followed.theta, states)
    return IdentifiedSet(simulate_identified(context, start), gains)


def is_long(evaluator: RunEvaluator) -> bool:
    """Return whether all runs of a robot with few joints are long."""
    few = len(evaluator.simulator.system.coordinates) <= MAX_JOINTS
    return few and all(run.times[-1] - run.times[0] >= MIN_SECONDS for run in evaluator.runs)


def _is_negligible(context: SearchContext, current: FilteredSet) -> bool:
    """Return whether a set leaves a negligible share of the base model's missing forces.

    Missing forces are the standard deviations of the process noise of a filter.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with its filter.
    """
    limits = NEGLIGIBLE_FORCE_SHARE * context.filters.base.force
    return not current.followed.has_missing_force or bool((current.followed.force < limits).all())


def _get_bounds(context: SearchContext, names: Sequence[str]) -> dict[int, Bounds]:
    """Return the bounds of the free base parameters and of some effects, by index in theta.

    Args:
        context: search, filters and regressions of the recording.
        names: names of the effects.
    """
    evaluator = context.evaluator
    free = [i for i in evaluator.base_indices.tolist() if i not in context.search.fixed_parameters]
    bounds = {i: compute_range_around(evaluator, i) for i in free}
    return bounds | get_bounds_by_index(evaluator, names)


def _fit_set(context: SearchContext, followed: FollowedRuns, names: Sequence[str]) -> FilteredSet:
    """Maximise the likelihood of the innovations with effects in the filter's model.

    Fitted are the free base parameters and the coefficients of the effects, by Gauss-Newton steps.
    They end when a step gains little compared with the gain over the base model so far.

    Args:
        context: search, filters and regressions of the recording.
        followed: the runs, filtered with the parameters from which the fit starts.
        names: names of the effects.
    """
    base_log_likelihood = context.filters.base.log_likelihood
    min_gain = max(
        MIN_STEP_GAIN_SHARE * (followed.log_likelihood - base_log_likelihood), MIN_STEP_GAIN
    )
    bounds = _get_bounds(context, names)
    best = maximise_innovation_likelihood(
        followed,
        bounds,
        MAX_SET_ITERATIONS,
        lambda theta, best: best.with_parameters(theta),
        min_gain,
    )
    return FilteredSet(best, tuple(names))


def _compute_min_gain(context: SearchContext, current: FilteredSet, name: str) -> float:
    """Return the minimum gain of an effect of a set in twice the log-likelihood.

    It is the penalty of the effect, or a small share of the gain of the set over the base model if
    that is larger.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with its filter.
        name: name of the effect.
    """
    filters = context.filters
    return max(
        filters.penalty(name), MIN_FURTHER_GAIN_SHARE * filters.compute_gain(current.followed)
    )


def _prune_set(
    context: SearchContext, current: FilteredSet
) -> tuple[FilteredSet, dict[str, float]]:
    """Remove the effects that gain too little, the least first, and maximise the likelihood again.

    The gain of an effect is its Wald statistic: the loss in twice the log-likelihood without it, to
    second order. If the removed effects together lose little, the set without them is the result.
    If they lose more than twice the gain at which a maximisation ends (`MIN_STEP_GAIN`), the best
    values of the other coefficients may have changed: the likelihood is maximised again, and the
    remaining effects are tested again.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with the runs followed by a filter with its effects.

    Returns:
        The remaining set, and the gain of each of its effects.
    """
    followed, names, lost_gain = current.followed, list(current.names), 0.0
    # The information is computed once; removing an effect only removes its rows and columns.
    bounds = _get_bounds(context, names)
    information = compute_information(followed, bounds)
    min_gains = {name: _compute_min_gain(context, current, name) for name in names}
    while True:
        gains = compute_wald_statistics(
            context.evaluator,
            followed.theta,
            names,
            information.select(list(_get_bounds(context, names))),
        )
        negligible = [name for name in names if gains[name] < min_gains[name]]
        if not negligible:
            break
        weakest = min(negligible, key=lambda name: gains[name] - min_gains[name])
        names.remove(weakest)
        lost_gain += gains[weakest]
    if len(names) == len(current.names):
        return current, gains
    theta = followed.theta.copy()
    for name in set(current.names) - set(names):
        theta[context.evaluator.coefficient_slices[name]] = 0.0
    if not np.array_equal(theta, followed.theta):
        followed = followed.with_parameters(theta)
    if lost_gain > 2.0 * MIN_STEP_GAIN:
        return _prune_set(context, _fit_set(context, followed, names))
    return FilteredSet(followed, tuple(names)), gains


def _add_next_effect(
    context: SearchContext, current: FilteredSet, columns: Columns
) -> FilteredSet | None:
    """Add the effect that gains most by regression, in place of the effects that it contains.

    The regression about the present set chooses the effect and its first coefficients. The effect
    must predict left-out runs better, because a model that stays incomplete lets an effect imitate
    a missing force in some of the runs. The larger set is then fitted, and must gain enough.

    Args:
        context: search, filters and regressions of the recording.
        current: the set.
        columns: responses of the effects that may be added.

    Returns:
        The larger set; None if no effect gains enough, or if the best one does not predict
        left-out runs better.
    """
    evaluator = context.evaluator
    regression, _ = build_regression_about(current, [columns], current.followed)
    gains = regression.compute_net_gains()
    for i, group in enumerate(regression.groups):
        # Effects of the set cannot be added again: their gain counts as zero.
        gains[i] *= group.effect not in current.names
    best = regression.groups[int(np.argmax(gains))]
    if not gains.max() > 0.0 or not regression.generalises([], [best]):
        return None
    (solution,) = regression.solve([best]).coefficients
    coefficients = group_coefficients(evaluator, columns.probes, best, solution)
    present_start = FitStart(current.names, current.followed.theta, evaluator.initial_state_guesses)
    start = add_effect_to_start(evaluator, present_start, best.effect, coefficients)
    larger = _fit_set(context, current.followed.with_parameters(start.theta), start.effects)
    gain = 2.0 * (larger.followed.log_likelihood - current.followed.log_likelihood)
    return larger if gain > _compute_min_gain(context, larger, best.effect) else None


def _list_single_effects(context: SearchContext) -> Columns:
    """Return the columns of the effects that may be added: at one place, with few coefficients.

    Candidates of the library are effects with few shapes; their families (``@*``) are left out.

    Args:
        context: search, filters and regressions of the recording.
    """
    library = context.columns.library
    chosen = [
        i
        for i, probe in enumerate(library.probes)
        if not probe.effect.endswith("@*")
        and len(context.evaluator.get_coefficient_indices(probe.effect)) <= MAX_IMPROVED_SIZE
    ]
    return library.subset(chosen)


def simulate_identified(context: SearchContext, start: FitStart) -> FittedModel:
    """Simulate the runs with identified parameters, from fitted initial states.

    Only the initial states are fitted, in a few iterations. The fit with the derivatives by all
    parameters, which the search needs, then makes no step.

    Args:
        context: search, filters and regressions of the recording.
        start: the parameters, and estimates of the initial states.
    """
    evaluator, search = context.evaluator, context.search
    (fitted_states,) = TrajectoryFitter(
        evaluator, search.noise, search.fixed_parameters, fits_parameters=False
    ).fit_models([start], MAX_STATE_ITERATIONS)
    (fit,) = TrajectoryFitter(evaluator, search.noise, search.fixed_parameters).fit_models(
        [replace(start, initial_states=fitted_states.initial_states)], 0
    )
    return search.add_fit(fit)
