"""Search for the effect that explains a recording with contacts.

The score of an effect at a contact is misleading: without it, the simulation slides where the robot
sticks, and a small change of a coefficient does not show what a large one does. The coefficient is
therefore estimated by maximum likelihood of the filter, which follows the data with a missing
force, or by scans of simulated runs. The initial states are estimated again with the fitted effect,
because the first estimate belongs to the model without it. Where a contact begins to slide, the sum
of squares has kinks at which Gauss-Newton steps end, so each fit begins with a scan.

If one of these fits leaves only noise, scores about it are valid. They show whether a further
effect acts, and which effects may replace it: to first order, the base model leaves the residual
e + c d with the residual e of the fit, the coefficient c and its response d, and a competing effect
explains this as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.kalman.cubature_filter import (
    Hypothesis,
    filter_hypotheses,
    set_first_states_in_contact,
)
from bench.diagnosis.search.candidate_directions import iterate_first_probes
from bench.diagnosis.search.effect_search import MAX_P_VALUE_FURTHER_EFFECT, EffectSearch
from bench.diagnosis.search.model_moves import MAX_REFITTED_CANDIDATES
from bench.diagnosis.search.score_test import SHAPE_COUNT_FOR_MULTISTART
from bench.diagnosis.search.start_selection import select_refit_starts
from sims.core.simulator import Array

MAX_COMPETITOR_SIZE = 2.0
"""Maximum residual of a competing effect to first order, relative to that of the model (RMS)."""
MAX_COMPETITORS = 4
"""Maximum number of competing effects that are fitted."""
DECREASES = (0.75, 0.5, 0.25)
"""Values that are tried, as shares of the largest possible decrease."""
INCREASES = (0.3, 0.7, 1.5)
"""Values that are tried, relative to the number of the model file."""
COMPARED_FORCE_SHARE = 0.1
"""Standard deviation of the missing force when values are compared, as a share of a typical force.

It is large enough for a model that lacks something to follow the data.
"""
REFINEMENT_WIDTHS = (0.25, 0.08)
"""Half of the intervals of the filter's refinements, relative to the number of the model file."""
GRID = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Values that are compared in a refinement, in half widths from the likeliest value."""
SCAN_WIDTHS = (1.5, 0.15, 0.03, 0.006, 0.001)
"""Half of the intervals of scans over a whole range, relative to the number of the model file."""
NEAR_SCAN_WIDTHS = (0.05, 0.01, 0.002, 0.0005)
"""Half of the intervals of scans near an estimate, relative to the number of the model file."""
SCANNED_VALUES = 21
"""Number of values of a scan."""
MAX_SCANNED_FITS = 4
"""Maximum number of fits that follow a scan."""
MAX_TRIED_EFFECTS = 3
"""Maximum number of effects at contacts that are fitted by simulation."""
MAX_MOVED_MODELS = 4
"""Maximum number of models of one effect that are fitted again from other initial states."""
MAX_SCAN_RATIO = 0.9
"""Maximum sum of squares in a scan of an effect that is fitted, relative to that without it."""
MAX_COST_RATIO = 0.5
"""Maximum sum of squares of an effect that is pursued, relative to that of the base model."""
MAX_EXPLAINED_EXCESS = 0.05
"""Maximum excess of a model whose initial states are not estimated again."""
MIN_COST_RATIO = 0.95
"""Ratio of the sums of squares of two fits above which no further fit is made."""


def propose_contact_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit single effects from initial states that belong to them, those at contacts first.

    Nothing is fitted if the base model leaves only noise, and no further effect if one explains the
    recording.

    Args:
        search: search with the fitted base model; it gets models with one effect.
        evaluators: its runs, followed by held-out runs, whose initial states are estimated again.

    Raises:
        SearchStoppedError: the search had to end; it has the models that were fitted so far.
    """
    if search.is_noise_like(search.base_model):
        return
    first_states = [(e.initial_state_guesses, e.state_prior) for e in evaluators]
    base = search.base_model
    likeliest = _find_likeliest_effect(search)
    if likeliest is not None:
        value = _refine_coefficient(search, likeliest)
        fits = [_fit_about_first_states_in_turn(search, evaluators, value)]
        if not _is_explained(search, fits[0][0]):
            others = [v for v in _rank_effects_at_contacts(search, base) if v.name != value.name]
            fits += [
                _fit_about_its_first_states(search, evaluators, v, SCAN_WIDTHS) for v in others
            ]
        model, value = min(fits, key=lambda pair: pair[0].fit.cost)
        if model.fit.cost < MAX_COST_RATIO * base.fit.cost:
            if not _is_explained(search, model):
                model, _ = _fit_about_first_states_in_turn(search, evaluators, value)
            search.fit_to_convergence(model)
            return
    for evaluator, (states, deviations) in zip(evaluators, first_states, strict=True):
        assert deviations is not None
        evaluator.begin_at(states, deviations)
    search.models.clear()
    search.add_fit(base.fit)
    _propose_single_effects(search, evaluators)


