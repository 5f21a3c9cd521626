"""Fit sets of effects that are nearly as good as the best one: they may be equivalent, or better.

Each effect of the best set is replaced in turn by another one, or moved to another place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.fitting.fitted_models import MAX_ITERATIONS, FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import (
    has_series,
    is_time_shift,
    list_joint_model_effects,
)
from bench.diagnosis.prediction_error.filters_with_effects import (
    COMPETING_MODEL_MARGIN,
    GAUSS_NEWTON_STEPS,
    compute_comparison_margin,
)
from bench.diagnosis.prediction_error.physically_equivalent_effects import (
    list_at_coupled_joints,
    list_moved_payloads,
    list_similar_dampings,
    list_similar_inertias,
    list_similar_shifts,
)
from bench.diagnosis.prediction_error.simulated_fits import (
    MAX_IMPROVED_SIZE,
    MAX_SINGLE_SQUARES_SHARE,
    fit_filtered,
    is_explained,
    is_nearly_explained,
    remove_idle_effects,
    select_lowest_of_each,
)
from bench.diagnosis.prediction_error.single_effect_fits import refine_at_force_limits
from bench.diagnosis.prediction_error.stepwise_selection_by_filters import try_one_more_effect
from bench.diagnosis.search.alternative_causes import differ_in_one_effect
from bench.diagnosis.search.fit_starts import make_replacing_start, scale_effect
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from sims.core.simulator import Array

FURTHER_STEPS = 4
"""Maximum number of further Gauss-Newton steps of a competing model that has improved much."""
MAX_COMPETING_EFFECTS = 5
"""Maximum number of competing models of each effect that are fitted by simulation."""
MAX_RICHER_LAWS = 3
"""Maximum number of richer laws that are fitted in place of a law."""
COMPETING_FACTORS = (0.5, 0.8, 1.0, 1.25, 2.0)
"""Factors of the regression coefficient at which a competing effect is simulated."""
MAX_SINGLE_LOSS = 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
"""Maximum loss of penalised log-likelihood by one effect in place of several."""
MIN_SAME_JOINT_GAIN_SHARE = 0.5
"""Minimum gain of an effect at the same joint that is tried as a replacement.

