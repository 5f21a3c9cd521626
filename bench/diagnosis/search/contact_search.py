"""Search for the effect that explains a recording with contacts.

The score of an effect at a contact is misleading: without it, the simulation slides where the robot
sticks, and a small change of a coefficient does not show what a large one does. The coefficient is
therefore estimated by maximum likelihood of the filter, which follows the data with a missing
force, or by scans of simulated runs. The initial states are estimated again with the fitted effect,
because the first estimate belongs to the model without it. Where a contact begins to slide, the sum
of squares has steps at which Gauss-Newton steps end, so each fit begins with a scan and a random
search of coefficients and initial states (`random_search`).

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

from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.kalman.cubature_filter import (
    FIRST_STATE_MARGIN,
    FilterHypothesis,
    compute_first_deviations,
    filter_hypotheses,
    set_first_states_in_contact,
    smooth_first_states,
)
from bench.diagnosis.search.candidate_directions import DirectionSet, iterate_first_probes
from bench.diagnosis.search.effect_search import (
    MAX_P_VALUE_FURTHER_EFFECT,
    MAX_REFITTED_CANDIDATES,
    EffectSearch,
)
from bench.diagnosis.search.fit_starts import select_refit_starts
from bench.diagnosis.search.random_search import EXPLAINED_SQUARES, RandomStartSearch
from bench.diagnosis.search.score_test import (
    SHAPE_COUNT_FOR_MULTISTART,
    CandidateScores,
    ScoreTest,
)
from sims.core.effect import members_of
from sims.core.simulator import Array

MAX_COMPETITOR_SIZE = 1.3
"""Maximum residual of a competing effect to first order, relative to that of the model (RMS)."""
DIFFERENCE_SHARES = (1e-2, 1e-3, 1e-4, 1e-5)
"""Relative changes of the coefficients in difference quotients."""
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
MAX_STATE_ESTIMATES = 4
"""Maximum number of estimates of the initial states with an effect."""
SAMPLED_WIDTH = 0.04
"""Standard deviation of coefficients in a random search, relative to the number of the model file.

For effects without such a number, it is relative to the coefficient.
"""
MAX_TRIED_EFFECTS = 3
"""Maximum number of effects that are fitted with initial states of their own."""
MAX_SCAN_RATIO = 0.9
"""Maximum sum of squares in a scan of an effect that is fitted, relative to that without it."""
MAX_COST_RATIO = 0.5
"""Maximum sum of squares of an effect that is pursued, relative to that of the base model."""
MAX_REPEATED_COST_RATIO = 0.25
"""Maximum sum of squares at which initial states are estimated again, relative to the base model.
"""
MAX_EXCESS_OF_WRONG_STATES = 2.0
"""Maximum excess of the base model at which its initial states may be all that is wrong."""
MAX_EXPLAINED_EXCESS = 0.05
"""Maximum excess of a model whose initial states are not estimated again."""
MIN_COST_RATIO = 0.7
"""Ratio of the sums of squares of two fits above which no further fit is made."""


def propose_contact_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit single effects in a recording with contacts, each with its own initial states.

    The effects and initial states that it finds are where the search of all effects starts. It does
    nothing if the base model leaves only noise, and it stops at the first effect that explains the
    recording.

    1. Search better initial states of the base model.
    2. Fit single effects, the likeliest effect at a contact first.
    3. Use the initial states of the best model for all runs, also held-out ones.

    Args:
        search: search with the fitted base model; it gets models with one effect.
        evaluators: its runs, followed by held-out runs, whose initial states are estimated again.

    Raises:
        SearchStoppedError: the search had to end; it has the models that were fitted so far.
    """
    base = search.base_model
    if search.is_noise_like(base):
        return
    # 1. Initial states of the base model.
    _search_states_of_base(search)
    base = search.base_model
    if search.is_noise_like(base):
        return
    try:
        # 2. Single effects.
        best = _fit_single_effects(search)
        if best is not None:
            # 3. Initial states of all runs.
            _use_first_states_of(search, evaluators, best)
    except SearchStoppedError:
        # Fits about other initial states begin without any model, but a search needs its base
        # model.
        search.models.setdefault(frozenset(), base)
        raise