def _fit_about_its_first_states(
    search: EffectSearch,
    evaluators: Sequence[RunEvaluator],
    value: _ScannedValue,
    widths: Sequence[float] = NEAR_SCAN_WIDTHS,
) -> tuple[FittedModel, _ScannedValue]:
    """Estimate the initial states with an effect, and scan and fit its coefficient about them."""
    _move_to_first_states_of(search, evaluators, _add_effect(search, value))
    states = search.evaluator.initial_state_guesses
    value = _scan_in_turn(search, value, states, widths)
    model = search.fit_one(FitStart((value.name,), _add_effect(search, value), states))
    index = search.evaluator.coefficient_slices[value.name].start
    return model, value._replace(coefficient=float(model.fit.theta[index]))


def _fit_about_first_states_in_turn(
    search: EffectSearch, evaluators: Sequence[RunEvaluator], value: _ScannedValue
) -> tuple[FittedModel, _ScannedValue]:
    """Fit an effect and estimate the initial states in turn, while the sum of squares decreases."""
    limit = MAX_COST_RATIO * search.base_model.fit.cost
    for _ in range(MAX_SCANNED_FITS):
        model, value = _fit_about_its_first_states(search, evaluators, value)
        if _is_explained(search, model) or not model.fit.cost < limit:
            break
        limit = MIN_COST_RATIO * model.fit.cost
    return model, value


def _is_explained(search: EffectSearch, model: FittedModel) -> bool:
    """Return whether no better initial states are needed for a model."""
    return search.compute_excess_residual(model) < MAX_EXPLAINED_EXCESS


