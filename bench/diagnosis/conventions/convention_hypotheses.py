"""Hypotheses on how the conventions of a robot's log differ from those of its model file.

Each hypothesis transforms the recorded signals to the conventions of the model. It changes a sign,
a zero position, a unit or the order of joints, restores whole turns, or shifts commands in time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from bench.diagnosis.conventions.signal_changes import SignalChange, advance_inputs, change_signals
from bench.diagnosis.conventions.unit_check import UNITS, UNITS_IN_WORDS, DescribedSignal, Subject
from bench.logs.importing.joint_order import find_order_by_variance
from bench.logs.importing.normalised_positions import compute_range_scale
from sims.core.simulator import Array
from sims.core.user_messages import join_first_names
from sims.recording.recording import Recording

TRIED_ZERO_OFFSETS = (
    np.array([-120.0, -70.0, -35.0, -15.0, 15.0, 35.0, 70.0, 120.0, 180.0]) * math.pi / 180.0
)
"""Offsets of a zero position that are tried, in rad; the best one is refined."""
MIN_OFFSET = 0.1
"""Minimum offset of a zero position that counts as a convention, in rad. Smaller offsets are errors
of calibration and assembly, which are causes.
"""
LATE_SAMPLES = (1, 2, 3, 4, 5, 6, 8)
"""Delays of command time stamps that are tried, in samples."""
TICKS_PER_TURN = (4096.0, 4095.0, 8192.0, 16384.0, 65536.0, 1024.0, 1023.0)
"""Common encoder resolutions, in ticks per turn."""
NORMALISED_RANGE = 100.0
"""Upper end of positions that are normalised to the range of a joint."""
WRAP_JUMP = 1.5 * math.pi
"""Minimum difference of successive positions that indicates a wrapped position, in rad."""
MAX_NAMED = 4
"""Maximum number of signals that a sentence names."""
QUANTITIES = ("q", "qd", "tau")
"""Prefixes of the channels of a joint: position, velocity, torque."""
SAME_UNIT_TOLERANCE = 1e-6
"""Relative difference of two factors up to which they are the same unit."""
INTEGER_TOLERANCE = 1e-6
"""Distance of a recorded value from an integer up to which it may be a count of encoder ticks."""


@dataclass(frozen=True)
class ConventionHypothesis:
    """Convention that may differ.

    Attributes:
        description: Sentence without its final period.
        changes: Signals that differ, by their name in the model.
        unit: Unit of the recorded values, if only the specified unit is wrong.
        has_free_offset: Whether the offsets of all changes are one unknown angle.
        late: Delay of the command time stamps, in s.
    """

    description: str
    changes: Mapping[str, SignalChange] = field(default_factory=dict)
    unit: str | None = None
    has_free_offset: bool = False
    late: float = 0.0

    @property
    def size(self) -> int:
        """Number of signals that differ."""
        return len(self.changes) + (self.late != 0.0)

    def applied(self, recording: Recording) -> Recording:
        """Return the recording with its signals in the conventions of the model.

        The initial states are dropped if a signal changes, because they were stated in the old
        convention. If the command time stamps are late, the commands are moved to earlier times.

        Args:
            recording: recording with the conventions of its description.
        """
        changed = change_signals(recording, self.changes)
        runs = [replace(run, initial={}) if self.changes else run for run in changed.runs]
        if self.late:
            runs = [advance_inputs(run, self.late) for run in runs]
        return replace(changed, runs=tuple(runs))

    def add_offset_step(self, step: float) -> ConventionHypothesis:
        """Return the hypothesis with a step in rad added to its offsets."""
        changes = {
            name: replace(change, offset=change.offset + step)
            for name, change in self.changes.items()
        }
        return replace(self, changes=changes)


@dataclass(frozen=True)
class JointSignals:
    """Joint and its recorded signals.

    Attributes:
        name: Name of the joint.
        channels: Names of recorded channels by quantity: ``q``, ``qd``, ``tau``.
        inputs: Names of the inputs of its actuators.
        servo_inputs: Names of the inputs of its position servos.
        range: Limits of its position, in rad or m; None if the model specifies none.
        is_hinge: Whether it is a hinge joint.
    """

    name: str
    channels: Mapping[str, str]
    inputs: tuple[str, ...]
    servo_inputs: tuple[str, ...]
    range: tuple[float, float] | None
    is_hinge: bool


def list_recorded_joints(subject: Subject) -> list[JointSignals]:
    """Collect for each joint of a robot its recorded channels, inputs and position range.

    The order is that of the coordinates of the robot.

    Args:
        subject: Recording and its robot.
    """
    kind: Any = subject.kind
    run = subject.recording.runs[0]
    units = {channel.name: channel.unit for channel in kind.channels}
    joints = []
    for coordinate in kind.system.coordinates:
        name = coordinate.removeprefix("q.")
        names_by_quantity = {quantity: f"{quantity}.{name}" for quantity in QUANTITIES}
        recorded_actuators = [
            actuator
            for actuator in kind.robot.actuators
            if actuator.joint == name and f"u.{actuator.name}" in run.inputs
        ]
        joints.append(
            JointSignals(
                name=name,
                channels={
                    q: channel
                    for q, channel in names_by_quantity.items()
                    if channel in run.channels
                },
                inputs=tuple(f"u.{actuator.name}" for actuator in recorded_actuators),
                servo_inputs=tuple(
                    f"u.{actuator.name}"
                    for actuator in recorded_actuators
                    if actuator.kind == "position"
                ),
                range=getattr(kind.robot.joint(name), "range", None),
                is_hinge=units.get(coordinate) == "rad",
            )
        )
    return joints


class HypothesisGenerator:
    """Generator of hypotheses on the conventions of a recording.

    Args:
        subject: Recording of a robot.
    """

    def __init__(self, subject: Subject) -> None:
        channels = list(subject.recording.runs[0].channels)
        self.joints = [joint for joint in list_recorded_joints(subject) if joint.channels]
        self._signals = {signal.name: signal for signal in subject.signals(channels)}

    def generate(
        self, recording: Recording, suspects: Sequence[JointSignals]
    ) -> Iterator[ConventionHypothesis]:
        """Yield hypotheses about the conventions of the log, those about the whole log first.

        1. Units of the whole log, if at least half of the joints are suspects.
        2. Commands that are recorded late.
        3. Signs, zero positions and units of each suspect joint, and its wrapped angles.
        4. Orders of the joints.

        Args:
            recording: Recording as read, or with some conventions corrected.
            suspects: Joints that the model follows badly, whose own conventions are tested.
        """
        # 1. The whole log.
        suspects = [joint for joint in suspects if joint.channels]
        if 2 * len(suspects) >= len(self.joints):
            yield from self._generate_common_units(recording)
            yield from self._generate_normalised_positions()
        # 2. Late commands.
        yield from _generate_late_commands(recording)
        # 3. Single joints.
        for joint in suspects:
            yield from _generate_signs(joint)
            yield from _generate_zero_offsets(joint, recording)
            for name in dict.fromkeys((*joint.channels.values(), *joint.inputs)):
                yield from _generate_units([self._signals[name]], recording)
        yield from _generate_wrapped_angles(suspects, recording)
        # 4. Orders.
        yield from _generate_joint_orders(self.joints, recording, suspects)

    def _generate_common_units(self, recording: Recording) -> Iterator[ConventionHypothesis]:
        """Yield hypotheses that all positions, commands, velocities or torques have another unit.

        They are tried together only if the description states the same unit for all of them.

        Args:
            recording: Recording in the units of its description.
        """
        positions, velocities, torques = map(self._list_channels, QUANTITIES)
        commands = [name for joint in self.joints for name in joint.servo_inputs]
        for names in (positions, commands, [*positions, *commands], velocities, torques):
            signals = [self._signals[name] for name in names]
            if len({(s.si, s.specified_unit, s.gain) for s in signals}) == 1:
                yield from _generate_units(signals, recording)

    def _list_channels(self, quantity: str) -> list[str]:
        return [joint.channels[quantity] for joint in self.joints if quantity in joint.channels]

    def _generate_normalised_positions(self) -> Iterator[ConventionHypothesis]:
        """Yield hypotheses that positions and commands are shares of the range of each joint.

        The shares are in percent, from 0 to 100 or from -100 to 100, as LeRobot records them. Only
        joints with a range in the model are changed.
        """
        limited = [joint for joint in self.joints if joint.range and "q" in joint.channels]
        if not limited:
            return
        for low in (-NORMALISED_RANGE, 0.0):
            changes: dict[str, SignalChange] = {}
            for joint in limited:
                assert joint.range is not None
                # Gain and offset that turn a percentage into a position in rad or m.
                scale = compute_range_scale(*joint.range, from_zero=low == 0.0)
                for name in (joint.channels["q"], *joint.servo_inputs):
                    # The values were multiplied by the gain of the stated unit, which is undone.
                    factor = scale.gain / self._signals[name].gain
                    changes[name] = SignalChange(name, factor, scale.offset)
            yield ConventionHypothesis(
                f"positions and commands look normalised to {low:g} to {NORMALISED_RANGE:g} over "
                "the range of each joint",
                changes,
            )


def _generate_signs(joint: JointSignals) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses of a reversed sign at a joint.

    They are: position with velocity, the commands, velocity alone, torque alone, and the whole axis
    (all signals of the joint).

    Args:
        joint: joint with the names of its channels by quantity, and of its inputs.
    """
    positions = [joint.channels[q] for q in ("q", "qd") if q in joint.channels]
    groups = [positions, list(joint.inputs)]
    # A reversed velocity alone, or torque alone. A velocity without a position is the first group
    # already.
    single_channels = [[joint.channels[q]] for q in ("qd", "tau") if q in joint.channels]
    groups += [names for names in single_channels if names != positions]
    for names in groups:
        if names:
            text = f"the sign of {join_first_names(names, MAX_NAMED)} looks reversed"
            yield ConventionHypothesis(text, {name: SignalChange(name, -1.0) for name in names})
    if positions and joint.inputs:
        names = [*joint.channels.values(), *joint.inputs]
        text = f"the axis of joint {joint.name} looks reversed, command and position"
        yield ConventionHypothesis(text, {name: SignalChange(name, -1.0) for name in names})