def _search_states_of_base(search: EffectSearch) -> None:
    """Search initial states at random with the base model, and keep them if it fits better.

    Smoothed initial states can be wrong where contacts make the motion rough. Then the base model
    may be complete although it does not explain the recording. If its residual is far above the
    noise, it lacks an effect, and nothing is searched.
    """
    base = search.base_model
    # The excess is the RMS residual in units of the noise, minus one.
    if not search.compute_excess_residual(base) < MAX_EXCESS_OF_WRONG_STATES:
        return
    evaluator = search.evaluator
    # The initial states, and the standard deviations of their errors.
    states_before, deviations_before = evaluator.initial_state_guesses, evaluator.state_prior
    # With contacts, initial states have been smoothed, which gives their standard deviations.
    assert deviations_before is not None
    # It replaces the initial states of the evaluator if it finds better ones.
    _search_first_states(search, evaluator, base.fit.theta)
    states = evaluator.initial_state_guesses
    # The array was not replaced: there are no better initial states.
    if states is states_before:
        return
    # Sums of squares about other initial states are not comparable.
    search.models.clear()
    model = search.fit_one(FitStart((), base.fit.theta, states))
    # Restore the former initial states, because the fit about the new ones is not better.
    if not model.penalised_log_likelihood > base.penalised_log_likelihood:
        evaluator.begin_at(states_before, deviations_before)
        search.models[frozenset()] = base


def _fit_single_effects(search: EffectSearch) -> FittedModel | None:
    """Fit models with one effect until one explains the recording.

    1. Fit the effect at a contact that a filter finds likeliest.
    2. If it does not explain the recording, fit the best of all effects, one after another.
    3. Return the best fit if it removes a large part of the discrepancy.

    Returns:
        The best model; None if none removes a large part of the discrepancy. Then the initial
        states are those of the base model, and the search has the fits about them.
    """
    base, evaluator = search.base_model, search.evaluator
    states, deviations = evaluator.initial_state_guesses, evaluator.state_prior
    # With contacts, initial states have been smoothed, which gives their standard deviations.
    assert deviations is not None
    fits: list[FittedModel] = []
    # 1. The likeliest effect at a contact.
    likeliest = _find_likeliest_effect(search)
    if likeliest is not None:
        value = _refine_coefficient(search, likeliest)
        fits.append(_fit_about_its_first_states(search, _make_start(search, value, states)))
    # 2. Other effects, from the initial states of the base model.
    # The fit of step 1 has replaced these states, which are restored. Its model is removed from the
    # search, because costs of fits about different initial states are not comparable.
    if not any(_is_explained(search, model) for model in fits):
        evaluator.begin_at(states, deviations)
        search.models.clear()
        search.add_fit(base.fit)
        for start in _list_single_effect_starts(search):
            fits.append(_fit_about_its_first_states(search, start))
            if _is_explained(search, fits[-1]):
                break
    # 3. The best fit, with the lowest sum of squares (cost).
    best = min(fits, key=lambda model: model.fit.cost, default=base)
    if best.fit.cost < MAX_COST_RATIO * base.fit.cost:
        return best
    evaluator.begin_at(states, deviations)
    return None


def _list_single_effect_starts(search: EffectSearch) -> list[FitStart]:
    """Return starts of fits with one effect each, best first.

    They start at the initial states of the base model. Their rank is the number of coefficients
    times the remaining sum of squares (the cost), lower is better. So an effect with more
    coefficients has to explain more. Only the best `MAX_TRIED_EFFECTS` are returned, and only if
    their rank is clearly below the cost of the base model.

    1. Effects at contacts are scanned over the range of their coefficient, without a fit.
    2. Of all other effects, those with the best scores are fitted.
    3. Of a fitted family (one effect at all joints), each member is also tried alone.

    Args:
        search: search with its models. The fits of step 2 are added to `search.models`.
    """
    base, evaluator = search.base_model, search.evaluator
    states = base.fit.initial_states
    # 1. Effects at contacts.
    # Pairs of rank and start. Effects at contacts have one coefficient, so that their rank is the
    # sum of squares.
    ranked_starts = [
        (value.squares, _make_start(search, value, states))
        for value in _rank_effects_at_contacts(search, base)
    ]
    # 2. The other effects; `refit_extensions` adds its fits to `search.models`.
    exclude_laws_with_many_shapes(search)
    search.refit_extensions([base], MAX_REFITTED_CANDIDATES)
    for model in search.models.values():
        # All models but the base model have one effect here.
        if model.effects:
            coefficient_count = len(evaluator.get_coefficient_indices(model.effects[0]))
            ranked_starts.append((coefficient_count * model.fit.cost, model.fit.make_start()))
            # 3. Members of a family.
            ranked_starts += _list_member_starts(search, model)
    limit = MAX_SCAN_RATIO * base.fit.cost
    ranked_starts.sort(key=lambda ranked_start: ranked_start[0])
    return [start for rank, start in ranked_starts if rank < limit][:MAX_TRIED_EFFECTS]


