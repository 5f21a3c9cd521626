"""Check the servos of a robot: commands, units, and stability at the step of the simulation.

The joint of a servo approximately follows its command: over the samples of all runs, with the
command u and the position q about their means,

    b = <u q> / <u^2>,    r = <u q> / sqrt(<u^2> <q^2>)                       (1)

are the slope and the correlation. They reveal wrong units (degrees), reversed signs and exchanged
columns.

A log that contains a measurement in place of the command does not contain the command at all; the
column with the highest correlation r to the position may be the true command.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.logs.quality.quality_finding import Anomaly
from sims.core.simulator import Array, InputError, Simulator
from sims.core.user_messages import join_first_names
from sims.recording.column_mapping import list_mapped_files
from sims.recording.log_formats.log_columns import LogFile
from sims.recording.log_formats.log_files import read_log
from sims.recording.recording import Recording
from sims.recording.recording_description import read_meta

MIN_FOLLOWING_CORRELATION = 0.9
"""Minimum correlation r of (1) for a position that follows a command."""
MAX_UNRELATED_CORRELATION = 0.7
"""Maximum absolute correlation r of (1) for a position that does not follow a command."""
MAX_REVERSED_SLOPE = -0.3
"""Maximum slope b of (1) for a servo that follows its command with reversed sign."""
DEGREE_SLOPE_RANGE = (40.0, 80.0)
"""Range of slopes b of (1) which show that one of the two signals is in degrees (57.3)."""

UNKNOWN_COLUMN = "NAME OF ITS COLUMN"
"""Stands for the column of a command where no column of the log can be it."""

MIN_COMPARED_SAMPLES = 20
"""Minimum number of samples, and of different values, that are compared."""

MIN_COMMAND_CORRELATION = 0.9
"""Minimum correlation of a position with the column that may be its command."""

MEASURED_QUANTITIES = {"position": "q", "velocity": "qd"}
"""Channel that a servo controls, by the kind of its actuator."""


class _Regression(NamedTuple):
    """Slope and correlation of a position against a command, equation (1)."""

    slope: float
    correlation: float


def check_servos(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Find servos whose joint moves against the command, or by a factor that a wrong unit explains.

    A joint follows its command if both correlate; the slope of the position against the command
    then shows the factor, ideally 1. Joints that follow each other's command are found as well, so
    all commands are compared with all positions.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system; only robots have servos.
    """
    if not kind.has_model:
        return
    robot: Any = kind
    first_run = recording.runs[0]
    # Name of the command and of the position of each recorded servo.
    servo_signals = [
        (f"u.{a.name}", f"q.{a.joint}")
        for a in robot.robot.actuators
        if a.kind == "position"
        and f"u.{a.name}" in first_run.inputs
        and f"q.{a.joint}" in first_run.channels
    ]
    regressions = {
        (command, position): _regress_position_on_command(recording, command, position)
        for command, _ in servo_signals
        for _, position in servo_signals
    }
    # Slopes around 57.3, the number of degrees in a radian: one signal is in degrees. A slope of
    # that size means the position, its inverse the command.
    min_degree_slope, max_degree_slope = DEGREE_SLOPE_RANGE
    for command, position in servo_signals:
        slope, correlation = regressions[command, position]
        is_following = correlation > MIN_FOLLOWING_CORRELATION
        if is_following and min_degree_slope < slope < max_degree_slope:
            ratio_text = f"{slope:.3g} times as far as {command} commands"
            message = f"moves {ratio_text}; is its unit degrees?"
            yield Anomaly(f"column {position}: {message}", True)
        elif is_following and 1.0 / max_degree_slope < slope < 1.0 / min_degree_slope:
            ratio_text = f"1/{1.0 / slope:.3g} of what {command} commands"
            yield Anomaly(
                f"column {position}: moves {ratio_text}; is the unit of {command} degrees?", False
            )
        elif correlation < -MIN_FOLLOWING_CORRELATION and slope < MAX_REVERSED_SLOPE:
            yield Anomaly(f"column {position}: moves against {command}; is a sign wrong?", False)
    yield from _check_exchanged(servo_signals, regressions)