def _generate_zero_offsets(
    joint: JointSignals, recording: Recording
) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses that the angle of a hinge is measured from another zero position.

    1. The position and the command of its servo have the same offset.
    2. The position alone has an offset.

    An offset is a free angle in rad: several are tried, and the best one is refined later. If the
    hinge has a servo, the offset of the position alone is estimated as the mean difference of
    command and position.

    The result is empty for a slide joint, or for a joint whose position is not recorded.

    Args:
        joint: joint with its recorded signals.
        recording: recording, of whose training runs the mean difference is taken.
    """
    position = joint.channels.get("q")
    if position is None or not joint.is_hinge:
        return
    # Without a servo, the fixed offsets are also tried for the position alone.
    tried_offsets = position_offsets = TRIED_ZERO_OFFSETS.tolist()
    # 1. Position and command.
    if joint.servo_inputs:
        text = f"joint {joint.name} looks counted from another zero, command and position"
        for offset in tried_offsets:
            names = (position, *joint.servo_inputs)
            changes = {name: SignalChange(name, 1.0, offset) for name in names}
            yield ConventionHypothesis(text, changes, has_free_offset=True)
        command = joint.servo_inputs[0]
        mean_differences = [
            np.nanmean(run.inputs[command] - run.channels[position]) for run in recording.training()
        ]
        position_offsets = [float(np.mean(mean_differences))]
    # 2. Position alone.
    text = f"position {position} looks counted from another zero"
    for offset in position_offsets:
        if abs(offset) > MIN_OFFSET:
            changes = {position: SignalChange(position, 1.0, offset)}
            yield ConventionHypothesis(text, changes, has_free_offset=True)


def _generate_wrapped_angles(
    joints: Sequence[JointSignals], recording: Recording
) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses that recorded angles jump by whole turns, which have to be added again.

    An encoder may count only within one turn. An angle of a hinge that jumps by nearly a turn
    between two samples is such a case; the command then shows the right turn.

    Args:
        joints: joints with their recorded signals.
        recording: the recording, whose training runs are examined.
    """
    for joint in joints:
        name = joint.channels.get("q")
        if name is None or not joint.is_hinge:
            continue
        jumps = [_compute_largest_jump(run.channels[name]) for run in recording.training()]
        if max(jumps) > WRAP_JUMP:
            command = joint.servo_inputs[0] if joint.servo_inputs else ""
            text = f"position {name} looks wrapped: whole turns are left out"
            yield ConventionHypothesis(
                text, {name: SignalChange(name, unwrap=True, command=command)}
            )


