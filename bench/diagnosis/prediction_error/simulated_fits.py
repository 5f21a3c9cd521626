"""Fit selected sets of effects to whole simulated runs, and decide whether they explain them.

The cost of a fit is not smooth where joints stick and where servos are at force limits, so a fit
may stop in a local minimum. It is restarted from nearby coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.dry_friction_form import has_dry_friction
from bench.diagnosis.fitting.base_fit import compute_start_costs
from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import compute_state_jacobian
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.settled_simulations import estimate_settled_start
from bench.diagnosis.search.fit_starts import make_replacing_start
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import TIME_DEPENDENT_EFFECTS
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

NEARBY_FACTORS = (0.8, 0.9, 0.96, 0.98, 0.99, 1.01, 1.02, 1.04, 1.1, 1.2)
"""Factors of a coefficient at which a fit looks for a lower cost nearby."""
MAX_IMPROVED_SIZE = 3
"""Maximum number of coefficients of an effect that is improved alone, such as from nearby ones."""
EXPLAINED_EXCESS = 0.03
"""Maximum excess over the noise of a fitted set that explains the data; see `is_at_noise`."""
NEARLY_EXPLAINED_SHARE = 0.1
"""Maximum excess, as a share of that of the base model, at which effects are only added."""
NEGLIGIBLE_EXCESS, NEGLIGIBLE_EXCESS_SHARE = 0.1, 0.005
"""Maximum excess at which the search ends: absolute, and as a share of that of the base model."""
NEGLIGIBLE_EXCESS_ON_GROUND = 0.3
"""Maximum absolute excess of a robot on the ground.

Simulated contacts creep, so that wheels and feet slip a little where real ones hold.
"""
MAX_SURPLUS = 2
"""Maximum number of consecutive effects with too little gain before a selection is cut."""
MAX_SLOW_EFFECTS = 2
"""Maximum number of effects in a set that is fitted by simulation although this is slow."""
MIN_FURTHER_GAIN_SHARE = 0.01
"""Minimum gain of a further effect, as a share of the gain of the set.

The model of a real robot is never complete, and long recordings show this with certainty.
"""
MAX_SINGLE_SQUARES_SHARE = 0.3
"""Maximum share of the squares beyond noise that a likely effect leaves before any fit."""
MAX_NOISE_LIKE_COST = 1.5
"""Maximum mean squared residual, in units of the noise, at which no better start is searched."""
MAX_STATE_ITERATIONS = 4
"""Maximum number of iterations for the initial states of the simulated runs."""


class RatedStart(NamedTuple):
    """A start that was simulated without a fit.

    Attributes:
        cost: sum of squared residuals in units of the noise; infinite if the simulation fails.
        start: the start.
    """

    cost: float
    start: FitStart


def fit_by_simulation(
    context: SearchContext, start: FitStart, is_incomplete: bool = False
) -> FittedModel:
    """Fit a set of effects by simulation, with restarts if it does not explain the runs.

    1. Fit the set once. For a robot on the ground, its first states are estimated before.
    2. Stop if it explains the runs, if its simulation fails, or if it leaves much of the
       discrepancy because it is incomplete: a force is missing in addition to its effects, or at a
       joint where none of them acts.
    3. Fit the first states alone, which is more robust than a fit of all together, and then all
       again, with derivatives by the first states about the simulated motion, because those about
       the measured motion may be invalid.
    4. Fit dry friction again from nearby coefficients, because its fit may stop in a local minimum.
       Where servos reach their force limits, this is done for all small effects.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        start: the effects, with first parameters and initial states.
        is_incomplete: whether a filter shows that a force is missing in addition to the effects.

    Returns:
        The fitted model, even if it does not explain the runs; its cost is infinite if simulation
        fails.
    """
    search, evaluator = context.search, context.evaluator
    if context.filters.base.is_on_ground:
        start = estimate_settled_start(evaluator, context.filters.noise, start)
    fitted = search.fit_one(start)
    if is_explained(context, fitted) or not np.isfinite(fitted.fit.cost):
        return fitted
    is_incomplete = is_incomplete or not context.filters.act_where_forces_are_missing(start.effects)
    if is_incomplete and not is_nearly_explained(context, fitted):
        return fitted
    # Replace the derivatives by first states in the evaluator, where all fits find them.
    derivatives_before = evaluator.state_derivatives
    start = fit_states_alone(context, fitted).make_start()
    compute_state_jacobian(evaluator, start.theta, start.initial_states, is_recomputed=True)
    fitted = search.fit_one(start)
    if not is_explained(context, fitted):
        # Derivatives about a wrong motion are not valid for other models.
        evaluator.state_derivatives = derivatives_before
    has_jumps = bool(context.filters.base.runs.jumps.any())
    for name in fitted.effects:
        is_small = len(evaluator.get_coefficient_indices(name)) <= MAX_IMPROVED_SIZE
        may_stop_early = has_dry_friction(evaluator, [name]) or (has_jumps and is_small)
        if may_stop_early and not is_explained(context, fitted):
            fitted = fit_nearby(context, fitted, name)
    return fitted


def fit_states_alone(context: SearchContext, model: FittedModel) -> TrajectoryFit:
    """Return a fit of the first states with the parameters of a model.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
    """
    search = context.search
    fitter = TrajectoryFitter(
        context.evaluator, search.noise, search.fixed_parameters, fits_parameters=False
    )
    (fit,) = fitter.fit_models([model.fit.make_start()])
    return fit


def simulate_identified(context: SearchContext, start: FitStart) -> FittedModel:
    """Simulate the runs with identified parameters, from fitted initial states.

    Only the initial states are fitted, in a few iterations. A second fit makes no step (zero
    iterations): it only computes the derivatives by all parameters, which the search needs.

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