def _list_member_starts(search: EffectSearch, model: FittedModel) -> list[tuple[float, FitStart]]:
    """Return starts with single members of a fitted family, with their sums of squares.

    A family is one effect with a coefficient for each place, such as friction at all joints. Often
    only one member acts, and a model with one coefficient is simpler. Each member starts from its
    coefficient in the family.

    Args:
        search: search with its run evaluator.
        model: fitted model with one effect.

    Returns:
        Pairs of sum of squares and start; empty if the effect is no family, or if its members do
        not have one coefficient each.
    """
    (name,) = model.effects
    evaluator, fit = search.evaluator, model.fit
    members = [member.name for member in members_of(evaluator.available_effects[name])]
    indices = list(evaluator.get_coefficient_indices(name))
    if len(members) < 2 or len(members) != len(indices):
        return []
    starts = []
    for member, index in zip(members, indices, strict=True):
        # A member need not be in the library as an effect of its own.
        if member not in evaluator.coefficient_slices:
            continue
        theta = fit.theta.copy()
        theta[indices] = 0.0
        theta[evaluator.coefficient_slices[member]] = fit.theta[index]
        starts.append(FitStart((member,), theta, fit.initial_states))
    if not starts:
        return []
    samples = np.array([start.theta for start in starts])
    squares = _compute_squares(evaluator, search.noise.sigma, samples, fit.initial_states)
    return list(zip(squares.tolist(), starts, strict=True))


def _fit_about_its_first_states(search: EffectSearch, start: FitStart) -> FittedModel:
    """Fit an effect and estimate the initial states in turn, while the sum of squares decreases.

    Contacts make the sum of squares rough, so Levenberg-Marquardt alone would stop at a wrong
    place. The rounds end when the effect explains the recording, or the cost hardly decreases. Each
    round has these steps:

    1. Estimate the initial states by a smoother.
    2. Scan the coefficient of an effect at a contact.
    3. Improve coefficients and initial states by random search.
    4. Fit all of them by Levenberg-Marquardt.

    Args:
        search: search with its models and run evaluator. The fit is stored in its models, and the
            evaluator keeps the last estimate of the initial states.
        start: start with a single effect.

    Returns:
        The fit of the last round.
    """
    evaluator, sigma = search.evaluator, search.noise.sigma
    (name,) = start.effects
    indices = list(evaluator.get_coefficient_indices(name))
    bounds = np.array(compute_coefficient_bounds(evaluator, name))
    is_at_contact = evaluator.available_effects[name].at == "contact"
    rng = search.make_rng("initial states", start.effects)
    # Another round follows only if the cost is below this limit, which decreases with the cost.
    limit = MAX_REPEATED_COST_RATIO * search.base_model.fit.cost
    theta = start.theta
    for _ in range(MAX_STATE_ESTIMATES):
        # 1. Smoother.
        smoothed = smooth_first_states(evaluator, theta, sigma)
        # The runs cannot be filtered with this effect.
        if smoothed is None:
            return search.fit_one(start)
        # 2. Scan.
        if is_at_contact:
            # An effect at a contact has one coefficient. It was not simulated yet, so that its sum
            # of squares is infinite.
            value = _ScannedValue(
                name,
                coefficient=float(theta[indices[0]]),
                unit=_get_unit(search, name),
                squares=np.inf,
            )
            states = np.array([run_start.mean for run_start in smoothed])
            theta = _add_effect(search, _scan_in_turn(search, value, NEAR_SCAN_WIDTHS, states))
        # 3. Random search.
        widths = _compute_widths(search, name, theta[indices])
        best_sample = RandomStartSearch(evaluator, sigma, smoothed, rng).run(
            theta, indices, widths, bounds
        )
        evaluator.begin_at(
            best_sample.states, FIRST_STATE_MARGIN * compute_first_deviations(smoothed)
        )
        # 4. Levenberg-Marquardt.
        # The fit of the last round is removed, since sums of squares about other initial states are
        # not comparable.
        search.models.pop(frozenset(start.effects), None)
        model = search.fit_one(FitStart(start.effects, best_sample.theta, best_sample.states))
        if _is_explained(search, model) or not model.fit.cost < limit:
            break
        limit, theta = MIN_COST_RATIO * model.fit.cost, model.fit.theta
    return model


