"""Fit single effects alone by simulation.

A servo at its limit is not linear, so a regression misjudges effects there. The effects that are
most likely missing are therefore simulated alone, as one batch: first each at several coefficients
(`fit_likely_effects`), and if none of them explains the runs, each fitted (`fit_single_effects`).
Those that compete with a single effect at a force limit are fitted further
(`refine_at_force_limits`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.prediction_error.dry_friction_fits import check_filter, check_fit
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import (
    JOINT_MODEL,
    LINK_MODEL,
    SERVO_MODEL,
    SET_POINT_MODEL,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    MAX_IMPROVED_SIZE,
    RatedStart,
    compute_likely_cost,
    fit_by_simulation,
    fit_nearby,
    has_noise_like_cost,
    is_at_noise,
    is_explained,
    is_nearly_explained,
    is_slow_to_simulate,
    list_nearby_starts,
    remove_idle_effects,
    select_lowest_of_each,
)
from bench.diagnosis.search.fit_starts import scale_effect
from sims.core.effect import members_of

SCANNED_FACTORS = (0.5, 2.0, 4.0)
"""Factors of a proposed coefficient at which an effect alone is also simulated."""
CLOSER_FACTORS = ((0.7, 0.84, 1.2, 1.4), (0.92, 0.96, 1.04, 1.09))
"""Factors of the best scanned coefficient that are simulated next, in two rounds."""
MIN_FAMILY_SQUARES_SHARE = 0.05
"""Minimum share of its squared residual by which an effect at all places beats one of its places.
"""
MAX_SCANNED = 5
"""Maximum number of likely effects that are simulated at closer factors, before any fit."""
MAX_SCANNED_FITS = 2
"""Maximum number of likely effects that are fitted alone."""
MAX_NEARBY = 5
"""Maximum number of effects that are simulated at nearby coefficients, those that fit best."""
MAX_REFINED = 3
"""Maximum number of effects that are fitted alone to convergence."""
MAX_REFINED_EXCESS_SHARE = 0.25
"""Maximum excess residual of a competing fit that is refined, above that of the best model.

