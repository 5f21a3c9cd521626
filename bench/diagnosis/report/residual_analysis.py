"""Residual analysis: size of the gap by run, channel and phase, and residual profiles."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.report.report_data import DataSplit, GapLocation, ResidualProfile
from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

PROFILE_BIN_COUNT = 12
"""Number of bins of a profile."""
PROFILE_TAIL_SHARE = 0.005
"""Share of the samples at either end that a profile's bins leave out, because outliers would
stretch the axis.
"""
REVERSAL_SPEED_SHARE = 0.05
"""Speed, as a share of the largest one, below which a motion counts as a reversal."""
REST_SPEED_SHARE = 0.01
"""Speed, as a share of the largest one, below which a motion counts as at rest if it lasts."""
MIN_CONSECUTIVE_SAMPLES = 5
"""Minimum number of consecutive samples for a lasting state."""
SATURATION_SHARE = 0.999
"""Share of its largest magnitude above which an input counts as saturated."""
IMPACT_MARGIN_SAMPLES = 2
"""Number of samples before and after an impact that belong to it."""


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


def detect_phases(evaluator: RunEvaluator, simulated: Array) -> dict[str, Mask]:
    """Detect phases of the motion as masks (R, T).

    They are flight, impact and at rest for a system that bounces; motion, reversal and at rest for
    others. A further phase, saturated input, may overlap with each of them. Without recorded
    coordinates there are no phases.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.
    """
    system = evaluator.simulator.system
    speed = compute_speeds(evaluator, simulated)
    if speed is None:
        return {}
    # The lower limit avoids a division by zero if nothing moves; then all is at rest.
    largest = max(float(np.nanmax(speed)), 1e-300)
    # A reversal is slow for a moment too, so only a lasting state counts as rest.
    is_at_rest = _find_lasting_stretches(speed < REST_SPEED_SHARE * largest)
    if system.bounces:
        impact = _find_impacts(evaluator, simulated) & ~is_at_rest
        masks = {"flight": ~impact & ~is_at_rest, "impact": impact, "at rest": is_at_rest}
    else:
        reversal = (speed < REVERSAL_SPEED_SHARE * largest) & ~is_at_rest
        masks = {"motion": ~reversal & ~is_at_rest, "reversal": reversal, "at rest": is_at_rest}
    saturated = _find_saturation(evaluator)
    if saturated.any():
        masks["saturated input"] = saturated
    return masks


def compute_speeds(evaluator: RunEvaluator, simulated: Array) -> Array | None:
    """Compute the speed (R, T) of the simulated motion along the recorded coordinates.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.

    Returns:
        Speed, 0 after the end of a run; None without recorded coordinates.
    """
    velocities = [
        _compute_slopes(evaluator, simulated, name)
        for name in evaluator.simulator.system.coordinates
        if name in evaluator.channels
    ]
    if not velocities:
        return None
    speeds: Array = np.sqrt(np.nan_to_num(np.square(velocities).sum(axis=0)))
    return speeds


def _compute_slopes(evaluator: RunEvaluator, simulated: Array, channel: str) -> Array:
    """Compute the time derivative (R, T) of a simulated channel; NaN after the end of a run.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.
        channel: name of the channel.
    """
    values = simulated[:, :, evaluator.channels.index(channel)]
    slopes = np.full_like(values, np.nan)
    for row, run_values, run_data in zip(slopes, values, evaluator.prepared_runs, strict=True):
        count = len(run_data.observed)
        # A single sample has no slope.
        if count > 1:
            row[:count] = np.gradient(run_values[:count], run_data.scenario.times)
    return slopes


def _find_lasting_stretches(mask: Mask) -> Mask:
    """Return where a mask is true for at least `MIN_CONSECUTIVE_SAMPLES` consecutive samples."""
    lasting = np.zeros_like(mask)
    for row, lasting_row in zip(mask, lasting, strict=True):
        # With zeros at both ends, changes come in pairs: start and end of each interval.
        padded = np.concatenate([[0], row.astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(padded))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            lasting_row[begin:end] = end - begin >= MIN_CONSECUTIVE_SAMPLES
    return lasting


def _find_impacts(evaluator: RunEvaluator, simulated: Array) -> Mask:
    """Return the mask (R, T) of the samples around each minimum of the simulated height.

    A ball touches the ground there; a few samples on either side are included. The height is the
    last coordinate; nothing is marked if it is not recorded.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: the runs of a ball.
        simulated: (R, T, C) simulated channels.
    """
    name = evaluator.simulator.system.coordinates[-1]
    mask = np.zeros(simulated.shape[:2], dtype=bool)
    if name not in evaluator.channels:
        return mask
    height = simulated[:, :, evaluator.channels.index(name)]
    # After the end of a shorter run heights are NaN, which are never lowest points.
    previous_heights, heights, next_heights = height[:, :-2], height[:, 1:-1], height[:, 2:]
    with np.errstate(invalid="ignore"):
        # In a flat interval only the last sample counts, so that one impact is not counted twice.
        is_lowest = (heights <= previous_heights) & (heights < next_heights)
    is_lowest = np.pad(is_lowest, ((0, 0), (1, 1)))
    for shift in range(-IMPACT_MARGIN_SAMPLES, IMPACT_MARGIN_SAMPLES + 1):
        mask |= np.roll(is_lowest, shift, axis=1)
    return mask


def _find_saturation(evaluator: RunEvaluator) -> Mask:
    """Return the mask (R, T) of samples at which the first input stays near its largest magnitude.

    It is all False for an input that is there most of the time, such as a constant or a square
    wave, which is not saturated.

    Shapes: R runs, T samples.

    Args:
        evaluator: Run evaluator of the recording.
    """
    mask = np.zeros(evaluator.observed.shape[:2], dtype=bool)
    for run_mask, run_data in zip(mask, evaluator.prepared_runs, strict=True):
        # Only the first input, if there is one.
        for signal in list(run_data.scenario.inputs.values())[:1]:
            size = np.abs(signal)
            largest = max(float(size.max()), 1e-300)
            run_mask[: signal.size] = (size >= SATURATION_SHARE * largest) & (size > 0)
    lasting = _find_lasting_stretches(mask)
    is_exceptional = lasting.mean() < 0.5
    return lasting if is_exceptional else np.zeros_like(mask)


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
    """Return bin edges (BINS + 1,) over most of the values; None if they are all equal."""
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
        slopes = _compute_slopes(evaluator, simulated, position)
        yield f"velocity of {joint.name}", f"{unit}/s", slopes
    # Without a recorded position, the simulated velocity is that of its channel.
    elif rate in evaluator.channels:
        values = simulated[:, :, evaluator.channels.index(rate)]
        yield f"velocity of {joint.name}", f"{unit}/s", values
    commands = [
        f"u.{actuator.name}" for actuator in robot.actuators if actuator.joint == joint.name
    ]
    yield from _iterate_inputs(evaluator, [*commands, f"force.{joint.name}"])


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
