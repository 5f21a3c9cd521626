"""Search long recordings on subsampled runs first, which is faster, then on all samples.

The model found and its close competing models are fitted to all samples. The search is repeated on
all samples only if these show more than the subsampled runs did.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import MAX_TIME_STEP, RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.search.alternative_causes import (
    list_competing_models,
    refine_best_model,
    select_decisive,
)
from bench.diagnosis.search.effect_search import (
    FAR_EXCESS,
    MAX_P_VALUE_FIRST_EFFECT,
    MAX_P_VALUE_FURTHER_EFFECT,
    EffectSearch,
    select_by_size,
)
from bench.diagnosis.search.scored_models import list_submodels
from bench.logs.sample_thinning import has_enough_samples, take_every_nth
from sims.recording.recording import Run

MIN_SAMPLES_TO_THIN = 5_000
"""Minimum total number of samples of all runs for which they are thinned."""
MIN_THINNED_SAMPLES = 2_000
"""Minimum total number of samples after thinning."""
MAX_SINGLE_EFFECT_REFITS = 6
"""Number of best single-effect models that are fitted to all samples in addition."""


def search_with_subsampling(search: EffectSearch) -> FittedModel:
    """Return the model of all effects that the data show; long runs are thinned first.

    Recordings with contacts have their own search, because thinned runs would begin in contact
    without an estimate of their initial states.

    Args:
        search: the search, which contains the fitted base model.

    Raises:
        SearchStoppedError: the search had to end early.
    """
    if search.evaluator.is_in_contact:
        # This import is needed for robots only.
        from bench.diagnosis.search.contact_search import search_in_contact

        return search_in_contact(search)
    thinned_runs = thin_runs(search.evaluator)
    if thinned_runs is None:
        return search.run()
    try:
        return _search_subsampled(search, thinned_runs)
    finally:
        thinned_runs.close()


def thin_runs(evaluator: RunEvaluator) -> RunEvaluator | None:
    """Return a run evaluator with fewer samples and the same parameters, for a faster search.

    Recordings with many samples in each step of the engine lose little information.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.

    Returns:
        The thinned runs, or None if there are few samples, if the sample interval is already as
        long as an engine step, or if a channel would lose too many samples.
    """
    total = int(evaluator.lengths.sum())
    # Of each run, every n-th sample is kept; n is its factor, at most this one.
    max_factor = total // MIN_THINNED_SAMPLES
    factors = [min(_compute_factor(run), max_factor) for run in evaluator.runs]
    if total < MIN_SAMPLES_TO_THIN or max(factors) < 2:
        return None
    runs = [
        take_every_nth(run, factor) for run, factor in zip(evaluator.runs, factors, strict=True)
    ]
    if not all(
        has_enough_samples(thinned_run, run, factor)
        for thinned_run, run, factor in zip(runs, evaluator.runs, factors, strict=True)
    ):
        return None
    return evaluator.with_runs(runs)


def _compute_factor(run: Run) -> int:
    """Return the number of sample intervals within one step of the simulator, at least 1."""
    intervals = np.diff(run.times)
    if not intervals.size:
        return 1
    # The small addend keeps rounding from reducing a whole number of intervals by one.
    return max(int(MAX_TIME_STEP / float(np.median(intervals)) + 1e-6), 1)


def _search_subsampled(search: EffectSearch, thinned_runs: RunEvaluator) -> FittedModel:
    """Search on runs with fewer samples, which is faster, then confirm the result on all samples.

    1. If scores on all samples show no effect, a search is not needed.
    2. Search on the subsampled runs.
    3. Fit the models that matter to all samples, and select the best.
    4. If all samples show more effects, repeat the search on them.

    Args:
        search: search on all samples, with the fitted base model.
        thinned_runs: the same runs with fewer samples.

    Raises:
        SearchStoppedError: the search had to end early; the best model so far is stored in
            `search`.
    """
    # 1. No effect.
    # The scores of the base model are needed in any case: they show how much each effect gains from
    # noise alone, by which it is penalised. If they show nothing, `run` returns the base model at
    # once.
    if search.is_complete(search.base_model, MAX_P_VALUE_FIRST_EFFECT):
        return search.run()
    # 2. Subsampled runs.
    subsampled_search = EffectSearch(
        thinned_runs,
        noise=search.noise,
        fixed_parameters=search.fixed_parameters,
        rng=search.make_rng("fewer samples"),
        is_noise_stated=search.is_noise_stated,
        thorough=search.thorough,
    )
    # The base model, which every search needs.
    subsampled_search.refit_models([search.base_model.fit.make_start()])
    try:
        subsampled_model = refine_best_model(subsampled_search, subsampled_search.run())
    except SearchStoppedError:
        _adopt_subsampled_models(search, subsampled_search.get_best_so_far())
        raise
    # 3. All samples.
    starts = _collect_full_fit_starts(subsampled_search, subsampled_model)
    if starts:
        search.refit_models(starts)
    model = _select_full_model(search, subsampled_model)
    # 4. Confirmation.
    if not _is_confirmed_by_all_samples(search, model):
        return search.run()
    # The model was compared with its neighbours on the subsampled runs, which need not be repeated.
    search.settled_effects = frozenset(model.effects)
    search.best_supported_model = model
    return model


def _adopt_subsampled_models(search: EffectSearch, model: FittedModel) -> None:
    """Adopt the best model of a search on thinned runs, which had to end early.

    It is simulated on all samples without a fit (zero iterations), for which there is no time.

    Args:
        search: search on all samples, in which the model is stored.
        model: best model of the search on thinned runs.
    """
    fitter = TrajectoryFitter(search.evaluator, search.noise, search.fixed_parameters)
    (fit,) = fitter.fit_models([model.fit.make_start()], iterations=0)
    search.best_supported_model = search.add_fit(fit)


def _collect_full_fit_starts(
    subsampled_search: EffectSearch, subsampled_model: FittedModel
) -> list[FitStart]:
    """Return starts of fits to all samples, from the best models of the search on subsampled runs.

    The models are the result, models that explain the data nearly as well, models without one of
    its effects, and the best models with a single effect.

    Args:
        subsampled_search: finished search on subsampled runs.
        subsampled_model: best model of this search.
    """
    competing_models = list_competing_models(subsampled_search, subsampled_model)
    selected_models = [
        subsampled_model,
        *select_decisive(subsampled_search, subsampled_model, competing_models),
        *list_submodels(subsampled_search, subsampled_model),
    ]
    # Models without one of the effects that were not fitted yet are fitted now.
    selected_models += [
        subsampled_search.remove_effect(subsampled_model, name) for name in subsampled_model.effects
    ]
    selected_models += select_by_size(subsampled_search, 1)[:MAX_SINGLE_EFFECT_REFITS]
    # A dictionary, because the lists overlap and each model is fitted once.
    starts = {model.effects: model.fit.make_start() for model in selected_models if model.effects}
    return list(starts.values())


def _select_full_model(search: EffectSearch, subsampled_model: FittedModel) -> FittedModel:
    """Return the fit to all samples of the model that was found.

    If its residual is near the noise, return the best model with as many effects, because thinned
    runs distinguish models less well.

    Args:
        search: search on all samples, with the fits of the models that the thinned runs select.
        subsampled_model: result of the search on thinned runs.
    """
    model = search.models[frozenset(subsampled_model.effects)]
    best = search.get_best(len(subsampled_model.effects))
    if best is None or search.compute_excess_residual(model) >= FAR_EXCESS:
        return model
    return best


def _is_confirmed_by_all_samples(search: EffectSearch, model: FittedModel) -> bool:
    """Return whether all samples support the model without any further effect.

    Args:
        search: search on all samples.
        model: its present model.
    """
    # Far from the noise, more samples of the same runs show nothing new.
    if search.compute_excess_residual(model) >= FAR_EXCESS:
        return True
    return search.is_complete(
        model, MAX_P_VALUE_FURTHER_EFFECT if model.effects else MAX_P_VALUE_FIRST_EFFECT
    )