def _compute_largest_jump(values: Array) -> float:
    """Return the largest difference of successive samples; missing samples are skipped."""
    return float(np.abs(np.diff(values[np.isfinite(values)])).max(initial=0.0))


def _generate_joint_orders(
    joints: Sequence[JointSignals], recording: Recording, suspects: Sequence[JointSignals]
) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses that the columns of the log belong to the joints in another order.

    The channels, the commands, or both may have this order. Tried are exchanges of two suspects,
    the alphabetical order and its inverse, the reversed one, and the one in which positions follow
    commands best. An order maps the index of a joint to the index of the joint whose columns it
    has.

    Args:
        joints: joints with their signals, in the order of the model.
        recording: the recording, whose commands the positions may follow.
        suspects: joints that the model follows badly; pairs of them are exchanged.
    """
    indices = range(len(joints))
    # Only signals that all joints have can be exchanged between any of them.
    has_commands = all(len(joint.inputs) == 1 for joint in joints)
    quantities = [q for q in QUANTITIES if all(q in joint.channels for joint in joints)]
    suspect_indices = [i for i in indices if joints[i] in suspects]
    orders = [{one: other, other: one} for one, other in combinations(suspect_indices, 2)]
    # Indices of the joints in the alphabetical order of their names.
    alphabetical = sorted(indices, key=lambda i: joints[i].name)
    orders += [
        {i: alphabetical.index(i) for i in indices},  # The log has the alphabetical order.
        dict(enumerate(alphabetical)),  # The inverse.
        {i: len(joints) - 1 - i for i in indices},  # The log has the reversed order.
    ]
    if has_commands and "q" in quantities:
        # Every joint has a recorded position and a command here.
        signals_of_runs = (
            (
                [run.inputs[joint.inputs[0]] for joint in joints],
                [run.channels[joint.channels["q"]] for joint in joints],
            )
            for run in recording.training()
        )
        orders.append(find_order_by_variance(signals_of_runs, len(joints)))
    # An order that leaves a joint out does not change it.
    for order in orders:
        exchanged = [
            (joints[index], joints[source]) for index, source in order.items() if index != source
        ]
        if not exchanged:
            continue
        exchanged_names = [
            joints[index].name for index in indices if order.get(index, index) != index
        ]
        names = join_first_names(exchanged_names, MAX_NAMED)
        channels = {
            joint.channels[q]: SignalChange(source.channels[q])
            for joint, source in exchanged
            for q in quantities
        }
        if channels:
            yield ConventionHypothesis(f"the channels of {names} look exchanged", channels)
        if not has_commands:
            continue
        # Every joint has exactly one command.
        commands = {joint.inputs[0]: SignalChange(source.inputs[0]) for joint, source in exchanged}
        yield ConventionHypothesis(f"the commands of {names} look exchanged", commands)
        if channels:
            text = f"the channels and commands of {names} look exchanged"
            yield ConventionHypothesis(text, {**channels, **commands})


def _generate_units(
    signals: Sequence[DescribedSignal], recording: Recording
) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses that some signals have another unit than the description states.

    The signals share a stated unit, such as radians; each other unit of that quantity is a factor.
    If all values of an angle are integers, encoder ticks are tried as well, with the zero at 0 or
    at half a turn.

    Args:
        signals: signals with the same stated unit.
        recording: recording in SI units, converted as the description states.
    """
    first_signal = signals[0]
    names = [signal.name for signal in signals]
    text = join_first_names(names, MAX_NAMED)
    for unit, gain in UNITS.get(first_signal.si, {}).items():
        # The values were multiplied by the gain of the stated unit, which is undone. A separate
        # factor of the description (`scale`) is part of that gain, and stays.
        scale = first_signal.scale * gain / first_signal.gain
        if not math.isclose(scale, 1.0, rel_tol=SAME_UNIT_TOLERANCE):
            unit_words, stated_words = (
                UNITS_IN_WORDS.get(unit_name, unit_name)
                for unit_name in (unit, first_signal.specified_unit)
            )
            yield ConventionHypothesis(
                f"the numbers of {text} look like {unit_words}, stated as {stated_words}",
                {name: SignalChange(name, scale) for name in names},
                unit=unit,
            )
    # Encoder ticks. Position zero is at tick 0, or at half a turn.
    if first_signal.si != "rad" or not _are_whole(signals, recording):
        return
    for ticks in TICKS_PER_TURN:
        scale = 2.0 * math.pi / ticks / first_signal.gain
        for zero in (0.0, math.pi):
            yield ConventionHypothesis(
                f"the numbers of {text} look like ticks, {ticks:g} a turn",
                {name: SignalChange(name, scale, -zero) for name in names},
            )