def _compute_widths(search: EffectSearch, name: str, coefficients: Array) -> Array:
    """Return the standard deviations (K,) with which a random search varies K coefficients.

    They are relative to the coefficients; for an effect at a contact, which may be zero, they are
    relative to the value of the model file that it changes.
    """
    is_at_contact = search.evaluator.available_effects[name].at == "contact"
    # Values to which the widths are relative.
    units = _get_unit(search, name) if is_at_contact else np.abs(coefficients)
    return np.broadcast_to(SAMPLED_WIDTH * units, coefficients.shape)


def _is_explained(search: EffectSearch, model: FittedModel) -> bool:
    """Return whether a model explains the recording with its present initial states."""
    return search.compute_excess_residual(model) < MAX_EXPLAINED_EXCESS


def _use_first_states_of(
    search: EffectSearch, evaluators: Sequence[RunEvaluator], model: FittedModel
) -> None:
    """Use the initial states of a model for all runs, and fit this model and the base model again.

    All models of the search are compared with these initial states. Those of held-out runs are
    estimated with the final coefficients of the model.

    Args:
        search: search whose base model is fitted again.
        evaluators: run evaluators of the fitted and the held-out runs.
        model: model whose initial states are used.
    """
    base, evaluator = search.base_model, search.evaluator
    deviations = evaluator.state_prior
    # With contacts, initial states have been smoothed, which gives their standard deviations.
    assert deviations is not None
    evaluator.begin_at(model.fit.initial_states, deviations)
    # Fits about other initial states are not comparable.
    search.models.clear()
    # A start without effects is that of the base model.
    search.refit_models([FitStart((), base.fit.theta, evaluator.initial_state_guesses)])
    model = search.fit_to_convergence(search.add_fit(model.fit))
    held_out = [other for other in evaluators if other is not evaluator]
    set_first_states_in_contact(held_out, model.fit.theta, search.noise.sigma)
    for other in held_out:
        _search_first_states(search, other, model.fit.theta)


def _search_first_states(search: EffectSearch, runs: RunEvaluator, theta: Array) -> None:
    """Search initial states at random if the smoothed ones do not explain the runs.

    Smoothed states are those that a Kalman smoother estimates from all samples of a run. The new
    states replace those of the runs only if the sum of squares decreases. Nothing happens if a
    filter cannot follow the runs.

    Shapes: P parameters.

    Args:
        search: search with the noise.
        runs: the runs, which begin at smoothed states.
        theta: (P,) parameters of the model.
    """
    sigma, sample_count = search.noise.sigma, int(np.isfinite(runs.observed).sum())
    (squares_before,) = _compute_squares(runs, sigma, theta[None], runs.initial_state_guesses)
    if not squares_before > EXPLAINED_SQUARES * sample_count:
        return
    smoothed = smooth_first_states(runs, theta, sigma)
    # The runs cannot be filtered with these parameters.
    if smoothed is None:
        return
    rng = search.make_rng("initial states")
    # No coefficients are varied.
    best_sample = RandomStartSearch(runs, sigma, smoothed, rng).run(
        theta, indices=[], widths=np.zeros(0), bounds=np.zeros((0, 2))
    )
    if best_sample.mean_square * sample_count < squares_before:
        runs.begin_at(best_sample.states, FIRST_STATE_MARGIN * compute_first_deviations(smoothed))


