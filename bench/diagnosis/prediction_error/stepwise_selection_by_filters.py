"""Select effects step by step by the likelihoods of Kalman filters with effects in their model.

If large forces are missing, the noise of the measured motion appears both in the innovations and in
the responses of effects that depend on the same readings, and regression prefers these effects. A
filter with the right effects in its model needs no process noise, so its likelihood decides. There
are three selections:

1. One by one (`add_to_model`, `add_to_dry_friction`, `select_in_model`): a set grows by the
   likeliest effect (forward selection; A. Miller, Subset Selection in Regression, 2nd ed., 2002,
   chapter 3). The best sets are fitted by simulation.
2. Several at once (`select_with_friction`): a joint that sticks makes a regression about the base
   model, which is linear, unreliable for all other effects. A filter with dry friction in its model
   follows the joint, so that its innovations are nearly linear in the effects that are left. One
   regression selects several of them, and the next one is made about a filter with these (iterated
   linearisation, as in the Gauss-Newton method; J. Nocedal, S. Wright, Numerical Optimization, 2nd
   ed., 2006, section 10.3). Only the last set is fitted by simulation.
3. In long recordings (`identify_incomplete`): a model of a real robot is never complete. Simulated
   over a long run without feedback, the forces that it lacks add up to a drift, so a fit of the
   simulation is biased, and every trial is slow. A filter attributes these forces to process noise
   and keeps the state near the data: its estimates are close to those of inverse dynamics (M.
   Gautier, A. Janot and P.-O. Vandanjon, IEEE Trans. Control Syst. Technol. 21, 428, 2013,
   doi:10.1109/TCST.2012.2185697). The textbook effects of joints and bodies are fitted, those that
   do not pay are removed, and further ones are added while each pays and predicts left-out runs
   better. If the filter then lacks no force, the model may be complete, and simulation decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import (
    Bounds,
    compute_range_around,
    get_bounds_by_index,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.kalman.candidate_responses import Columns
from bench.diagnosis.kalman.likelihood_fit import (
    MIN_STEP_GAIN,
    compute_information,
    compute_wald_statistics,
    maximise_innovation_likelihood,
)
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.dry_friction_fits import (
    check_filter,
    check_fit,
    is_friction_sufficient,
    make_dry_friction_start,
)
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import JOINT_MODEL, SERVO_MODEL
from bench.diagnosis.prediction_error.filters_with_effects import (
    COMPETING_MODEL_MARGIN,
    FilteredSet,
    compute_comparison_margin,
)
from bench.diagnosis.prediction_error.regression_columns import (
    build_regression_about,
    group_coefficients,
)
from bench.diagnosis.prediction_error.regression_selection import (
    MAX_SET_SIZE,
    Regression,
    Selected,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    MAX_IMPROVED_SIZE,
    MIN_FURTHER_GAIN_SHARE,
    fit_filtered,
    has_noise_like_cost,
    is_explained,
    make_filtered_start,
    remove_idle_effects,
    select_lowest_of_each,
    simulate_identified,
)
from bench.diagnosis.search.fit_starts import add_effect_to_start
from bench.diagnosis.search.score_test import DirectionGroup

MAX_SINGLE_STEPS = 4
"""Maximum number of effects that are added one by one."""
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
FRICTION_FAMILY = "friction.coulomb@*"
"""Dry friction of all joints."""
JOINT_MODEL_STEPS = 4
"""Maximum number of Gauss-Newton steps for the coefficients of the standard joint model."""
MAX_RELINEARISATIONS = 3
"""Maximum number of regressions, each about a filter with the effects of the previous ones."""
MIN_LONG_DURATION = 8.0
"""Minimum duration in seconds of each run of a long recording."""
MIN_LONG_EXCESS = 100.0
"""Minimum excess of the base model at which a long recording is identified without simulation.

It is in units of the noise. Smaller discrepancies are explained by simulation.
"""
MAX_LONG_JOINTS = 3
"""Maximum number of joints of a robot with a long recording.

More of them have too many coefficients for finite differences.
"""
TEXTBOOK_EFFECTS = ("friction.coulomb", "drag.linear", "inertia.scale")
"""Effects that are in the model of a long recording from the start, at every place.

The inertia of a body that moves along a straight line has no influence, and is removed.
"""
MAX_ADDED_TO_TEXTBOOK = 3
"""Maximum number of effects that are added to the textbook model."""
NEGLIGIBLE_FORCE_SHARE = 0.1
"""Maximum missing forces, as a share of those of the base model, at which no effect is added."""
MAX_SET_ITERATIONS = 6
"""Maximum number of Gauss-Newton steps of a set together with the base parameters."""
MIN_STEP_GAIN_SHARE = 0.003
"""Minimum gain by a Gauss-Newton step of such a fit for which another step follows.

