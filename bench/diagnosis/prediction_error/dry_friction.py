"""Dry friction of a selection, and its form.

The force of dry friction is not linear in its limit where a joint sticks or creeps. Therefore it is
fitted before other effects, and filters compare whether it has MuJoCo's soft form.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.friction_form_verdict import (
    has_dry_friction,
    is_likelier_soft,
    with_plain_friction,
)
from bench.diagnosis.prediction_error.effect_selection import Selected
from bench.diagnosis.prediction_error.search_context import SearchContext
from bench.diagnosis.prediction_error.selected_sets import without_surplus
from bench.diagnosis.prediction_error.simulated_fits import fit, is_explained, without_idle_effects
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS


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
    """Compare a selection with soft dry friction, before anything is fitted.

    Args:
        context: context of the search.
        selected: the selection.

    Raises:
        SoftFrictionError: soft friction is likelier than the selection.
    """
    filters = context.filters
    if filters.is_soft or not filters.base.lacks_force:
        return
    friction = dry_friction_of(context, selected)
    # Stiff friction that explains the runs needs no comparison.
    if friction.effects and is_explained(context, context.search.fit_one(friction)):
        return
    kept = without_surplus(context, selected)
    own = filters.log_likelihood(context.columns.start(kept.groups, kept.coefficients).theta)
    check_filter(context, own, is_preliminary=True)


def check_filter(
    context: SearchContext, log_likelihood: float, is_preliminary: bool = False
) -> None:
    """Compare the log-likelihood of a filter with that of soft dry friction.

    Args:
        context: context of the search.
        log_likelihood: log-likelihood of the filter.
        is_preliminary: whether nothing has been fitted yet.

    Raises:
        SoftFrictionError: soft friction is likelier.
    """
    soft = context.filters.soft_friction
    if soft is None:
        return
    softer = context.filters.log_likelihood(soft.theta, is_soft=True)
    if softer > log_likelihood + 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO:
        raise SoftFrictionError(soft, is_preliminary)


def check_fit(context: SearchContext, model: FittedModel) -> None:
    """Compare a fitted model with the same effects in the soft form of dry friction.

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
    friction = dry_friction_of(context, selected)
    if not friction.effects or not selected.followed.lacks_force:
        return context.search.base_model
    known = context.search.models.get(frozenset(friction.effects))
    if known is not None and is_explained(context, known):
        return without_idle_effects(context, known)
    found = fit(context, friction)
    return without_idle_effects(context, found) if is_explained(context, found) else found


def dry_friction_of(context: SearchContext, selected: Selected) -> FitStart:
    """Return a start with only the dry friction of a selection, in its form without a state.

    A family replaces its members.

    Args:
        context: context of the search.
        selected: the selection.
    """
    world, filters = context.world, context.filters
    start = context.columns.start(selected.groups, selected.coefficients)
    plain, own = with_plain_friction(world, start.effects, start.theta)
    native = [name for name in plain if name.partition("@")[0] in MODEL_FIELD_EFFECTS]
    friction = [name for name in native if has_dry_friction(world, [name])]
    contained = {part for name in friction for part in world.available_effects[name].contains}
    names = tuple(name for name in friction if name not in contained)
    theta = filters.reference.copy()
    for name in names:
        theta[world.slots[name]] = own[world.slots[name]]
    return FitStart(names, theta, filters.first_states(filters.base))


def stands_alone(context: SearchContext, selected: Selected, friction: FittedModel) -> bool:
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
    _, plain = with_plain_friction(context.world, start.effects, start.theta)
    stiff = filters.log_likelihood(plain)
    soft = -np.inf if filters.is_soft else filters.log_likelihood(plain, is_soft=True)
    own = -np.inf if np.array_equal(plain, start.theta) else filters.log_likelihood(start.theta)
    if not max(stiff, soft) > own - 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO:
        return False
    if soft > max(stiff, own) + 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO:
        check_fit(context, friction)
    return True
