"""Fit the sets that regression selects, and select again with effects of many shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.prediction_error.effect_selection import Selected
from bench.diagnosis.prediction_error.joint_effects import acts_at, has_many_shapes
from bench.diagnosis.prediction_error.search_context import SearchContext
from bench.diagnosis.prediction_error.simulated_fits import fit, higher_merit, without_idle_effects
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.dynamics.effect_forces import TIME_DEPENDENT_EFFECTS
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

MAX_SURPLUS = 2
"""Maximum number of consecutive effects with too little gain before a selection is cut."""
MAX_SLOW_EFFECTS = 2
"""Maximum number of effects in a set that is fitted by simulation although this is slow."""
LEAST_SHARE = 0.01
"""Minimum gain of a further effect, as a share of the gain of the set.

The model of a real robot is never complete, and long recordings show this with certainty.
"""


def fit_quick_selection(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the selected set by simulation, without effects that gain little.

    Args:
        context: context of the search.
        selected: the selection.

    Returns:
        The fitted model, or the base model if simulation is slow and a force is still missing.
    """
    kept = without_surplus(context, selected)
    slow = len(kept.groups) > MAX_SLOW_EFFECTS and _is_slow(context, kept)
    if slow and selected.followed.lacks_force:
        return context.search.base_model
    return fit_selection(context, kept)


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
    states = context.filters.first_states(selected.followed)
    found = fit(context, replace(start, states=states))
    if not np.isfinite(found.fit.cost):
        return base
    found = without_idle_effects(context, found)
    if selected.shows_steps:
        found = context.search.without_step_errors(found)
    return higher_merit(found, base)


def without_surplus(context: SearchContext, selected: Selected) -> Selected:
    """Drop the last effects of a selection that gain little with the set in a filter's model.

    Far from the base model, the linear regression is wrong.

    Args:
        context: context of the search.
        selected: the selection.
    """
    filters = context.filters
    own = filters.log_likelihood(filters.reference)
    best, kept, gained = 0.0, 0, 0.0
    found: list[Array] = []
    for count in range(1, len(selected.groups) + 1):
        if count > kept + MAX_SURPLUS:
            break
        groups = selected.groups[:count]
        coefficients = selected.regression.solve(groups)[1]
        theta = context.columns.start(groups, coefficients).theta
        gain = 2.0 * (filters.log_likelihood(theta) - own)
        penalty = sum(filters.penalty(group.effect) for group in groups)
        least = LEAST_SHARE * max(gained, 0.0) * (count - kept)
        if gain - penalty > best and gain - gained > least:
            best, kept, gained, found = gain - penalty, count, gain, coefficients
    return replace(selected, groups=selected.groups[:kept], coefficients=found)


def _is_slow(context: SearchContext, selected: Selected) -> bool:
    """Return whether a set is slow to simulate.

    This is the case if forces are computed in every step, or have their own states.
    """
    effects = [context.world.available_effects[name] for name in selected.effects]
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
    world, joints = context.world, np.flatnonzero(selected.followed.missing_forces).tolist()
    rich = [n for n in world.library if has_many_shapes(n) and acts_at(world, n, joints)]
    if not rich:
        return selected
    world.watch.stage(f"testing {len(rich)} effects with many shapes", 1)
    context.columns.add(rich)
    return context.columns.select()
