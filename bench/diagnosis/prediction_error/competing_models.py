"""Fit sets of effects that are nearly as good as the best one by simulation.

They may be equivalent to it, or better.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import MAX_ITERATIONS, FittedModel
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.forward_growth import (
    COMPETING_MODEL_MARGIN,
    LINEARISATION_ERROR,
    try_one_more_effect,
)
from bench.diagnosis.prediction_error.model_filters import (
    GAUSS_NEWTON_STEPS,
    JOINT_MODEL,
    SERVO_MODEL,
    has_series,
    list_at_coupled_joints,
    list_joint_model_effects,
)
from bench.diagnosis.prediction_error.selection_fits import MAX_IMPROVED_SIZE, refine_single_effects
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_filtered,
    is_explained,
    make_replacing_start,
    select_more_likely,
)
from sims.core.simulator import Array

MAX_COMPETING_EFFECTS = 5
"""Maximum number of competing models of each effect that are fitted by simulation."""
MIN_SAME_JOINT_GAIN_SHARE = 0.5
"""Minimum gain of an effect at the same joint that is tried as a replacement.

It is a share of the gain by regression of the effect that it replaces.
"""


class _CompetingEffect(NamedTuple):
    """An effect that may replace another one.

    Attributes:
        effect: its name.
        c: (k,) its coefficients from the regression.
        loss: loss in twice the log-likelihood.
    """

    effect: str
    c: Array
    loss: float


def fit_single_in_place(context: SearchContext, best: FittedModel) -> FittedModel:
    """Return a model with one effect in place of several if it is as good.

    Two linear laws may imitate one nonlinear law.

    Args:
        context: context of the search.
        best: the best model so far.
    """
    explained = len(best.effects) > 1 and is_explained(context, best)
    if (
        not explained
        or has_series(context.evaluator, best.effects)
        or context.evaluator.search_control.is_over()
    ):
        return best
    filters = context.filters
    single_sets = try_one_more_effect(context, filters.empty_set)
    if not single_sets:
        return best
    (name,) = single_sets[0].names
    penalty = sum(filters.penalty(one) for one in best.effects) - filters.penalty(name)
    loss = filters.get_filter(best).log_likelihood - single_sets[0].followed.log_likelihood
    if 2.0 * loss > penalty + COMPETING_MODEL_MARGIN:
        return best
    return select_more_likely(
        fit_competing_models(context, fit_filtered(context, single_sets[0])), best
    )


def fit_competing_models(context: SearchContext, best: FittedModel) -> FittedModel:
    """Fit the sets that are nearly as good by the regression, and return the best of all.

    Args:
        context: context of the search.
        best: the best model so far.
    """
    search, evaluator = context.search, context.evaluator
    has_no_fit = not best.effects or not np.isfinite(best.fit.cost)
    if has_no_fit or has_series(evaluator, best.effects):
        return best
    starts, competing_effects = list[FitStart](), set[str]()
    for name in best.effects:
        for competing_effect in _find_competing_effects(context, best, name):
            competing_effects.add(competing_effect.effect)
            start = make_replacing_start(
                evaluator, best, [name], competing_effect.effect, competing_effect.c
            )
            if frozenset(start.effects) in search.models:
                continue
            confirmed = _confirm_by_filter(context, best, competing_effect, start)
            starts += [confirmed] if confirmed is not None else []
    if starts:
        search.refit_models(starts, is_racing=False)
    size = len(best.effects)
    if size == 1 and context.filters.base.runs.jumps.any():
        # Fits at force limits may stop in local minima.
        laws = JOINT_MODEL + SERVO_MODEL
        plain = [name for name in competing_effects if name.partition("@")[0] in laws]
        fitted = [
            search.models[frozenset([name])] for name in plain if frozenset([name]) in search.models
        ]
        refine_single_effects(context, fitted)
    _fit_at_coupled_joints(context, size)
    _refine_near(context, size)
    likeliest = search.get_best(size)
    return best if likeliest is None else likeliest


def _find_competing_effects(
    context: SearchContext, model: FittedModel, name: str
) -> list[_CompetingEffect]:
    """Return the effects that are nearly as good by the regression in place of the given one."""
    evaluator = context.evaluator
    regression, columns = context.columns.regression(model)
    remaining = regression.make_regression_without(columns[name])
    # Effects with more coefficients gain more under the null hypothesis.
    gains = remaining.compute_net_gains()
    own_gain = remaining.compute_gain(columns[name]) - context.filters.penalty(name)
    same_joint = list_joint_model_effects(evaluator, name)
    competing_effects, near_count = dict[str, _CompetingEffect](), 0
    for i in np.argsort(-gains, kind="stable").tolist():
        group = remaining.groups[i]
        effect, loss = group.effect, own_gain - float(gains[i])
        if effect not in evaluator.library or effect in (*model.effects, *competing_effects):
            continue
        is_near = (
            loss <= COMPETING_MODEL_MARGIN + LINEARISATION_ERROR * own_gain
            and near_count < MAX_COMPETING_EFFECTS
        )
        # Regression is inaccurate for a large effect, so effects at the same joint are tried.
        is_promising = effect in same_joint and gains[i] > MIN_SAME_JOINT_GAIN_SHARE * own_gain
        # A law that contains this one never replaces it.
        if (is_near or is_promising) and name not in evaluator.available_effects[effect].contains:
            near_count += is_near
            c = context.columns.coefficients(group, remaining.solve([group])[1][0])
            competing_effects[effect] = _CompetingEffect(effect, c, loss)
    return list(competing_effects.values())


def _confirm_by_filter(
    context: SearchContext, best: FittedModel, competing_effect: _CompetingEffect, start: FitStart
) -> FitStart | None:
    """Return a start with a competing model that a filter confirms, else None.

    A filter is used only if the competing model is far behind by the regression, which is linear.
    """
    if competing_effect.loss <= COMPETING_MODEL_MARGIN:
        return start
    filters = context.filters
    has_few_coefficients = (
        len(context.evaluator.get_coefficient_indices(competing_effect.effect)) <= MAX_IMPROVED_SIZE
    )
    steps = GAUSS_NEWTON_STEPS if has_few_coefficients else 0
    # Better coefficients do not help an effect with which the filter follows the runs worse.
    if (
        len(start.effects) == 1
        and filters.log_likelihood(start.theta) < filters.base.log_likelihood
    ):
        return None
    followed, names = filters.follow_with_effects(start.theta, start.effects, steps)
    loss = filters.get_filter(best).log_likelihood - followed.log_likelihood
    return (
        None
        if 2.0 * loss > COMPETING_MODEL_MARGIN
        else FitStart(names, followed.theta, start.initial_states)
    )


def _fit_at_coupled_joints(context: SearchContext, size: int) -> None:
    """Fit the best models of a size with each effect moved to the other joints of its loop."""
    search, evaluator = context.search, context.evaluator
    starts: dict[frozenset[str], FitStart] = {}
    for model in _list_models_near_the_best(context, size):
        for name in model.effects:
            c = model.fit.theta[evaluator.coefficient_slices[name]]
            for other in list_at_coupled_joints(evaluator, name):
                start = make_replacing_start(evaluator, model, [name], other, c)
                key = frozenset(start.effects)
                if other not in model.effects and key not in search.models:
                    starts[key] = start
    if starts:
        search.refit_models(list(starts.values()), is_racing=False)


def _refine_near(context: SearchContext, size: int) -> None:
    """Fit the models of a size with nearly the best merit to convergence.

    Otherwise, incomplete fits would decide between them.
    """
    search, near_models = context.search, _list_models_near_the_best(context, size)
    if context.evaluator.search_control.is_over() or len(near_models) < 2:
        return
    fitter = TrajectoryFitter(
        context.evaluator, search.noise, search.fixed_parameters, is_final_fit=True
    )
    starts = [model.fit.make_start() for model in near_models]
    for model, fit in zip(near_models, fitter.fit_models(starts, MAX_ITERATIONS), strict=True):
        if fit.cost < model.fit.cost:
            search.add_fit(fit)


def _list_models_near_the_best(context: SearchContext, size: int) -> list[FittedModel]:
    """Return the models with `size` effects whose merit is close to the highest."""
    of_size = [m for m in context.search.models.values() if len(m.effects) == size]
    highest = max((model.penalised_log_likelihood for model in of_size), default=-np.inf)
    return [
        model
        for model in of_size
        if model.penalised_log_likelihood > highest - COMPETING_MODEL_MARGIN
    ]