It is a share of the excess residual of the base model.
"""


def list_likely_starts(context: SearchContext) -> list[RatedStart]:
    """Return the proposed effects that alone remove most of the residual, without any fit.

    Where a servo is at its limit or chatters, the cost is flat at the base model and steep far from
    it, so that a fit from the coefficient of a regression stays where it is. Each effect is
    therefore simulated at its proposed coefficient and, unless one of them explains the runs with
    it, at several factors of it. Effects at one joint are left out if a force is missing at another
    joint.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.

    Returns:
        Costs and starts with one effect each, in ascending order of the cost (sum of squared
        residuals in units of the noise).
    """
    filters = context.filters
    states = filters.estimate_first_states(filters.base)
    proposed = [
        replace(start, initial_states=states)
        for start in context.proposals.list_alone(is_fitted=False)
    ]
    rated_starts = select_lowest_of_each(context, proposed)
    if not has_noise_like_cost(context, rated_starts):
        rated_starts = _try_scaled(context, rated_starts, SCANNED_FACTORS)
    limit = compute_likely_cost(context)
    return _drop_families(context, [rated for rated in rated_starts if rated.cost < limit])


def _drop_families(context: SearchContext, rated_starts: Sequence[RatedStart]) -> list[RatedStart]:
    """Drop effects at all places that leave hardly less than the same effect at one place.

    Fits of such a family take longer, because it has a coefficient for each place.

    Args:
        context: search, filters and regressions of the recording.
        rated_starts: costs and starts with one effect each.
    """
    # Costs by the names of the effects, here tuples of one name.
    costs = {rated.start.effects: rated.cost for rated in rated_starts}
    effects = context.evaluator.available_effects
    remaining = []
    for rated in rated_starts:
        (name,) = rated.start.effects
        # An effect at a single place has no other members, and remains.
        members = [member.name for member in members_of(effects[name]) if member.name != name]
        limit = (1.0 + MIN_FAMILY_SQUARES_SHARE) * rated.cost
        if not any(costs.get((member,), np.inf) < limit for member in members):
            remaining.append(rated)
    return remaining


def _try_scaled(
    context: SearchContext, rated_starts: Sequence[RatedStart], factors: Sequence[float]
) -> list[RatedStart]:
    """Simulate starts also at factors of their coefficient, and keep the best of each effect.

    Effects with several coefficients are kept as they are.

    Args:
        context: search, filters and regressions of the recording.
        rated_starts: costs and starts with one effect each.
        factors: factors of the coefficient.

    Returns:
        Cost and start of each effect, in ascending order of the cost.
    """
    scaled = []
    for _, start in rated_starts:
        (name,) = start.effects
        if len(context.evaluator.get_coefficient_indices(name)) == 1:
            scaled += [scale_effect(context.evaluator, start, name, factor) for factor in factors]
    # The best start of each effect, at first the given one.
    lowest = {rated.start.effects: rated for rated in rated_starts}
    for rated in select_lowest_of_each(context, scaled):
        if rated.cost < lowest[rated.start.effects].cost:
            lowest[rated.start.effects] = rated
    return sorted(lowest.values(), key=lambda rated: rated.cost)


def fit_likely_effects(context: SearchContext, likely_starts: Sequence[RatedStart]) -> FittedModel:
    """Fit the effects that alone remove most of the residual, one after another.

    Coefficients far from the linear range are first improved by simulations at factors of them,
    because the cost has local minima. The effects with the lowest costs are then fitted; the fits
    end with the first model that explains the runs.

    Args:
        context: search, filters and regressions of the recording.
        likely_starts: result of `list_likely_starts`.

    Returns:
        The best model, which may be the base model.
    """
    best = context.search.base_model
    scanned = list(likely_starts[:MAX_SCANNED])
    # Closer factors are not needed once a start leaves little more than noise.
    for factors in CLOSER_FACTORS:
        if not has_noise_like_cost(context, scanned):
            scanned = _try_scaled(context, scanned, factors)
    for _, start in scanned[:MAX_SCANNED_FITS]:
        fitted = fit_by_simulation(context, start)
        if not is_explained(context, fitted) and is_nearly_explained(context, fitted):
            fitted = fit_nearby(context, fitted, fitted.effects[0])
        if np.isfinite(fitted.fit.cost):
            best = select_likeliest(best, fitted)
        if is_explained(context, best):
            return remove_idle_effects(context, best)
    return best


def fit_single_effects(context: SearchContext) -> FittedModel:
    """Fit each of the proposed effects alone, by simulation.

    A regression misjudges effects where a servo is at its limit, so the effects that are most
    likely missing are fitted in one batch, and the best of them to convergence. Effects at one
    joint are left out if a force is missing at another joint.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.

    Returns:
        The best model if it explains the runs, without an effect that gains too little; otherwise
        the base model.

    Raises:
        SoftFrictionError: none explains the runs, and dry friction is likelier in MuJoCo's soft
            form.
    """
    search, filters = context.search, context.filters
    states = filters.estimate_first_states(filters.base)
    # All effects that may be proposed at a joint. Their number is the maximum number of proposals,
    # so that none is left out.
    effects_at_joint = JOINT_MODEL + LINK_MODEL + SERVO_MODEL + SET_POINT_MODEL
    starts = context.proposals.list_alone(len(effects_at_joint))
    if not starts:
        return search.base_model
    fitted, best = list[FittedModel](), search.base_model
    for is_slow in (False, True):
        # Slow effects are fitted only if no other effect explains the runs.
        batch = [
            replace(start, initial_states=states)
            for start in starts
            if is_slow_to_simulate(context, start.effects) == is_slow
        ]
        if batch and not is_explained(context, best):
            fitted += search.fit_all(batch)
            best = select_likeliest(*fitted)
    if not is_explained(context, best):
        best = select_likeliest(best, refine_single_effects(context, fitted))
    if is_explained(context, best):
        return remove_idle_effects(context, best)
    # Raise an error if dry friction of the other form is likelier.
    check_filter(context, filters.get_filter(best).log_likelihood)
    check_fit(context, best)
    return search.base_model


def refine_single_effects(context: SearchContext, fitted: Sequence[FittedModel]) -> FittedModel:
    """Fit some effects alone to convergence, and return the likeliest model after penalties.

    Those with the lowest cost are fitted first, each from its fit or from a nearby coefficient,
    whichever has the lowest cost. Fits may stop in local minima where joints stick and at force
    limits. The cost ranks them, since likelihoods with coloured noise are unreliable if the
    residual is large.

    Args:
        context: search, filters and regressions of the recording.
        fitted: models with a single effect, fitted in few steps.

    Returns:
        The best model, or the base model if that is likelier.
    """
    starts: list[FitStart] = []
    # Effects with many coefficients have too many nearby ones.
    small = [
        model
        for model in fitted
        if len(context.evaluator.get_coefficient_indices(model.effects[0])) <= MAX_IMPROVED_SIZE
    ]
    for model in sorted(small, key=lambda model: model.fit.cost)[:MAX_NEARBY]:
        nearby_starts = list_nearby_starts(context, model, model.effects[0])
        starts += [model.fit.make_start(), *nearby_starts]
    best = context.search.base_model
    for _, start in select_lowest_of_each(context, starts)[:MAX_REFINED]:
        refined = fit_by_simulation(context, start)
        if not is_at_noise(context, refined) and is_nearly_explained(context, refined):
            refined = fit_nearby(context, refined, refined.effects[0])
        best = select_likeliest(best, refined)
        if is_explained(context, best) or context.evaluator.search_control.is_over():
            break
    return best


def refine_at_force_limits(
    context: SearchContext, best: FittedModel, competing_effects: Collection[str]
) -> None:
    """Fit single effects of the joint and servo models further, if they may reach the best model.

    Fits at force limits may stop in local minima. A fit whose excess residual (RMS residual in
    units of the noise, minus one) is far above that of the best model will hardly reach it, and is
    not fitted further. The results are stored in `search.models`.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model, with a single effect.
        competing_effects: names of the effects that compete with it.
    """
    search, laws = context.search, JOINT_MODEL + SERVO_MODEL
    limit = search.compute_excess_residual(best) + MAX_REFINED_EXCESS_SHARE * (
        search.compute_excess_residual(search.base_model)
    )
    fitted = [
        search.models[frozenset([name])]
        for name in competing_effects
        if name.partition("@")[0] in laws and frozenset([name]) in search.models
    ]
    refine_single_effects(
        context, [model for model in fitted if search.compute_excess_residual(model) < limit]
    )
