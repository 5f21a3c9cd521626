"""Propose a discriminating run: the run in which the predictions of two models differ most.

It is a T-optimal design over a few changes that an experimenter can make (A. C. Atkinson, V. V.
Fedorov, Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57), with the competing model's
parameters fixed at their fit to the present data. On a run x with T samples of C channels the two
models differ by

    apart(x) = sqrt(mean over t, c of ((y_model - y_other) / sigma_c)^2)                       (1)

For a robot no run is proposed that exceeds a limit of the model file
(`diagnosis.experiment_design`): commands
and initial states are limited, and the motion is simulated with both models.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import (
    UNLIMITED,
    Interval,
    StatedLimits,
    read_model_file_limits,
)
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from sims.core.document_fields import OPTIONAL, Document
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, Scenario

MIN_DISCRIMINATION_SIGMAS = 2.0
"""Minimum RMS difference of two models, in noise standard deviations, for which one more run would
distinguish them.
"""
INITIAL_STATE_FACTORS = (0.3, 2.0, -1.0)
"""Factors of an initial state that are tried."""
REST_STATE = 0.05
"""Minimum magnitude of an initial state to which the factors of `INITIAL_STATE_FACTORS` apply.

A smaller state is replaced by the numbers in `INITIAL_STATE_FACTORS` themselves.
"""
MIN_DROP_HEIGHT = 1.0
"""Minimum initial height in metres of a system that bounces."""
INPUT_FACTORS = (0.3, 3.0)
"""Factors of an input that are tried."""
ROBOT_INPUTS = (0.3, 2.0)
"""Factors of a robot's input that are tried: it may be driven at most twice as hard as before."""
MIN_INPUT_FACTOR = 1.1
"""Minimum factor by which an input must change, up or down, to be a different run."""


@dataclass(frozen=True)
class DiscriminatingRun(Document):
    """Proposed run or measurement, as in verdict.json.

    Attributes:
        says: Proposal as a sentence.
        change: By name, the differences from the first fitted run: seconds, an initial state, or
            the factor of an input; None if no run is proposed.
        apart: RMS difference of the two models in units of the noise; None if no run is proposed.
    """

    says: str
    change: Mapping[str, float] | None = field(default=None, metadata=OPTIONAL)
    apart: float | None = field(default=None, metadata=OPTIONAL)


class _Run(NamedTuple):
    """Candidate run that could be recorded."""

    says: str
    change: dict[str, float]
    scenario: Scenario
    states: Array


def propose_discriminating_run(
    models: ModelSet, model: FittedModel, competing_model: FittedModel
) -> DiscriminatingRun:
    """Propose a run or measurement that shows which of two models is right.

    1. Change the present runs in a few ways that an experimenter can make, and simulate each with
       both models.
    2. Select the run within the limits of the robot on which the models differ most.
    3. Describe it, or, if they differ by less than `MIN_DISCRIMINATION_SIGMAS`, explain why.

    Args:
        models: Fitted models, which include both.
        model: Model of the present diagnosis.
        competing_model: Competing model that explains the data as well.
    """
    evaluator = models.evaluator
    # 1. Changed runs.
    description = ""
    change: dict[str, float] = {}
    largest_discrimination = 0.0
    runs_by_discrimination = [
        (_compute_discrimination(evaluator, run, model, competing_model, models.noise.sigma), run)
        for run in _iterate_changed_runs(evaluator)
    ]
    # A run that cannot be simulated with both models is not proposed.
    runs_by_discrimination = [
        (discrimination, run)
        for discrimination, run in runs_by_discrimination
        if np.isfinite(discrimination) and discrimination > 0.0
    ]
    runs_by_discrimination.sort(key=lambda entry: -entry[0])
    # 2. The most different run within the limits.
    is_limited = False
    if first_run := _find_first_within_limits(
        evaluator, (model, competing_model), runs_by_discrimination
    ):
        largest_discrimination, (description, change, _, _) = first_run
        is_limited = (
            largest_discrimination < MIN_DISCRIMINATION_SIGMAS <= runs_by_discrimination[0][0]
        )
    # 3. Description.
    # Effects that both models have are not in question.
    effects = set(model.effects)
    competing_names = set(competing_model.effects)
    model_effects = " and ".join(sorted(effects - competing_names))
    competing_effects = " and ".join(sorted(competing_names - effects))
    if largest_discrimination < MIN_DISCRIMINATION_SIGMAS:
        return DiscriminatingRun(
            _explain_no_run(evaluator, model_effects, competing_effects, is_limited),
            {},
            largest_discrimination,
        )
    description += (
        f": in it the predictions with {model_effects} and {competing_effects} differ by "
        f"{largest_discrimination:.3g} times "
        "the noise"
    )
    return DiscriminatingRun(description, change, largest_discrimination)


