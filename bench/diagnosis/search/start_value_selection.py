"""Select the starts of fits with one more effect, among high-scoring effects and initial values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import FIT_HORIZONS
from bench.diagnosis.fitting.fitted_models import EffectNames, FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart, KnownJacobian
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.coefficient_start_values import (
    generate_event_times,
    generate_neighbouring_end_stops,
)
from bench.diagnosis.search.score_test import CandidateScores, DirectionGroup
from sims.core.simulator import Array

MAX_REFITS_BY_SQUARES = 3
"""Number of best candidates by sum of squares that are refitted in addition.

Far from the data, AR(1) noise explains almost any residual, so likelihood scores are misleading.
"""
MAX_REFITS_BY_SIMULATION = 2
"""Maximum number of candidates scored by full simulation that are refitted.

They are refitted if they outscore the best linearised candidate.
"""
MIN_RELATIVE_SCORE = 0.25
"""Minimum score of a candidate to be refitted, as a share of the best score."""
MIN_RELATIVE_SCORE_EXACT = 0.6
"""Minimum score of a candidate to be refitted if scores are exact to first order.

It is a share of the best score.
"""
MAX_REFITS_THOROUGH = 20
"""Maximum number of candidates that are refitted in patient fits of robots."""
SIZE_SHARES = (1.0, 0.25)
"""Shares of the size predicted by a score at which fits start.