def _compute_squares(evaluator: RunEvaluator, sigma: Array, samples: Array, states: Array) -> Array:
    """Simulate the runs with N sets of parameters, and return the sums of squares (N,).

    The residuals are in units of the noise. A simulation that diverges has an infinite sum.

    Shapes: R runs, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        sigma: (C,) standard deviation of the noise of each channel.
        samples: (N, P) sets of parameters.
        states: (R, s) initial states.
    """
    run_count, sample_count = len(states), len(samples)
    # Every run is simulated with every set of parameters, in one batch: all runs with the first
    # set, then all runs with the second, and so on.
    simulated = evaluator.simulate(
        np.repeat(samples, run_count, axis=0),
        np.tile(np.arange(run_count), sample_count),
        np.tile(states, (sample_count, 1)),
    )
    residual = simulated.reshape(sample_count, *evaluator.observed.shape) - evaluator.observed
    scaled = np.where(np.isfinite(evaluator.observed), residual, 0.0) / sigma
    squares = np.square(scaled).sum(axis=(1, 2, 3))
    return np.where(np.isfinite(squares), squares, np.inf)


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
        _ScannedValue(name, 0.0, _get_unit(search, name), np.inf)
        for name in evaluator.library
        if evaluator.available_effects[name].at == "contact"
    ]


def _get_unit(search: EffectSearch, name: str) -> float:
    """Return the value of the model file that an effect at a contact changes, such as a friction.

    Coefficients at contacts are scanned in multiples of this value.
    """
    # The lower bound of the first coefficient is where the number of the file becomes zero.
    return -compute_coefficient_bounds(search.evaluator, name)[0][0]


def _find_likeliest_effect(search: EffectSearch) -> _ScannedValue | None:
    """Return the effect at a contact, with a coefficient, that a Kalman filter finds likeliest.

    Each effect at a contact is tried at several values of its coefficient that decrease or increase
    the number of the model file (`unit`). A filter follows the data also where a simulation would
    diverge. Return None if there are no such effects, or the filter fails for all.

    Args:
        search: search with its run evaluator.
    """
    values = []
    for effect in _list_effects_at_contacts(search):
        values += [effect._replace(coefficient=-share * effect.unit) for share in DECREASES]
        values += [effect._replace(coefficient=share * effect.unit) for share in INCREASES]
    if not values:
        return None
    likelihoods = _compute_log_likelihoods(search, values)
    best = int(np.argmax(likelihoods))
    return values[best] if np.isfinite(likelihoods[best]) else None


def _refine_coefficient(search: EffectSearch, value: _ScannedValue) -> _ScannedValue:
    """Refine the coefficient of an effect by the likelihood of the filter, on two finer grids."""
    for width in REFINEMENT_WIDTHS:
        values = _list_nearby_values(search, value, width * np.array(GRID))
        value = values[int(np.argmax(_compute_log_likelihoods(search, values)))]
    return value


def _rank_effects_at_contacts(search: EffectSearch, base: FittedModel) -> list[_ScannedValue]:
    """Scan each effect at a contact over its range, and rank those that explain the residual.

    A scan simulates the runs with equidistant values of the coefficient, from the initial states of
    the base model. No derivative is used, since contacts make the motion rough.

    Args:
        search: search with its run evaluator.
        base: fitted base model.

    Returns:
        The best value of each effect that explains a part of the discrepancy, the best effect
        first.
    """
    scanned_values = _scan_effects_at_contacts(search, base.fit.initial_states)
    if not scanned_values:
        return []
    # With the coefficient zero, any effect is off. A scan of width zero simulates only this value.
    without_effect = _scan(
        search,
        scanned_values[0]._replace(coefficient=0.0),
        width=0.0,
        states=base.fit.initial_states,
    )
    limit = MAX_SCAN_RATIO * without_effect.squares
    useful = [value for value in scanned_values if value.squares < limit]
    return sorted(useful, key=lambda value: value.squares)[:MAX_TRIED_EFFECTS]


def find_lowest_scan(search: EffectSearch) -> float:
    """Return the lowest sum of squares of scans of all effects at contacts; infinite without any.

    If it is far below that of the present model, an effect at a contact acts. The initial states
    are those that were estimated with the present model. Squares are in units of the noise.
    """
    scanned_values = _scan_effects_at_contacts(search, search.evaluator.initial_state_guesses)
    return min((value.squares for value in scanned_values), default=np.inf)