def _find_first_within_limits(
    evaluator: RunEvaluator, models: Sequence[FittedModel], runs: Sequence[tuple[float, _Run]]
) -> tuple[float, _Run] | None:
    """Return the first run that stays within the limits of a robot, whichever model is right.

    A proposed run must not damage the robot. For a system without a model file it is the first run.
    The search ends at the first run that does not discriminate the models, because the following
    ones do not either.

    Args:
        evaluator: Evaluator of the recorded runs.
        models: Models, either of which may be right.
        runs: Candidate runs with the RMS difference of the two models, largest first.

    Returns:
        A run with its difference, which is 0 if no discriminating run is within the limits; None
        without runs.
    """
    if not evaluator.kind.has_model or not runs or runs[0][0] < MIN_DISCRIMINATION_SIGMAS:
        return runs[0] if runs else None
    # These imports are needed for robots only.
    from bench.diagnosis.experiment_design.candidate_runs import CandidateRun as RigRun
    from bench.diagnosis.experiment_design.candidate_runs import RunPlan
    from bench.diagnosis.experiment_design.safety_limits import RigLimits

    limits = RigLimits(evaluator, models[0])
    for discrimination, run in runs:
        candidate = RigRun(RunPlan(), run.says, run.scenario, run.states)
        if discrimination < MIN_DISCRIMINATION_SIGMAS or all(
            limits(model, [candidate])[0] for model in models
        ):
            return discrimination, run
    return 0.0, runs[0][1]


def _explain_no_run(
    evaluator: RunEvaluator, model_effects: str, competing_effects: str, is_limited: bool
) -> str:
    """Write what the user can do if no run distinguishes the two models.

    Args:
        evaluator: evaluator, whose channels are recorded.
        model_effects: effects of the model in words.
        competing_effects: effects of the competing model in words.
        is_limited: whether only the limits of the model file exclude such a run.
    """
    channels = [channel.name for channel in evaluator.kind.channels]
    unrecorded = ", ".join(name for name in channels if name not in evaluator.channels)
    advice = "measure one of the causes directly"
    # Another sensor may measure a difference where these sensors agree.
    if unrecorded:
        advice = f"also record {unrecorded}"
    if is_limited:
        return (
            "No run of this kind within the limits of the model file would distinguish "
            f"{model_effects} from {competing_effects}; {advice}, "
            "or search for other commands with simgap design"
        )
    return (
        f"No run of this kind would distinguish {model_effects} from {competing_effects}: "
        f"their predictions agree within the noise; {advice}"
    )


def _iterate_changed_runs(evaluator: RunEvaluator) -> Iterator[_Run]:
    """Yield runs like the first one with one changed duration, initial state or input."""
    limits = read_model_file_limits(evaluator)
    first = _get_first_run(evaluator, limits)
    # If several runs discriminate equally well, the first one is proposed.
    yield _lengthen_run(first)
    yield from _change_initial_states(evaluator, first, limits)
    yield from _scale_inputs(evaluator, first, limits)


def _get_first_run(evaluator: RunEvaluator, limits: StatedLimits) -> _Run:
    """Return the first fitted run, as the basis of the proposals.

    A robot starts at rest, because it cannot be started in motion, and with commands and positions
    within their limits.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        limits: limits of the model file; empty for a system.
    """
    run_data = evaluator.prepared_runs[0]
    if not evaluator.kind.has_model:
        return _Run("", {}, run_data.scenario, run_data.initial_state_guess)
    rates = set(evaluator.simulator.system.rates)
    states = [
        0.0 if name in rates else _clip(value, limits.states.get(name))
        for name, value in zip(evaluator.state_names, run_data.initial_state_guess, strict=True)
    ]
    recorded_inputs = run_data.scenario.inputs
    inputs = {
        name: _clip(values, limits.commands.get(name)) for name, values in recorded_inputs.items()
    }
    is_limited = any((inputs[name] != values).any() for name, values in recorded_inputs.items())
    limit_note = ", with commands limited as the model file states" if is_limited else ""
    return _Run(limit_note, {}, replace(run_data.scenario, inputs=inputs), np.array(states))


def _clip(values: Any, limits: Interval | None) -> Any:
    """Clip a number or an array to an interval.

    Args:
        values: number or array.
        limits: lower and upper end; None for no limit.
    """
    return values if limits is None else np.clip(values, *limits)


def _lengthen_run(first: _Run) -> _Run:
    """Return the run recorded for twice the time, with its inputs repeated from the beginning.

    Args:
        first: Run to lengthen.
    """
    times = first.scenario.times
    later_times = times[1:] - times[0]
    doubled_times = np.concatenate([times, times[-1] + later_times])
    inputs = {}
    for name, signal in first.scenario.inputs.items():
        # The inputs are repeated from the beginning.
        inputs[name] = np.concatenate([signal, signal[1:]])
    scenario = replace(first.scenario, times=doubled_times, inputs=inputs)
    seconds = float(doubled_times[-1] - doubled_times[0])
    change = {"seconds": seconds}
    return _Run(f"Record twice as long{first.says}", change, scenario, first.states)


