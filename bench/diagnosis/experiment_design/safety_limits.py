"""Limits of an experimental setup: reject runs that exceed limits of position, speed or force.

Runs are also rejected if bodies touch that did not touch before. The runs are simulated, and all
moving channels are monitored, whether they are recorded or not.

A limit of the model file holds whatever the present runs did. An MJCF specifies joint ranges, force
limits of joints (`actuatorfrcrange`), control ranges and force ranges of actuators. A URDF
specifies joint ranges, efforts and velocities; MuJoCo does not compile the velocities, so they are
read from the file (`urdf_loading.read_velocity_limits`). Where the file specifies no limit, it
follows from the values in the present runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.logs.quality.pose_check import find_contacts
from sims.core.simulator import Array, Scenario

if TYPE_CHECKING:
    from bench.diagnosis.experiment_design.candidate_runs import CandidateRun

Interval = tuple[float, float]
UNLIMITED: Interval = (-np.inf, np.inf)
TRAVEL_FACTOR = 3.0
"""Distance by which a channel without a specified limit may leave its present range, as a multiple
of that range.
"""
SPEED_AND_FORCE_FACTOR = 2.0
"""Maximum speed and force of a robot's joint without a specified limit, as a multiple of the
present maximum.
"""
STOP_SHARE = 0.01
"""Share of its range by which a joint may press into its stop if it did so in the present runs:
stops are soft in MuJoCo.
"""
IDLE_JOINT_SHARE = 0.1
"""Minimum value used as the present maximum speed and force of a joint that was at rest, as a share
of the maximum over all joints.
"""
ROUNDING_TOLERANCE = 1e-9
"""Distance beyond a limit that counts as rounding, relative to the larger limit."""


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
        actuators = [actuator for actuator in robot.actuators if actuator.joint == name]
        if joint.effort is not None:
            forces[f"tau.{name}"] = _get_effort_limit(robot, joint)
        elif actuators and all(actuator.force is not None for actuator in actuators):
            forces[f"tau.{name}"] = UNLIMITED
    commands = {
        f"u.{actuator.name}": _compute_command_range(robot, actuator)
        for actuator in robot.actuators
    }
    commands |= {f"force.{name}": _get_effort_limit(robot, joint) for name, joint in joints.items()}
    return StatedLimits(
        commands={name: interval for name, interval in commands.items() if interval != UNLIMITED},
        positions={f"q.{name}": joint.range for name, joint in joints.items() if joint.range},
        velocities={
            f"qd.{name}": (-speed, speed) for name, speed in robot.speeds.items() if name in joints
        },
        forces=forces,
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
        # All motors of the joint may act at the same time with this control.
        motor_count = sum(
            other.joint == joint.name and other.kind == "motor" for other in robot.actuators
        )
        control_interval = _divide_interval(
            _get_effort_limit(robot, joint), gear * gain * motor_count
        )
        return _intersect(interval, control_interval)
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
    """Intersect two intervals; return the first if they are disjoint."""
    (first_low, first_high), (second_low, second_high) = first, second
    low, high = max(first_low, second_low), min(first_high, second_high)
    return (low, high) if low <= high else first


def _multiply_interval(interval: Interval | None, factor: float) -> Interval:
    """Multiply an interval by a factor; unlimited without an interval or with a zero factor."""
    if interval is None or not factor:
        return UNLIMITED
    low, high = sorted(factor * end for end in interval)
    return low, high


def _divide_interval(interval: Interval | None, divisor: float) -> Interval:
    """Return an interval divided by a number; unlimited if the number is zero.

    Args:
        interval: lower and upper end; None for no limit.
        divisor: the number, such as a gear ratio; a negative one swaps the ends.
    """
    return _multiply_interval(interval, 1.0 / divisor) if divisor else UNLIMITED


class RigLimits:
    """Check of which runs an experimental setup can execute.

    Args:
        evaluator: Run evaluator of the present runs.
        model: Model fitted to them.
    """

    def __init__(self, evaluator: RunEvaluator, model: FittedModel) -> None:
        """Simulate the present runs with the fitted model, and derive the channel limits.

        `present_runs` has the simulated channels of each present run, (T,) by name, and `bounds`
        the lowest and highest value that a proposed run may have, by channel.
        """
        self.evaluator = evaluator
        fitted_states = model.fit.initial_states
        self.present_runs = self._simulate_monitored_channels(
            model,
            [run_data.scenario for run_data in evaluator.prepared_runs],
            # NaN where a state is not estimated.
            np.where(np.isfinite(fitted_states), fitted_states, evaluator.initial_state_guesses),
        )
        self.bounds = self._determine_bounds()

    def __call__(self, model: FittedModel, runs: Sequence[CandidateRun]) -> list[bool]:
        """Return for each run whether it stays within the limits if a model is true.

        Args:
            model: Model with which the runs are simulated.
            runs: Candidate runs.
        """
        if not runs:
            return []
        states = np.array([run.states for run in runs])
        simulated_channels = self._simulate_monitored_channels(
            model, [run.scenario for run in runs], states
        )
        return [self._is_within_limits(channels) for channels in simulated_channels]

    # -- monitored channels

    @cached_property
    def monitored_channels(self) -> list[str]:
        """Names of the monitored channels.

        For a robot they are positions, velocities and forces of joints; otherwise coordinates,
        rates and observed channels.
        """
        kind = self.evaluator.kind
        if kind.has_model:
            names = {
                f"{quantity}.{joint.name}"
                for joint in self._single_coordinate_joints
                for quantity in ("q", "qd", "tau")
            }
        else:
            names = {*kind.system.coordinates, *kind.system.rates, *self.evaluator.channels}
        return [channel.name for channel in kind.channels if channel.name in names]

    @property
    def _single_coordinate_joints(self) -> list[Any]:
        """The joints of the robot with one coordinate."""
        robot: Any = self.evaluator.kind
        return [joint for joint in robot.robot.joints if joint.has_one_coordinate]

    def _simulate_monitored_channels(
        self, model: FittedModel, scenarios: Sequence[Scenario], states: Array
    ) -> list[Mapping[str, Array]]:
        """Simulate runs with a model, and return all channels that have limits, (T,) by name.

        Channels that are not recorded are simulated too, because a run can damage a robot at a
        joint without a sensor.

        Shapes: T samples, s states of a run.

        Args:
            model: fitted model with which the runs are simulated.
            scenarios: R runs that could be recorded.
            states: (R, s) initial states of these runs.
        """
        evaluator = self.evaluator
        values = {
            parameter.name: float(value)
            for parameter, value in zip(evaluator.parameters, model.fit.theta, strict=True)
        }
        # The simulator of the fit returns the recorded channels only.
        simulator = evaluator.make_observing_simulator(self.monitored_channels, model.effects)
        try:
            theta = np.array([[values.get(p.name, 0.0) for p in simulator.parameters]])
            # Constants that the fit estimated as parameters.
            freed_constants = {c.name: values[c.name] for c in evaluator.freed_constants}
            model_scenarios = [
                replace(scenario, constants={**scenario.constants, **freed_constants})
                for scenario in scenarios
            ]
            initial = dict(zip(evaluator.state_names, states.T, strict=True))
            result = simulator.simulate_batch(
                np.repeat(theta, len(model_scenarios), 0), model_scenarios, initial
            )
        finally:
            simulator.close()
        evaluator.simulation_count += len(model_scenarios)
        names = [channel.name for channel in simulator.channels]
        # The batch is padded to the longest run.
        return [
            dict(zip(names, channel_values[: scenario.times.size].T, strict=True))
            for channel_values, scenario in zip(result, model_scenarios, strict=True)
        ]

    # -- limits

    def _determine_bounds(self) -> dict[str, tuple[float, float]]:
        """Determine the allowed range of each monitored channel.

        1. A system: the range of the present runs, widened.
        2. A robot: the limit of the model file if it states one.
        3. Otherwise, for positions, the range of the present runs, widened; for speeds and forces,
           a multiple of the largest value in these runs.
        """
        present_ranges = {}
        for name in self.monitored_channels:
            values = np.concatenate([run[name] for run in self.present_runs])
            values = values[np.isfinite(values)]
            present_ranges[name] = (
                (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
            )
        scales = {channel.name: channel.scale for channel in self.evaluator.kind.channels}
        # 1. A system.
        if not self.evaluator.kind.has_model:
            return {
                name: _widen_range(*present_range, scales[name])
                for name, present_range in present_ranges.items()
            }
        stated_limits = read_model_file_limits(self.evaluator).channels
        bounds = {}
        for name, (low, high) in present_ranges.items():
            quantity = name.partition(".")[0]
            # 2. Limits of the model file.
            if name in stated_limits:
                bounds[name] = _widen_by_stop(stated_limits[name], (low, high), quantity == "q")
            # 3. Limits of the present runs.
            elif quantity == "q":
                bounds[name] = _widen_range(low, high, scales[name])
            else:
                # A joint that hardly moved may be as fast as a share of the fastest joint.
                largest_of_all = max(
                    max(map(abs, present_range))
                    for other_name, present_range in present_ranges.items()
                    if other_name.startswith(quantity)
                )
                limit = SPEED_AND_FORCE_FACTOR * max(
                    abs(low), abs(high), IDLE_JOINT_SHARE * largest_of_all
                )
                bounds[name] = -limit, limit
        return bounds

    def _is_within_limits(self, channels: Mapping[str, Array]) -> bool:
        """Return whether a simulated run stays within the limits of all monitored channels.

        A run of a robot must also not touch bodies that did not touch each other in the present
        runs.

        Args:
            channels: (T,) simulated values by channel. A run with NaN or infinity is rejected.
        """
        for name, values in channels.items():
            if not np.isfinite(values).all():
                return False
            low, high = self.bounds[name]
            is_limited = np.isfinite([low, high]).all()
            tolerance = ROUNDING_TOLERANCE * max(abs(low), abs(high)) if is_limited else 0.0
            if values.min() < low - tolerance or values.max() > high + tolerance:
                return False
        return (
            not self.evaluator.kind.has_model
            or find_contacts(self.evaluator.kind, channels) <= self._touching_pairs
        )

    @cached_property
    def _touching_pairs(self) -> frozenset[tuple[int, int]]:
        """Pairs of bodies that touched in the present runs."""
        return frozenset().union(
            *(find_contacts(self.evaluator.kind, run) for run in self.present_runs)
        )


def _widen_by_stop(stated_range: Interval, present_range: Interval, is_position: bool) -> Interval:
    """Return the limits of the model file, with a position range widened a little if necessary.

    It is widened to the range of the present runs, but at each end by at most `STOP_SHARE` of the
    range, because a joint may have been pressed into its soft stop.

    Args:
        stated_range: lower and upper limit of the model file.
        present_range: smallest and largest value in the present runs.
        is_position: whether the channel is a position.
    """
    if not is_position:
        return stated_range
    (low, high), (present_low, present_high) = stated_range, present_range
    max_widening = STOP_SHARE * (high - low)
    return (
        max(min(low, present_low), low - max_widening),
        min(max(high, present_high), high + max_widening),
    )


def _widen_range(low: float, high: float, scale: float) -> tuple[float, float]:
    """Return a range with the allowed margin at both ends.

    Args:
        low: lower end of the recorded range.
        high: upper end of the recorded range.
        scale: minimum size of the range from which the margin is computed.
    """
    margin = TRAVEL_FACTOR * max(high - low, scale)
    return low - margin, high + margin
