"""Candidate runs that could be recorded next, within the limits that a model file specifies.

There are two kinds: runs by a plan (`RigModel`), and present runs with one change
(`iterate_changed_runs`).

A plan sets the driven inputs, the form, size and offset of the command, the initial state, the
constants (such as a load) and the sampling rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bench.core.input_signals import evaluate_signal
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.model_file_limits import (
    UNLIMITED,
    Interval,
    StatedLimits,
    read_model_file_limits,
)
from sims.core.simulator import Array, Scenario

MAX_PROBE_FREQUENCY = 8.0
"""Largest frequency of a proposed command, Hz."""
MAX_CYCLES_PER_SAMPLE = 0.1
"""Largest frequency of a proposed command, in cycles per sample interval."""


COMMAND_SIZE_FACTORS = (1.0, 2.0, 0.4)
"""Command sizes that are tried, as factors of the largest command recorded."""
INITIAL_STATE_FACTORS = (1.0, 1.4, 2.0, -1.0, 0.6, 0.3)
"""Initial coordinates that are tried, as factors of the recorded initial coordinate."""
COMMAND_OFFSET_FACTORS = (0.5, -0.5)
"""Command offsets that are tried instead of the median, as factors of the largest command."""
HOLD_FACTORS = (2, 4)
"""Factors that are tried for a longer sampling interval; commands are held or interpolated over it.
"""
MIN_SAMPLES = 40
"""Minimum number of samples of a run."""
REST_RATE = 0.05
"""Rate of a coordinate, in its unit per second, below which a run began at rest."""
REST_STATE = 0.05
"""Minimum magnitude of an initial coordinate to which `INITIAL_STATE_FACTORS` apply."""
RELEASE_SHARE = 0.2
"""Share of a run after which a pushed system is released."""


@dataclass(frozen=True)
class RunPlan:
    """Plan of a run.

    Attributes:
        driven_inputs: Driven inputs; empty if the system is only released.
        form: Form of the command in words.
        size: Size of the command, as a factor of the largest one recorded.
        level: Offset of the command from its median, as a factor of the largest one recorded.
        states: Initial states by name, where they differ from the first run's at rest.
        constants: Constants by name, such as load, length or gain, with values from the recorded
            runs.
        hold_factor: Factor of the sampling interval.
    """

    driven_inputs: tuple[str, ...] = ()
    form: str = ""
    size: float = 1.0
    level: float = 0.0
    states: tuple[tuple[str, float], ...] = ()
    constants: tuple[tuple[str, float], ...] = ()
    hold_factor: int = 1


@dataclass(frozen=True)
class CandidateRun:
    """Candidate run: a plan with its command signals and its initial state."""

    plan: RunPlan
    says: str
    scenario: Scenario
    states: Array


class RigModel:
    """Experimental setup, from which variants of the recorded runs are made."""

    def __init__(self, evaluator: RunEvaluator, seconds: float) -> None:
        """Measure the usual input levels, command sizes and sampling interval of the present runs.

        `median_commands` has the median of each input over all runs, in the unit of the input;
        `largest_commands` its largest deviation from this median. `driven_inputs` names the inputs
        that deviate at all. `step` is the median sampling interval of the first run in seconds, and
        `initial_state` the initial state of a candidate run.

        Args:
            evaluator: Run evaluator of the recorded runs.
            seconds: Duration of the next run in seconds.
        """
        self.evaluator, self.seconds = evaluator, seconds
        self.recorded_scenario = evaluator.prepared_runs[0].scenario
        self.step = float(np.median(np.diff(self.recorded_scenario.times)))
        self.largest_commands, self.median_commands = {}, {}
        for name in self.recorded_scenario.inputs:
            signals = [run_data.scenario.inputs[name] for run_data in evaluator.prepared_runs]
            middle = float(np.median(np.concatenate(signals)))
            self.largest_commands[name] = max(
                float(np.abs(values - middle).max()) for values in signals
            )
            self.median_commands[name] = middle
        self.driven_inputs = tuple(
            name for name in self.recorded_scenario.inputs if self.largest_commands[name] > 0
        )
        self.limits = read_model_file_limits(evaluator)
        self.initial_state = _get_rest_state(evaluator, self.limits)

    # -- plans

    def list_basic_plans(self) -> Iterator[RunPlan]:
        """Yield plans of every form and size, for each input alone and for all together.

        Plans that only release the system from other initial states come first.
        """
        for state in self._iterate_initial_states():
            yield RunPlan(states=(state,))
        input_groups: list[tuple[str, ...]] = [(name,) for name in self.driven_inputs]
        if len(input_groups) > 1:
            input_groups.append(self.driven_inputs)
        for driven_inputs in input_groups:
            for size in COMMAND_SIZE_FACTORS:
                for form in COMMAND_FORMS:
                    yield RunPlan(driven_inputs, form, size)

    def list_variants(self, plan: RunPlan) -> Iterator[RunPlan]:
        """Yield variants of a plan with one property changed, to improve the best plans.

        Properties are initial states, constants, offset and size of the commands, and the time for
        which a command is held.

        Args:
            plan: Plan of a run.
        """
        for name, value in self._iterate_initial_states():
            states = {**dict(plan.states), name: value}
            yield replace(plan, states=tuple(states.items()))
        # The changed constant comes last; its value in the plan, if it has one, is left out.
        for name, values in self._list_adjustable_constants().items():
            other_constants = dict(plan.constants)
            other_constants.pop(name, None)
            for value in values:
                yield replace(plan, constants=(*other_constants.items(), (name, value)))
        if plan.driven_inputs:
            # Offset and size are factors of the largest recorded command.
            for level in COMMAND_OFFSET_FACTORS:
                yield replace(plan, level=level)
            for size in COMMAND_SIZE_FACTORS:
                yield replace(plan, size=size)
        # Each command is held for several sampling intervals; too few samples tell nothing.
        for hold_factor in HOLD_FACTORS:
            if self.seconds / (self.step * hold_factor) >= MIN_SAMPLES:
                yield replace(plan, hold_factor=hold_factor)

    def _iterate_initial_states(self) -> Iterator[tuple[str, float]]:
        """Yield other initial states for a proposed run, each as the name of a state and its value.

        States that are specified in all runs are not changed. The others are:

        1. Multiples of the initial coordinates of the first run.
        2. The largest initial rates that were recorded, in both directions. A robot cannot be
           started in motion, so it has none of them.
        """
        evaluator = self.evaluator
        system = evaluator.simulator.system
        known_states = {
            evaluator.state_names[i] for i in np.flatnonzero(evaluator.known_state_mask.all(axis=0))
        }
        # 1. Coordinates.
        for name in system.coordinates:
            if name in known_states:
                continue
            usual_value = float(self.initial_state[evaluator.state_names.index(name)])
            # Multiples of a value near zero would hardly differ, so the factors are the values.
            scale = usual_value if abs(usual_value) > REST_STATE else 1.0
            # Outside its range a joint begins at the limit, which is tried only once.
            yield from dict.fromkeys(
                (name, float(_clip(scale * factor, self.limits.positions.get(name))))
                for factor in INITIAL_STATE_FACTORS
            )
        # 2. Rates.
        if evaluator.kind.has_model:
            return
        for name in system.rates:
            initial_rates = evaluator.initial_state_guesses[:, evaluator.state_names.index(name)]
            fastest = float(np.abs(initial_rates).max())
            if name not in known_states and fastest > REST_RATE:
                yield name, fastest
                yield name, -fastest

    def _list_adjustable_constants(self) -> dict[str, list[float]]:
        """Return the values of the constants that differ between the recorded runs, by name.

        A constant that has had several values, such as a load, can be set by the experimenter.
        """
        values: dict[str, set[float]] = {}
        for run in self.evaluator.runs:
            for name, value in run.constants.items():
                values.setdefault(name, set()).add(value)
        return {
            name: sorted(recorded_values)
            for name, recorded_values in values.items()
            if len(recorded_values) > 1
        }

    # -- runs

    def make_run(self, plan: RunPlan) -> CandidateRun:
        """Turn a plan into a run that can be simulated: commands, constants and initial state.

        1. Hold each input at its recorded median.
        2. Add the planned signal to the driven inputs, within their limits. The description of the
           run says which inputs were limited.
        3. Set the planned initial states and constants.

        Args:
            plan: Plan of the run: form, size and offset of the commands, held time, constants and
                initial states.
        """
        # 1. Medians.
        times = np.arange(0.0, self.seconds, self.step * plan.hold_factor)
        inputs = {
            name: _clip(np.full(times.size, median), self.limits.commands.get(name))
            for name, median in self.median_commands.items()
        }
        initial_state = self.initial_state.copy()
        # 2. Signals of the driven inputs.
        limited_inputs = []
        for number, name in enumerate(plan.driven_inputs):
            # Inputs that are driven together get different random signals.
            rng = np.random.default_rng(number)
            signal = plan.size * _compute_command(plan.form, times, self.step, rng)
            command = self.median_commands[name] + self.largest_commands[name] * (
                signal + plan.level
            )
            inputs[name] = _clip(command, self.limits.commands.get(name))
            if (inputs[name] != command).any():
                limited_inputs.append(name)
        # 3. Initial states and constants.
        for name, value in plan.states:
            initial_state[self.evaluator.state_names.index(name)] = value
        constants = {**self.recorded_scenario.constants, **dict(plan.constants)}
        scenario = replace(self.recorded_scenario, times=times, inputs=inputs, constants=constants)
        return CandidateRun(
            plan, self._describe_plan(plan, inputs, limited_inputs), scenario, initial_state
        )

    def _describe_plan(
        self, plan: RunPlan, inputs: Mapping[str, Array], limited_inputs: Sequence[str]
    ) -> str:
        """Describe a plan in words that tell the user how to record the run.

        For example "u.elbow: chirp, 2 times the recorded amplitude, from q.elbow = 0.3".

        Args:
            plan: Plan of the run.
            inputs: (T,) commands by name, after they are limited.
            limited_inputs: Names of the inputs that were clipped to the limits of the setup.
        """
        if plan.driven_inputs:
            input_text = plan.driven_inputs[0] if len(plan.driven_inputs) == 1 else "all inputs"
            text = f"{input_text}: {plan.form}, {plan.size:g} times the recorded amplitude"
        else:
            # Nothing is driven: the system moves from its initial state only.
            text = "release"
        if plan.level:
            medians = [f"{name} = {np.median(inputs[name]):.3g}" for name in plan.driven_inputs]
            text += f", about {', '.join(medians)}"
        for name in limited_inputs:
            low, high = self.limits.commands[name]
            text += f", {name} limited to {low:.4g} to {high:.4g}"
        if plan.states:
            text += ", from " + ", ".join(f"{name} = {value:.3g}" for name, value in plan.states)
        if plan.constants:
            text += ", with " + ", ".join(f"{name} = {value:.4g}" for name, value in plan.constants)
        if plan.hold_factor > 1:
            text += (
                f", commands and samples {1.0 / (self.step * plan.hold_factor):.4g} times a second"
            )
        return text


COMMAND_FORMS: Mapping[str, str] = {
    "slow multisine": "multisine:1:{slow:g}:1",
    "fast multisine": "multisine:1:{middle:g}:{fast:g}",
    "chirp": "chirp:1:{slow:g}:{fast:g}",
    "steps of 0.5 s": "steps:1:0.5",
    "steps of 0.1 s": "steps:1:0.1",
    "slow sine": "sine:1:{slow:g}",
    "square wave of 1 Hz": "square:1:1",
    "square wave of 4 Hz": "square:1:4",
    "ramps up and down": "",
    "holds": "",
    "a push, then zero input": "",
}
"""Signal specifications of unit size, by name of the form.

