"""Selection of effects by filters that have dry friction in their model.

A joint that sticks makes a regression about the base model, which is linear, unreliable for all
other effects. A filter with the friction in its model follows the joint, so that its innovations
are nearly linear in the effects that are left: several are selected by one regression, and the next
regression is made about a filter with these (iterated linearisation, as in the Gauss-Newton method;
J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., 2006, section 10.3). Only the last set is
fitted by simulation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import get_bounds_by_index
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.kalman.likelihood_fit import compute_information, compute_wald_statistics
from bench.diagnosis.prediction_error.dry_friction_fits import make_dry_friction_start
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import JOINT_MODEL
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet
from bench.diagnosis.prediction_error.regression_columns import build_regression_about
from bench.diagnosis.prediction_error.regression_selection import (
    MAX_SET_SIZE,
    Regression,
    Selected,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_filtered,
    is_explained,
    remove_idle_effects,
)
from bench.diagnosis.search.fit_starts import add_effect_to_start
from bench.diagnosis.search.score_test import DirectionGroup

FRICTION_FAMILY = "friction.coulomb@*"
"""Dry friction of all joints."""
JOINT_MODEL_STEPS = 4
"""Maximum number of Gauss-Newton steps for the coefficients of the standard joint model."""
MAX_RELINEARISATIONS = 3
"""Maximum number of regressions, each about a filter with the effects of the previous ones."""


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
    current = _choose_start(context, friction)
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


def _choose_start(context: SearchContext, friction: FitStart) -> FilteredSet:
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

    def compute_criterion(current: FilteredSet) -> float:
        """Return the penalised log-likelihood of a set; higher is better."""
        penalty = sum(filters.penalty(name) for name in current.names)
        return 2.0 * current.followed.log_likelihood - penalty

    friction_alone = filters.follow_with_effects(friction.theta, friction.effects)
    # None if a regression adds nothing to the friction.
    selected = _add_selected(context, friction_alone) or friction_alone
    return max(selected, _follow_joint_model(context, friction), key=compute_criterion)


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
    # Effects of the joint model other than the friction, for all joints (``@*``).
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
