"""Fit effects alone by simulation.

A filter is linear about the measured motion, but a joint that sticks and a servo at its limit are
not linear. Therefore the effects that are most likely missing are simulated as one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.prediction_error.dry_friction import check_filter, check_fit
from bench.diagnosis.prediction_error.effect_selection import Selected
from bench.diagnosis.prediction_error.joint_effects import JOINT_MODEL, SERVO_MODEL, acts_at
from bench.diagnosis.prediction_error.search_context import SearchContext
from bench.diagnosis.prediction_error.simulated_fits import (
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
from sims.robot.dynamics.series_joints import is_series_effect

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
    states = filters.first_states(filters.base)
    starts = context.proposals.of(filters.empty_set, len(JOINT_MODEL + SERVO_MODEL))
    found = search.fit_all([replace(start, states=states) for start in starts])
    best = max(found, key=lambda model: model.penalised_log_likelihood, default=search.base_model)
    if not is_explained(context, best):
        best = higher_merit(best, refine_single_effects(context, found))
    if is_explained(context, best):
        return without_idle_effects(context, best)
    check_filter(context, filters.of_model(best).log_likelihood)
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
        if len(context.world.get_coefficient_indices(name)) <= MAX_IMPROVED_SIZE:
            starts += [model.fit.make_start(), *starts_nearby(context, model, name)]
    best = context.search.base_model
    for _, start in lowest_of_each(context, starts)[:MAX_REFINED]:
        found = fit(context, start)
        if not is_at_noise(context, found) and is_nearly_explained(context, found):
            found = fit_nearby(context, found, found.effects[0])
        best = higher_merit(best, found)
        if is_explained(context, best) or context.world.watch.has_abandoned_fits():
            break
    return best


def fit_series_effects(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit elastic joints and backlash between drive and links at the most affected joint.

    These effects have their own states, so each shape is simulated.

    Args:
        context: context of the search.
        selected: the selection, whose missing forces determine the joint.
    """
    world, search = context.world, context.search
    joints = selected.followed.joints_by_loss[:1]
    names = [name for name in world.library if is_series_effect(world.available_effects[name])]
    probes = context.columns.probes([name for name in names if acts_at(world, name, joints)])
    if not probes:
        return search.base_model
    world.watch.stage("testing elasticity and play between drives and links", len(probes))
    starts = []
    for probe in probes:
        theta = context.filters.theta_with(probe.effect, probe.coefficients)
        starts.append(FitStart((probe.effect,), theta, world.guess))
    found = search.fit_all([start for _, start in lowest_of_each(context, starts)])
    return fit(
        context, max(found, key=lambda model: model.penalised_log_likelihood).fit.make_start()
    )