def make_filtered_start(context: SearchContext, current: FilteredSet) -> FitStart:
    """Return the start of a fit with the coefficients of a filter.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with its filter.
    """
    states = context.filters.estimate_first_states(current.followed)
    return FitStart(current.names, current.followed.theta, states)


def fit_filtered(context: SearchContext, current: FilteredSet) -> FittedModel:
    """Fit a set by simulation, starting from the coefficients of its filter; the fit is cached.

    A set is a group of effects in the model of a Kalman filter. The filter also tells whether a
    force is still missing; then a fit that leaves much of the residual is not repeated.

    Args:
        context: search, filters and regressions of the recording.
        current: the set.
    """
    key = current.names, current.followed.theta.tobytes()
    if key not in context.filtered_fits:
        start = make_filtered_start(context, current)
        context.filtered_fits[key] = fit_by_simulation(
            context, start, current.followed.has_missing_force
        )
    return context.filtered_fits[key]


def fit_nearby(context: SearchContext, model: FittedModel, name: str) -> FittedModel:
    """Fit a model again from the best of several nearby coefficients of an effect.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
        name: name of the effect.
    """
    # All starts have the same effects, so one of them is selected.
    ((cost, start),) = select_lowest_of_each(context, list_nearby_starts(context, model, name))
    return context.search.fit_one(start) if cost < model.fit.cost else model


def list_nearby_starts(context: SearchContext, model: FittedModel, name: str) -> list[FitStart]:
    """Return starts with nearby coefficients of an effect, each changed by several factors.

    The cost of a fit has local minima, for instance where joints stick; one of these starts may lie
    beyond. Initial states are those of the fit, or those that were measured.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        model: the fitted model.
        name: name of the effect.
    """
    measured_states = context.filters.estimate_first_states(context.filters.base)
    starts = []
    for index in context.evaluator.get_coefficient_indices(name):
        for factor in NEARBY_FACTORS:
            theta = model.fit.theta.copy()
            theta[index] *= factor
            starts += [
                FitStart(model.effects, theta, initial_states)
                for initial_states in (model.fit.initial_states, measured_states)
            ]
    return starts


def select_lowest_of_each(context: SearchContext, starts: Sequence[FitStart]) -> list[RatedStart]:
    """Simulate starts, and return the one with the lowest cost for each set of effects.

    Simulating all starts once over the whole runs, without a fit, is cheap. Only these best starts
    are then fitted.

    Args:
        context: search, filters and regressions of the recording.
        starts: the starts.

    Returns:
        The start with its cost for each set, in ascending order of the cost (sum of squared
        residuals in units of the noise). A start that cannot be simulated has an infinite cost.
    """
    if not starts:
        return []
    costs = compute_start_costs(
        context.evaluator, context.search.noise, starts, share=1.0, failed_residual=np.inf
    )
    best_of_each_set: dict[tuple[str, ...], RatedStart] = {}
    # In ascending order of the cost, so the first start of a set is its best one.
    for i in np.argsort(costs, kind="stable").tolist():
        best_of_each_set.setdefault(starts[i].effects, RatedStart(float(costs[i]), starts[i]))
    return list(best_of_each_set.values())


