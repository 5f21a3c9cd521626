"""Fit by simulation what regression selects: whole sets, dry friction alone, single effects.

The force of dry friction is not linear in its limit where a joint sticks or creeps. Therefore it is
fitted before other effects, and filters compare whether it has MuJoCo's soft form. A servo at its
limit is not linear either, so the effects that are most likely missing are simulated alone, as one
batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.friction_form_verdict import (
    has_dry_friction,
    is_likelier_soft,
    replace_by_stateless_friction,
)
from bench.diagnosis.prediction_error.effect_proposals import MIN_GAIN_SHARE, SearchContext
from bench.diagnosis.prediction_error.model_filters import (
    JOINT_MODEL,
    SERVO_MODEL,
    acts_at_joint,
    has_many_shapes,
)
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_by_simulation,
    fit_nearby,
    is_at_noise,
    is_explained,
    is_nearly_explained,
    list_nearby_starts,
    remove_idle_effects,
    select_lowest_of_each,
    select_more_likely,
)
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.dynamics.effect_forces import TIME_DEPENDENT_EFFECTS
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

MAX_SURPLUS = 2
"""Maximum number of consecutive effects with too little gain before a selection is cut."""
MAX_SLOW_EFFECTS = 2
"""Maximum number of effects in a set that is fitted by simulation although this is slow."""
FIRST_ITERATIONS = 5
"""Maximum number of steps of the first fit of dry friction."""
MIN_LEAD_SHARE = 0.1
"""Minimum lead in log-likelihood of soft dry friction over a selection that is far less likely.

It is a share of the gain over the base model.
"""
MIN_FURTHER_GAIN_SHARE = 0.01
"""Minimum gain of a further effect, as a share of the gain of the set.

The model of a real robot is never complete, and long recordings show this with certainty.
"""


def fit_quick_selection(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the selected set by simulation, without effects that gain little.

    It is not fitted if simulation is slow and the filter shows that a force is still missing.

    Args:
        context: context of the search.
        selected: the selection.

    Returns:
        The fitted model, or the base model if simulation is slow and a force is still missing.
    """
    useful_selection = drop_surplus_effects(context, selected)
    is_slow = len(useful_selection.groups) > MAX_SLOW_EFFECTS and _is_slow(
        context, useful_selection.effects
    )
    if is_slow and selected.followed.has_missing_force:
        return context.search.base_model
    return fit_selection(context, useful_selection)


