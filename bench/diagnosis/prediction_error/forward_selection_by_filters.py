"""Forward selection of effects by Kalman filters: grow a set by the likeliest effect, one by one.

If large forces are missing, the noise of the measured motion appears both in the innovations and in
the responses of effects that depend on the same readings, and regression prefers these effects. A
filter with the right effect in its model needs no process noise (forward selection; A. Miller,
Subset Selection in Regression, 2nd ed., 2002, chapter 3). The best sets are fitted by simulation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.prediction_error.dry_friction_fits import (
    check_filter,
    check_fit,
    is_friction_sufficient,
    make_dry_friction_start,
)
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import (
    SERVO_MODEL,
)
from bench.diagnosis.prediction_error.filters_with_effects import (
    COMPETING_MODEL_MARGIN,
    FilteredSet,
    compute_comparison_margin,
)
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.simulated_fits import (
    MIN_FURTHER_GAIN_SHARE,
    fit_filtered,
    has_noise_like_cost,
    is_explained,
    make_filtered_start,
    remove_idle_effects,
    select_lowest_of_each,
)

MAX_STEPS = 4
"""Maximum number of effects that are added one after another."""
MAX_IMPROVED_TRIALS = 3
"""Maximum number of tried effects whose coefficients are improved at each step."""
SETTLED_SHARE = 0.1
"""Minimum distance of a trial that is not improved, as a share of the gain of the best one."""
MAX_FIRST_EFFECTS = 2
"""Number of the likeliest trials that are fitted by simulation, at any distance from the best."""
MAX_REMAINING_FORCE_SHARE = 0.7
"""Maximum share of a joint's missing force that remains when an added effect replaces it.

With the right effect 0.1 or less remains, and with effects that imitate another one 0.75 to 1.1.
"""
MAX_REPLACED_FORCE_SHARE = 0.3
"""Maximum share of a joint's missing force that remains when an effect replaces it.