An empty one is computed by `_compute_command`.
"""


def _compute_command(form: str, times: Array, step: float, rng: np.random.Generator) -> Array:
    """Compute the command signal (T,) of a form, such as a chirp or steps, with magnitude one.

    The caller scales it to the size of the recorded commands. Frequencies follow from duration and
    sampling interval.

    Args:
        form: name of the form, a key of `COMMAND_FORMS`.
        times: (T,) sample times from zero, s.
        step: sampling interval, s.
        rng: random numbers of forms with random phases or levels.
    """
    run_fraction = times / (times[-1] or 1.0)
    if form == "ramps up and down":
        # One period of a triangle wave.
        return np.asarray(2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * run_fraction)))
    if form == "holds":
        # Levels alternate with a large change each time, so that friction becomes visible.
        levels = np.array([0.0, 1.0, -1.0, 0.5, -0.5, 0.25])
        level_indices = (run_fraction * levels.size).astype(np.intp)
        # The last sample, at the fraction 1, has the last level.
        return levels[np.minimum(level_indices, levels.size - 1)]
    if form == "a push, then zero input":
        return np.where(run_fraction < RELEASE_SHARE, 1.0, 0.0)
    seconds = float(times[-1])
    # In Hz. The slow frequency has one cycle in the run, but is 0.1 to 0.5 Hz. The fast one has at
    # least ten samples in a cycle, but is at most 8 Hz.
    slow_frequency = min(max(1.0 / max(seconds, step), 0.1), 0.5)
    fast_frequency = max(
        min(MAX_PROBE_FREQUENCY, MAX_CYCLES_PER_SAMPLE / step), 2.0 * slow_frequency
    )
    formula = COMMAND_FORMS[form].format(
        slow=slow_frequency, middle=min(1.0, 0.5 * fast_frequency), fast=fast_frequency
    )
    return evaluate_signal(formula, times, rng)


CHANGED_STATE_FACTORS = (0.3, 2.0, -1.0)
"""Factors of an initial state that are tried."""
MIN_DROP_HEIGHT = 1.0
"""Minimum initial height in metres of a system that bounces."""
INPUT_FACTORS = (0.3, 3.0)
"""Factors of an input that are tried."""
ROBOT_INPUTS = (0.3, 2.0)
"""Factors of a robot's input that are tried: it may be driven at most twice as hard as before."""
MIN_INPUT_FACTOR = 1.1
"""Minimum factor by which an input must change, up or down, to be a different run."""


