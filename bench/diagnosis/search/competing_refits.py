"""Refit the best model of a search and the competing models of the same size to convergence.

The search tests few candidates about each model, and stops fits that fall behind. A diagnosed cause
must be compared with all competing models, each at its own optimum.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.search.effect_search import FAR_EXCESS, EffectSearch
from bench.diagnosis.search.initial_values import generate_frequency_neighbours
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit

MAX_COMPETITOR_DISTANCE = 30.0
"""Maximum difference in twice the log-likelihood (merit) of competing models that are refitted."""
MAX_COMPETITOR_EXCESS_RATIO = 1.5
"""Maximum excess of refitted competing models, as a multiple of the excess of the model."""


def refine_best_model(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Refit a model and its promising competing models of the same size to convergence.

    If the residual is noise, generalised least squares is used. If it has structure, ordinary least
    squares is used, because the structure is not noise and would distort the fit.

    Args:
        search: the search, with all fitted models.
        model: the model that the search found.

    Returns:
        The best of these models.
    """
    size = len(model.effects)
    if search.settled_effects != frozenset(model.effects):
        model = _swap_each_effect(search, model)
    neighbour_starts = list(generate_frequency_neighbours(search.evaluator, model.fit))
    # Periodic effects have dozens of local minima.
    if neighbour_starts:
        search.refit_from_segments(size)
    submodels = list_submodels(search, model)
    noise = _estimate_model_noise(search, model)
    competing_models = list_competing_models(search, model)
    if noise is None:
        competing_models = select_decisive(search, model, competing_models)
    compared_models = [model]
    # With structure in the residual, merit only compares how well models mimic it, so no competing
    # model replaces the model.
    if noise is not None:
        compared_models = [
            candidate
            for candidate in competing_models
            if abs(model.penalised_log_likelihood - candidate.penalised_log_likelihood)
            < MAX_COMPETITOR_DISTANCE
        ] or [model]
    starts = [candidate.fit.make_start() for candidate in competing_models]
    starts += [candidate.fit.make_start() for candidate in submodels]
    starts += [
        _make_swapped_start(search, model, candidate)
        for candidate in compared_models
        if _differs_in_one(model, candidate)
    ]
    search.refit_models([*starts, *neighbour_starts], noise)
    # A refit that ends worse is not stored, so the table contains the best fit of each model.
    refitted = [search.models[frozenset(candidate.effects)] for candidate in compared_models]
    return max(refitted, key=lambda candidate: candidate.penalised_log_likelihood)


def _swap_each_effect(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Replace each effect by every other effect of the library, and return the best model.

    Unlike `swap_effect`, which refits only the most promising candidates, all are fitted.

    Args:
        search: the search; the fitted models are added to it.
        model: the model whose effects are replaced.
    """
    size = len(model.effects)
    known_effect_sets = set(search.models)
    submodels = [search.remove_effect(model, name) for name in model.effects]
    search.refit_extensions(submodels, len(search.evaluator.library))
    best = model
    for key, other_model in search.models.items():
        # The search has already compared the known models.
        if key in known_effect_sets or len(key) != size:
            continue
        if other_model.penalised_log_likelihood > best.penalised_log_likelihood:
            best = other_model
    return best


def _differs_in_one(model: FittedModel, other_model: FittedModel) -> bool:
    """Return whether `other_model` has all effects except one of a model with several effects."""
    return len(model.effects) > 1 and len(set(model.effects) - set(other_model.effects)) == 1


def _make_swapped_start(
    search: EffectSearch, model: FittedModel, other_model: FittedModel
) -> FitStart:
    """Return a start for a competing model, with all shared effects at the values of the model.

    A law with several coefficients converges to slightly different values each time, which would
    make equivalent models look different.

    Args:
        search: the search, with all fitted models.
        model: the fitted model.
        other_model: competing model.
    """
    (added_effect,), (removed_effect,) = (
        set(m.effects) - set(n.effects) for m, n in ((other_model, model), (model, other_model))
    )
    coefficient_slices = search.evaluator.coefficient_slices
    added = coefficient_slices[added_effect]
    theta = model.fit.theta.copy()
    theta[coefficient_slices[removed_effect]] = 0.0
    theta[added] = other_model.fit.theta[added]
    return FitStart(other_model.effects, theta, model.fit.initial_states)


def list_competing_models(search: EffectSearch, model: FittedModel) -> list[FittedModel]:
    """Return models with as many effects that explain the data nearly as well, including the model.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
    """
    size = len(model.effects)
    return [
        other_model
        for other_model in search.models.values()
        if len(other_model.effects) == size and _is_competitive(search, other_model, model)
    ]


def select_decisive(
    search: EffectSearch, model: FittedModel, competing_models: Sequence[FittedModel]
) -> list[FittedModel]:
    """Return the competing models whose comparison with a model can change the answer.

    Far from the noise, no competing model replaces the model. They only show what may stand in
    place of one of its effects, so those that differ in several effects are left out.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
        competing_models: models with as many effects, from `list_competing_models`.
    """
    if search.compute_excess_residual(model) < FAR_EXCESS:
        return list(competing_models)
    names = set(model.effects)
    return [m for m in competing_models if len(names - set(m.effects)) <= 1]


def _is_competitive(search: EffectSearch, other_model: FittedModel, model: FittedModel) -> bool:
    """Return whether two models are close in merit or in excess residual.

    Merit is the penalised log-likelihood, and the excess residual the RMS residual in units of the
    noise, minus one. Merit is misleading if the residual has structure.

    Args:
        search: the search, with all fitted models.
        other_model: competing model.
        model: the fitted model.
    """
    if (
        abs(model.penalised_log_likelihood - other_model.penalised_log_likelihood)
        < MAX_COMPETITOR_DISTANCE
    ):
        return True
    return search.compute_excess_residual(
        other_model
    ) < MAX_COMPETITOR_EXCESS_RATIO * search.compute_excess_residual(model)


def list_submodels(search: EffectSearch, model: FittedModel) -> list[FittedModel]:
    """Return the models without one of the effects, from which the gain of each is measured.

    Args:
        search: the search, with all fitted models.
        model: the larger model.
    """
    names = set(model.effects)
    size = len(names) - 1
    submodels = []
    for other_model in search.models.values():
        if len(other_model.effects) == size and set(other_model.effects) < names:
            submodels.append(other_model)
    return submodels


def _estimate_model_noise(search: EffectSearch, model: FittedModel) -> NoiseModel | None:
    """Estimate the AR(1) noise of each channel from the residual of a model.

    Return None if the residual has structure, because it is then not noise.

    Args:
        search: the search.
        model: the fitted model.
    """
    if assess_lack_of_fit(search, model).has_structure:
        return None
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    # Correlations are never negative, as in the score test.
    return NoiseModel(sigma, np.maximum(model.likelihood.phi, 0.0))