def _scan_effects_at_contacts(search: EffectSearch, states: Array) -> list[_ScannedValue]:
    """Scan each effect at a contact over its whole range, and return its best value."""
    values = _list_effects_at_contacts(search)
    return [_scan_in_turn(search, value, SCAN_WIDTHS, states) for value in values]


def _scan_in_turn(
    search: EffectSearch, value: _ScannedValue, widths: Sequence[float], states: Array
) -> _ScannedValue:
    """Scan a coefficient with intervals of decreasing widths, each about the best value so far."""
    for width in widths:
        value = _scan(search, value, width, states)
    return value


def _list_nearby_values(
    search: EffectSearch, value: _ScannedValue, distances: Array
) -> list[_ScannedValue]:
    """Return coefficients near a value of an effect at a contact, within its bounds.

    Args:
        search: search with its run evaluator.
        value: the effect, with the coefficient about which the others lie.
        distances: (N,) distances from it, in units of the number of the model file that the effect
            changes.
    """
    # An effect at a contact has one coefficient.
    ((low, high),) = compute_coefficient_bounds(search.evaluator, value.name)
    coefficients = np.clip(value.coefficient + value.unit * distances, low, high)
    return [value._replace(coefficient=float(c)) for c in coefficients]


def _scan(search: EffectSearch, value: _ScannedValue, width: float, states: Array) -> _ScannedValue:
    """Simulate the runs with equidistant coefficients, and return the value with the best fit.

    Shapes: R runs, s states of a run.

    Args:
        search: search with the base model.
        value: centre of the scan.
        width: half of the interval, relative to the number of the model file.
        states: (R, s) initial states.
    """
    search.evaluator.search_control.check_not_stopped()
    distances = width * np.linspace(-1.0, 1.0, SCANNED_VALUES)
    values = _list_nearby_values(search, value, distances)
    theta = np.array([_add_effect(search, value) for value in values])
    squares = _compute_squares(search.evaluator, search.noise.sigma, theta, states)
    best = int(np.argmin(squares))
    return values[best]._replace(squares=float(squares[best]))


def _compute_log_likelihoods(search: EffectSearch, values: Sequence[_ScannedValue]) -> Array:
    """Return the log-likelihood (N,) of each value of a coefficient, summed over the runs.

    A cubature Kalman filter follows each run with each value. It allows for a missing force
    (process noise), so that it follows the data even if the model lacks an effect.

    Args:
        search: search with its run evaluator and noise.
        values: N effects, each with one coefficient.
    """
    evaluator = search.evaluator
    evaluator.search_control.check_not_stopped()
    runs = range(len(evaluator.prepared_runs))
    hypotheses = [
        FilterHypothesis(run, theta, COMPARED_FORCE_SHARE)
        for theta in (_add_effect(search, value) for value in values)
        for run in runs
    ]
    results = filter_hypotheses(evaluator, search.noise.sigma, hypotheses)
    log_likelihoods = np.array([result.log_likelihood for result in results])
    total: Array = log_likelihoods.reshape(len(values), len(runs)).sum(axis=1)
    return total


def _make_start(search: EffectSearch, value: _ScannedValue, states: Array) -> FitStart:
    """Return the start of a fit of an effect at a contact, with initial states (R, s)."""
    return FitStart((value.name,), _add_effect(search, value), states)


def _add_effect(search: EffectSearch, value: _ScannedValue) -> Array:
    """Return the parameters (P,) of the base model with an effect."""
    theta = search.base_model.fit.theta.copy()
    theta[search.evaluator.coefficient_slices[value.name]] = value.coefficient
    return theta


def search_in_contact(search: EffectSearch) -> FittedModel:
    """Search the effects of a recording with contacts, and return the best model.

    Laws with many shapes are candidates only if the simpler ones do not explain the recording,
    because scoring every shape takes long.

    1. Search without laws with many shapes.
    2. If the best model leaves more than noise, discard all scores, and search with all laws.

    Args:
        search: the search, which contains the base model and models of one effect at a contact.
    """
    # 1. Simple laws.
    exclude_laws_with_many_shapes(search)
    model = _search_simple_laws(search)
    if search.is_noise_like(model):
        search.settled_effects = frozenset(model.effects)
        search.best_supported_model = model
        return model
    # 2. All laws.
    # Stored scores (`cached_scans`, `superseded_scans`) lack the excluded laws.
    search.excluded_effects = frozenset()
    search.cached_scans.clear()
    search.superseded_scans.clear()
    search.scores_by_effects.clear()
    return search.run()


