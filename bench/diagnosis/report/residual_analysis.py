"""Residual analysis: where and when a simulation differs from the recording, and by how much.

It has the RMS residual by run, channel and phase of the motion, and residual profiles: the mean
residual as a function of another variable, such as a velocity.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.report.cause_and_value_text import sanitise
from bench.diagnosis.report.diagnosed_places import find_joint
from bench.diagnosis.report.joint_figure import is_robot
from bench.diagnosis.report.motion_phases import compute_slopes, compute_speeds, detect_phases
from bench.diagnosis.report.report_data import (
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ResidualProfile,
)
from bench.pages.page_table import Table
from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

PROFILE_BIN_COUNT = 12
"""Number of bins of a profile."""
PROFILE_TAIL_SHARE = 0.005
"""Share of the samples at either end that a profile's bins leave out, because outliers would
stretch the axis.
"""


def compute_gap_locations(
    evaluator: RunEvaluator, before: Array, after: Array, sigma: Array, mark: str = ""
) -> list[GapLocation]:
    """Compute the RMS residual in units of the noise, by run, channel and phase of the motion.

    They show where the simulation is wrong. 1 is the noise itself.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
        sigma: (C,) noise of each channel.
        mark: Text that is appended to the names of runs.
    """
    before_squares, after_squares = (
        np.square((evaluator.observed - simulated) / sigma) for simulated in (before, after)
    )
    return [
        GapLocation(
            kind,
            label,
            samples=int(mask.sum()),
            before=float(np.sqrt(before_squares[mask].mean())),
            after=float(np.sqrt(after_squares[mask].mean())),
        )
        for kind, label, mask in _list_parts(evaluator, after, mark)
        # A run or phase without samples has no RMS.
        if mask.any()
    ]


def _list_parts(
    evaluator: RunEvaluator, simulated: Array, mark: str
) -> list[tuple[str, str, Mask]]:
    """List the parts of the data for which the residual is reported: runs, channels and phases.

    Each has its kind, its label and the mask (R, T, C) of its samples.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: run evaluator with the recorded runs.
        simulated: (R, T, C) simulated runs, which determine the phases of the motion.
        mark: text that is appended to the names of runs.
    """
    observed_mask = np.isfinite(evaluator.observed)
    run_count, _, channel_count = observed_mask.shape
    data_parts: list[tuple[str, str, Mask]] = []
    for run_index, run_data in enumerate(evaluator.prepared_runs):
        is_this_run = np.arange(run_count) == run_index
        mask = observed_mask & is_this_run[:, None, None]
        data_parts.append(("run", run_data.name + mark, mask))
    for channel_index, name in enumerate(evaluator.channels):
        is_this_channel = np.arange(channel_count) == channel_index
        data_parts.append(("channel", name, observed_mask & is_this_channel))
    # Phases come from the simulation, because noise of a measured speed would cause false ones.
    for phase, phase_mask in detect_phases(evaluator, simulated).items():
        data_parts.append(("phase", phase, observed_mask & phase_mask[:, :, None]))
    return data_parts


def compute_channel_errors(split: DataSplit) -> Array:
    """Compute each channel's RMSE (C, 2) before and after, in its unit; NaN without samples.

    Args:
        split: Recorded runs with the simulation before and after the causes are added.
    """
    channel_count = split.observed.shape[2]
    errors = np.full((channel_count, 2), np.nan)
    for column, simulated in enumerate((split.before, split.after)):
        for channel_index in range(channel_count):
            residual = (split.observed - simulated)[:, :, channel_index]
            # The mean of an empty set would cause a warning.
            if np.isfinite(residual).any():
                errors[channel_index, column] = np.sqrt(np.nanmean(residual**2))
    return errors


def compute_normalised_rms(report: DiagnosisReportData, split: DataSplit, model: str) -> float:
    """Compute the RMS residual of a data split over all channels, in units of the noise.

    Args:
        report: Report data.
        split: Data split.
        model: ``before`` or ``after``.
    """
    sigma = np.array([c.sigma for c in report.channels])
    residual = (split.observed - getattr(split, model)) / sigma
    # The mean of an empty set would cause a warning.
    return float(np.sqrt(np.nanmean(residual**2))) if np.isfinite(residual).any() else float("nan")


def compute_residual_profiles(
    evaluator: RunEvaluator, before: Array, after: Array, sigma: Array
) -> list[ResidualProfile]:
    """Compute the profiles of the residual against time, position, speed and inputs.

    A profile is the mean residual of a channel in bins of such a variable, and shows on what a
    missing force depends. The channel is the one that sensor effects act on. For a robot it is the
    one with the largest gap, against the variables of its joint. A variable that does not change
    has no profile.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
        sigma: (C,) noise of each channel.
    """
    # Name of the channel on which sensor effects act.
    name = evaluator.simulator.system.reading(evaluator.channels)
    variables = _iterate_variables(evaluator, after)
    if get_robot(evaluator) is not None:
        name = _find_largest_residual_channel(evaluator, before, sigma)
        variables = _iterate_joint_variables(evaluator, after, name)
    channel_index = evaluator.channels.index(name)
    profiles = []
    for variable, unit, values in variables:
        is_finite = np.isfinite(evaluator.observed[:, :, channel_index]) & np.isfinite(values)
        variable_values = values[is_finite]
        edges = _compute_bin_edges(variable_values)
        # The variable does not change.
        if edges is None:
            continue
        # Values outside the edges count in the outermost bins.
        bin_indices = np.searchsorted(edges, variable_values, side="right") - 1
        bins = np.clip(bin_indices, 0, PROFILE_BIN_COUNT - 1)
        counts = np.bincount(bins, minlength=PROFILE_BIN_COUNT).astype(np.float64)
        before_residual, after_residual = (
            (evaluator.observed - simulated)[:, :, channel_index][is_finite]
            for simulated in (before, after)
        )
        # The mean of an empty bin is NaN and is not drawn.
        with np.errstate(invalid="ignore", divide="ignore"):
            before_means = np.bincount(bins, before_residual, PROFILE_BIN_COUNT) / counts
            after_means = np.bincount(bins, after_residual, PROFILE_BIN_COUNT) / counts
            standard_errors = sigma[channel_index] / np.sqrt(counts)
        standard_errors[counts == 0] = np.nan
        centres = (edges[1:] + edges[:-1]) / 2.0
        profiles.append(
            ResidualProfile(
                name, variable, unit, centres, before_means, after_means, standard_errors
            )
        )
    return profiles


def get_robot(evaluator: RunEvaluator) -> RobotModel | None:
    """Return the robot of a recording; None for other systems."""
    robot: RobotModel | None = getattr(evaluator.kind.system, "robot", None)
    return robot


def _find_largest_residual_channel(evaluator: RunEvaluator, before: Array, sigma: Array) -> str:
    """Return the channel with the largest residual in units of its noise.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        before: (R, T, C) channels simulated with the base model.
        sigma: (C,) standard deviation of the noise of each channel.
    """
    squares = np.square((evaluator.observed - before) / sigma)
    sizes = []
    for channel_index in range(len(evaluator.channels)):
        channel_squares = squares[:, :, channel_index][np.isfinite(squares[:, :, channel_index])]
        sizes.append(float(channel_squares.mean()) if channel_squares.size else 0.0)
    return evaluator.channels[int(np.argmax(sizes))]


def _compute_bin_edges(values: Array) -> Array | None:
    """Return the edges of equal bins over most of the values; None if they are all equal.

    The share `PROFILE_TAIL_SHARE` of the values is outside the edges at either end.

    Args:
        values: (N,) values of the variable.

    Returns:
        (`PROFILE_BIN_COUNT` + 1,) edges in ascending order.
    """
    if not values.size or np.ptp(values) == 0:
        return None
    low, high = (
        float(v) for v in np.quantile(values, [PROFILE_TAIL_SHARE, 1.0 - PROFILE_TAIL_SHARE])
    )
    edges: Array = np.linspace(low, high, PROFILE_BIN_COUNT + 1)
    # The values between the quantiles may be equal although the outermost ones are not.
    return edges if edges[-1] > edges[0] else None


def _iterate_variables(
    evaluator: RunEvaluator, simulated: Array
) -> Iterator[tuple[str, str, Array]]:
    """Yield the variables of residual profiles, each with name, unit and values (R, T).

    They are the time, the position along the primary coordinate, the speed, and each recorded
    input. Values are NaN after the end of a run.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        simulated: (R, T, C) simulated channels, from which position and speed are taken.
    """
    times = _compute_run_times(evaluator)
    yield "time", "s", times
    system = evaluator.simulator.system
    units = {channel.name: channel.unit for channel in evaluator.kind.channels}
    primary = system.coordinates[system.primary] if system.coordinates else ""
    # The simulated position is used, because the noise of a measured one is part of the residual.
    if primary in evaluator.channels:
        position = simulated[:, :, evaluator.channels.index(primary)]
        yield "position", units[primary], position
    speed = compute_speeds(evaluator, simulated)
    if speed is not None:
        unit = f"{units.get(primary, 'm')}/s"
        yield "speed", unit, np.where(np.isfinite(times), speed, np.nan)
    yield from _iterate_inputs(evaluator, [channel.name for channel in evaluator.kind.inputs])


def _compute_run_times(evaluator: RunEvaluator) -> Array:
    """Return the time (R, T) in seconds since the start of each run, whatever its clock."""
    times = np.full(evaluator.observed.shape[:2], np.nan)
    for r, run_data in enumerate(evaluator.prepared_runs):
        times[r, : len(run_data.observed)] = run_data.scenario.times - run_data.scenario.times[0]
    return times


def _iterate_inputs(
    evaluator: RunEvaluator, names: Collection[str]
) -> Iterator[tuple[str, str, Array]]:
    """Yield name, unit and values (R, T) of the recorded inputs with these names.

    Shapes: R runs, T samples.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        names: names of the inputs.
    """
    for channel in evaluator.kind.inputs:
        if channel.name not in names:
            continue
        values = np.full(evaluator.observed.shape[:2], np.nan)
        for run_values, run_data in zip(values, evaluator.prepared_runs, strict=True):
            signal = run_data.scenario.inputs.get(channel.name)
            if signal is not None:
                run_values[: len(run_data.observed)] = signal
        if np.isfinite(values).any():
            yield channel.name, channel.unit, values


def _iterate_joint_variables(
    evaluator: RunEvaluator, simulated: Array, channel: str
) -> Iterator[tuple[str, str, Array]]:
    """Yield the variables for residual profiles of a joint's channel: name, unit and values (R, T).

    They are the time, the position, the velocity with its sign, because friction acts against it,
    and the recorded inputs that act on the joint. A channel that is not one of a joint has only the
    time.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs of a robot.
        simulated: (R, T, C) simulated channels.
        channel: name of the channel, such as ``q.elbow``.
    """
    times = _compute_run_times(evaluator)
    yield "time", "s", times
    robot = get_robot(evaluator)
    joints = robot.joints if robot is not None else ()
    _, _, joint_name = channel.partition(".")
    joint = next((joint for joint in joints if joint.name == joint_name), None)
    if robot is None or joint is None:
        return
    position, rate = f"q.{joint.name}", f"qd.{joint.name}"
    unit = joint.unit
    if position in evaluator.channels:
        values = simulated[:, :, evaluator.channels.index(position)]
        yield f"position of {joint.name}", unit, values
        slopes = compute_slopes(evaluator, simulated, position)
        yield f"velocity of {joint.name}", f"{unit}/s", slopes
    # Without a recorded position, the simulated velocity is that of its channel.
    elif rate in evaluator.channels:
        values = simulated[:, :, evaluator.channels.index(rate)]
        yield f"velocity of {joint.name}", f"{unit}/s", values
    commands = [
        f"u.{actuator.name}" for actuator in robot.actuators if actuator.joint == joint.name
    ]
    yield from _iterate_inputs(evaluator, [*commands, f"force.{joint.name}"])


def build_gap_location_table(report: DiagnosisReportData) -> Table:
    """Build a table with one row per part of the data: its RMS residual in units of the noise.

    Args:
        report: Data of the report, whose gap locations are runs, channels and phases of the motion.
    """
    rows = []
    for location in report.gap_locations:
        row = {
            "kind": location.kind,
            "part": sanitise(location.label, 80),
            "samples": location.samples,
            "before": location.before,
        }
        if report.has_extended_model:
            row["after"] = location.after
        if is_robot(report):
            name = location.label if location.kind == "channel" else ""
            row["joint"] = find_joint(report, "channel", name)
        rows.append(row)
    return Table.from_rows(rows)