Scores are linear, so a smaller size is tried, too.
"""
RANGE_SHARES = (0.2, 0.7, 1.5)
"""Shares of the plausible range at which fits of a single coefficient start in addition."""


def select_refit_starts(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    model: FittedModel,
    direction_set: DirectionSet,
    scores: CandidateScores,
    max_count: int,
    fits_all: bool,
) -> list[FitStart]:
    """Return starts of fits with one more effect, for the effects with the best scores.

    1. Rank the effects by their scores.
    2. Make starts with several values of the coefficients for each peak of an effect's score: a
       peak is the best shape, such as a frequency, or another local maximum.
    3. Simulate all starts, and keep the nearest to the data for each peak.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        model: fitted model to extend by one effect.
        direction_set: sensitivity directions of the candidates.
        scores: scores of the candidates about this model.
        max_count: maximum number of candidates.
        fits_all: whether to include all candidates, or for robots up to `MAX_REFITS_THOROUGH`.
    """
    numbered_starts = []
    # If scores use derivatives of the simulator, few candidates are better than their score.
    min_relative_score = (
        MIN_RELATIVE_SCORE_EXACT if evaluator.has_linearisation else MIN_RELATIVE_SCORE
    )
    if fits_all and evaluator.has_linearisation:
        max_count, min_relative_score = MAX_REFITS_THOROUGH, 0.0
    # If scores are less reliable, they only order the fits, and exclude no candidate.
    is_all_wanted = fits_all and not evaluator.has_linearisation
    # 1. Ranked effects.
    for i in _rank_candidates(
        scores,
        max_count,
        min_relative_score,
        is_all_wanted,
        _find_simulated_scores(evaluator, scores),
    ):
        name = scores.effects[i]
        # 2. Starting values.
        # The score peaks of an effect are fitted separately, because each may lead to its own
        # minimum.
        for peak_number, (group, predicted_coefficients) in enumerate(scores.peaks[i]):
            known_jacobian = _predict_jacobian(evaluator, model, direction_set, group, name)
            for c in _list_start_sizes(
                evaluator, direction_set, group, predicted_coefficients, name
            ):
                start = replace(
                    add_effect_to_start(evaluator, model.fit.make_start(), name, c),
                    known_jacobian=known_jacobian,
                )
                numbered_starts.append((peak_number, start))
    # 3. The nearest start of each peak.
    # Fits of all candidates begin with the first part of the runs, so starts are compared there.
    run_share = FIT_HORIZONS[0].share if fits_all else 1.0
    return _select_nearest_start(evaluator, noise, numbered_starts, run_share)


def _find_simulated_scores(evaluator: RunEvaluator, scores: CandidateScores) -> frozenset[int]:
    """Return the indices of the candidates of a robot that are scored by full simulation.

    They are the series effects, whose response cannot be linearised; for other systems all scores
    are computed in the same way, and the result is empty.

    Args:
        evaluator: the runs, with all available effects.
        scores: scores of the candidates.
    """
    if not evaluator.has_linearisation:
        return frozenset()
    # Imported here, because only robots need it.
    from sims.robot.dynamics.series_joints import is_series_effect

    return frozenset(
        i
        for i, name in enumerate(scores.effects)
        if is_series_effect(evaluator.available_effects[name])
    )


def _rank_candidates(
    scores: CandidateScores,
    max_count: int,
    share: float,
    is_all_wanted: bool,
    simulated: frozenset[int],
) -> list[int]:
    """Return the indices of the effects to refit, the most promising first.

    1. Effects with the best scores above their null-hypothesis level.
    2. Effects with the best scores for white noise, if they are not among these.
    3. Effects scored by full simulation that exceed all linear scores. They are added to the others
       and replace none: far from the data, their score may exceed the first-order score of the true
       effect.

    Args:
        scores: scores of all candidates.
        max_count: maximum number of candidates by their score.
        share: minimum score above the null level, as a fraction of the best one.
        is_all_wanted: whether to return all candidates.
        simulated: candidates scored by full simulation, which are selected separately.
    """
    score_excess = scores.score - scores.null_quantiles
    ranked: list[int] = np.argsort(-score_excess, kind="stable").tolist()
    if is_all_wanted:
        return ranked
    # 1. Best scores.
    order = [i for i in ranked if i not in simulated]
    selected = [i for i in order if score_excess[i] >= share * score_excess[order[0]]][:max_count]
    # 2. White noise.
    by_squares = [
        int(i) for i in np.argsort(-scores.white_noise_scores, kind="stable") if i not in simulated
    ]
    selected_by_squares = by_squares[:MAX_REFITS_BY_SQUARES]
    # 3. Full simulations.
    best_excess = score_excess[order[0]] if order else -np.inf
    selected_by_simulation = [
        i for i in ranked if i in simulated and score_excess[i] >= best_excess
    ][:MAX_REFITS_BY_SIMULATION]
    selected += [i for i in selected_by_squares if i not in selected]
    return selected + selected_by_simulation


def add_effect_to_start(evaluator: RunEvaluator, start: FitStart, name: str, c: Array) -> FitStart:
    """Add an effect to a model, in place of the effects that it contains.

    The start of the new effect takes over the coefficients of those: an effect and one that it
    contains together would have no unique solution.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        start: the model.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        c: (k,) coefficients of the effect.

    Returns:
        Start of a fit, with the effect last.
    """
    effect = evaluator.available_effects[name]
    contained, theta = effect.contains, start.theta.copy()
    for contained_effect in sorted(set(contained) & set(start.effects)):
        part_slice = evaluator.coefficient_slices[contained_effect]
        c = effect.taking(c, contained_effect, theta[part_slice])
        theta[part_slice] = 0.0
    theta[evaluator.coefficient_slices[name]] = c
    remaining_effects = [n for n in start.effects if n not in contained]
    return FitStart((*remaining_effects, name), theta, start.initial_states)


def _predict_jacobian(
    evaluator: RunEvaluator,
    model: FittedModel,
    direction_set: DirectionSet,
    group: DirectionGroup,
    name: str,
) -> KnownJacobian | None:
    """Return the approximate Jacobian of a model with one more effect, from known derivatives.

    A fit that starts with it needs no simulations for its first Jacobian. It consists of the
    Jacobian of the model and the directions of the effect. Columns of simpler effects that the new
    one contains are dropped, since it replaces them. Return None if the directions do not contain
    all coefficients: none for shape coefficients, such as frequencies, whose range does not contain
    zero.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        model: fitted model without the effect.
        direction_set: directions of all candidates about this model.
        group: directions of the effect at one grid point.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    if not evaluator.has_linearisation:
        return None
    columns = {
        direction_set.candidates[i].coefficient_index: i
        for i in group.column_indices
        if not direction_set.candidates[i].is_single_size
    }
    coefficient_indices = evaluator.get_coefficient_indices(name)
    shape_indices = [
        i
        for i in range(len(coefficient_indices))
        if evaluator.parameters[coefficient_indices[i]].bounds[0] > 0
    ]
    if not columns or shape_indices:
        return None
    jacobian = np.zeros((*direction_set.responses.shape[:3], len(coefficient_indices)))
    for index, column in columns.items():
        jacobian[..., index] = direction_set.responses[..., column]
    contained = [
        evaluator.get_coefficient_indices(n)
        for n in evaluator.available_effects[name].contains
        if n in model.effects
    ]
    replaced_indices = {index for span in contained for index in span}
    return (
        model.fit.get_known_jacobian()
        .drop_parameters(replaced_indices)
        .add_parameters(coefficient_indices, jacobian)
    )