It is a share of the gain by regression of the effect that it replaces.
"""


class _CompetingEffect(NamedTuple):
    """An effect that may replace another one.

    Attributes:
        effect: its name.
        coefficients: (k,) its coefficients from the regression.
        loss: loss in twice the log-likelihood by the replacement, from the regression; infinite if
            it is not computed.
    """

    effect: str
    coefficients: Array
    loss: float


def fit_single_in_place(context: SearchContext, best: FittedModel) -> FittedModel:
    """Return a model with one effect in place of several if it is as good.

    Two linear laws may imitate one nonlinear law, and many coefficients of two laws one law with
    few. If a model with several effects explains the runs, or nearly, it is compared with the best
    single effect:

    1. Find the best single effect: by its fits, if all proposed effects were fitted by simulation,
       and otherwise by filters.
    2. Stop if it is far worse.
    3. Fit its competitors, the effects that may act like it, and take the best of all.
    4. Return this one unless its penalised log-likelihood is lower by more than `MAX_SINGLE_LOSS`.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model so far.

    Returns:
        The model with one effect; `best` if none is as good, or for a model with joints in series,
        which filters do not follow.
    """
    search, filters = context.search, context.filters
    may_imitate = len(best.effects) > 1 and is_nearly_explained(context, best)
    if (
        not may_imitate
        or has_series(context.evaluator, best.effects)
        or context.evaluator.search_control.is_over()
    ):
        return best
    # Each proposed effect, as a set of one name.
    proposed = [frozenset(start.effects) for start in context.proposals.list_alone()]
    if not proposed:
        return best
    if all(effects in search.models for effects in proposed):
        # Proposed effects that were fitted alone show how good a single effect can be.
        single = select_likeliest(*(search.models[effects] for effects in proposed))
        loss = best.penalised_log_likelihood - single.penalised_log_likelihood
        if 2.0 * loss > COMPETING_MODEL_MARGIN:
            return best
    else:
        # Filters with one effect each, the likeliest first.
        single_sets = try_one_more_effect(context, filters.empty_set)
        if not single_sets:
            return best
        (name,) = single_sets[0].names
        penalty = sum(filters.penalty(one) for one in best.effects) - filters.penalty(name)
        loss = filters.get_filter(best).log_likelihood - single_sets[0].followed.log_likelihood
        # Fewer effects save penalty; the single one is not fitted if it loses far more likelihood.
        if 2.0 * loss > penalty + COMPETING_MODEL_MARGIN:
            return best
        single = fit_filtered(context, single_sets[0])
    single = fit_competing_models(context, single)
    # One cause is simpler than several that act alike, as a tilt and an offset with less gravity.
    limit = best.penalised_log_likelihood - MAX_SINGLE_LOSS
    return single if single.penalised_log_likelihood > limit else best


def replace_time_shifts(context: SearchContext, best: FittedModel) -> FittedModel:
    """Return a model with another delay or lag in place of one of its own, if that is likelier.

    A filter does not follow late readings, so that a regression confuses delays with lags. Further
    effects would only imitate the difference.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model so far, which does not explain the runs.
    """
    evaluator = context.evaluator
    starts = [
        make_replacing_start(
            evaluator, best, [name], similar, best.fit.theta[evaluator.coefficient_slices[name]]
        )
        for name in best.effects
        for similar in list_similar_shifts(evaluator, name)
        if similar not in best.effects
    ]
    if not starts or has_series(evaluator, best.effects):
        return best
    # The start with the lowest cost of all, as (cost, start), is the first.
    ((_, start), *_) = select_lowest_of_each(context, starts)
    return _select_improved(context, best, [context.search.fit_one(start)])


def replace_by_richer_laws(context: SearchContext, best: FittedModel) -> FittedModel:
    """Return a model with a richer law in place of one of its laws, if that is likelier.

    Friction that depends on the position or the velocity looks like Coulomb friction at first, and
    a selection that begins with the latter may not reach the richer law. A heavier body looks like
    a payload anywhere on it. Those richer laws with the largest gains by the regression about the
    model are fitted, each with its best shape.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model so far, which does not explain the runs.
    """
    search, evaluator, starts = context.search, context.evaluator, list[FitStart]()
    if not best.effects or not np.isfinite(best.fit.cost) or has_series(evaluator, best.effects):
        return best
    for name in best.effects:
        richer_laws = _list_richer_laws(context, name)
        if not richer_laws:
            continue
        regression, own_columns = context.columns.regression(best)
        # The regression about the model without this law.
        remaining = regression.make_regression_without(own_columns[name])
        # The best shape of each richer law, as a group of columns; the largest gain first.
        groups = [g for g, _ in remaining.rank_effects() if g.effect in richer_laws]
        for group in groups[:MAX_RICHER_LAWS]:
            coefficients = context.columns.solve_alone(remaining, group)
            starts.append(make_replacing_start(evaluator, best, [name], group.effect, coefficients))
    return _select_improved(context, best, search.fit_all(starts)) if starts else best


def _list_richer_laws(context: SearchContext, name: str) -> list[str]:
    """Return the laws at the same place that contain an effect, and the payload of a mass.

    Args:
        context: search, filters and regressions of the recording.
        name: name of the effect.
    """
    effect, _, place = name.partition("@")
    # `find_contained_slices` has the simpler laws that a law contains at the same place, by name.
    return [
        law
        for law in context.evaluator.library
        if name in context.search.find_contained_slices(law)
        or (effect == "mass.scale" and law == f"payload@{place}")
    ]


def _select_improved(
    context: SearchContext, best: FittedModel, fits: Sequence[FittedModel]
) -> FittedModel:
    """Return the likeliest of some models without idle effects; `best` if none is likelier."""
    likeliest = select_likeliest(best, *fits)
    return best if likeliest is best else remove_idle_effects(context, likeliest)


def fit_competing_models(context: SearchContext, best: FittedModel) -> FittedModel:
    """Fit the sets that are nearly as good by the regression, and return the best of all.

    Each effect of the best model is replaced in turn by the effects that a regression finds nearly
    as good; where the regression is not certain, a filter or simulations confirm it. The effects
    are also moved to other joints of their kinematic loop, and payloads to neighbouring bodies.
    Models that remain close to the best are fitted to convergence. This is repeated about a better
    model, about which effects that act alike have better starts. It ends at a set that was compared
    before: a family may be likelier than its only member that acts, which is preferred to it.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model so far.

    Returns:
        The fitted model with the highest penalised log-likelihood among those with as many effects
        as `best`, or a simpler one that is as good; `best` itself if it has no effects or series
        joints.
    """
    compared = set[frozenset[str]]()
    while frozenset(best.effects) not in compared:
        compared.add(frozenset(best.effects))
        best = _find_better_competitor(context, best)
    return best


def _find_better_competitor(context: SearchContext, best: FittedModel) -> FittedModel:
    """Fit the competing models about the best one, and return the best of all.

    1. Fit the models in which another effect replaces one of the best model.
    2. Where drives reach their force limits, fit competing single effects further.
    3. Fit models with effects moved to related places, such as other joints of a closed loop.
    4. Fit the models near the best to convergence.
    5. Try one effect in place of two.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        best: the best model so far; it is returned if it has no effects, joints in series, or if
            its simulation fails.
    """
    search, evaluator = context.search, context.evaluator
    # The cost is infinite if the simulation fails. Filters do not follow joints in series.
    has_no_fit = not best.effects or not np.isfinite(best.fit.cost)
    if has_no_fit or has_series(evaluator, best.effects):
        return best
    starts, competing_effects = list[FitStart](), set[str]()
    for name in best.effects:
        for competing_effect in _find_competing_effects(context, best, name):
            competing_effects.add(competing_effect.effect)
            start = make_replacing_start(
                evaluator, best, [name], competing_effect.effect, competing_effect.coefficients
            )
            if not _should_fit(context, best, competing_effect, start):
                continue
            confirmed = _confirm(context, best, competing_effect, start)
            starts += [confirmed] if confirmed is not None else []
    if starts:
        # Fits that stay far behind the best model are no alternatives, and are stopped early.
        search.refit_models(starts)
    # The fits are stored in `search.models`, from which the best model with as many effects is
    # taken at the end.
    size = len(best.effects)
    # Jumps of the state in the linear model come from drives at their force limits.
    if size == 1 and context.filters.base.runs.jumps.any():
        refine_at_force_limits(context, best, competing_effects)
    _fit_at_related_places(context, size)
    _refine_near(context, size)
    preferred = search.get_best(size) or best
    merged = _replace_two_effects(context, preferred)
    if merged is not None:
        return merged
    if set(preferred.effects) == set(best.effects):
        return preferred
    # A family may replace another one, and a single member of it may be enough.
    return remove_idle_effects(context, preferred)


def _should_fit(
    context: SearchContext, best: FittedModel, competing_effect: _CompetingEffect, start: FitStart
) -> bool:
    """Return whether to fit a competing model: it is not fitted yet, or worse than predicted.

    Fits with dry friction may stop in local minima. An effect that acts like that of the best model
    is then as good if it starts from there.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model.
        competing_effect: the effect that replaces one of its effects.
        start: start of a fit of the competing model.
    """
    fitted = context.search.models.get(frozenset(start.effects))
    if fitted is None:
        return True
    # Loss of the fit, and that which the regression predicts, in twice the log-likelihood.
    fitted_loss = 2.0 * (best.penalised_log_likelihood - fitted.penalised_log_likelihood)
    predicted_loss = competing_effect.loss
    is_near = predicted_loss <= COMPETING_MODEL_MARGIN
    return is_near and fitted_loss > COMPETING_MODEL_MARGIN + predicted_loss


def _replace_two_effects(context: SearchContext, best: FittedModel) -> FittedModel | None:
    """Return a model with one effect in place of two, if it is as good as the best one, else None.

    Two effects can imitate one: more inertia and more damping of a pendulum look like less gravity.
    Then the same effect can replace either of them, and it is tried in place of both.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model.
    """
    evaluator = context.evaluator
    # Models that differ from the best one in one effect: by the effect that they add, and then by
    # the effect of the best model that it replaces.
    replaced = dict[str, dict[str, FittedModel]]()
    for model in _list_models_near_the_best(context, len(best.effects)):
        if differ_in_one_effect(best, model):
            (removed,) = set(best.effects) - set(model.effects)
            (added,) = set(model.effects) - set(best.effects)
            replaced.setdefault(added, {})[removed] = model
    starts = []
    for name, models in replaced.items():
        if len(models) < 2:
            continue
        # The effect can replace at least two effects, so it is tried in place of two of them.
        likeliest = select_likeliest(*models.values())
        coefficients = likeliest.fit.theta[evaluator.coefficient_slices[name]]
        starts.append(make_replacing_start(evaluator, best, list(models)[:2], name, coefficients))
    fits = [context.search.fit_one(start) for start in starts]
    merged = select_likeliest(*fits, best)
    return None if merged is best else merged


def _find_competing_effects(
    context: SearchContext, model: FittedModel, name: str
) -> list[_CompetingEffect]:
    """Return the effects that are nearly as good by the regression in place of the given one.

    The regression is about the fitted model without the given effect, so that its gain and that of
    every other effect are comparable. Compared are gains in twice the log-likelihood minus the
    penalty of the effect. The result contains

    - at most `MAX_COMPETING_EFFECTS` effects whose gain is nearly as large, not counting families
      (effects at every place, ``@*``) in place of an effect at one place;
    - effects of the joint or servo model at the same joint that gain much less, because the linear
      regression is inaccurate for large effects;
    - in place of a delay or a lag, all similar ones, with the same coefficient.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.
        name: name of the effect to replace.
    """
    evaluator = context.evaluator
    regression, own_columns = context.columns.regression(model)
    remaining = regression.make_regression_without(own_columns[name])
    own_gain = remaining.compute_gain(own_columns[name]) - context.filters.penalty(name)
    same_joint = list_joint_model_effects(evaluator, name)
    competing_effects, near_count = dict[str, _CompetingEffect](), 0
    for group, gain in remaining.rank_effects():
        effect, loss = group.effect, own_gain - gain
        # Forces of any shape are candidates too, but no effects of the library.
        if effect not in evaluator.library or effect in model.effects:
            continue
        is_near = loss <= compute_comparison_margin(own_gain) and near_count < MAX_COMPETING_EFFECTS
        is_promising = effect in same_joint and gain > MIN_SAME_JOINT_GAIN_SHARE * own_gain
        # A law that contains this one never replaces it.
        if (is_near or is_promising) and name not in evaluator.available_effects[effect].contains:
            # Families are hardly ever likelier than an effect at one place, so they do not count.
            near_count += is_near and (name.endswith("@*") or not effect.endswith("@*"))
            coefficients = context.columns.solve_alone(remaining, group)
            competing_effects[effect] = _CompetingEffect(effect, coefficients, loss)
    coefficients = model.fit.theta[evaluator.coefficient_slices[name]]
    for effect in list_similar_shifts(evaluator, name):
        if effect not in model.effects:
            competing_effects[effect] = _CompetingEffect(effect, coefficients, np.inf)
    return list(competing_effects.values())


def _confirm(
    context: SearchContext, best: FittedModel, competing_effect: _CompetingEffect, start: FitStart
) -> FitStart | None:
    """Return the start of a competing model if it may be as good as the best one, else None.

    The regression that proposes the model is linear. So further tests decide, unless its loss of
    likelihood is small:

    - Loss within `COMPETING_MODEL_MARGIN`, or a payload, whose response is far from linear in its
      place: the start is returned as it is, without a test.
    - Delay or lag: simulations decide, because a filter does not follow late readings.
    - One coefficient, and the best model explains the runs: simulations decide, because they are
      faster and show more then.
    - All others: a filter decides.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model.
        competing_effect: the effect that replaces one of its effects, with its loss in the
            regression.
        start: start of a fit of the competing model, with the coefficients from the regression.

    Returns:
        The start, with coefficients that the test improved; None if the competing model is far
        worse.
    """
    is_payload = competing_effect.effect.startswith("payload@")
    if competing_effect.loss <= COMPETING_MODEL_MARGIN or is_payload:
        return start
    effect = context.evaluator.available_effects[competing_effect.effect]
    has_one_coefficient = competing_effect.coefficients.size == 1
    if is_time_shift(effect) or (has_one_coefficient and is_explained(context, best)):
        return _confirm_by_simulation(context, best, competing_effect, start)
    return _confirm_by_filter(context, best, competing_effect, start)


def _confirm_by_simulation(
    context: SearchContext, best: FittedModel, competing_effect: _CompetingEffect, start: FitStart
) -> FitStart | None:
    """Return the start of a competing model with the best of several simulated coefficients.

    None is returned if its cost exceeds that of the best model by much of that of the base model.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model.
        competing_effect: the effect, with one coefficient, that replaces one of its effects.
        start: start of a fit of the competing model; its coefficient is scaled.
    """
    # Costs are sums of squared residuals in units of the noise.
    limit = best.fit.cost + MAX_SINGLE_SQUARES_SHARE * context.search.base_model.fit.cost
    name, factors = competing_effect.effect, np.array(COMPETING_FACTORS)
    # Readings that are late shift the first states, a command that comes late does not.
    is_shift = is_time_shift(context.evaluator.available_effects[name])
    same_effect_starts = _add_filtered_states(context, [start]) if is_shift else [start]
    # The second round is between the neighbours of the best factor of the first one.
    for _ in range(2):
        starts = [
            scale_effect(context.evaluator, unscaled, name, factor)
            for unscaled in same_effect_starts
            for factor in factors.tolist()
        ]
        ((cost, lowest),) = select_lowest_of_each(context, starts)
        if cost < limit:
            return lowest
        # Index of the best factor; the starts repeat all factors for each choice of first states.
        best_index = next(i for i, scaled in enumerate(starts) if scaled is lowest) % factors.size
        # The ends of the new range were simulated already, so they are left out.
        first = factors[max(best_index - 1, 0)]
        last = factors[min(best_index + 1, factors.size - 1)]
        factors = np.geomspace(first, last, factors.size + 2)[1:-1]
    return None


def _confirm_by_filter(
    context: SearchContext, best: FittedModel, competing_effect: _CompetingEffect, start: FitStart
) -> FitStart | None:
    """Return the start of a competing model that a filter confirms, else None.

    A filter with the effect in its model improves the coefficients by Gauss-Newton steps, and its
    log-likelihood must come close to that of the best model. Many coefficients are improved only if
    the loss is within the error of the linear regression, as for a family of the same forces.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        best: the best model.
        competing_effect: the effect that replaces one of its effects.
        start: start of a fit of the competing model, with the coefficients from the regression.
    """
    filters = context.filters
    has_few_coefficients = competing_effect.coefficients.size <= MAX_IMPROVED_SIZE
    gain = filters.compute_gain(filters.get_filter(best))
    # The margin contains the error of the linear regression, a share of the gain.
    is_near = competing_effect.loss <= compute_comparison_margin(gain)
    steps = GAUSS_NEWTON_STEPS if has_few_coefficients or is_near else 0
    # Better coefficients do not help an effect with which the filter follows the runs worse.
    if (
        len(start.effects) == 1
        and filters.log_likelihood(start.theta) < filters.base.log_likelihood
    ):
        return None
    followed, names = filters.follow_with_effects(start.theta, start.effects, steps)
    best_log_likelihood = filters.get_filter(best).log_likelihood
    gained = followed.log_likelihood - filters.log_likelihood(start.theta)
    # The margin is in twice the log-likelihood.
    if 0.5 * COMPETING_MODEL_MARGIN < best_log_likelihood - followed.log_likelihood < gained:
        # The steps gained more than what is still missing, so further steps may reach the best one.
        followed, names = filters.follow_with_effects(followed.theta, names, FURTHER_STEPS)
    if 2.0 * (best_log_likelihood - followed.log_likelihood) > COMPETING_MODEL_MARGIN:
        return None
    return FitStart(names, followed.theta, start.initial_states)


def _fit_at_related_places(context: SearchContext, size: int) -> None:
    """Fit the best models of a size with effects moved to places where they may act alike.

    Joints of a closed loop move together, so the data may not show at which of them an effect acts.
    The same holds for a payload and the bodies of a joint, for masses and inertias, and for the
    damping of a joint and that of its servo. The fitted models are added to `search.models`.

    Args:
        context: search, filters and regressions of the recording.
        size: number of effects of the models.
    """
    search, evaluator = context.search, context.evaluator
    starts: dict[frozenset[str], FitStart] = {}
    for model in _list_models_near_the_best(context, size):
        for name in model.effects:
            coefficients = model.fit.theta[evaluator.coefficient_slices[name]]
            moved = [(other, coefficients) for other in list_at_coupled_joints(evaluator, name)]
            moved += list_moved_payloads(evaluator, name, coefficients)
            moved += list_similar_inertias(evaluator, name, coefficients)
            moved += list_similar_dampings(evaluator, name, coefficients)
            for other, other_coefficients in moved:
                start = make_replacing_start(evaluator, model, [name], other, other_coefficients)
                key = frozenset(start.effects)
                known_fit = search.models.get(key)
                # A fit from another start that is worse than the base model has failed.
                has_failed = known_fit is not None and (
                    known_fit.penalised_log_likelihood < search.base_model.penalised_log_likelihood
                )
                if other not in model.effects and (known_fit is None or has_failed):
                    starts[key] = start
    # A servo at its force limit may chatter in a simulation from the first states of another model.
    rated_starts = select_lowest_of_each(context, _add_filtered_states(context, starts.values()))
    if rated_starts:
        search.refit_models([rated.start for rated in rated_starts], is_racing=False)


def _add_filtered_states(context: SearchContext, starts: Iterable[FitStart]) -> list[FitStart]:
    """Return starts with their own first states, and again with those of the base model's filter.

    The own first states are those of a model with another effect. The filter's are estimated from
    the readings, and so biased by neither.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        starts: starts of fits.
    """
    states = context.filters.estimate_first_states(context.filters.base)
    return [both for start in starts for both in (start, replace(start, initial_states=states))]


def _refine_near(context: SearchContext, size: int) -> None:
    """Fit the models of a size whose penalised log-likelihood is nearly the best to convergence.

    Otherwise, incomplete fits would decide between them. Improved fits replace those in
    `search.models`. A single model near the best is not fitted again.

    Args:
        context: search, filters and regressions of the recording.
        size: number of effects of the models.
    """
    search, near_models = context.search, _list_models_near_the_best(context, size)
    if context.evaluator.search_control.is_over() or len(near_models) < 2:
        return
    # Final fits end at convergence, not at the threshold of the search.
    fitter = TrajectoryFitter(
        context.evaluator, search.noise, search.fixed_parameters, is_final_fit=True
    )
    starts = [model.fit.make_start_with_derivatives() for model in near_models]
    for model, fit in zip(near_models, fitter.fit_models(starts, MAX_ITERATIONS), strict=True):
        if fit.cost < model.fit.cost:
            search.add_fit(fit)


def _list_models_near_the_best(context: SearchContext, size: int) -> list[FittedModel]:
    """Return the models with `size` effects whose penalised log-likelihood is near the highest.

    Args:
        context: search, filters and regressions of the recording.
        size: number of effects of the models.
    """
    of_size = [m for m in context.search.models.values() if len(m.effects) == size]
    highest = max((model.penalised_log_likelihood for model in of_size), default=-np.inf)
    return [
        model
        for model in of_size
        if model.penalised_log_likelihood > highest - COMPETING_MODEL_MARGIN
    ]