def _are_whole(signals: Sequence[DescribedSignal], recording: Recording) -> bool:
    """Return whether all recorded values of these signals are integers, as encoder ticks are.

    Integers indicate raw counts, whose unit the description may have wrong.

    Args:
        signals: Signals with the gain that converts the recorded numbers to SI units.
        recording: Recording in SI units.
    """
    for run in recording.training():
        recorded = {**run.inputs, **run.channels}
        for signal in signals:
            # The numbers as they stand in the log.
            numbers = recorded[signal.name] / signal.gain
            numbers = numbers[np.isfinite(numbers)]
            if not np.allclose(numbers, np.rint(numbers), rtol=0.0, atol=INTEGER_TOLERANCE):
                return False
    return True


def _generate_late_commands(recording: Recording) -> Iterator[ConventionHypothesis]:
    """Yield hypotheses that the time stamps of all commands are late by 1 to 8 samples.

    Then the robot seems to respond before a command.

    Args:
        recording: Recording whose sampling interval is the unit of the delays.
    """
    run = recording.runs[0]
    if not run.inputs or run.times.size < 2:
        return
    interval = float(np.median(np.diff(run.times)))
    for count in LATE_SAMPLES:
        late = count * interval
        text = f"commands look stamped {late:.4g} s late: the robot answers before them"
        yield ConventionHypothesis(text, late=late)