With right effects 0.005 to 0.21 remained, since the filter is linear about the base model's motion.
"""
MAX_IMITATIONS = 2
"""Number of effects in a row that replace no missing force after which no other is added."""
ALL_SERVOS_STEPS = 6
"""Maximum number of Gauss-Newton steps for the coefficients of all servos."""


def add_to_model(context: SearchContext, model: FittedModel) -> FittedModel:
    """Add effects to a fitted model as long as each gains more than its penalty, and fit the set.

    A filter with the effects in its model decides which are added; the final set is fitted by
    simulation, and effects that gain too little there are removed.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.

    Returns:
        The larger fitted model; the given one if no effect gains enough.
    """
    current = FilteredSet(context.filters.get_filter(model), model.effects)
    larger = _grow_set(context, current)
    if larger is current:
        return model
    return remove_idle_effects(context, fit_filtered(context, larger))


def add_to_dry_friction(
    context: SearchContext, selected: Selected, friction: FittedModel
) -> FittedModel:
    """Add effects to the dry friction of a selection, and fit the best sets.

    Friction laws with an internal state are replaced by laws without. Nothing is added if such
    friction follows the runs worse than the selection does.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection.
        friction: its dry friction, fitted alone.

    Returns:
        The best model; the base model if the selection has no friction or is likelier.

    Raises:
        SoftFrictionError: the friction has MuJoCo's soft form.
    """
    if not friction.effects or not is_friction_sufficient(context, selected, friction):
        return context.search.base_model
    return select_in_model(context, make_dry_friction_start(context, selected))


def select_in_model(context: SearchContext, friction: FitStart | None = None) -> FittedModel:
    """Add effects one after another to dry friction, or to the base model, and fit the best sets.

    1. Compare filters with one more effect in the model, since they are fast.
    2. Fit the sets that are nearly as likely as the best one by simulation, until one explains the
       runs. Sets that do not act at all joints where forces are missing are skipped.
    3. If none explains the runs, fit all servos together (without dry friction only).
    4. If that does not help either, extend the likeliest set by further effects, and fit it: two
       effects together may explain what neither explains alone. This is not done if its effect
       replaces little of any missing force, because it then imitates one that the library lacks.

    If no effect gains enough in step 1, dry friction is fitted alone.

    Args:
        context: search, filters and regressions of the recording.
        friction: dry friction that is in the model from the start; None to start from the base
            model.

    Returns:
        The model with the highest penalised log-likelihood; the base model if no effect pays or no
        fit succeeds.

    Raises:
        SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
    """
    search_control = context.evaluator.search_control
    filters = context.filters
    base = context.search.base_model
    current = filters.empty_set
    if friction is not None:
        current = filters.follow_with_effects(friction.theta, friction.effects)
    larger_sets = _list_larger_that_pay(context, current)
    if not larger_sets and friction is None:
        # No effect pays, but soft dry friction may: raise an error if it does.
        check_filter(context, current.followed.log_likelihood)
        return base
    best = base if larger_sets else fit_filtered(context, current)
    for larger_set in _select_nearly_as_likely(context, larger_sets):
        if not filters.act_where_forces_are_missing(larger_set.names):
            continue
        best = select_likeliest(best, fit_filtered(context, larger_set))
        if is_explained(context, best) or search_control.is_over():
            break
    # Step 3. Without dry friction, there is a larger set: otherwise the base model was returned.
    if friction is None and not is_explained(context, best) and not search_control.is_over():
        check_filter(context, larger_sets[0].followed.log_likelihood)
        best = select_likeliest(best, _fit_all_servos(context, larger_sets[0]))
    # Step 4.
    may_grow = bool(larger_sets) and not _is_imitation(current, larger_sets[0])
    if may_grow and not is_explained(context, best) and not search_control.is_over():
        best = select_likeliest(best, fit_filtered(context, _grow_set(context, larger_sets[0])))
    if not np.isfinite(best.fit.cost) or not best.effects:
        return base
    if not is_explained(context, best):
        check_fit(context, best)
    return remove_idle_effects(context, best)


def _grow_set(context: SearchContext, current: FilteredSet) -> FilteredSet:
    """Add one effect after another to a set, each time the one with the largest likelihood.

    It stops if no effect is worth its penalty, if the filter lacks no force any more, if the last
    two effects replace no missing force, or if a simulation with the coefficients of the filter
    leaves little more than noise.

    Args:
        context: search, filters and regressions of the recording.
        current: the set to begin with.
    """
    # Number of the last effects in a row that replace no missing force.
    imitations = 0
    # The set to begin with has at least one effect, which counts as the first step.
    for _ in range(MAX_STEPS - 1):
        is_force_missing = current.followed.missing_forces.any()
        larger = _list_larger_that_pay(context, current) if is_force_missing else []
        if not larger:
            break
        # After an imitation, the next effect may be the right one; if it is not, the library lacks
        # it.
        imitations = imitations + 1 if _is_imitation(current, larger[0]) else 0
        current = larger[0]
        start = make_filtered_start(context, current)
        if imitations == MAX_IMITATIONS or has_noise_like_cost(
            context, select_lowest_of_each(context, [start])
        ):
            break
    return current


def _list_larger_that_pay(context: SearchContext, current: FilteredSet) -> list[FilteredSet]:
    """Return the sets with one more effect whose gain in likelihood exceeds the minimum.

    The gain, in twice the log-likelihood, must reach the penalty of the added effect, and a small
    share of the gain of the present set over the base model: with long recordings even useless
    effects gain more than the penalty. The likeliest set is the first.

    Args:
        context: search, filters and regressions of the recording.
        current: the set to extend by one effect.
    """
    filters = context.filters
    present = current.followed if current.names else filters.base
    min_share_gain = MIN_FURTHER_GAIN_SHARE * filters.compute_gain(present)
    return [
        larger
        for larger in try_one_more_effect(context, current)
        if 2.0 * (larger.followed.log_likelihood - present.log_likelihood)
        >= max(filters.penalty(larger.names[-1]), min_share_gain)
    ]


def try_one_more_effect(context: SearchContext, current: FilteredSet) -> list[FilteredSet]:
    """Follow the runs with each proposed effect in addition to a set, and rank the larger sets.

    The effects with the largest gains by regression are tried first. If one of them replaces a
    missing force, the others, which a regression may have missed, are not tried. The result is
    cached, because sets that grow from different effects may become equal. It is reused unless
    effects were added to the library, or the set now follows the runs much better.

    Args:
        context: search, filters and regressions of the recording.
        current: the set.

    Returns:
        The larger sets, the likeliest (after the penalty of its effect) first; empty if no effect
        gains.
    """
    key = frozenset(current.names), len(context.columns.library.probes)
    if key in context.extended_sets:
        extended, larger_sets = context.extended_sets[key]
        gain = context.filters.compute_gain(current.followed)
        margin = compute_comparison_margin(gain)
        if gain < context.filters.compute_gain(extended.followed) + margin:
            return larger_sets
    larger_sets = _compare_larger_sets(context, current)
    context.extended_sets[key] = current, larger_sets
    return larger_sets


def _compare_larger_sets(context: SearchContext, current: FilteredSet) -> list[FilteredSet]:
    """Return the likeliest sets with one more effect, with improved coefficients, the best first.

    Args:
        context: search, filters and regressions of the recording.
        current: the set.
    """
    starts = context.proposals.of(current)
    context.evaluator.search_control.begin_stage(
        "testing the effects of the model one by one", len(starts)
    )
    followed, compared = list[FilteredSet](), list[FilteredSet]()
    # First the effects with the largest gains by regression, then all others.
    for part in (starts[:MAX_IMPROVED_TRIALS], starts[MAX_IMPROVED_TRIALS:]):
        followed += _follow_each(context, part)
        compared = _improve_likeliest(context, followed, compared)
        if compared and _compute_remaining_share(current, compared[0]) < MAX_REPLACED_FORCE_SHARE:
            break
    return compared


def _follow_each(context: SearchContext, starts: Sequence[FitStart]) -> list[FilteredSet]:
    """Return the filters of models with the coefficients of the regression, without improving them.

    Args:
        context: search, filters and regressions of the recording.
        starts: models with one more effect than a set.
    """
    search_control, followed = context.evaluator.search_control, list[FilteredSet]()
    for start in starts:
        followed.append(context.filters.follow_with_effects(start.theta, start.effects, steps=0))
        search_control.advance()
        search_control.check_not_stopped()
    return followed


def _improve_likeliest(
    context: SearchContext, followed: Sequence[FilteredSet], improved: Sequence[FilteredSet]
) -> list[FilteredSet]:
    """Improve the coefficients of the likeliest sets by Gauss-Newton steps, and rank them.

    A good effect with a wrong coefficient would lose without these steps. They are saved if another
    set already explains the runs and is far better.

    Args:
        context: search, filters and regressions of the recording.
        followed: sets with the coefficients of the regression.
        improved: those among them whose coefficients are already improved.

    Returns:
        At most `MAX_IMPROVED_TRIALS` sets, the one with the best information criterion first.
    """

    def compute_criterion(larger_set: FilteredSet) -> float:
        return _compute_criterion(context, larger_set)

    known = {larger_set.names: larger_set for larger_set in improved}
    compared = list[FilteredSet]()
    for larger_set in sorted(followed, key=compute_criterion)[:MAX_IMPROVED_TRIALS]:
        if larger_set.names in known:
            larger_set = known[larger_set.names]
        elif not compared or not _is_settled(context, compared[0], larger_set):
            larger_set = context.filters.improve(larger_set)
        compared.append(larger_set)
        compared.sort(key=compute_criterion)
    return compared


def _compute_remaining_share(current: FilteredSet, larger: FilteredSet) -> float:
    """Return the smallest share of a joint's missing force that remains with one more effect.

    The missing force at a joint is the standard deviation of the process noise that the filter
    needs there. An effect replaces it if little of it remains.

    Args:
        current: the set; the result is infinite if no force is missing with it.
        larger: the set with one more effect.
    """
    missing = current.followed.missing_forces
    shares = larger.followed.force[missing] / current.followed.force[missing]
    return float(shares.min(initial=np.inf))


def _is_imitation(current: FilteredSet, larger: FilteredSet) -> bool:
    """Return whether the last effect of a set imitates another one: it replaces no missing force.

    Args:
        current: the set without this effect.
        larger: the set with it.
    """
    return _compute_remaining_share(current, larger) > MAX_REMAINING_FORCE_SHARE


def _is_settled(context: SearchContext, best: FilteredSet, other: FilteredSet) -> bool:
    """Return whether a set lacks no force, and another one is far worse.

    A set lacks no force if its filter needs no process noise. The coefficients of the other set
    then need not be improved.

    Args:
        context: search, filters and regressions of the recording.
        best: the set with the best criterion.
        other: the set with the next best one.
    """
    loss = _compute_criterion(context, other) - _compute_criterion(context, best)
    gain = context.filters.compute_gain(best.followed)
    return (
        loss > COMPETING_MODEL_MARGIN + SETTLED_SHARE * gain and not best.followed.has_missing_force
    )


def _select_nearly_as_likely(
    context: SearchContext, larger_sets: Sequence[FilteredSet]
) -> Sequence[FilteredSet]:
    """Return the sets that a filter cannot distinguish from the likeliest one.

    The filter uses a linearised model, so these sets are then fitted by simulation. The likeliest
    is the first; at least `MAX_FIRST_EFFECTS` sets are returned if there are that many.

    Args:
        context: search, filters and regressions of the recording.
        larger_sets: sets of the same size, the likeliest first.
    """
    if not larger_sets:
        return ()
    gain = context.filters.compute_gain(larger_sets[0].followed)
    limit = _compute_criterion(context, larger_sets[0]) + compute_comparison_margin(gain)
    near_sets = [
        larger_set for larger_set in larger_sets if _compute_criterion(context, larger_set) <= limit
    ]
    return [*near_sets, *larger_sets[len(near_sets) : MAX_FIRST_EFFECTS]]


def _compute_criterion(context: SearchContext, current: FilteredSet) -> float:
    """Return the information criterion of a set: penalty of its last effect minus 2 log L.

    Lower is better. Sets are compared that differ in this effect only.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with its filter.
    """
    penalty = context.filters.penalty(current.names[-1])
    return penalty - 2.0 * current.followed.log_likelihood


def _fit_all_servos(context: SearchContext, likeliest: FilteredSet) -> FittedModel:
    """Fit stiffness and damping of all servos together, if forces are missing at several joints.

    Another effect may gain more than the stiffness or the damping alone. If that effect leaves a
    force missing at one joint only, the servos of the other joints are right. The base model is
    then returned, and also if the library has no effects of all servos.

    Args:
        context: search, filters and regressions of the recording.
        likeliest: the likeliest set with one effect.
    """
    names = [f"{effect}@*" for effect in SERVO_MODEL]
    filters = context.filters
    are_missing_at_several = all(
        followed.missing_forces.sum() > 1 for followed in (filters.base, likeliest.followed)
    )
    if not are_missing_at_several or not set(names) <= set(context.evaluator.library):
        return context.search.base_model
    return fit_filtered(
        context, filters.follow_with_effects(filters.reference, names, ALL_SERVOS_STEPS)
    )