class ChangedRun(NamedTuple):
    """Candidate run that could be recorded."""

    says: str
    change: dict[str, float]
    scenario: Scenario
    states: Array


def iterate_changed_runs(evaluator: RunEvaluator) -> Iterator[ChangedRun]:
    """Yield runs like the first recorded one with one changed duration, initial state or input.

    An experimenter can make each of these changes. If several runs discriminate two models equally
    well, the first one is proposed.

    Args:
        evaluator: evaluator of the recorded runs.
    """
    limits = read_model_file_limits(evaluator)
    first = _get_first_run(evaluator, limits)
    yield _lengthen_run(first)
    yield from _change_initial_states(evaluator, first, limits)
    yield from _scale_inputs(evaluator, first, limits)


def _get_first_run(evaluator: RunEvaluator, limits: StatedLimits) -> ChangedRun:
    """Return the first fitted run, as the basis of the proposals.

    A robot starts at rest, because it cannot be started in motion, and with commands and positions
    within their limits.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        limits: limits of the model file; empty for a system.
    """
    run_data = evaluator.prepared_runs[0]
    if not evaluator.kind.has_model:
        return ChangedRun("", {}, run_data.scenario, run_data.initial_state_guess)
    recorded_inputs = run_data.scenario.inputs
    inputs = {
        name: _clip(values, limits.commands.get(name)) for name, values in recorded_inputs.items()
    }
    is_limited = any((inputs[name] != values).any() for name, values in recorded_inputs.items())
    limit_note = ", with commands limited as the model file states" if is_limited else ""
    scenario = replace(run_data.scenario, inputs=inputs)
    return ChangedRun(limit_note, {}, scenario, _get_rest_state(evaluator, limits))


