"""Fit effects alone by simulation.

A filter is linear about the measured motion, but a joint that sticks and a servo at its limit are
not linear. Therefore the effects that are most likely missing are simulated as one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.gap.model.models import Model
from bench.gap.model.problem import Start
from bench.gap.prediction_error.dry_friction import check_filter, check_fit
from bench.gap.prediction_error.identification import Selected
from bench.gap.prediction_error.joint_effects import JOINT_MODEL, SERVO_MODEL, acts_at
from bench.gap.prediction_error.search_context import SearchContext
from bench.gap.prediction_error.simulated_fits import (
    fit,
    fit_nearby,
    higher_merit,
    is_at_noise,
    is_explained,
    is_nearly_explained,
    lowest_of_each,
    starts_nearby,
    without_idle_effects,
)
from sims.robot.series import is_series

MAX_REFINED = 3
"""Maximum number of effects that are fitted alone to convergence."""
MAX_IMPROVED_SIZE = 3
"""Maximum number of coefficients of an effect that is refined alone or improved by a filter."""


def fit_single_effects(context: SearchContext) -> Model:
    """Fit each of the proposed effects alone.

    Returns:
        The best model, or the base model if none explains the runs.

    Raises:
        SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
    """
    search, filters = context.search, context.filters
    states = filters.first_states(filters.base)
    starts = context.proposals.of(filters.empty_set, len(JOINT_MODEL + SERVO_MODEL))
    found = search.fit_all([replace(start, states=states) for start in starts])
    best = max(found, key=lambda model: model.merit, default=search.base)
    if not is_explained(context, best):
        best = higher_merit(best, refine_single_effects(context, found))
    if is_explained(context, best):
        return without_idle_effects(context, best)
    check_filter(context, filters.of_model(best).log_likelihood)
    check_fit(context, best)
    return search.base


def refine_single_effects(context: SearchContext, fitted: Sequence[Model]) -> Model:
    """Fit some effects alone to convergence, and return the model with the highest merit.

    Those with the lowest cost are fitted first. Fits may stop in local minima where joints stick
    and at force limits, and likelihoods with coloured noise are unreliable if the residual is
    large.

    Args:
        context: context of the search.
        fitted: models with a single effect.
    """
    starts: list[Start] = []
    for model in fitted:
        (name,) = model.names
        if len(context.world.places(name)) <= MAX_IMPROVED_SIZE:
            starts += [model.fit.start(), *starts_nearby(context, model, name)]
    best = context.search.base
    for _, start in lowest_of_each(context, starts)[:MAX_REFINED]:
        found = fit(context, start)
        if not is_at_noise(context, found) and is_nearly_explained(context, found):
            found = fit_nearby(context, found, found.names[0])
        best = higher_merit(best, found)
        if is_explained(context, best) or context.world.watch.left():
            break
    return best


def fit_series_effects(context: SearchContext, selected: Selected) -> Model:
    """Fit elastic joints and backlash between drive and links at the most affected joint.

    These effects have their own states, so each shape is simulated.

    Args:
        context: context of the search.
        selected: the selection, whose missing forces determine the joint.
    """
    world, search = context.world, context.search
    joints = selected.followed.joints_by_loss[:1]
    names = [name for name in world.library if is_series(world.effects[name])]
    probes = context.columns.probes([name for name in names if acts_at(world, name, joints)])
    if not probes:
        return search.base
    world.watch.stage("testing elasticity and play between drives and links", len(probes))
    starts = []
    for probe in probes:
        theta = context.filters.theta_with(probe.effect, probe.c)
        starts.append(Start((probe.effect,), theta, world.guess))
    found = search.fit_all([start for _, start in lowest_of_each(context, starts)])
    return fit(context, max(found, key=lambda model: model.merit).fit.start())
