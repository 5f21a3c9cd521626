"""Run all checks of a log: clock, signal values and consistency of channels.

The checks need no fitted model. Quality checks give findings, each with its remedy; implausible
logs are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, cast

from bench.core.resource_estimates import FORCE_HINT
from bench.logs.importing.normalised_positions import check_normalised_positions
from bench.logs.quality import (
    clock_checks,
    pose_checks,
    range_checks,
    servo_checks,
    signal_checks,
    velocity_checks,
)
from bench.logs.quality.quality_finding import Anomaly, QualityFinding
from sims.core.simulator import InputError, Simulator
from sims.recording.recording import Recording

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel
    from sims.robot.robot_simulator import RobotSimulator


def check_log_quality(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Run all quality checks: clock, single signals, and consistency between signals.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        Findings in the order of the checks.
    """
    yield from clock_checks.check_intervals(recording)
    yield from signal_checks.check_repeated_samples(recording)
    yield from clock_checks.check_clock_drift(recording, kind)
    yield from signal_checks.check_quantisation(recording, kind)
    yield from signal_checks.check_saturation(recording, kind)
    yield from signal_checks.check_standstill(recording, kind)
    yield from velocity_checks.check_velocities(recording, kind)
    yield from pose_checks.find_body_contacts(recording, kind)


def check_recording_plausible(
    recording: Recording, kind: type[Simulator], force: bool = False
) -> list[str]:
    """Reject impossible time stamps and robot positions, and return all other anomalies.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.
        force: Whether the user insists.

    Returns:
        Texts of the anomalies, to be shown to the user.

    Raises:
        InputError: An anomaly is certain, which means that no correct recording can have it, and
            `force` is False; the message is one line.
    """
    # Positions first: their wrong units make stamps look implausible, but not vice versa.
    anomalies = [
        *find_log_anomalies(recording),
        *range_checks.check_joint_ranges(recording, kind),
        *servo_checks.check_servos(recording, kind),
        *servo_checks.check_servo_stability(recording, kind),
        *clock_checks.find_anomalies(recording, kind),
        *pose_checks.find_missing_base_poses(recording, kind),
        *(
            Anomaly(contact.text_line, False)
            for contact in pose_checks.find_body_contacts(recording, kind)
        ),
    ]
    for anomaly in anomalies:
        if anomaly.certain and not force:
            raise InputError(f"{recording.path}: {anomaly.text}, {FORCE_HINT}")
    return [anomaly.text for anomaly in anomalies]


def find_log_anomalies(recording: Recording) -> Iterator[Anomaly]:
    """Yield the omissions from a recording's logs, and units that they do not state."""
    yield from (Anomaly(note, False) for note in recording.notes)
    yield from check_normalised_positions(recording)


def format_log_warnings(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield warnings about a robot's signals: those missing in the log, and those beyond limits.

    Other systems have none.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    if not kind.has_model:
        return
    robot = cast("type[RobotSimulator]", kind).robot
    yield from _list_missing_signals(recording, robot)
    yield from range_checks.list_exceeded_ranges(recording, robot)


def _list_missing_signals(recording: Recording, robot: RobotModel) -> Iterator[str]:
    """Yield a line that names the missing commands, and one for the missing joint positions.

    Args:
        recording: the recording, of which the first run counts.
        robot: model of the robot.
    """
    run = recording.runs[0]
    missing_commands = [f"u.{a.name}" for a in robot.actuators if f"u.{a.name}" not in run.inputs]
    if missing_commands:
        yield f"not in the log, assumed to be zero: {', '.join(missing_commands)}"
    joints = [joint.name for joint in robot.joints if joint.has_one_coordinate]
    missing_joints = [name for name in joints if f"q.{name}" not in run.channels]
    if missing_joints:
        joint_names = ", ".join(missing_joints)
        yield (
            "positions that are not in the log, with initial values from the model file: "
            f"{joint_names}"
        )