def exclude_laws_with_many_shapes(search: EffectSearch) -> None:
    """Exclude effects with many values of their shape parameters from the scores of a search.

    Scoring every shape, such as every frequency, would take too long. `search_in_contact` includes
    them again if the other effects do not explain the recording.

    Args:
        search: search whose `excluded_effects` are set.
    """
    evaluator, base = search.evaluator, search.base_model.fit
    probe_counts = {
        name: sum(1 for _ in iterate_first_probes(evaluator, base.effects, name))
        for name in evaluator.library
    }
    search.excluded_effects = frozenset(
        name for name, count in probe_counts.items() if count > SHAPE_COUNT_FOR_MULTISTART
    )


def _search_simple_laws(search: EffectSearch) -> FittedModel:
    """Search the effects that are not excluded, and return the best model.

    If a single effect already explains the recording, a full search is not needed. Then only other
    single effects that might explain it as well are fitted (its competitors).

    Args:
        search: search with its models.
    """
    best = select_likeliest(*search.models.values())
    if not search.is_noise_like(best) or not search.is_complete(best, MAX_P_VALUE_FURTHER_EFFECT):
        return search.run()
    # The base model alone explains the recording.
    if not best.effects:
        return best
    # For the p-value of the effect, the surrogates of these scores stand for those about the model
    # without it, which is not scored.
    search.reference_scores = search.score_missing_effects(best)
    _fit_competing_effects(search, best)
    models = [model for model in search.models.values() if len(model.effects) == 1]
    return select_likeliest(*models)


def _fit_competing_effects(search: EffectSearch, model: FittedModel) -> None:
    """Fit the single effects that may replace the only effect of a model.

    To first order, the model without the effect leaves the residual e + c d: the residual e of the
    fit, plus the change c d by the effect with coefficient c. An effect that explains this sum may
    replace the present one.

    1. Compute the change by the present effect.
    2. Score all other effects against the sum, about the model without the effect.
    3. Select those that leave almost as small a residual as the present effect does.
    4. Fit them from their best coefficients. The fits are stored in `search.models`.

    Args:
        search: the search, with the stored scan of the model: the responses of the runs to the
            effects that it lacks (directions), and their scores.
        model: fitted model with one effect.
    """
    (name,) = model.effects
    # Scores need derivatives at the parameters of the model itself.
    model = search.refine_jacobian(model)
    scan = search.cached_scans[frozenset(model.effects)]
    residual = search.compute_residual(model.fit)
    # 1. Change by the present effect: (R, T, C), as the residual.
    change = _compute_change(search, model)
    # The residual e + c d of the model without the effect, to first order.
    combined_residual = residual + change
    # 2. Scores.
    test = _make_test_without_effect(search, model, scan.directions)
    scores = test.compute_scores(combined_residual)
    # 3. Selection.
    # Parameters and initial states absorb a part of the change, as they would in a fit.
    (residual_without_effect,) = test.project_out(combined_residual[None])
    squares_without, squares_with = (
        float(np.square(values / search.noise.sigma).sum())
        for values in (residual_without_effect, residual)
    )
    sample_count = int(search.observed_mask.sum())
    # For white noise and n samples, the score of effect k is n log(SS / SS_k), where SS is the sum
    # of squares without any effect and SS_k that with effect k.
    competing_squares = squares_without * np.exp(-scores.white_noise_scores / sample_count)
    # RMS of the residual of each effect, relative to that of the present effect.
    relative_residuals = np.sqrt(competing_squares / squares_with)
    competitors = _select_smallest_residuals(scores, relative_residuals)
    if not competitors.effects:
        return
    # 4. Fits.
    # They extend a model without effects that has the other parameters and the initial states of
    # the given model.
    theta = model.fit.theta.copy()
    theta[search.evaluator.coefficient_slices[name]] = 0.0
    base = search.base_model
    fit_without_effect = replace(base.fit, theta=theta, initial_states=model.fit.initial_states)
    starts = select_refit_starts(
        search.evaluator,
        search.noise,
        replace(base, fit=fit_without_effect),
        scan.directions,
        competitors,
        MAX_COMPETITORS,
        fits_all=False,
    )
    search.refit_models(starts, is_racing=False)