def compute_likely_cost(context: SearchContext) -> float:
    """Return the cost below which a start that was simulated without a fit is likely.

    It is that of noise plus the share `MAX_SINGLE_SQUARES_SHARE` of what the base model leaves
    beyond noise.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
    """
    noise = float(context.filters.base.runs.recorded.sum())
    return noise + MAX_SINGLE_SQUARES_SHARE * max(context.search.base_model.fit.cost - noise, 0.0)


def has_noise_like_cost(context: SearchContext, rated_starts: Sequence[RatedStart]) -> bool:
    """Return whether the best of some simulated starts leaves little more than noise without a fit.

    This is the case if its mean squared residual, in units of the noise, is below
    `MAX_NOISE_LIKE_COST`.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        rated_starts: costs and starts in ascending order of the cost; there may be none.
    """
    if not rated_starts:
        return False
    sample_count = int(context.filters.base.runs.recorded.sum())
    return rated_starts[0].cost < MAX_NOISE_LIKE_COST * sample_count


def is_explained(context: SearchContext, model: FittedModel) -> bool:
    """Return whether a fitted model leaves only noise, or a negligible share of a large residual.

    The excess residual is the RMS residual in units of the noise, minus one. It is negligible if it
    is below both an absolute limit and a share of that of the base model. A model with stiff dry
    friction must leave only noise: a small remaining residual may show that the friction has
    MuJoCo's soft form (`filters.is_soft` if the simulator has that form already).

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        model: the fitted model.
    """
    if is_at_noise(context, model):
        return True
    # Friction of the wrong form may leave a small residual.
    if has_dry_friction(context.evaluator, model.effects) and not context.filters.is_soft:
        return False
    compute_excess = context.search.compute_excess_residual
    is_on_ground = context.filters.base.is_on_ground
    return compute_excess(model) < min(
        NEGLIGIBLE_EXCESS_ON_GROUND if is_on_ground else NEGLIGIBLE_EXCESS,
        NEGLIGIBLE_EXCESS_SHARE * compute_excess(context.search.base_model),
    )


def is_at_noise(context: SearchContext, model: FittedModel) -> bool:
    """Return whether a fitted model leaves only noise.

    The residual must pass the tests of noise, and its excess be below `EXPLAINED_EXCESS`, or below
    `NEGLIGIBLE_EXCESS` for a robot on the ground, whose simulated contacts creep.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        model: the fitted model.
    """
    limit = NEGLIGIBLE_EXCESS if context.filters.base.is_on_ground else EXPLAINED_EXCESS
    is_small = context.search.compute_excess_residual(model) < limit
    return is_small and context.search.is_noise_like(model)


def is_nearly_explained(context: SearchContext, model: FittedModel) -> bool:
    """Return whether a model removes most of the discrepancy.

    Its excess residual (RMS residual in units of the noise, minus one) is compared with that of the
    base model.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
    """
    compute_excess = context.search.compute_excess_residual
    return compute_excess(model) < NEARLY_EXPLAINED_SHARE * compute_excess(
        context.search.base_model
    )


def remove_idle_effects(context: SearchContext, model: FittedModel) -> FittedModel:
    """Remove effects that gain less than their penalty, and simplify families and richer laws.

    The same effect at every place becomes one effect for all places, its family (``@*``). A family
    is replaced by a single member that is as good, and a law by a simpler one that it contains.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
    """
    model = _merge_into_families(context, context.search.drop_unneeded_effects(model))
    search = context.search
    is_reducible = any(
        name.endswith("@*") or search.find_contained_slices(name) for name in model.effects
    )
    return search.simplify_laws(model) if is_reducible else model


def _merge_into_families(context: SearchContext, model: FittedModel) -> FittedModel:
    """Replace the same effect at every place by one effect for all places, its family.

    For example, ``drag.linear@shoulder`` and ``drag.linear@elbow``, of a robot with these joints,
    become ``drag.linear@*``, which begins at their coefficients. The refitted family is kept if its
    penalised log-likelihood is not lower by more than `INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO`: it
    is one decision instead of one for each place.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
    """
    evaluator = context.evaluator
    # The names of families in the library end in "@*".
    for family in (name for name in evaluator.library if name.endswith("@*")):
        members = [member.name for member in members_of(evaluator.available_effects[family])]
        if len(members) < 2 or not set(members) <= set(model.effects):
            continue
        coefficients = np.concatenate(
            [model.fit.theta[evaluator.coefficient_slices[name]] for name in members]
        )
        # A family that shares coefficients between places cannot begin at those of its members.
        if coefficients.size != len(evaluator.get_coefficient_indices(family)):
            continue
        fitted = context.search.fit_one(
            make_replacing_start(evaluator, model, members, family, coefficients)
        )
        limit = model.penalised_log_likelihood - INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
        if fitted.penalised_log_likelihood > limit:
            model = fitted
    return model