def check_servo_stability(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Find servos whose gains are too large for the time step of their simulation.

    Such a servo oscillates from step to step up to its force limit, so that no simulation agrees
    with a recording. The poses of the first run are tested, since the inertia depends on them.

    Args:
        recording: recording to check.
        kind: simulator class of its system; only robots have servos.
    """
    if not kind.has_model:
        return
    # These imports are needed for robots only.
    from sims.robot.contact_pairs import iterate_poses
    from sims.robot.servo_stability import list_unstable_servos

    robot: Any = kind
    settings = robot.numerics
    poses = iterate_poses(kind, recording.runs[0].channels)
    unstable_servos = list_unstable_servos(robot.robot, settings, poses)
    if not unstable_servos:
        return
    stable_steps = [servo.stable_step for servo in unstable_servos if servo.stable_step]
    remedy = "simulate with the integrator implicitfast"
    if len(stable_steps) == len(unstable_servos):
        remedy += f" or with a time step of {1e3 * min(stable_steps):.3g} ms"
    servos = "servo" if len(unstable_servos) == 1 else "servos"
    names = join_first_names(servo.name for servo in unstable_servos)
    yield Anomaly(
        f"{servos} {names}: gains too large for "
        f"{settings.integrator} steps of {1e3 * settings.timestep:.3g} ms: the simulation "
        f"oscillates from step to step, up to the force limit; {remedy}",
        False,
    )


def _check_exchanged(
    servo_signals: list[tuple[str, str]], regressions: dict[tuple[str, str], _Regression]
) -> Iterator[Anomaly]:
    """Find pairs of joints that follow each other's command instead of their own.

    Args:
        servo_signals: names of command and position of each servo.
        regressions: slope and correlation of each position against each command, by the names of
            command and position.
    """
    for i, (command, position) in enumerate(servo_signals):
        for other_command, other_position in servo_signals[i + 1 :]:
            # Each position against the other's command, and against its own.
            crossed = regressions[command, other_position], regressions[other_command, position]
            own = regressions[command, position], regressions[other_command, other_position]
            if (
                min(pair.correlation for pair in crossed) > MIN_FOLLOWING_CORRELATION
                and max(abs(pair.correlation) for pair in own) < MAX_UNRELATED_CORRELATION
            ):
                subject = (
                    f"columns {position} and {other_position}: each follows the other's command"
                )
                yield Anomaly(f"{subject}; are they swapped?", False)


def _regress_position_on_command(recording: Recording, command: str, position: str) -> _Regression:
    """Compute slope and correlation of a position against a command, over all runs.

    With command u and position q about their means in each run, and sums <> over all samples, the
    slope is b = <u q> / <u^2> and the correlation r = <u q> / sqrt(<u^2> <q^2>) (1). If one of them
    is constant, or both are unrelated, the result leads to no finding: slope 1, correlation 0.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        command: name of the input.
        position: name of the channel.
    """
    products = np.zeros(3)
    for run in recording.runs:
        u, q = run.inputs[command], run.channels[position]
        is_finite = np.isfinite(u) & np.isfinite(q)
        if is_finite.sum() > 1:
            u, q = u[is_finite] - u[is_finite].mean(), q[is_finite] - q[is_finite].mean()
            products += np.array([u @ u, u @ q, q @ q])
    uu, uq, qq = products
    if min(uu, qq) <= 0 or uq == 0:
        return _Regression(slope=1.0, correlation=0.0)
    return _Regression(float(uq / uu), float(uq / np.sqrt(uu * qq)))


def find_copied_commands(
    recording: Recording, kind: type[Simulator]
) -> Iterator[tuple[str, str, str]]:
    """Yield the commands of servos that equal the measurement of their joint in all samples.

    Such a log does not contain the command: a servo whose command equals its position exerts no
    force.

    Args:
        recording: Recording of a robot.
        kind: Simulator class of the robot.

    Yields:
        Name of the input, name of the channel that it equals, and the column that may be the
        command instead, `UNKNOWN_COLUMN` if there is none.
    """
    robot: Any = kind.robot  # type: ignore[attr-defined]
    for actuator in robot.actuators:
        # A position servo is compared with the position, a velocity servo with the velocity.
        quantity = MEASURED_QUANTITIES.get(actuator.kind)
        command, channel = f"u.{actuator.name}", f"{quantity}.{actuator.joint}"
        runs = [run for run in recording.runs if command in run.inputs and channel in run.channels]
        if not runs:
            continue
        command_values = np.concatenate([run.inputs[command] for run in runs])
        measured_values = np.concatenate([run.channels[channel] for run in runs])
        is_recorded = np.isfinite(measured_values)
        command_values, measured_values = command_values[is_recorded], measured_values[is_recorded]
        # The readings of a joint that hardly moves may equal its command anyway.
        if len(np.unique(measured_values)) >= MIN_COMPARED_SAMPLES and np.array_equal(
            command_values, measured_values
        ):
            yield command, channel, _find_likely_column(recording, channel)


def _find_likely_column(recording: Recording, channel: str) -> str:
    """Find the column of the log that is probably the true command of a servo.

    The message proposes it to the user. Of the columns that the description does not use, it is the
    one with the highest correlation to the recorded position. Return `UNKNOWN_COLUMN` if none
    correlates enough.

    Args:
        recording: the recording, with its description and logs.
        channel: name of the channel with the position.
    """
    try:
        description, meta = read_meta(recording.path)
    except InputError:  # A recording in memory has no description.
        return UNKNOWN_COLUMN
    tables = [table for kind in ("channels", "inputs") for table in meta.get(kind, {}).values()]
    used_columns = [
        column for table in tables if isinstance(table, dict) for column in _list_columns(table)
    ]
    channel_table = meta.get("channels", {}).get(channel, {})
    # Without a stated column, the column has the name of the channel.
    position_column, *_ = _list_columns(channel_table) or [channel]
    best, best_correlation = UNKNOWN_COLUMN, MIN_COMMAND_CORRELATION
    # The first log with the position decides.
    for log in _iterate_logs(description):
        if position_column not in log.list_columns():
            continue
        position = log.get_column(position_column)
        for column in log.list_columns():
            if column in (*used_columns, position_column):
                continue
            correlation = _compute_correlation(log.get_column(column), position)
            if correlation > best_correlation:
                best, best_correlation = column, correlation
        break
    return best


def _list_columns(table: dict[str, Any]) -> list[str]:
    """Return the columns that the table of a signal names."""
    column = table.get("column", [])
    return [column] if isinstance(column, str) else list(column)


def _iterate_logs(description: Path) -> Iterator[LogFile]:
    """Yield the logs of a description that can be read."""
    for path in list_mapped_files(description):
        try:
            yield read_log(path)
        except InputError:  # Such as the model file.
            continue


def _compute_correlation(u: Array, y: Array) -> float:
    """Return the correlation of two columns; 0 if they are equal, or one does not change.

    It is also 0 if the columns have different lengths, or fewer than `MIN_COMPARED_SAMPLES` samples
    in common.

    Args:
        u: (T,) first column, NaN where missing.
        y: (T,) second column.
    """
    # A column that equals a measurement is a copy of it, and not its command.
    if u.shape != y.shape or np.array_equal(u, y, equal_nan=True):
        return 0.0
    is_recorded = np.isfinite(u) & np.isfinite(y)
    u, y = u[is_recorded], y[is_recorded]
    if u.size < MIN_COMPARED_SAMPLES or np.ptp(u) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(u, y)[0, 1])