def _make_test_without_effect(
    search: EffectSearch, model: FittedModel, directions: DirectionSet
) -> ScoreTest:
    """Make a score test about the model without its only effect.

    A test projects out what the fitted parameters can explain. About the model itself, it would
    project out the change by the effect, whose coefficients are fitted. So the derivatives by these
    coefficients are removed.

    Args:
        search: the search, with the runs and the noise.
        model: fitted model with one effect.
        directions: responses of the runs to the candidate effects.
    """
    columns = _find_columns(search, model)
    fit_without_effect = replace(
        model.fit,
        effects=(),
        free_indices=np.delete(model.fit.free_indices, columns),
        jacobian=np.delete(model.fit.jacobian, columns, axis=3),
    )
    return ScoreTest(
        fit_without_effect,
        directions,
        search.observed_mask,
        search.compute_channel_weights(model),
    )


def _select_smallest_residuals(
    scores: CandidateScores, relative_residuals: Array
) -> CandidateScores:
    """Return the scores of the effects that leave the smallest residuals, in ascending order.

    They are at most `MAX_COMPETITORS`, and each of their residuals is below `MAX_COMPETITOR_SIZE`.

    Args:
        scores: scores of E effects.
        relative_residuals: (E,) RMS of the residual of each effect, relative to that of the effect
            it may replace.
    """
    order = [
        int(i)
        for i in np.argsort(relative_residuals)
        if relative_residuals[i] < MAX_COMPETITOR_SIZE
    ][:MAX_COMPETITORS]
    return replace(
        scores,
        effects=tuple(scores.effects[i] for i in order),
        score=scores.score[order],
        null_quantiles=scores.null_quantiles[order],
        peaks=tuple(scores.peaks[i] for i in order),
        null_scores=scores.null_scores[order],
        white_noise_scores=scores.white_noise_scores[order],
    )


def _find_columns(search: EffectSearch, model: FittedModel) -> list[int]:
    """Return the columns of a fit's Jacobian that belong to the only effect of a model."""
    (name,) = model.effects
    parameter_indices = search.evaluator.get_coefficient_indices(name)
    return [int(np.flatnonzero(model.fit.free_indices == index)[0]) for index in parameter_indices]


def _compute_change(search: EffectSearch, model: FittedModel) -> Array:
    """Return the change of the runs by the only effect of a model, to first order (R, T, C).

    With the runs y(c) at the coefficients c, it is the derivative of y((1 + h) c) by h, from
    central differences. A contact can make the motion jump between two simulations; then a
    difference quotient is arbitrarily large. So quotients with several h are computed, and that
    with the smallest sum of squares is returned.

    Shapes: R runs, T samples, C channels.

    Args:
        search: search with its run evaluator.
        model: model with one effect.
    """
    (name,) = model.effects
    evaluator, fit = search.evaluator, model.fit
    indices = list(evaluator.get_coefficient_indices(name))
    runs = len(fit.initial_states)
    # Relative changes h of the coefficients, the positive ones first.
    shares = np.concatenate([DIFFERENCE_SHARES, -np.array(DIFFERENCE_SHARES)])
    samples = np.repeat(fit.theta[None], len(shares), axis=0)
    samples[:, indices] *= 1.0 + shares[:, None]
    simulated = evaluator.simulate(
        np.repeat(samples, runs, axis=0),
        np.tile(np.arange(runs), len(shares)),
        np.tile(fit.initial_states, (len(shares), 1)),
    ).reshape(len(shares), *evaluator.observed.shape)
    upper, lower = np.split(simulated, 2)
    widths = 2.0 * np.array(DIFFERENCE_SHARES)[:, None, None, None]
    changes = np.where(search.observed_mask, (upper - lower) / widths, 0.0)
    squares = np.square(changes / search.noise.sigma).sum(axis=(1, 2, 3))
    # A simulation that diverges gives NaN.
    smallest: Array = changes[int(np.argmin(np.nan_to_num(squares, nan=np.inf)))]
    return smallest