def fit_quick_selection(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the selected set by simulation, without effects that gain little.

    It is not fitted if simulation is slow and the filter shows that a force is still missing.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection.

    Returns:
        The fitted model, or the base model if simulation is slow and a force is still missing.
    """
    useful_selection = drop_surplus_effects(context, selected, is_simulated=True)
    if _is_too_slow(context, selected, len(useful_selection.groups)):
        return context.search.base_model
    return fit_selection(context, useful_selection)


def _is_too_slow(context: SearchContext, selected: Selected, count: int) -> bool:
    """Return whether a selection is too slow to simulate for a set that is incomplete anyway.

    It has many effects, one of them is slow to simulate, and a force is missing in addition.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection.
        count: number of its effects that are simulated.
    """
    return (
        count > MAX_SLOW_EFFECTS
        and is_slow_to_simulate(context, selected.effects[:count])
        and selected.followed.has_missing_force
    )


def fit_selection(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the selected set by simulation, and drop effects that do not pay there.

    If the innovations show errors of the integrator's steps, the fit is corrected for them.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection by regression, with coefficients to start from.

    Returns:
        The fitted model; the base model if it is more likely, if the selection is empty, or if it
        cannot be simulated.
    """
    base = context.search.base_model
    if not selected.groups:
        return base
    start = context.columns.start(selected.groups, selected.coefficients)
    states = context.filters.estimate_first_states(selected.followed)
    start = replace(start, initial_states=states)
    fitted = fit_by_simulation(context, start, selected.followed.has_missing_force)
    if not np.isfinite(fitted.fit.cost):
        return base
    fitted = remove_idle_effects(context, fitted)
    if selected.shows_steps:
        fitted = context.search.correct_step_errors(fitted)
    return select_likeliest(fitted, base)


def drop_surplus_effects(
    context: SearchContext, selected: Selected, is_simulated: bool = False
) -> Selected:
    """Drop the last effects of a selection that gain little with the set in a filter's model.

    Far from the base model, the linear regression is wrong. So the first one, two, three, ...
    effects of the selection are put into a filter's model. The number of effects with the largest
    gain minus penalty is kept. The trials end when `MAX_SURPLUS` further effects do not gain
    enough.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        selected: the selection, in the order in which effects were added.
        is_simulated: whether the set is kept for a simulation, so that the trials also end when it
            is too slow to simulate.

    Returns:
        The selection with its first effects only, with the coefficients of a regression on them.
    """
    filters = context.filters
    base_log_likelihood = filters.base.log_likelihood
    best_net_gain, kept_count, best_gain = 0.0, 0, 0.0
    best_coefficients: list[Array] = []
    for count in range(1, len(selected.groups) + 1):
        is_slow = is_simulated and _is_too_slow(context, selected, kept_count)
        if is_slow or count > kept_count + MAX_SURPLUS:
            break
        groups = selected.groups[:count]
        coefficients = selected.regression.solve(groups).coefficients
        theta = context.columns.start(groups, coefficients).theta
        gain = 2.0 * (filters.log_likelihood(theta) - base_log_likelihood)
        penalty = sum(filters.penalty(group.effect) for group in groups)
        # For each effect after the best set so far, a share of the gain of that set.
        min_gain = MIN_FURTHER_GAIN_SHARE * max(best_gain, 0.0) * (count - kept_count)
        if gain - penalty > best_net_gain and gain - best_gain > min_gain:
            best_net_gain = gain - penalty
            kept_count = count
            best_gain = gain
            best_coefficients = coefficients
    return replace(selected, groups=selected.groups[:kept_count], coefficients=best_coefficients)


def is_slow_to_simulate(context: SearchContext, names: Sequence[str]) -> bool:
    """Return whether one of some effects is slow to simulate.

    Slow are forces that Python computes in every step, and effects with their own states. Those
    that are fields of MuJoCo's model or depend on time alone are fast.

    Args:
        context: search, filters and regressions of the recording.
        names: names of the effects.
    """
    effects = [context.evaluator.available_effects[name] for name in names]
    return any(
        member.of not in MODEL_FIELD_EFFECTS
        and member.hook in ("force", "hidden")
        and member.of not in TIME_DEPENDENT_EFFECTS
        for effect in effects
        for member in members_of(effect)
    )