def _change_initial_states(
    evaluator: RunEvaluator, first: _Run, limits: StatedLimits
) -> Iterator[_Run]:
    """Yield runs that differ from a recorded run in one initial state.

    A state is multiplied by several factors; a state of zero gets the factors as values. The
    initial velocities of a robot are not changed, because it starts at rest.

    Args:
        evaluator: evaluator of the recorded runs.
        first: recorded run that is changed.
        limits: limits of the model file; empty for a system.
    """
    system = evaluator.simulator.system
    height_index = len(system.coordinates) - 1
    states_with_units = zip(evaluator.state_names, _list_state_units(evaluator), strict=True)
    for index, (name, unit) in enumerate(states_with_units):
        above_ground = system.bounces and index == height_index
        if evaluator.kind.has_model and name not in system.coordinates:
            continue
        for factor in INITIAL_STATE_FACTORS:
            # A body cannot be released below the ground.
            if above_ground and factor < 0:
                continue
            initial_state = first.states.copy()
            value = float(initial_state[index])
            is_nonzero = abs(value) > REST_STATE
            value = factor * value if is_nonzero else factor
            if above_ground:
                value = max(value, MIN_DROP_HEIGHT)
            value = float(_clip(value, limits.states.get(name)))
            initial_state[index] = value
            description = f"Start with {name} = {value:.3g} {unit}{first.says}"
            yield _Run(description, {name: value}, first.scenario, initial_state)


def _scale_inputs(evaluator: RunEvaluator, first: _Run, limits: StatedLimits) -> Iterator[_Run]:
    """Yield runs that differ from a recorded run in the amplitude of one input.

    An input is never scaled beyond the limits of its command. Factors near one are left out,
    because they change too little.

    Args:
        evaluator: evaluator of the recorded runs.
        first: recorded run that is changed.
        limits: limits of commands that the model file states.
    """
    factors = ROBOT_INPUTS if evaluator.kind.has_model else INPUT_FACTORS
    for name, signal in first.scenario.inputs.items():
        if not signal.any():
            continue
        low, high = limits.commands.get(name, UNLIMITED)
        largest_factor = _compute_largest_factor(signal, (low, high))
        for factor in dict.fromkeys(min(factor, largest_factor) for factor in factors):
            scaled_signal = factor * signal
            if (
                1.0 / MIN_INPUT_FACTOR < factor < MIN_INPUT_FACTOR
                or scaled_signal.min() < low
                or scaled_signal.max() > high
            ):
                continue
            inputs = {**first.scenario.inputs, name: scaled_signal}
            comparison = "smaller" if factor < 1 else "larger"
            description = (
                f"Make the input {name} {comparison}, {factor:.3g} times what it was{first.says}"
            )
            scenario = replace(first.scenario, inputs=inputs)
            yield _Run(description, {name: factor}, scenario, first.states)


def _compute_largest_factor(signal: Array, limits: Interval) -> float:
    """Return the largest factor that keeps a signal within its limits, rounded down.

    It is infinite if nothing limits the signal.
    """
    ends = zip((float(signal.min()), float(signal.max())), limits, strict=True)
    # No factor reaches a limit of the opposite sign.
    factors = [limit / end for end, limit in ends if np.isfinite(limit) and end * limit > 0]
    # A factor with three decimals is easy to set.
    return float(np.floor(1e3 * min(factors)) / 1e3) if factors else np.inf


def _list_state_units(evaluator: RunEvaluator) -> list[str]:
    """List the units of the states: coordinates, their rates, and further states.

    Args:
        evaluator: Run evaluator of the system.
    """
    system = evaluator.simulator.system
    units = {channel.name: channel.unit for channel in evaluator.kind.channels}
    coordinate_units = [units.get(name, "m") for name in system.coordinates]
    rate_units = [f"{unit}/s" for unit in coordinate_units]
    # A user-defined system may have further states after the rates, in any unit.
    further_states = system.rates[len(coordinate_units) :]
    further_units = [units.get(name, "SI") for name in further_states]
    return [*coordinate_units, *rate_units, *further_units]


def _compute_discrimination(
    evaluator: RunEvaluator,
    run: _Run,
    model: FittedModel,
    competing_model: FittedModel,
    sigma: Array,
) -> float:
    """Simulate a run with two models, and return the RMS difference of their predictions, eq. (1).

    It is sqrt(mean over samples and channels of ((y_model - y_other) / sigma)^2), in standard
    deviations of the noise. The larger it is, the more clearly the run shows which model is right.

    Args:
        evaluator: run evaluator that simulates the run.
        run: run that could be recorded.
        model: fitted model with one of the causes.
        competing_model: fitted model with the other one.
        sigma: (C,) standard deviation of the noise of each channel.
    """
    thetas = np.stack([model.fit.theta, competing_model.fit.theta])
    predictions = evaluator.simulate_scenarios(
        thetas, [run.scenario] * 2, np.stack([run.states] * 2)
    )
    whitened_difference = (predictions[0] - predictions[1]) / sigma
    return compute_rms(whitened_difference)  # (1)
