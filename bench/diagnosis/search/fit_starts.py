"""Starts of fits: with one more effect, with other effects, coefficients or initial states.

Effects with high scores are added to a fitted model (`select_refit_starts`). Least squares finds
only the nearest local minimum. End stops, frequencies and event times have many of them, so that
their fits start from several values. Other starts add, replace, swap or scale an effect of a model,
or have better initial states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import (
    compute_coefficient_bounds,
    list_coefficients,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.time_scaled_ranges import is_instant, is_period
from bench.diagnosis.fitting.base_fit import FIT_HORIZONS
from bench.diagnosis.fitting.fitted_models import EffectNames, FittedModel
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, KnownJacobian, TrajectoryFit
from bench.diagnosis.search.candidate_directions import (
    EVENT_TIME_COUNT,
    DirectionSet,
    generate_end_stops,
)
from bench.diagnosis.search.score_test import CandidateScores, DirectionGroup
from bench.diagnosis.validation.held_out_runs import MIN_SQUARES_DECREASE, HeldOutRuns
from sims.core.simulator import Array, Parameter

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
END_STOP_STIFFNESS_FACTORS = (0.3, 1.0, 3.0)
"""Stiffness factors of end stops that a fit starts from, relative to the best-scoring one."""
END_STOP_DEPTH_SHARES = tuple(np.geomspace(0.002, 0.4, 10).tolist())
"""Depths of end stops within the range of a coordinate, as shares of the range."""
REFIT_STIFFNESS_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Stiffness factors of alternative end stops with the same turning point as the fitted one."""
MAX_EVENT_TIME_SUBDIVISIONS = 16
"""Maximum number of times between two tried event times at which a fit starts."""
EVENT_TIME_SHIFTS_SAMPLES = (-8, -4, -2, -1, 1, 2, 4, 8)
"""Shifts of the time of a single event that are tried, in samples."""
FREQUENCY_SHIFTS_CYCLES = (-1.0, -0.5, 0.5, 1.0)
"""Shifts of a frequency or period that are tried, in cycles over the longest run."""
CONTACT_DEPTH_EXPONENT = -0.4
"""Exponent of the stiffness in the depth of contact of a motion with given energy."""


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
    2. Make starts with several values of the coefficients for each score peak of an effect: its
       best shape, such as a frequency, or another local maximum of the score.
    3. Simulate all starts, and keep the nearest to the data for each peak.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        model: fitted model to extend by one effect.
        direction_set: directions, which are the responses of the runs to the candidate effects.
        scores: scores of the candidates about this model.
        max_count: maximum number of candidates, unless `fits_all`.
        fits_all: True to return starts of all candidates, whatever their scores; for robots, of the
            best `MAX_REFITS_THOROUGH`, because their simulations are expensive.

    Returns:
        The starts, at most one for each score peak of each selected effect; none for a peak whose
        simulations all fail.
    """
    # 1. Ranked effects.
    ranked_candidates = _select_candidates(evaluator, scores, max_count, fits_all)
    # Each start has the number of its peak among those of its effect.
    numbered_starts = []
    for i in ranked_candidates:
        name = scores.effects[i]
        # 2. Starting values.
        # The score peaks of an effect are fitted separately, because each may lead to its own
        # minimum.
        for peak_number, (group, predicted_coefficients) in enumerate(scores.peaks[i]):
            known_jacobian = _predict_jacobian(evaluator, model, direction_set, group, name)
            for coefficients in _list_start_coefficients(
                evaluator, direction_set, group, predicted_coefficients, name
            ):
                start = replace(
                    add_effect_to_start(evaluator, model.fit.make_start(), name, coefficients),
                    known_jacobian=known_jacobian,
                )
                numbered_starts.append((peak_number, start))
    # 3. The nearest start of each peak.
    # Fits of all candidates begin with the first part of the runs, so starts are compared there.
    run_share = FIT_HORIZONS[0].share if fits_all else 1.0
    return _select_nearest_start(evaluator, noise, numbered_starts, run_share)


def _select_candidates(
    evaluator: RunEvaluator, scores: CandidateScores, max_count: int, fits_all: bool
) -> list[int]:
    """Return the indices of the effects to refit, the most promising first.

    The limits depend on how reliable scores are. For robots without contacts
    (`has_linearisation`), they use derivatives of the simulator, so that few candidates are better
    than their score. For other systems, they are less reliable.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        scores: scores of all candidates about one model.
        max_count: maximum number of candidates by their score, unless `fits_all`.
        fits_all: True to return all candidates, or for robots the best `MAX_REFITS_THOROUGH`.
    """
    if not evaluator.has_linearisation:
        min_relative_score = MIN_RELATIVE_SCORE
    elif fits_all:
        max_count, min_relative_score = MAX_REFITS_THOROUGH, 0.0
    else:
        min_relative_score = MIN_RELATIVE_SCORE_EXACT
    return _rank_candidates(
        scores,
        max_count,
        min_relative_score,
        # Scores that are less reliable then only order the fits.
        includes_all=fits_all and not evaluator.has_linearisation,
        simulated_candidates=_find_simulated_scores(evaluator, scores),
    )


def _find_simulated_scores(evaluator: RunEvaluator, scores: CandidateScores) -> frozenset[int]:
    """Return the indices of the candidates of a robot that are scored by full simulation.

    They are the series effects, whose response cannot be linearised; for other systems all scores
    are computed in the same way, and the result is empty.

    Args:
        evaluator: the runs, with all available effects.
        scores: scores of the candidates.
    """
    # True for robots without contacts.
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
    min_relative_score: float,
    includes_all: bool,
    simulated_candidates: frozenset[int],
) -> list[int]:
    """Return the indices of the effects to refit, the most promising first.

    Scores are compared after their null level is subtracted: what noise alone reaches (90 %
    quantile). Selected are:

    1. Effects with the best scores.
    2. Effects that reduce the sum of squares most, which are those with the best scores for white
       noise.
    3. Effects scored by full simulation that exceed all linear scores. They are added to the others
       and replace none: far from the data, their score may exceed the first-order score of the true
       effect.

    Args:
        scores: scores of all candidates.
        max_count: maximum number of candidates by their score.
        min_relative_score: minimum score above the null level, as a fraction of the best one.
        includes_all: whether to return all candidates, ordered by their scores; the other limits
            are then ignored.
        simulated_candidates: indices of the candidates scored by full simulation, which are
            selected separately.
    """
    score_excess = scores.score - scores.null_quantiles
    ranked: list[int] = np.argsort(-score_excess, kind="stable").tolist()
    if includes_all:
        return ranked
    # 1. Best scores.
    linear = [i for i in ranked if i not in simulated_candidates]
    # Without linear scores, every simulated score exceeds them.
    best_excess = score_excess[linear[0]] if linear else -np.inf
    selected = [i for i in linear if score_excess[i] >= min_relative_score * best_excess][
        :max_count
    ]
    # 2. Sum of squares.
    by_squares = [
        int(i)
        for i in np.argsort(-scores.white_noise_scores, kind="stable")
        if i not in simulated_candidates
    ]
    selected += [i for i in by_squares[:MAX_REFITS_BY_SQUARES] if i not in selected]
    # 3. Full simulations.
    by_simulation = [
        i for i in ranked if i in simulated_candidates and score_excess[i] >= best_excess
    ]
    return selected + by_simulation[:MAX_REFITS_BY_SIMULATION]


def _predict_jacobian(
    evaluator: RunEvaluator,
    model: FittedModel,
    direction_set: DirectionSet,
    group: DirectionGroup,
    name: str,
) -> KnownJacobian | None:
    """Return the approximate Jacobian of a robot's model with one more effect, without simulations.

    A fit can start with it. It consists of the Jacobian of the model, without the columns of
    simpler effects that the new one replaces, and the directions of the effect (changes of the runs
    per unit of a coefficient).

    Args:
        evaluator: evaluator that simulates the recorded runs.
        model: fitted model without the effect.
        direction_set: directions of all candidates about this model.
        group: the columns of `direction_set` that belong to the effect at one choice of its shape.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

    Returns:
        The Jacobian; None if it cannot be composed: for systems that are not robots, if the
        directions are no derivatives but changes by one full size, and for effects with a shape
        coefficient, such as a frequency, which has no direction.
    """
    # True for robots without contacts.
    if not evaluator.has_linearisation:
        return None
    # The column of the directions for each scaling coefficient (index within the effect).
    column_by_coefficient = {
        direction_set.candidates[column].coefficient_index: column
        for column in group.column_indices
        if not direction_set.candidates[column].is_single_size
    }
    coefficient_indices = evaluator.get_coefficient_indices(name)
    # Only the range of a shape coefficient does not contain zero; its lower bound is positive.
    has_shape = any(evaluator.parameters[index].bounds[0] > 0 for index in coefficient_indices)
    if not column_by_coefficient or has_shape:
        return None
    # Derivatives (R, T, C, k) by the k coefficients of the effect.
    jacobian = np.zeros((*direction_set.responses.shape[:3], len(coefficient_indices)))
    for coefficient_index, column in column_by_coefficient.items():
        jacobian[..., coefficient_index] = direction_set.responses[..., column]
    replaced_indices = {
        index
        for simpler_effect in evaluator.available_effects[name].contains
        if simpler_effect in model.effects
        for index in evaluator.get_coefficient_indices(simpler_effect)
    }
    return (
        model.fit.get_known_jacobian()
        .drop_parameters(replaced_indices)
        .add_parameters(coefficient_indices, jacobian)
    )


def _list_start_coefficients(
    evaluator: RunEvaluator,
    direction_set: DirectionSet,
    group: DirectionGroup,
    estimate: Array,
    name: str,
) -> Iterator[Array]:
    """Yield coefficients of an effect from which its fit may reach different local minima.

    A direction is the response of the runs to a candidate effect.

    1. A direction that is valid at one size gives this size, and neighbouring ones for an end stop.
    2. Otherwise the linear estimate and a fraction of it, each also with other event times.
    3. For a single coefficient, also fractions of its plausible range.

    Args:
        evaluator: evaluator, which has the bounds of the coefficients.
        direction_set: directions of all candidates about the model.
        group: the columns of `direction_set` that belong to the effect at one choice of its shape.
        estimate: (m,) linear estimate of the coefficient of each of the m directions of the group.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    bounds = compute_coefficient_bounds(evaluator, name)
    # All directions of the group have the same shape, so that the first one stands for them.
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
    # Shares of the upper end of the plausible range, of either sign if the sign is free.
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

    Simulating a start costs much less than fitting it. A score peak is a model with one more effect
    at one shape of the effect, such as one frequency. The nearest start has the smallest sum of
    squared residuals in units of the noise.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        numbered_starts: starts, each with the number of its score peak among those of its effect.
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
    # One element (R, T, C) for each start.
    predictions = predictions.reshape(start_count, run_count, *predictions.shape[1:])
    sample_mask = evaluator.get_sample_mask(run_share)
    lowest_costs: dict[tuple[int, EffectNames], float] = {}
    nearest_starts: dict[tuple[int, EffectNames], FitStart] = {}
    for (peak_number, start), simulated in zip(numbered_starts, predictions, strict=True):
        residual = evaluator.observed - simulated
        normalised_residual = np.where(sample_mask, residual, 0.0) / noise.sigma
        cost = float(np.square(normalised_residual).sum())
        peak = peak_number, start.effects
        # A failed simulation has the cost NaN, which is never the lowest.
        if cost < lowest_costs.get(peak, np.inf):
            lowest_costs[peak] = cost
            nearest_starts[peak] = start
    return list(nearest_starts.values())