It is a share of the gain over the base model so far.
"""


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
    # The base model, with the empty set of effects.
    current = filters.empty_set
    if friction is not None:
        current = filters.follow_with_effects(friction.theta, friction.effects)
    larger_sets = _list_larger_that_pay(context, current)
    if not larger_sets and friction is None:
        # No effect pays, but soft dry friction may: raise an error if it does.
        check_filter(context, current.followed.log_likelihood)
        return base
    # Step 2, or dry friction alone if no effect pays in addition to it.
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
        current: the set to begin with, a group of effects in the model of a Kalman filter.

    Returns:
        The largest set, with its filter; `current` itself if no effect is added.
    """
    # Number of the last effects in a row that replace no missing force.
    imitations = 0
    # The set to begin with has at least one effect, which counts as the first step.
    for _ in range(MAX_SINGLE_STEPS - 1):
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
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        current: the set to extend by one effect.
    """
    filters = context.filters
    # An empty set is the base model.
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

    Proposed effects are tried in two parts, those with the largest gains by regression first. The
    second part is not tried if the best effect of the first one replaces a missing force. At most
    `MAX_IMPROVED_TRIALS` sets are returned.

    Args:
        context: search, filters and regressions of the recording.
        current: the set to extend by one effect.
    """
    # Models with one more effect, those that regression proposes first.
    starts = context.proposals.of(current)
    context.evaluator.search_control.begin_stage(
        "testing the effects of the model one by one", len(starts)
    )
    # All sets that were filtered so far, and the best of them with improved coefficients.
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

    improved_by_names = {larger_set.names: larger_set for larger_set in improved}
    compared = list[FilteredSet]()
    for larger_set in sorted(followed, key=compute_criterion)[:MAX_IMPROVED_TRIALS]:
        if larger_set.names in improved_by_names:
            larger_set = improved_by_names[larger_set.names]
        # The best set so far comes first; one that is far worse stays as it is.
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
    # Mask of the joints where the filter needs process noise.
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
    # The near sets are the first ones of `larger_sets`; the next ones follow up to the minimum.
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
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects, and `filters.reference` its parameters.
        likeliest: the likeliest set with one effect.
    """
    names = [f"{effect}@*" for effect in SERVO_MODEL]
    filters = context.filters
    # With neither of them, the filter lacks a force at one joint only.
    are_missing_at_several = all(
        followed.missing_forces.sum() > 1 for followed in (filters.base, likeliest.followed)
    )
    if not are_missing_at_several or not set(names) <= set(context.evaluator.library):
        return context.search.base_model
    # The coefficients begin at zero, those of the model without effects.
    return fit_filtered(
        context, filters.follow_with_effects(filters.reference, names, ALL_SERVOS_STEPS)
    )


def select_with_friction(context: SearchContext, selected: Selected) -> FittedModel:
    """Select the other effects with dry friction of all joints in the filter's model.

    A set is a group of effects in the model of a Kalman filter (`FilteredSet`). It begins with dry
    friction and grows by regressions. Nothing is done if the selection has no friction of all
    joints: effects in addition to friction at one joint are found faster one by one.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection about the base model, whose dry friction is used.

    Returns:
        The set, fitted by simulation; the base model if nothing is done, or nothing is selected in
        addition to the friction.
    """
    friction = make_dry_friction_start(context, selected)
    if FRICTION_FAMILY not in friction.effects:
        return context.search.base_model
    current = _choose_friction_start(context, friction)
    for _ in range(MAX_RELINEARISATIONS):
        larger = _add_selected(context, current)
        if larger is None:
            break
        current = larger
    # No effect was added to the friction, and dry friction alone is fitted elsewhere.
    if len(current.names) == len(friction.effects):
        return context.search.base_model
    fitted = fit_filtered(context, current)
    return remove_idle_effects(context, fitted) if is_explained(context, fitted) else fitted


def _choose_friction_start(context: SearchContext, friction: FitStart) -> FilteredSet:
    """Return dry friction with the first selected effects, or the standard joint model.

    The standard joint model has viscous friction and motor inertia (armature) in addition to dry
    friction. Motor inertia at all joints imitates a payload, so this model is not always better.
    Twice the log-likelihood of the filter, minus the penalties of all effects, decides.

    Args:
        context: search, filters and regressions of the recording.
        friction: dry friction of all joints.

    Returns:
        The better set, with its filter.
    """
    filters = context.filters

    def compute_penalised(current: FilteredSet) -> float:
        """Return twice the penalised log-likelihood of a set; higher is better."""
        penalty = sum(filters.penalty(name) for name in current.names)
        return 2.0 * current.followed.log_likelihood - penalty

    friction_alone = filters.follow_with_effects(friction.theta, friction.effects)
    # None if a regression adds nothing to the friction.
    selected = _add_selected(context, friction_alone) or friction_alone
    return max(selected, _follow_joint_model(context, friction), key=compute_penalised)


def _follow_joint_model(context: SearchContext, friction: FitStart) -> FilteredSet:
    """Filter the runs with the standard joint model at all joints, as far as it is needed.

    A robot whose file has no friction mostly lacks viscous friction and the inertia of its motors,
    too. These effects are added together to the dry friction, and their coefficients are improved.
    Those that gain less than their penalty (Wald statistic) are then removed.

    Args:
        context: search, filters and regressions of the recording.
        friction: dry friction of all joints.

    Returns:
        The set of the remaining effects, with its filter.
    """
    filters, evaluator = context.filters, context.evaluator
    # Effects of the joint model other than the friction, for all joints (``@*``). Their
    # coefficients begin at zero, as in the parameters of the friction.
    others = [
        name
        for name in (f"{effect}@*" for effect in JOINT_MODEL)
        if name in evaluator.library and name not in friction.effects
    ]
    current = filters.follow_with_effects(
        friction.theta, (*friction.effects, *others), JOINT_MODEL_STEPS
    )
    theta = current.followed.theta.copy()
    information = compute_information(
        current.followed, get_bounds_by_index(evaluator, current.names)
    )
    gains = compute_wald_statistics(evaluator, theta, current.names, information)
    idle = [name for name in others if gains[name] < filters.penalty(name)]
    if not idle:
        return current
    for name in idle:
        theta[evaluator.coefficient_slices[name]] = 0.0
    return filters.follow_with_effects(theta, [n for n in current.names if n not in idle])


def _add_selected(context: SearchContext, current: FilteredSet) -> FilteredSet | None:
    """Add the effects that a regression about a set selects, and improve the coefficients.

    The regression is linear, so that it may select effects that only imitate the nonlinear part of
    others. A filter, which is not linear in its effects, therefore tests the first one, two, three,
    ... selected effects in addition to the set. Each further effect must pass two tests:

    1. With the coefficients from the regression, the filter is likelier than with one effect less,
       also with coefficients from the regression. This needs no Gauss-Newton steps.
    2. With improved coefficients, twice the log-likelihood gains at least the effect's penalty over
       the best set so far.

    The first effect that fails ends the trials.

    Args:
        context: search, filters and regressions of the recording.
        current: the set of effects to which others are added, with its filter in `followed`.

    Returns:
        The largest set that passes, with improved coefficients; None if no effect passes.
    """
    filters = context.filters
    regression, _ = build_regression_about(current, [context.columns.library], current.followed)
    # Log-likelihood of the last set before its coefficients were improved.
    best, last_unimproved = current, -np.inf
    chosen: list[DirectionGroup] = []
    for count in range(1, MAX_SET_SIZE + 1):
        chosen = regression.select(count, chosen)
        # The selection is complete, or begins to select effects of the set again: these are
        # candidates too, but cannot be added twice.
        if len(chosen) < count or any(group.effect in current.names for group in chosen):
            break
        start = _make_larger(context, current, chosen, regression)
        larger = filters.follow_with_effects(start.theta, start.effects, steps=0)
        # Test 1: `followed` are the runs, filtered with the coefficients from the regression.
        if larger.followed.log_likelihood <= last_unimproved:
            break
        last_unimproved = larger.followed.log_likelihood
        larger = filters.improve(larger)
        # Test 2.
        penalty = sum(filters.penalty(name) for name in larger.names[len(best.names) :])
        if 2.0 * (larger.followed.log_likelihood - best.followed.log_likelihood) < penalty:
            break
        best = larger
    return None if best is current else best


def _make_larger(
    context: SearchContext,
    current: FilteredSet,
    chosen: Sequence[DirectionGroup],
    regression: Regression,
) -> FitStart:
    """Return a model with the effects of a set and further ones from a regression.

    The effects of the set keep their coefficients, unless a further effect contains and replaces
    them. The coefficients of the further effects are solved for together by the regression.

    Args:
        context: search, filters and regressions of the recording.
        current: the set, with its filter.
        chosen: the further effects, each with its columns of the regression.
        regression: regression of the innovations of the set's filter.
    """
    start = FitStart(current.names, current.followed.theta, context.evaluator.initial_state_guesses)
    for group, solution in zip(chosen, regression.solve(chosen).coefficients, strict=True):
        coefficients = context.columns.coefficients(group, solution)
        start = add_effect_to_start(context.evaluator, start, group.effect, coefficients)
    return start


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
    little are removed. Then up to `MAX_ADDED_TO_TEXTBOOK` further effects are added, each with the
    largest gain by regression, until the missing forces are negligible or no effect gains enough.
    The result is simulated, but not fitted by simulation: an incomplete model drifts away over a
    long run.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.

    Returns:
        The identified set; None if the runs are short or nearly explained, if no effect pays, or
        if the set lacks no force, so that a simulation can be fitted.
    """
    evaluator, filters = context.evaluator, context.filters
    # RMS residual of the base model in units of the noise, minus one.
    excess = context.search.compute_excess_residual(context.search.base_model)
    if not is_long(evaluator) or not excess > MIN_LONG_EXCESS or evaluator.search_control.is_over():
        return None
    evaluator.search_control.begin_stage("identifying the joints and bodies")
    textbook = [
        name
        for name in evaluator.library
        if name.partition("@")[0] in TEXTBOOK_EFFECTS and not name.endswith("@*")
    ]
    current, gains = _prune_set(context, _fit_with_base_parameters(context, filters.base, textbook))
    columns: Columns | None = None
    for _ in range(MAX_ADDED_TO_TEXTBOOK):
        if _leaves_negligible_force(context, current):
            break
        # The responses are computed only if an effect is missing.
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
    few = len(evaluator.simulator.system.coordinates) <= MAX_LONG_JOINTS
    return few and all(run.times[-1] - run.times[0] >= MIN_LONG_DURATION for run in evaluator.runs)


