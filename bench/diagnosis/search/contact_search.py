"""Search for the effect that explains a recording with contacts.

Each effect at a contact has been fitted before (`bench.diagnosis.kalman.contact_proposals`),
because scores about the base model are misleading at contacts. If one of these fits leaves only
noise, scores about it are valid. They show whether a further effect acts, and which effects may
replace it: to first order, the base model leaves the residual e + c d with the residual e of the
fit, the coefficient c and its response d, and a competing effect explains this as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.search.candidate_directions import iterate_first_probes
from bench.diagnosis.search.effect_search import MAX_P_VALUE_FURTHER_EFFECT, EffectSearch
from bench.diagnosis.search.score_test import SHAPE_COUNT_FOR_MULTISTART
from bench.diagnosis.search.start_selection import select_refit_starts
from sims.core.simulator import Array

MAX_COMPETITOR_SIZE = 2.0
"""Maximum residual of a competing effect to first order, relative to that of the model (RMS)."""
MAX_COMPETITORS = 4
"""Maximum number of competing effects that are fitted."""


def search_in_contact(search: EffectSearch) -> FittedModel:
    """Return the model of all effects that a recording with contacts shows.

    Laws with many shapes are candidates only if the simpler ones do not explain the recording.

    Args:
        search: the search, which contains the base model and models of one effect at a contact.
    """
    exclude_laws_with_many_shapes(search)
    model = _search_simple_laws(search)
    if search.is_noise_like(model):
        search.settled_effects = frozenset(model.effects)
        search.best_supported_model = model
        return model
    search.excluded_effects = frozenset()
    search.cached_scans.clear()
    search.superseded_scans.clear()
    search.scores_by_effects.clear()
    return search.run()


def exclude_laws_with_many_shapes(search: EffectSearch) -> None:
    """Exclude effects from scores whose shape parameters have many values to try."""
    evaluator, base = search.evaluator, search.base_model.fit
    probe_counts = {
        name: sum(1 for _ in iterate_first_probes(evaluator, base, name))
        for name in evaluator.library
    }
    search.excluded_effects = frozenset(
        name for name, count in probe_counts.items() if count > SHAPE_COUNT_FOR_MULTISTART
    )


def _search_simple_laws(search: EffectSearch) -> FittedModel:
    """Return the best model of the present library."""
    best = max(search.models.values(), key=lambda model: model.penalised_log_likelihood)
    if not search.is_noise_like(best) or not search.is_complete(best, MAX_P_VALUE_FURTHER_EFFECT):
        return search.run()
    if not best.effects:
        return best
    search.reference_scores = search.score_missing_effects(best)
    _fit_competing_effects(search, best)
    models = [model for model in search.models.values() if len(model.effects) == 1]
    return max(models, key=lambda model: model.penalised_log_likelihood)


def _fit_competing_effects(search: EffectSearch, model: FittedModel) -> None:
    """Fit the effects that may replace the only effect of a model.

    Args:
        search: the search, with scores about the model.
        model: the model.
    """
    (name,) = model.effects
    scan = search.cached_scans[frozenset(model.effects)]
    residual = search.compute_residual(model.fit)
    change = _compute_change(search, model)
    scores = scan.test.compute_scores(residual + change)
    sigma = search.noise.sigma
    before, after = (
        float(np.square((values / sigma)[search.observed_mask]).sum())
        for values in (residual + change, residual)
    )
    count = int(search.observed_mask.sum())
    # A score is n log(SS / SS_k) of the sums of squares before and after.
    sizes = np.sqrt(before * np.exp(-scores.score / count) / after)
    order = [int(i) for i in np.argsort(sizes) if sizes[i] < MAX_COMPETITOR_SIZE][:MAX_COMPETITORS]
    if not order:
        return
    competitors = replace(
        scores,
        effects=tuple(scores.effects[i] for i in order),
        score=scores.score[order],
        null_quantiles=scores.null_quantiles[order],
        peaks=tuple(scores.peaks[i] for i in order),
        null_scores=scores.null_scores[order],
        white_noise_scores=scores.white_noise_scores[order],
    )
    theta = model.fit.theta.copy()
    theta[search.evaluator.coefficient_slices[name]] = 0.0
    base = search.base_model
    fit = replace(base.fit, theta=theta, initial_states=model.fit.initial_states)
    base = replace(base, fit=fit)
    starts = select_refit_starts(
        search.evaluator,
        search.noise,
        base,
        scan.directions,
        competitors,
        MAX_COMPETITORS,
        fits_all=False,
    )
    search.refit_models(starts, is_racing=False)


def _compute_change(search: EffectSearch, model: FittedModel) -> Array:
    """Return the change of the runs by the only effect of a model, to first order (R, T, C)."""
    (name,) = model.effects
    places = list(search.evaluator.get_coefficient_indices(name))
    columns = [int(np.flatnonzero(model.fit.free_indices == place)[0]) for place in places]
    change: Array = model.fit.jacobian[..., columns] @ model.fit.theta[places]
    return np.where(search.observed_mask, change, 0.0)