def generate_neighbouring_end_stops(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> Iterator[Array]:
    """Yield end stops (k,) on the same side as a given one; nothing for other effects.

    They are starts of a fit near an end stop with a good score. All depths are tried, because the
    stiffness determines the depth of contact.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        coefficients: (k,) coefficients of the given end stop: the stiffness, positive for the upper
            and negative for the lower end of the range, then its position.
    """
    if evaluator.available_effects[name].coefficients[0].of == "stop":
        stiffness = coefficients[0]
        # Stiffness as a fraction of the largest plausible one.
        bound_share = abs(stiffness) / list_coefficients(evaluator, name)[0].bounds[1]
        # Simulating a robot costs a hundred times as much, so fewer stops are tried.
        stiffness_factors, depth_shares = (
            ((1.0,), END_STOP_DEPTH_SHARES[::2])
            if evaluator.has_linearisation
            else (END_STOP_STIFFNESS_FACTORS, END_STOP_DEPTH_SHARES)
        )
        yield from generate_end_stops(
            evaluator,
            name,
            side=np.sign(stiffness),
            stiffness_shares=[bound_share * factor for factor in stiffness_factors],
            depth_shares=depth_shares,
        )


def generate_equal_travel_end_stops(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> Iterator[Array]:
    """Yield coefficients (k,) of softer and harder end stops with the turning point of a given one.

    They are starts for a fit, since stiffness and position of a stop are nearly interchangeable.
    The depth of contact for a motion of equal energy is proportional to K^(-2/5), with the
    stiffness K, by eq. (2) of `sims.effects.state_limits`. Nothing is generated for other effects.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        coefficients: (k,) coefficients of the given end stop: the stiffness, positive for the upper
            and negative for the lower end of the range, then its position.
    """
    # The effect is no end stop, or its stiffness is zero, so that it is off.
    if evaluator.available_effects[name].coefficients[0].of != "stop" or not coefficients[0]:
        return
    stiffness, position = coefficients[:2]
    low, high = evaluator.get_coordinate_range(name)
    # The motion turns at the end of the recorded range.
    turning_point = high if stiffness > 0 else low
    for factor in REFIT_STIFFNESS_FACTORS:
        end_stop = coefficients.copy()
        end_stop[0] = factor * stiffness
        # The depth of contact changes with the stiffness.
        end_stop[1] = turning_point - (turning_point - position) * factor**CONTACT_DEPTH_EXPONENT
        yield end_stop


def generate_event_times(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> Iterator[Array]:
    """Yield coefficients (k,) with other event times near a given one, between the time stamps.

    A fit cannot move an event time over a sample, because the cost has a step there. The times
    cover the interval to the next event times that scores have tried. Nothing is generated for
    effects without an event time.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        coefficients: (k,) given coefficients, one of which may be an event time in s.
    """
    for i, parameter in enumerate(list_coefficients(evaluator, name)):
        if not is_instant(parameter):
            continue
        clock_start, clock_end = evaluator.time_span
        stamps = np.unique(
            np.concatenate([run_data.scenario.times for run_data in evaluator.prepared_runs])
        )
        # Between two samples, the exact time does not matter.
        midpoints = (stamps[1:] + stamps[:-1]) / 2.0
        # Distance of the event times that scores try.
        grid_spacing = (clock_end - clock_start) / (EVENT_TIME_COUNT + 1)
        near_midpoints = midpoints[np.abs(midpoints - coefficients[i]) <= grid_spacing]
        # At most MAX_EVENT_TIME_SUBDIVISIONS of them, equally spaced: the quotient is rounded up,
        # and is 1 if there are none.
        stride = -(-near_midpoints.size // MAX_EVENT_TIME_SUBDIVISIONS) or 1
        for instant in near_midpoints[::stride].tolist():
            moved_coefficients = coefficients.copy()
            moved_coefficients[i] = instant
            yield moved_coefficients


def generate_shifted_starts(evaluator: RunEvaluator, fit: TrajectoryFit) -> Iterator[FitStart]:
    """Yield starts with shifted frequencies, periods, event times and end stops.

    Least squares stops at the nearest of the many local minima that such effects have, so fits
    start from several of them.

    Args:
        evaluator: evaluator with the recorded runs.
        fit: fit whose effects are shifted.
    """
    for name in fit.effects:
        for coefficients in generate_equal_travel_end_stops(
            evaluator, name, fit.theta[evaluator.coefficient_slices[name]]
        ):
            theta = fit.theta.copy()
            theta[evaluator.coefficient_slices[name]] = coefficients
            yield FitStart(fit.effects, theta, fit.initial_states)
        bounds = compute_coefficient_bounds(evaluator, name)
        for i, index in enumerate(evaluator.get_coefficient_indices(name)):
            parameter = evaluator.parameters[index]
            fitted_value = float(fit.theta[index])
            for shifted_value in _shift_frequency_or_time(
                evaluator, parameter, fitted_value, evaluator.get_effect_travel(name)
            ):
                theta = fit.theta.copy()
                theta[index] = np.clip(shifted_value, *bounds[i])
                yield FitStart(fit.effects, theta, fit.initial_states)


def _shift_frequency_or_time(
    evaluator: RunEvaluator, parameter: Parameter, value: float, travel: float
) -> Iterator[float]:
    """Yield shifted values of a frequency, a period or an event time.

    The shifts are about the distance of neighbouring local minima: event times are shifted by
    samples, frequencies by fractions of a cycle over the longest run, and periods, which are
    lengths of travel of a joint, by fractions of a cycle over its largest travel.

    Args:
        evaluator: evaluator, whose longest run determines how far a frequency is shifted.
        parameter: coefficient, with its unit and plausible range.
        value: value to shift, in the unit of the coefficient.
        travel: largest range of the position within one run, in m or rad, for periods over
            position.
    """
    if is_instant(parameter):
        for samples in EVENT_TIME_SHIFTS_SAMPLES:
            yield value + samples * evaluator.sample_interval
        return
    for cycles in FREQUENCY_SHIFTS_CYCLES:
        if parameter.unit == "Hz":
            yield value + cycles / evaluator.longest_duration
        elif is_period(parameter, travel) and value > 0:
            frequency = 1.0 / value + cycles / travel
            # Beyond the longest period, the frequency might become negative.
            lowest_frequency = 1.0 / parameter.bounds[1]
            yield 1.0 / max(frequency, lowest_frequency)


def add_effect_to_start(
    evaluator: RunEvaluator, start: FitStart, name: str, coefficients: Array
) -> FitStart:
    """Add an effect to the start of a fit, in place of the simpler effects that it contains.

    Both together would have no unique solution: Stribeck friction, for example, contains Coulomb
    friction. What the simpler effects did is added to the coefficients of the new one, and their
    own coefficients become zero.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        start: start of a fit of the model without the effect.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        coefficients: (k,) coefficients of the effect.

    Returns:
        Start of a fit, with the effect last.
    """
    effect = evaluator.available_effects[name]
    theta = start.theta.copy()
    for simpler_effect in sorted(set(effect.contains) & set(start.effects)):
        simpler_slice = evaluator.coefficient_slices[simpler_effect]
        # Coefficients with which the effect also does what the simpler one did.
        coefficients = effect.taking(coefficients, simpler_effect, theta[simpler_slice])
        theta[simpler_slice] = 0.0
    theta[evaluator.coefficient_slices[name]] = coefficients
    remaining_effects = [n for n in start.effects if n not in effect.contains]
    return FitStart((*remaining_effects, name), theta, start.initial_states)


def make_replacing_start(
    evaluator: RunEvaluator,
    model: FittedModel,
    removed_effects: Sequence[str],
    new_effect: str,
    coefficients: Array,
) -> FitStart:
    """Return a start of a fit in which one effect replaces several others of a model.

    All other parameters and the first states are those of the model.

    Args:
        evaluator: the runs.
        model: the fitted model.
        removed_effects: effects that are removed.
        new_effect: the effect that replaces them.
        coefficients: (k,) coefficients of the new effect.
    """
    theta = model.fit.theta.copy()
    for name in removed_effects:
        theta[evaluator.coefficient_slices[name]] = 0.0
    theta[evaluator.coefficient_slices[new_effect]] = coefficients
    remaining = (name for name in model.effects if name not in removed_effects)
    return FitStart((*remaining, new_effect), theta, model.fit.initial_states)


def make_swapped_start(
    evaluator: RunEvaluator, model: FittedModel, other_model: FittedModel
) -> FitStart:
    """Return a start for a competing model, with all shared effects at the values of the model.

    The models differ in one effect, whose coefficients are those of the competing model. A law with
    several coefficients converges to slightly different values each time, which would make
    equivalent models look different.

    Args:
        evaluator: the runs, with the position of each effect in the parameters theta.
        model: fitted model, whose base parameters, shared effects and initial states are used.
        other_model: fitted competing model, in which one effect of `model` is replaced.
    """
    (added_effect,) = set(other_model.effects) - set(model.effects)
    (removed_effect,) = set(model.effects) - set(other_model.effects)
    added = evaluator.coefficient_slices[added_effect]
    theta = model.fit.theta.copy()
    # Zero coefficients switch an effect off.
    theta[evaluator.coefficient_slices[removed_effect]] = 0.0
    theta[added] = other_model.fit.theta[added]
    return FitStart(other_model.effects, theta, model.fit.initial_states)


def scale_effect(evaluator: RunEvaluator, start: FitStart, name: str, factor: float) -> FitStart:
    """Return a start with the one coefficient of an effect scaled, within its bounds.

    Args:
        evaluator: the runs, with the bounds of the coefficient.
        start: the start; it is not changed.
        name: name of the effect.
        factor: factor of its coefficient.
    """
    theta = start.theta.copy()
    (index,) = evaluator.get_coefficient_indices(name)
    ((low, high),) = compute_coefficient_bounds(evaluator, name)
    theta[index] = np.clip(factor * theta[index], low, high)
    return replace(start, theta=theta)


def find_first_states(
    evaluator: RunEvaluator, noise: NoiseModel, fit: TrajectoryFit
) -> FitStart | None:
    """Return a start with better initial states of the fitted runs; None without better ones.

    A fit may have stopped in a local minimum of the initial states. So these are fitted again with
    the parameters of the fit, to ever longer parts of the runs, like those of held-out runs. They
    must reduce the sum of squares by at least `MIN_SQUARES_DECREASE`. A robot on the ground keeps
    its initial states, those with settled contacts.

    Args:
        evaluator: the fitted runs.
        noise: noise that weights the channels.
        fit: fit of these runs.
    """
    filtered_runs = evaluator.filtered_runs
    if filtered_runs is not None and filtered_runs.is_on_ground:
        return None
    # The fit may replace these derivatives, which other fits of the runs use.
    derivatives_before = evaluator.state_derivatives
    runs = HeldOutRuns(evaluator, noise)
    (prediction,) = runs.fit_initial_states([fit.theta], is_staged=True)
    evaluator.state_derivatives = derivatives_before
    squares = np.square((evaluator.observed - prediction.simulated) / noise.sigma)
    # The comparison is negated because a failed prediction is NaN.
    if not squares[runs.seen].sum() < fit.cost - MIN_SQUARES_DECREASE:
        return None
    return replace(fit.make_start(), initial_states=prediction.states)