def _leaves_negligible_force(context: SearchContext, current: FilteredSet) -> bool:
    """Return whether a set leaves a negligible share of the base model's missing forces.

    Missing forces are the standard deviations of the process noise of a filter.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        current: the set, with its filter.
    """
    limits = NEGLIGIBLE_FORCE_SHARE * context.filters.base.force
    return not current.followed.has_missing_force or bool((current.followed.force < limits).all())


def _get_bounds_with_base(context: SearchContext, names: Sequence[str]) -> dict[int, Bounds]:
    """Return the bounds of the free base parameters and of some effects, by index in theta.

    Args:
        context: search, filters and regressions of the recording.
        names: names of the effects.
    """
    evaluator = context.evaluator
    free = [i for i in evaluator.base_indices.tolist() if i not in context.search.fixed_parameters]
    bounds = {i: compute_range_around(evaluator, i) for i in free}
    return bounds | get_bounds_by_index(evaluator, names)


def _fit_with_base_parameters(
    context: SearchContext, followed: FollowedRuns, names: Sequence[str]
) -> FilteredSet:
    """Maximise the likelihood over the base parameters and some effects in the filter's model.

    Fitted are the free base parameters and the coefficients of the effects, by Gauss-Newton steps.
    They end when a step gains little compared with the gain over the base model so far.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        followed: the runs, filtered with the parameters from which the fit starts.
        names: names of the effects.
    """
    base_log_likelihood = context.filters.base.log_likelihood
    min_gain = max(
        MIN_STEP_GAIN_SHARE * (followed.log_likelihood - base_log_likelihood), MIN_STEP_GAIN
    )
    bounds = _get_bounds_with_base(context, names)
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
    bounds = _get_bounds_with_base(context, names)
    information = compute_information(followed, bounds)
    min_gains = {name: _compute_min_gain(context, current, name) for name in names}
    while True:
        gains = compute_wald_statistics(
            context.evaluator,
            followed.theta,
            names,
            information.select(list(_get_bounds_with_base(context, names))),
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
    # The coefficients of removed effects may have been zero already.
    if not np.array_equal(theta, followed.theta):
        followed = followed.with_parameters(theta)
    if lost_gain > 2.0 * MIN_STEP_GAIN:
        return _prune_set(context, _fit_with_base_parameters(context, followed, names))
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
    larger = _fit_with_base_parameters(
        context, current.followed.with_parameters(start.theta), start.effects
    )
    gain = 2.0 * (larger.followed.log_likelihood - current.followed.log_likelihood)
    return larger if gain > _compute_min_gain(context, larger, best.effect) else None


def _list_single_effects(context: SearchContext) -> Columns:
    """Return the columns of the effects that may be added: at one place, with few coefficients.

    A column is the response of the runs to one trial coefficient of an effect. Left out are
    families, one effect at all places (``@*``), effects with more than `MAX_IMPROVED_SIZE`
    coefficients, and effects with many shapes, which `columns.library` does not have.

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
