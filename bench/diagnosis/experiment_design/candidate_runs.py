"""Candidate runs that could be recorded next, within the limits that a model file specifies.

An MJCF specifies joint ranges, force limits of joints (`actuatorfrcrange`), control ranges and
force ranges of actuators. A URDF specifies joint ranges, efforts and velocities; MuJoCo does not
compile the velocities, so they are read from the file (`urdf_loading.read_velocity_limits`).

A plan sets the driven inputs, the form, size and offset of the command, the initial state, the
constants (such as a load) and the sampling rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bench.core.input_signals import evaluate_signal
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array, Scenario

Interval = tuple[float, float]
UNLIMITED: Interval = (-np.inf, np.inf)
MAX_PROBE_FREQUENCY = 8.0
"""Largest frequency of a proposed command, Hz."""
MAX_CYCLES_PER_SAMPLE = 0.1
"""Largest frequency of a proposed command, in cycles per sample interval."""


@dataclass(frozen=True)
class StatedLimits:
    """Limits of a robot's model file; empty for a system without one.

    Attributes:
        commands: Minimum and maximum of each limited input, in its unit. The command of a joint's
            actuator respects its control range and the limits of the joint: a torque respects
            effort and force range, a set point the joint's range or velocity.
        positions: Limits of joints by channel ``q.JOINT``, in rad or m.
        velocities: Limits of joints by channel ``qd.JOINT``, in rad/s or m/s.
        forces: Limits of joints by channel ``tau.JOINT``, in N m or N; infinite if the simulation
            itself limits the force of every actuator of the joint.
    """

    commands: Mapping[str, Interval] = field(default_factory=dict)
    positions: Mapping[str, Interval] = field(default_factory=dict)
    velocities: Mapping[str, Interval] = field(default_factory=dict)
    forces: Mapping[str, Interval] = field(default_factory=dict)

    @property
    def states(self) -> Mapping[str, Interval]:
        """Limits of positions and velocities, by name of the state."""
        return {**self.positions, **self.velocities}

    @property
    def channels(self) -> Mapping[str, Interval]:
        """Limits of all channels, by name."""
        return {**self.states, **self.forces}


def read_model_file_limits(evaluator: RunEvaluator) -> StatedLimits:
    """Read the limits of commands, positions, velocities and forces from a robot's model file.

    Proposed runs must stay within them. A system without a model file has none. A force is
    unlimited here if the simulation itself limits that of every actuator of the joint.

    Args:
        evaluator: Evaluator of the recorded runs.
    """
    if not evaluator.kind.has_model:
        return StatedLimits()
    kind: Any = evaluator.kind
    robot = kind.robot
    joints = {joint.name: joint for joint in robot.joints if joint.has_one_coordinate}
    forces = {}
    for name, joint in joints.items():
        drives = [actuator for actuator in robot.actuators if actuator.joint == name]
        if joint.effort is not None:
            forces[f"tau.{name}"] = _get_effort_limit(robot, joint)
        elif drives and all(actuator.force is not None for actuator in drives):
            forces[f"tau.{name}"] = UNLIMITED
    commands = {
        f"u.{actuator.name}": _compute_command_range(robot, actuator)
        for actuator in robot.actuators
    }
    commands |= {f"force.{name}": _get_effort_limit(robot, joint) for name, joint in joints.items()}
    return StatedLimits(
        {name: interval for name, interval in commands.items() if interval != UNLIMITED},
        {f"q.{name}": joint.range for name, joint in joints.items() if joint.range},
        {f"qd.{name}": (-v, v) for name, v in robot.speeds.items() if name in joints},
        forces,
    )


def _compute_command_range(robot: Any, actuator: Any) -> Interval:
    """Compute the range of an actuator's command that respects all limits of actuator and joint.

    It is in the unit of the command: a force for a motor, a position or velocity for a servo.
    Limits of the joint are converted by gear and gain.

    Args:
        robot: model of the robot.
        actuator: actuator whose command is limited.
    """
    interval = actuator.range or UNLIMITED
    if actuator.joint is None:
        return interval
    joint = robot.joint(actuator.joint)
    gear = float(robot.compiled.actuator_gear[actuator.id, 0])
    if actuator.kind == "motor":
        # The actuator force is gain times control, and the joint force is gear times actuator
        # force.
        gain = float(robot.compiled.actuator_gainprm[actuator.id, 0])
        interval = _intersect(interval, _divide_interval(actuator.force, gain))
        # Several motors of a joint may act at the same time.
        motors = [a for a in robot.actuators if a.joint == joint.name and a.kind == "motor"]
        force_per_control = gear * gain * len(motors)
        return _intersect(
            interval, _divide_interval(_get_effort_limit(robot, joint), force_per_control)
        )
    # The set point of a servo is the gear times the desired value at the joint.
    if actuator.kind in ("position", "pid"):
        interval = _intersect(interval, _multiply_interval(joint.range, gear))
    elif actuator.kind == "velocity" and joint.name in robot.speeds:
        speed = robot.speeds[joint.name]
        interval = _intersect(interval, _multiply_interval((-speed, speed), gear))
    return interval


def _get_effort_limit(robot: Any, joint: Any) -> Interval:
    """Return the interval of the effort of all actuators on a joint, in N or N·m.

    A proposed run must not ask for more than the joint's limit. It is unlimited if the model file
    states no limit of the effort (``actuatorfrcrange`` in MJCF, ``effort`` in URDF).

    Args:
        robot: model of the robot.
        joint: the joint.
    """
    if joint.effort is None:
        return UNLIMITED
    # `joint.effort` is only the upper limit; the compiled model has both.
    low, high = robot.compiled.jnt_actfrcrange[joint.id].tolist()
    return low, high


def _intersect(first: Interval, second: Interval) -> Interval:
    """Intersect two intervals; return the first if they are disjoint.

    Args:
        first: an interval.
        second: another one.
    """
    low, high = max(first[0], second[0]), min(first[1], second[1])
    return (low, high) if low <= high else first


def _multiply_interval(interval: Interval | None, factor: float) -> Interval:
    """Multiply an interval by a factor; unlimited without an interval or with a zero factor."""
    if interval is None or not factor:
        return UNLIMITED
    low, high = sorted((interval[0] * factor, interval[1] * factor))
    return low, high


def _divide_interval(interval: Interval | None, divisor: float) -> Interval:
    """Return an interval divided by a number; unlimited if the number is zero.

    Args:
        interval: lower and upper end; None for no limit.
        divisor: the number, such as a gear ratio; a negative one swaps the ends.
    """
    return _multiply_interval(interval, 1.0 / divisor) if divisor else UNLIMITED


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
HOLD_LEVEL_COUNT = 6
"""Number of levels in a run of holds."""


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
        self.initial_state = self._get_initial_state()

    def _get_initial_state(self) -> Array:
        """Return the initial state of the first run, at rest and within joint ranges.

        A robot cannot be started in motion.
        """
        states = self.evaluator.prepared_runs[0].initial_state_guess.copy()
        rates = set(self.evaluator.simulator.system.rates)
        for state_index, name in enumerate(self.evaluator.state_names):
            states[state_index] = (
                0.0
                if name in rates
                else self._clip_to_joint_range(name, float(states[state_index]))
            )
        return states

    def _clip_to_joint_range(self, name: str, value: float) -> float:
        """Clip a state to the range of its joint.

        Args:
            name: name of the state, such as ``q.elbow``.
            value: value in rad or m.
        """
        return float(np.clip(value, *self.limits.positions.get(name, UNLIMITED)))

    # -- plans

    def list_basic_plans(self) -> Iterator[RunPlan]:
        """Yield plans of every form and size, for each input alone and for all together.

        Plans that only release the system from other initial states are included.
        """
        for state in self._iterate_initial_states():
            yield RunPlan(states=(state,))
        groups = [(name,) for name in self.driven_inputs]
        for input_groups in [*groups, self.driven_inputs] if len(groups) > 1 else groups:
            for size in COMMAND_SIZE_FACTORS:
                for form in COMMAND_FORMS:
                    yield RunPlan(input_groups, form, size)

    def list_variants(self, plan: RunPlan) -> Iterator[RunPlan]:
        """Yield variants of a plan with one property changed, to improve the best plans.

        Properties are initial states, constants, offset and size of the commands, and the time for
        which a command is held.

        Args:
            plan: Plan of a run.
        """
        for name, value in self._iterate_initial_states():
            yield replace(plan, states=tuple((dict(plan.states) | {name: value}).items()))
        for name, values in self._list_adjustable_constants().items():
            other_constants = tuple(pair for pair in plan.constants if pair[0] != name)
            for value in values:
                yield replace(plan, constants=(*other_constants, (name, value)))
        if plan.driven_inputs:
            for level in COMMAND_OFFSET_FACTORS:
                yield replace(plan, level=level)
            for size in COMMAND_SIZE_FACTORS:
                yield replace(plan, size=size)
        for hold_factor in HOLD_FACTORS:
            if self.seconds / (self.step * hold_factor) >= MIN_SAMPLES:
                yield replace(plan, hold_factor=hold_factor)

    def _iterate_initial_states(self) -> Iterator[tuple[str, float]]:
        """Yield other initial states for a proposed run, each as the name of a state and its value.

        They are multiples of the recorded initial coordinates. Except for robots, which start at
        rest, they are also the largest initial rates that were recorded, in both directions. States
        that are specified in all runs are not changed.
        """
        system, evaluator = self.evaluator.simulator.system, self.evaluator
        known_states = {
            evaluator.state_names[i] for i in np.flatnonzero(evaluator.known_state_mask.all(axis=0))
        }
        for name in system.coordinates:
            usual_value = float(self.initial_state[evaluator.state_names.index(name)])
            values = [
                share * usual_value if abs(usual_value) > REST_STATE else share
                for share in INITIAL_STATE_FACTORS
            ]
            # Outside its range a joint begins at the limit, which is tried only once.
            reachable_values = dict.fromkeys(
                self._clip_to_joint_range(name, value) for value in values
            )
            for value in reachable_values if name not in known_states else ():
                yield name, value
        if evaluator.kind.has_model:
            return
        for name in system.rates:
            fastest = float(
                np.abs(evaluator.initial_state_guesses[:, evaluator.state_names.index(name)]).max()
            )
            for value in (
                (fastest, -fastest) if fastest > REST_RATE and name not in known_states else ()
            ):
                yield name, value

    def _list_adjustable_constants(self) -> dict[str, list[float]]:
        """Return the constants that differ between runs, with their values, which are available.

        A constant that has had several values, such as a load, can be set by the experimenter.
        """
        values: dict[str, set[float]] = {}
        for run in self.evaluator.runs:
            for name, value in run.constants.items():
                values.setdefault(name, set()).add(value)
        return {
            name: sorted(values_of_constant)
            for name, values_of_constant in values.items()
            if len(values_of_constant) > 1
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
            name: self._limit_command(name, np.full(times.size, self.median_commands[name]))
            for name in self.recorded_scenario.inputs
        }
        initial_state = self.initial_state.copy()
        # 2. Signals of the driven inputs.
        limited_inputs = []
        for number, name in enumerate(plan.driven_inputs):
            signal = plan.size * _compute_command(
                plan.form, times, self.step, np.random.default_rng(number)
            )
            command = self.median_commands[name] + self.largest_commands[name] * (
                signal + plan.level
            )
            inputs[name] = self._limit_command(name, command)
            limited_inputs += [name] if (inputs[name] != command).any() else []
        # 3. Initial states and constants.
        for name, value in plan.states:
            initial_state[self.evaluator.state_names.index(name)] = value
        constants = {**self.recorded_scenario.constants, **dict(plan.constants)}
        scenario = replace(self.recorded_scenario, times=times, inputs=inputs, constants=constants)
        return CandidateRun(
            plan, self._describe_plan(plan, inputs, limited_inputs), scenario, initial_state
        )

    def _limit_command(self, name: str, values: Array) -> Array:
        """Clip a command to the limits of its actuator and its joint.

        Args:
            name: name of the input.
            values: (T,) command in the unit of the input.
        """
        return np.asarray(np.clip(values, *self.limits.commands.get(name, UNLIMITED)))

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
            text = "release"
        if plan.level:
            medians = [f"{name} = {np.median(inputs[name]):.3g}" for name in plan.driven_inputs]
            text += f", about {', '.join(medians)}"
        for name in limited_inputs:
            low, high = self.limits.commands[name]
            text += f", {name} limited to {low:.4g} to {high:.4g}"
        initial_texts = [f"{name} = {value:.3g}" for name, value in plan.states]
        text += f", from {', '.join(initial_texts)}" if initial_texts else ""
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
        form: name of the form, a key of `COMMAND_FORMS`, or one of those that are computed here.
        times: (T,) sample times from zero, s.
        step: sampling interval, s.
        rng: random numbers of forms with random phases or levels.
    """
    run_fraction = times / (times[-1] or 1.0)
    if form == "ramps up and down":
        return np.asarray(2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * run_fraction)))
    if form == "holds":
        # Levels alternate with a large change each time, so that friction becomes visible.
        levels = np.array([0.0, 1.0, -1.0, 0.5, -0.5, 0.25])
        return levels[
            np.minimum((run_fraction * HOLD_LEVEL_COUNT).astype(np.intp), HOLD_LEVEL_COUNT - 1)
        ]
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
