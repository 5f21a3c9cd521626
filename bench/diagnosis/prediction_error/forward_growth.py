"""Grow sets of effects one by one, each selected by filters with the effect in the model.

If large forces are missing, the noise of the measured motion appears both in the innovations and in
the responses of effects that depend on the same readings, and regression prefers these effects. A
filter with the right effect in its model needs no process noise (forward selection; A. Miller,
Subset Selection in Regression, 2nd ed., 2002, chapter 3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.prediction_error.effect_proposals import (
    MAX_REGRESSION_PROPOSALS,
    SearchContext,
)
from bench.diagnosis.prediction_error.model_filters import SERVO_MODEL, FilteredSet
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.selection_fits import (
    MIN_FURTHER_GAIN_SHARE,
    check_filter,
    check_fit,
    is_friction_sufficient,
    make_dry_friction_start,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_filtered,
    is_explained,
    remove_idle_effects,
    select_more_likely,
)

MAX_STEPS = 4
"""Maximum number of effects that are added one after another."""
MAX_IMPROVED_TRIALS = 3
"""Maximum number of tried effects whose coefficients are improved at each step."""
SETTLED_SHARE = 0.1
"""Minimum distance of a trial that is not improved, as a share of the gain of the best one."""
MAX_FIRST_EFFECTS = 2
"""Number of the likeliest trials that are fitted by simulation, at any distance from the best."""
ALL_SERVOS_STEPS = 6
"""Maximum number of Gauss-Newton steps for the coefficients of all servos."""
COMPETING_MODEL_MARGIN = 20.0
"""Maximum distance in twice the log-likelihood of sets that are compared by simulation."""
LINEARISATION_ERROR = 0.03
"""Maximum relative error of a gain that is computed from linear responses."""


def add_to_model(context: SearchContext, model: FittedModel) -> FittedModel:
    """Add effects to a fitted model as long as each pays, and fit the set.

    Args:
        context: context of the search.
        model: the fitted model.
    """
    current = FilteredSet(context.filters.get_filter(model), model.effects)
    larger = _grow_set(context, current)
    if larger is current:
        return model
    return remove_idle_effects(context, fit_filtered(context, larger))


def add_to_dry_friction(
    context: SearchContext, selected: Selected, friction: FittedModel
) -> FittedModel:
    """Add effects to the dry friction of a selection.

    Args:
        context: context of the search.
        selected: the selection.
        friction: its dry friction, fitted alone.

    Returns:
        The best model, or the base model if the selection has no friction or is likelier.

    Raises:
        SoftFrictionError: the friction has MuJoCo's soft form.
    """
    if not friction.effects or not is_friction_sufficient(context, selected, friction):
        return context.search.base_model
    return select_in_model(context, make_dry_friction_start(context, selected))


def select_in_model(context: SearchContext, friction: FitStart | None = None) -> FittedModel:
    """Add effects one after another to dry friction, or to the base model.

    Args:
        context: context of the search.
        friction: dry friction that is in the model from the start, if any.

    Raises:
        SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
    """
    search_control, filters, base = (
        context.evaluator.search_control,
        context.filters,
        context.search.base_model,
    )
    current = filters.empty_set
    if friction is not None:
        current = filters.follow_with_effects(friction.theta, friction.effects)
    larger_sets = _list_larger_that_pay(context, current)
    if not larger_sets and friction is None:
        check_filter(context, current.followed.log_likelihood)
        return base
    best = base if larger_sets else fit_filtered(context, current)
    for trial in _select_nearly_as_likely(context, larger_sets):
        best = select_more_likely(best, fit_filtered(context, trial))
        if search_control.is_over():
            break
    if friction is None and not is_explained(context, best) and not search_control.is_over():
        check_filter(context, larger_sets[0].followed.log_likelihood)
        best = select_more_likely(best, _fit_all_servos(context))
    # Two effects together may explain what neither explains alone.
    if larger_sets and not is_explained(context, best) and not search_control.is_over():
        best = select_more_likely(best, fit_filtered(context, _grow_set(context, larger_sets[0])))
    if not np.isfinite(best.fit.cost) or not best.effects:
        return base
    if not is_explained(context, best):
        check_fit(context, best)
    return remove_idle_effects(context, best)


def _grow_set(context: SearchContext, current: FilteredSet) -> FilteredSet:
    """Add one effect after another to a set, each time the one with the largest likelihood.

    It stops if no effect is worth its penalty, or if the filter lacks no force any more.
    """
    for _ in range(MAX_STEPS - 1):
        larger = (
            _list_larger_that_pay(context, current) if current.followed.has_missing_force else []
        )
        if not larger:
            break
        current = larger[0]
    return current


def _list_larger_that_pay(context: SearchContext, current: FilteredSet) -> list[FilteredSet]:
    """Return the sets with one more effect whose gain in likelihood exceeds its penalty.

    The likeliest set is the first.
    """
    filters = context.filters
    present = current.followed if current.names else filters.base
    share = MIN_FURTHER_GAIN_SHARE * filters.compute_gain(present)
    return [
        larger
        for larger in try_one_more_effect(context, current)
        if 2.0 * (larger.followed.log_likelihood - present.log_likelihood)
        >= max(filters.penalty(larger.names[-1]), share)
    ]


def try_one_more_effect(context: SearchContext, current: FilteredSet) -> list[FilteredSet]:
    """Follow the runs with each effect that gains most in addition to a set.

    Args:
        context: context of the search.
        current: the set.

    Returns:
        The larger sets, the likeliest first; empty if no effect gains.
    """
    search_control, filters = context.evaluator.search_control, context.filters
    search_control.begin_stage(
        "testing the effects of the model one by one", MAX_REGRESSION_PROPOSALS
    )
    larger_sets = []
    for start in context.proposals.of(current):
        larger_sets.append(filters.follow_with_effects(start.theta, start.effects, 0))
        search_control.advance()
        search_control.check_not_stopped()
    larger_sets.sort(key=lambda larger_set: _compute_criterion(context, larger_set))
    # The coefficients of the best are improved before they are compared.
    compared = list[FilteredSet]()
    for larger_set in larger_sets[:MAX_IMPROVED_TRIALS]:
        if compared and _is_settled(context, compared[0], larger_set):
            compared.append(larger_set)
            continue
        compared.append(filters.follow_with_effects(larger_set.followed.theta, larger_set.names))
        compared.sort(key=lambda larger_set: _compute_criterion(context, larger_set))
    return compared


def _is_settled(context: SearchContext, best: FilteredSet, other: FilteredSet) -> bool:
    """Return whether a set explains the runs, and another one is far worse."""
    loss = _compute_criterion(context, other) - _compute_criterion(context, best)
    gain = context.filters.compute_gain(best.followed)
    return (
        loss > COMPETING_MODEL_MARGIN + SETTLED_SHARE * gain and not best.followed.has_missing_force
    )


def _select_nearly_as_likely(
    context: SearchContext, larger_sets: Sequence[FilteredSet]
) -> Sequence[FilteredSet]:
    """Return the sets whose likelihood in the filter is too close to that of the best set.

    The filter uses a linearised model, so these sets are then fitted by simulation. The likeliest
    is the first; at least `MAX_FIRST_EFFECTS` sets are returned if there are that many.
    """
    if not larger_sets:
        return ()
    error = LINEARISATION_ERROR * context.filters.compute_gain(larger_sets[0].followed)
    limit = _compute_criterion(context, larger_sets[0]) + COMPETING_MODEL_MARGIN + error
    near_sets = [
        larger_set for larger_set in larger_sets if _compute_criterion(context, larger_set) <= limit
    ]
    return [*near_sets, *larger_sets[len(near_sets) : MAX_FIRST_EFFECTS]]


def _compute_criterion(context: SearchContext, current: FilteredSet) -> float:
    """Return the penalised log likelihood of a set's last effect, as an information criterion."""
    penalty = context.filters.penalty(current.names[-1])
    return penalty - 2.0 * current.followed.log_likelihood


def _fit_all_servos(context: SearchContext) -> FittedModel:
    """Fit stiffness and damping of all servos together, if forces are missing at several joints.

    Another effect may gain more than the stiffness or the damping alone.
    """
    names = [f"{effect}@*" for effect in SERVO_MODEL]
    filters = context.filters
    several = filters.base.missing_forces.sum() > 1
    if not several or not set(names) <= set(context.evaluator.library):
        return context.search.base_model
    return fit_filtered(
        context, filters.follow_with_effects(filters.reference, names, ALL_SERVOS_STEPS)
    )
