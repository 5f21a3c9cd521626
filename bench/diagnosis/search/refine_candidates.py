"""Refit the model found by the search and its close rivals to convergence.

The search tests few candidates about each model, and stops fits that fall behind. A diagnosed cause
must be compared with all rivals, each at its own optimum.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.search.candidate_directions import generate_frequency_neighbours
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit

MAX_COMPETITOR_DISTANCE = 30.0
"""Maximum difference in twice the log-likelihood (merit) of rivals that are refitted."""
MAX_COMPETITOR_EXCESS_RATIO = 1.5
"""Maximum excess of rivals that are refitted, as a multiple of the excess of the model."""


def refine_best_model(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Refit a model and its promising rivals of the same size to convergence.

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
    around = list(generate_frequency_neighbours(search.world, model.fit))
    # Periodic effects have dozens of local minima.
    if around:
        search.refit_from_segments(size)
    near = list_competing_models(search, model)
    parts = list_submodels(search, model)
    noise = _estimate_model_noise(search, model)
    judged = [model]
    # With structure in the residual, merit only compares how well models mimic it, so no rival
    # replaces the model.
    if noise is not None:
        judged = [
            m
            for m in near
            if abs(model.penalised_log_likelihood - m.penalised_log_likelihood)
            < MAX_COMPETITOR_DISTANCE
        ] or [model]
    starts = [m.fit.make_start() for m in near]
    starts += [m.fit.make_start() for m in parts]
    starts += [_make_swapped_start(search, model, m) for m in judged if _differs_in_one(model, m)]
    search.refit_models([*starts, *around], noise)
    # A refit that ends worse is not stored, so the table contains the best fit of each model.
    refitted = [search.models[frozenset(m.effects)] for m in judged]
    return max(refitted, key=lambda m: m.penalised_log_likelihood)


def _swap_each_effect(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Replace each effect by every other effect of the library, and return the best model.

    Unlike `swap_effect`, which refits only the most promising candidates, all are fitted.
    """
    size = len(model.effects)
    known = set(search.models)
    smaller = [search.remove_effect(model, name) for name in model.effects]
    search.refit_extensions(smaller, len(search.world.library))
    best = model
    for key, other in search.models.items():
        # The search has already compared the known models.
        if key in known or len(key) != size:
            continue
        if other.penalised_log_likelihood > best.penalised_log_likelihood:
            best = other
    return best


def _differs_in_one(model: FittedModel, other: FittedModel) -> bool:
    """Return whether `other` has all effects of a model of at least two effects except one."""
    return len(model.effects) > 1 and len(set(model.effects) - set(other.effects)) == 1


def _make_swapped_start(search: EffectSearch, model: FittedModel, other: FittedModel) -> FitStart:
    """Return a start for a rival in which all shared effects have the values of the model.

    A law with several coefficients converges to slightly different values each time, which would
    make equivalent models look different.
    """
    (own,), (gone,) = (set(m.effects) - set(n.effects) for m, n in ((other, model), (model, other)))
    slots = search.world.slots
    theta = model.fit.theta.copy()
    theta[slots[gone]] = 0.0
    theta[slots[own]] = other.fit.theta[slots[own]]
    return FitStart(other.effects, theta, model.fit.states)


def list_competing_models(search: EffectSearch, model: FittedModel) -> list[FittedModel]:
    """Return models with as many effects that explain the data nearly as well, including the model.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
    """
    size = len(model.effects)
    return [
        other
        for other in search.models.values()
        if len(other.effects) == size and _is_competitive(search, other, model)
    ]


def _is_competitive(search: EffectSearch, other: FittedModel, model: FittedModel) -> bool:
    """Return whether two models are close in merit or in excess.

    Merit is misleading if the residual has structure.
    """
    if (
        abs(model.penalised_log_likelihood - other.penalised_log_likelihood)
        < MAX_COMPETITOR_DISTANCE
    ):
        return True
    return search.compute_excess(other) < MAX_COMPETITOR_EXCESS_RATIO * search.compute_excess(model)


def list_submodels(search: EffectSearch, model: FittedModel) -> list[FittedModel]:
    """Return the models without one of the effects, from which the gain of each is measured.

    Args:
        search: the search, with all fitted models.
        model: the larger model.
    """
    names = set(model.effects)
    size = len(names) - 1
    smaller = []
    for other in search.models.values():
        if len(other.effects) == size and set(other.effects) < names:
            smaller.append(other)
    return smaller


def _estimate_model_noise(search: EffectSearch, model: FittedModel) -> NoiseModel | None:
    """Estimate the AR(1) noise of each channel from the residual of a model.

    Return None if the residual has structure, because it is then not noise.
    """
    if assess_lack_of_fit(search, model).has_structure:
        return None
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    # Correlations are never negative, as in the score test.
    return NoiseModel(sigma, np.maximum(model.likelihood.phi, 0.0))