def fit_selection(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the selected set by simulation, and drop effects that do not pay there.

    Args:
        context: context of the search.
        selected: the selection.
    """
    base = context.search.base_model
    if not selected.groups:
        return base
    start = context.columns.start(selected.groups, selected.coefficients)
    states = context.filters.estimate_first_states(selected.followed)
    fitted = fit_by_simulation(context, replace(start, initial_states=states))
    if not np.isfinite(fitted.fit.cost):
        return base
    fitted = remove_idle_effects(context, fitted)
    if selected.shows_steps:
        fitted = context.search.correct_step_errors(fitted)
    return select_more_likely(fitted, base)


def drop_surplus_effects(context: SearchContext, selected: Selected) -> Selected:
    """Drop the last effects of a selection that gain little with the set in a filter's model.

    Far from the base model, the linear regression is wrong.

    Args:
        context: context of the search.
        selected: the selection.
    """
    filters = context.filters
    base_log_likelihood = filters.base.log_likelihood
    best_net_gain, best_count, best_gain = 0.0, 0, 0.0
    best_coefficients: list[Array] = []
    for count in range(1, len(selected.groups) + 1):
        if count > best_count + MAX_SURPLUS:
            break
        groups = selected.groups[:count]
        coefficients = selected.regression.solve(groups)[1]
        theta = context.columns.start(groups, coefficients).theta
        gain = 2.0 * (filters.log_likelihood(theta) - base_log_likelihood)
        penalty = sum(filters.penalty(group.effect) for group in groups)
        min_gain = MIN_FURTHER_GAIN_SHARE * max(best_gain, 0.0) * (count - best_count)
        if gain - penalty > best_net_gain and gain - best_gain > min_gain:
            best_net_gain, best_count, best_gain, best_coefficients = (
                gain - penalty,
                count,
                gain,
                coefficients,
            )
    return replace(selected, groups=selected.groups[:best_count], coefficients=best_coefficients)


def _is_slow(context: SearchContext, names: Sequence[str]) -> bool:
    """Return whether effects are slow to simulate.

    This is the case if forces are computed in every step, or have their own states.
    """
    effects = [context.evaluator.available_effects[name] for name in names]
    return any(
        member.of not in MODEL_FIELD_EFFECTS
        and member.hook in ("force", "hidden")
        and member.of not in TIME_DEPENDENT_EFFECTS
        for effect in effects
        for member in members_of(effect)
    )


def select_with_shapes(context: SearchContext, selected: Selected) -> Selected:
    """Select again with effects of many shapes, at the joints where a force is missing.

    Args:
        context: context of the search.
        selected: the previous selection.
    """
    evaluator, joints = context.evaluator, np.flatnonzero(selected.followed.missing_forces).tolist()
    effects_with_shapes = [
        n for n in evaluator.library if has_many_shapes(n) and acts_at_joint(evaluator, n, joints)
    ]
    if not effects_with_shapes:
        return selected
    evaluator.search_control.begin_stage(
        f"testing {len(effects_with_shapes)} effects with several coefficients", 1
    )
    context.columns.add(effects_with_shapes)
    return context.columns.select()


class SoftFrictionError(Exception):
    """Dry friction of these data has MuJoCo's soft form: search with a simulator of that form.

    Attributes:
        start: the model whose filter shows this; None if a simulation does.
        is_preliminary: whether only filters show this, before any fit.
    """

    def __init__(self, start: FitStart | None = None, is_preliminary: bool = False) -> None:
        super().__init__()
        self.start, self.is_preliminary = start, is_preliminary


def check_selection(context: SearchContext, selected: Selected) -> None:
    """Raise `SoftFrictionError` if soft dry friction explains the runs better than a selection.

    It compares log-likelihoods of filters, before anything but dry friction is fitted.

    Args:
        context: context of the search.
        selected: the selection.

    Raises:
        SoftFrictionError: soft friction is likelier than the selection.
    """
    filters = context.filters
    if filters.is_soft or not filters.base.has_missing_force:
        return
    stiff_friction = make_dry_friction_start(context, selected)
    # Stiff friction that explains the runs needs no comparison.
    if stiff_friction.effects and is_explained(
        context, context.search.fit_one(stiff_friction, FIRST_ITERATIONS)
    ):
        return
    soft_start = _find_soft_friction(context)
    if soft_start is None:
        return
    soft_log_likelihood = filters.log_likelihood(soft_start.theta, is_soft=True)
    gain = soft_log_likelihood - filters.base.log_likelihood
    # Another effect at the joint that promises more is fitted first.
    if not gain > max(context.proposals.compute_largest_gain_of_others(soft_start.effects[0]), 0.0):
        return
    if _is_far_less_likely(context, selected, soft_log_likelihood):
        raise SoftFrictionError(soft_start, is_preliminary=True)
    useful_selection = drop_surplus_effects(context, selected)
    log_likelihood = filters.log_likelihood(
        context.columns.start(useful_selection.groups, useful_selection.coefficients).theta
    )
    check_filter(context, log_likelihood, is_preliminary=True)


def _find_soft_friction(context: SearchContext) -> FitStart | None:
    """Return the likeliest model of soft dry friction at the joint where regression shows friction.

    Returns:
        The model; None if the gain of dry friction by regression is far below the largest gain, or
        if friction is already soft.
    """
    columns, evaluator = context.columns, context.evaluator
    regression = columns.base_regression
    gains, groups = regression.gains([]), regression.groups
    friction_groups = [
        i
        for i in np.argsort(-gains, kind="stable").tolist()
        if gains[i] > MIN_GAIN_SHARE * gains.max()
        and groups[i].effect.startswith("friction.coulomb@")
        and not groups[i].effect.endswith("@*")
        and groups[i].effect in evaluator.library
    ]
    if not friction_groups:
        return None
    best_group = groups[friction_groups[0]]
    (coefficient,) = columns.coefficients(best_group, regression.solve([best_group])[1][0])
    return context.filters.find_soft_friction(
        best_group.effect, float(np.copysign(1.0, coefficient))
    )


def _is_far_less_likely(context: SearchContext, selected: Selected, log_likelihood: float) -> bool:
    """Return whether a selection is far less likely than another model.

    The likelihood of the selection is that of the regression, and that of a filter with its first
    effect.

    Args:
        context: context of the search.
        selected: the selection.
        log_likelihood: log-likelihood of the other model.
    """
    base = context.filters.base.log_likelihood
    limit = log_likelihood - MIN_LEAD_SHARE * max(log_likelihood - base, 0.0)
    if not max(base, selected.log_likelihood) < limit:
        return False
    first = context.columns.start(selected.groups[:1], selected.coefficients[:1])
    return context.filters.log_likelihood(first.theta) < limit


def check_filter(
    context: SearchContext, log_likelihood: float, is_preliminary: bool = False
) -> None:
    """Raise `SoftFrictionError` if soft dry friction is likelier than a model with its filter.

    Args:
        context: context of the search.
        log_likelihood: log-likelihood of the filter.
        is_preliminary: whether nothing has been fitted yet.

    Raises:
        SoftFrictionError: soft friction is likelier.
    """
    soft_start = _find_soft_friction(context)
    if soft_start is None:
        return
    soft_log_likelihood = context.filters.log_likelihood(soft_start.theta, is_soft=True)
    if soft_log_likelihood > log_likelihood + 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO:
        raise SoftFrictionError(soft_start, is_preliminary)


def check_fit(context: SearchContext, model: FittedModel) -> None:
    """Raise `SoftFrictionError` if a fitted model is likelier with soft dry friction.

    It is refitted with the same effects in the soft form.

    Args:
        context: context of the search.
        model: the fitted model.

    Raises:
        SoftFrictionError: the soft form is likelier.
    """
    if is_likelier_soft(context.search, model, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO):
        raise SoftFrictionError


def fit_dry_friction(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the dry friction of a selection alone.

    Args:
        context: context of the search.
        selected: the selection.

    Returns:
        The fitted model, or the base model if the selection has no friction or leaves no force
        missing.
    """
    friction = make_dry_friction_start(context, selected)
    if not friction.effects or not selected.followed.has_missing_force:
        return context.search.base_model
    fitted_before = context.search.models.get(frozenset(friction.effects))
    if fitted_before is not None and is_explained(context, fitted_before):
        return remove_idle_effects(context, fitted_before)
    if fitted_before is not None and np.isfinite(fitted_before.fit.cost):
        friction = fitted_before.fit.make_start()
    fitted = fit_by_simulation(context, friction)
    return remove_idle_effects(context, fitted) if is_explained(context, fitted) else fitted


def make_dry_friction_start(context: SearchContext, selected: Selected) -> FitStart:
    """Return a start with only the dry friction of a selection, in its form without a state.

    A family replaces its members.

    Args:
        context: context of the search.
        selected: the selection.
    """
    evaluator, filters = context.evaluator, context.filters
    start = context.columns.start(selected.groups, selected.coefficients)
    stateless_names, stateless_theta = replace_by_stateless_friction(
        evaluator, start.effects, start.theta
    )
    model_field_effects = [
        name for name in stateless_names if name.partition("@")[0] in MODEL_FIELD_EFFECTS
    ]
    friction = [name for name in model_field_effects if has_dry_friction(evaluator, [name])]
    contained = {part for name in friction for part in evaluator.available_effects[name].contains}
    names = tuple(name for name in friction if name not in contained)
    theta = filters.reference.copy()
    for name in names:
        theta[evaluator.coefficient_slices[name]] = stateless_theta[
            evaluator.coefficient_slices[name]
        ]
    return FitStart(names, theta, filters.estimate_first_states(filters.base))


def is_friction_sufficient(
    context: SearchContext, selected: Selected, friction: FittedModel
) -> bool:
    """Return whether dry friction without a state follows the data as well as the selection.

    Args:
        context: context of the search.
        selected: the selection.
        friction: its dry friction, fitted alone.

    Raises:
        SoftFrictionError: the friction has MuJoCo's soft form.
    """
    filters = context.filters
    start = context.columns.start(selected.groups, selected.coefficients)
    _, stateless_theta = replace_by_stateless_friction(
        context.evaluator, start.effects, start.theta
    )
    stiff_log_likelihood = filters.log_likelihood(stateless_theta)
    soft_log_likelihood = (
        -np.inf if filters.is_soft else filters.log_likelihood(stateless_theta, is_soft=True)
    )
    selected_log_likelihood = (
        -np.inf
        if np.array_equal(stateless_theta, start.theta)
        else filters.log_likelihood(start.theta)
    )
    if (
        not max(stiff_log_likelihood, soft_log_likelihood)
        > selected_log_likelihood - 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
    ):
        return False
    if (
        soft_log_likelihood
        > max(stiff_log_likelihood, selected_log_likelihood)
        + 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
    ):
        check_fit(context, friction)
    return True


MAX_REFINED = 3
"""Maximum number of effects that are fitted alone to convergence."""
MAX_IMPROVED_SIZE = 3
"""Maximum number of coefficients of an effect that is refined alone or improved by a filter."""


def fit_single_effects(context: SearchContext) -> FittedModel:
    """Fit each of the proposed effects alone.

    Returns:
        The best model, or the base model if none explains the runs.

    Raises:
        SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
    """
    search, filters = context.search, context.filters
    states = filters.estimate_first_states(filters.base)
    starts = context.proposals.of(filters.empty_set, len(JOINT_MODEL + SERVO_MODEL))
    fitted, best = list[FittedModel](), search.base_model
    for is_slow in (False, True):
        # Slow effects are fitted only if no other effect explains the runs.
        group = [one for one in starts if _is_slow(context, one.effects) == is_slow]
        if group and not is_explained(context, best):
            fitted += search.fit_all([replace(start, initial_states=states) for start in group])
            best = max(fitted, key=lambda model: model.penalised_log_likelihood)
    if not is_explained(context, best):
        best = select_more_likely(best, refine_single_effects(context, fitted))
    if is_explained(context, best):
        return remove_idle_effects(context, best)
    check_filter(context, filters.get_filter(best).log_likelihood)
    check_fit(context, best)
    return search.base_model


def refine_single_effects(context: SearchContext, fitted: Sequence[FittedModel]) -> FittedModel:
    """Fit some effects alone to convergence, and return the model with the highest merit.

    Those with the lowest cost are fitted first. Fits may stop in local minima where joints stick
    and at force limits, and likelihoods with coloured noise are unreliable if the residual is
    large.

    Args:
        context: context of the search.
        fitted: models with a single effect.
    """
    starts: list[FitStart] = []
    for model in fitted:
        (name,) = model.effects
        if len(context.evaluator.get_coefficient_indices(name)) <= MAX_IMPROVED_SIZE:
            starts += [model.fit.make_start(), *list_nearby_starts(context, model, name)]
    best = context.search.base_model
    for _, start in select_lowest_of_each(context, starts)[:MAX_REFINED]:
        refined = fit_by_simulation(context, start)
        if not is_at_noise(context, refined) and is_nearly_explained(context, refined):
            refined = fit_nearby(context, refined, refined.effects[0])
        best = select_more_likely(best, refined)
        if is_explained(context, best) or context.evaluator.search_control.is_over():
            break
    return best


def fit_series_effects(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit elastic joints and backlash between drive and links at the most affected joint.

    These effects have their own states, so each shape is simulated.

    Args:
        context: context of the search.
        selected: the selection, whose missing forces determine the joint.
    """
    evaluator, search = context.evaluator, context.search
    joints = selected.followed.joints_by_loss[:1]
    names = [
        name for name in evaluator.library if is_series_effect(evaluator.available_effects[name])
    ]
    probes = context.columns.probes(
        [name for name in names if acts_at_joint(evaluator, name, joints)]
    )
    if not probes:
        return search.base_model
    evaluator.search_control.begin_stage(
        "testing elasticity and backlash between drives and links", len(probes)
    )
    starts = []
    for probe in probes:
        theta = context.filters.make_theta_with(probe.effect, probe.coefficients)
        starts.append(FitStart((probe.effect,), theta, evaluator.initial_state_guesses))
    fitted = search.fit_all([start for _, start in select_lowest_of_each(context, starts)])
    return fit_by_simulation(
        context, max(fitted, key=lambda model: model.penalised_log_likelihood).fit.make_start()
    )