def _propose_single_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit the effects with the best scores, and estimate the initial states with the best of them.

    The first estimate belongs to the model without the effect. The best effects are fitted again
    until one of them explains the recording.
    """
    exclude_laws_with_many_shapes(search)
    base = search.base_model
    search.refit_extensions([base], MAX_REFITTED_CANDIDATES)
    for _ in range(MAX_SCANNED_FITS):
        fitted = sorted(
            (model for model in search.models.values() if model.effects),
            key=lambda model: model.fit.cost,
        )
        if not fitted or _is_explained(search, fitted[0]):
            return
        if not fitted[0].fit.cost < MAX_COST_RATIO * base.fit.cost:
            return
        cost = fitted[0].fit.cost
        _move_to_first_states_of(search, evaluators, fitted[0].fit.theta)
        states = search.evaluator.initial_state_guesses
        search.refit_models(
            [FitStart(m.effects, m.fit.theta, states) for m in fitted[:MAX_MOVED_MODELS]],
            is_racing=False,
        )
        if not min(m.fit.cost for m in search.models.values()) < MIN_COST_RATIO * cost:
            return


def _move_to_first_states_of(
    search: EffectSearch, evaluators: Sequence[RunEvaluator], theta: Array
) -> None:
    """Estimate the initial states with parameters (P,), and fit the base model again about them.

    Raises:
        SearchStoppedError: the search had to end; it keeps the models about the former states.
    """
    base, known = search.base_model, dict(search.models)
    set_first_states_in_contact(evaluators, theta, search.noise.sigma)
    # Sums of squares about other initial states are not comparable.
    search.models.clear()
    try:
        search.refit_models([FitStart((), base.fit.theta, search.evaluator.initial_state_guesses)])
    except SearchStoppedError:
        search.models.update(known)
        raise


class _ScannedValue(NamedTuple):
    """Coefficient of an effect at a contact.

    Attributes:
        name: the effect.
        coefficient: its coefficient.
        unit: the number of the model file, in the unit of the coefficient.
        squares: sum of squares of the scan, in units of the noise.
    """

    name: str
    coefficient: float
    unit: float
    squares: float


def _list_effects_at_contacts(search: EffectSearch) -> list[_ScannedValue]:
    """Return the effects at contacts, each with the coefficient zero."""
    evaluator = search.evaluator
    return [
        # A coefficient is limited below, where the number of the file becomes zero.
        _ScannedValue(name, 0.0, -compute_coefficient_bounds(evaluator, name)[0][0], np.inf)
        for name in evaluator.library
        if evaluator.available_effects[name].at == "contact"
    ]


def _find_likeliest_effect(search: EffectSearch) -> _ScannedValue | None:
    """Return the likeliest of some values of all effects at contacts; None if there are none."""
    values = []
    for start in _list_effects_at_contacts(search):
        values += [start._replace(coefficient=-share * start.unit) for share in DECREASES]
        values += [start._replace(coefficient=share * start.unit) for share in INCREASES]
    if not values:
        return None
    likelihoods = _compute_log_likelihoods(search, values)
    best = int(np.argmax(likelihoods))
    return values[best] if np.isfinite(likelihoods[best]) else None


def _refine_coefficient(search: EffectSearch, value: _ScannedValue) -> _ScannedValue:
    """Return the likeliest coefficient of an effect near a value."""
    for width in REFINEMENT_WIDTHS:
        values = _list_nearby_values(search, value, width * np.array(GRID))
        value = values[int(np.argmax(_compute_log_likelihoods(search, values)))]
    return value


def _rank_effects_at_contacts(search: EffectSearch, base: FittedModel) -> list[_ScannedValue]:
    """Scan each effect at a contact over its range, from the initial states of the base model.

    Returns:
        The best value of each effect that explains a part of the discrepancy, the best effect
        first.
    """
    found = _scan_effects_at_contacts(search, base.fit.initial_states)
    if not found:
        return []
    unchanged = _scan(search, found[0]._replace(coefficient=0.0), 0.0, base.fit.initial_states)
    useful = [value for value in found if value.squares < MAX_SCAN_RATIO * unchanged.squares]
    return sorted(useful, key=lambda value: value.squares)[:MAX_TRIED_EFFECTS]


def find_lowest_scan(search: EffectSearch) -> float:
    """Return the lowest sum of squares of scans of all effects at contacts; infinite without any.

    The initial states are those that were estimated with the present model.
    """
    found = _scan_effects_at_contacts(search, search.evaluator.initial_state_guesses)
    return min((value.squares for value in found), default=np.inf)


def _scan_effects_at_contacts(search: EffectSearch, states: Array) -> list[_ScannedValue]:
    """Return the best value of each effect at a contact over its range, from initial states."""
    values = _list_effects_at_contacts(search)
    return [_scan_in_turn(search, value, states, SCAN_WIDTHS) for value in values]


def _scan_in_turn(
    search: EffectSearch, value: _ScannedValue, states: Array, widths: Sequence[float]
) -> _ScannedValue:
    """Return the best value of scans with these widths, each about the best value of the last."""
    for width in widths:
        value = _scan(search, value, width, states)
    return value


def _list_nearby_values(
    search: EffectSearch, value: _ScannedValue, distances: Array
) -> list[_ScannedValue]:
    """Return possible values at distances relative to the number of the model file."""
    ((low, high),) = compute_coefficient_bounds(search.evaluator, value.name)
    coefficients = np.clip(value.coefficient + value.unit * distances, low, high)
    return [value._replace(coefficient=float(c)) for c in coefficients]


def _scan(search: EffectSearch, value: _ScannedValue, width: float, states: Array) -> _ScannedValue:
    """Return the value that has the lowest sum of squares.

    Args:
        search: search with the base model.
        value: centre of the scan.
        width: half of the interval, relative to the number of the model file.
        states: (R, s) initial states.
    """
    evaluator, runs = search.evaluator, len(states)
    evaluator.search_control.check_not_stopped()
    distances = width * np.linspace(-1.0, 1.0, SCANNED_VALUES)
    values = _list_nearby_values(search, value, distances)
    theta = np.array([_add_effect(search, value) for value in values])
    simulated = evaluator.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), len(theta)),
        np.tile(states, (len(theta), 1)),
    )
    residual = simulated.reshape(len(theta), *evaluator.observed.shape) - evaluator.observed
    scaled = np.where(search.observed_mask, residual, 0.0) / search.noise.sigma
    squares = np.square(scaled).sum(axis=(1, 2, 3))
    squares = np.where(np.isfinite(squares), squares, np.inf)
    best = int(np.argmin(squares))
    return values[best]._replace(squares=float(squares[best]))


def _compute_log_likelihoods(search: EffectSearch, values: Sequence[_ScannedValue]) -> Array:
    """Return the log-likelihood (N,) of each value, summed over the runs."""
    evaluator = search.evaluator
    evaluator.search_control.check_not_stopped()
    runs = range(len(evaluator.prepared_runs))
    hypotheses = [
        Hypothesis(run, theta, COMPARED_FORCE_SHARE)
        for theta in (_add_effect(search, value) for value in values)
        for run in runs
    ]
    results = filter_hypotheses(evaluator, search.noise.sigma, hypotheses)
    found = np.array([result.log_likelihood for result in results])
    total: Array = found.reshape(len(values), len(runs)).sum(axis=1)
    return total


def _add_effect(search: EffectSearch, value: _ScannedValue) -> Array:
    """Return the parameters (P,) of the base model with an effect."""
    theta = search.base_model.fit.theta.copy()
    theta[search.evaluator.coefficient_slices[value.name]] = value.coefficient
    return theta


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