def _get_rest_state(evaluator: RunEvaluator, limits: StatedLimits) -> Array:
    """Return the initial state (s,) of the first run, at rest and within joint ranges.

    All rates are zero, because a robot cannot be started in motion.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        limits: limits of the model file; empty for a system.
    """
    rates = set(evaluator.simulator.system.rates)
    guess = evaluator.prepared_runs[0].initial_state_guess
    return np.array(
        [
            0.0 if name in rates else _clip(value, limits.positions.get(name))
            for name, value in zip(evaluator.state_names, guess, strict=True)
        ]
    )


def _clip(values: Any, limits: Interval | None) -> Any:
    """Clip a number or an array to an interval.

    Args:
        values: number or array.
        limits: lower and upper end; None for no limit.
    """
    return values if limits is None else np.clip(values, *limits)


def _lengthen_run(first: ChangedRun) -> ChangedRun:
    """Return the run recorded for twice the time, with its inputs repeated from the beginning.

    Args:
        first: Run to lengthen.
    """
    times = first.scenario.times
    later_times = times[1:] - times[0]
    doubled_times = np.concatenate([times, times[-1] + later_times])
    # The last sample of the run is the first one of its repetition.
    inputs = {
        name: np.concatenate([signal, signal[1:]]) for name, signal in first.scenario.inputs.items()
    }
    scenario = replace(first.scenario, times=doubled_times, inputs=inputs)
    change = {"seconds": float(doubled_times[-1] - doubled_times[0])}
    return ChangedRun(f"Record twice as long{first.says}", change, scenario, first.states)