def _list_start_sizes(
    evaluator: RunEvaluator,
    direction_set: DirectionSet,
    group: DirectionGroup,
    estimate: Array,
    name: str,
) -> Iterator[Array]:
    """Yield coefficients of an effect from which its fit may reach different local minima.

    1. A direction that is valid at one size gives this size, and neighbouring ones for an end stop.
    2. Otherwise the linear estimate and fractions of it.
    3. For a single coefficient, also fractions of its plausible range.

    Args:
        evaluator: evaluator, which has the bounds of the coefficients.
        direction_set: directions of all candidates about the model.
        group: directions of the effect at one grid point.
        estimate: linear estimate of the coefficient of each direction of the group.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    bounds = compute_coefficient_bounds(evaluator, name)
    first_probe = direction_set.candidates[group.column_indices[0]]
    # 1. One size.
    # A direction for one full size says nothing about other sizes.
    if first_probe.is_single_size:
        yield first_probe.coefficients
        yield from generate_neighbouring_end_stops(evaluator, name, first_probe.coefficients)
        return
    # 2. Linear estimate.
    for share in SIZE_SHARES:
        coefficients = first_probe.coefficients.copy()
        for column, size in zip(group.column_indices, estimate, strict=True):
            index = direction_set.candidates[column].coefficient_index
            coefficients[index] = share * float(np.clip(size, *bounds[index]))
        yield coefficients
        yield from generate_event_times(evaluator, name, coefficients)
    # 3. Plausible range.
    # With several coefficients, the ranges do not show how the coefficients are related.
    if len(group.column_indices) > 1:
        return
    index = evaluator.coefficient_slices[name].start + first_probe.coefficient_index
    _, upper_bound = evaluator.parameters[index].bounds
    shares = list(RANGE_SHARES)
    if first_probe.can_be_negative:
        shares += [-share for share in RANGE_SHARES]
    for share in shares:
        coefficients = first_probe.coefficients.copy()
        coefficients[first_probe.coefficient_index] = share * upper_bound
        yield coefficients


def _select_nearest_start(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    numbered_starts: Sequence[tuple[int, FitStart]],
    run_share: float,
) -> list[FitStart]:
    """Simulate all starts, and return the nearest to the data for each score peak.

    Simulating a start costs much less than fitting it.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        numbered_starts: starts with the number of their score peak.
        run_share: fraction of each run, from its beginning, on which the cost is computed.
    """
    if not numbered_starts:
        return []
    starts = [start for _, start in numbered_starts]
    run_count = len(evaluator.prepared_runs)
    start_count = len(starts)
    theta = np.repeat([s.theta for s in starts], run_count, axis=0)
    states = np.concatenate([s.initial_states for s in starts])
    run_indices = np.tile(np.arange(run_count), start_count)
    # All starts are simulated in one engine call, as one batch.
    predictions = evaluator.simulate(theta, run_indices, states, run_share)
    predictions = predictions.reshape(start_count, run_count, *predictions.shape[1:])
    sample_mask = evaluator.get_sample_mask(run_share)
    best: dict[tuple[int, EffectNames], tuple[float, FitStart]] = {}
    for (number, start), simulated in zip(numbered_starts, predictions, strict=True):
        residual = evaluator.observed - simulated
        normalised_residual = np.where(sample_mask, residual, 0.0) / noise.sigma
        cost = float(np.square(normalised_residual).sum())
        key = (number, start.effects)
        lowest_cost = best[key][0] if key in best else np.inf
        # A failed simulation has the cost NaN, which is never the lowest.
        if cost < lowest_cost:
            best[key] = cost, start
    return [start for _, start in best.values()]