def _change_initial_states(
    evaluator: RunEvaluator, first: ChangedRun, limits: StatedLimits
) -> Iterator[ChangedRun]:
    """Yield runs that differ from a recorded run in one initial state.

    A state is multiplied by several factors; a state near zero gets the factors as values. The
    initial velocities of a robot are not changed, because it starts at rest. A bouncing body is
    released at least `MIN_DROP_HEIGHT` above the ground; its height is the last coordinate.

    Args:
        evaluator: evaluator of the recorded runs.
        first: recorded run that is changed.
        limits: limits of the model file; empty for a system.
    """
    system = evaluator.simulator.system
    height_index = len(system.coordinates) - 1
    states_with_units = zip(evaluator.state_names, _list_state_units(evaluator), strict=True)
    for index, (name, unit) in enumerate(states_with_units):
        is_height = system.bounces and index == height_index
        if evaluator.kind.has_model and name not in system.coordinates:
            continue
        first_value = float(first.states[index])
        for factor in CHANGED_STATE_FACTORS:
            # A body cannot be released below the ground.
            if is_height and factor < 0:
                continue
            value = factor * first_value if abs(first_value) > REST_STATE else factor
            if is_height:
                value = max(value, MIN_DROP_HEIGHT)
            value = float(_clip(value, limits.states.get(name)))
            initial_state = first.states.copy()
            initial_state[index] = value
            description = f"Start with {name} = {value:.3g} {unit}{first.says}"
            yield ChangedRun(description, {name: value}, first.scenario, initial_state)


def _scale_inputs(
    evaluator: RunEvaluator, first: ChangedRun, limits: StatedLimits
) -> Iterator[ChangedRun]:
    """Yield runs that differ from a recorded run in the amplitude of one input.

    Inputs that are zero throughout are not scaled. An input is never scaled beyond the limits of
    its command: a factor that would exceed them is replaced by the largest possible one. Factors
    near one are left out, because they change too little.

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
            yield ChangedRun(description, {name: factor}, scenario, first.states)


def _compute_largest_factor(signal: Array, limits: Interval) -> float:
    """Return the largest factor that keeps a signal within its limits, rounded down.

    It is infinite if nothing limits the signal. It has three decimals, as such a factor is easy to
    set.

    Args:
        signal: (T,) samples of an input.
        limits: lower and upper limit, in the unit of the signal; infinite for no limit.
    """
    extremes = float(signal.min()), float(signal.max())
    # The smallest value is compared with the lower limit, the largest one with the upper limit. No
    # positive factor reaches a limit of the opposite sign.
    factors = [
        limit / extreme
        for extreme, limit in zip(extremes, limits, strict=True)
        if np.isfinite(limit) and extreme * limit > 0
    ]
    return float(np.floor(1e3 * min(factors)) / 1e3) if factors else np.inf


def _list_state_units(evaluator: RunEvaluator) -> list[str]:
    """List the units of the states: coordinates, their rates, and further states.

    Args:
        evaluator: Run evaluator of the system.
    """
    system = evaluator.simulator.system
    units = {channel.name: channel.unit for channel in evaluator.kind.channels}
    # A coordinate that is not a channel has no stated unit; metres are assumed.
    coordinate_units = [units.get(name, "m") for name in system.coordinates]
    rate_units = [f"{unit}/s" for unit in coordinate_units]
    # A user-defined system may have further states after the rates, in any unit.
    further_states = system.rates[len(coordinate_units) :]
    further_units = [units.get(name, "SI") for name in further_states]
    return [*coordinate_units, *rate_units, *further_units]
