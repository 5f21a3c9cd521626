"""Summarise a recording: statistics of each run and each signal, as text and as document.

The summary of a robot includes its model file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import numpy as np

from sims.core.noise_estimation import NoiseEstimate, count_gaps, estimate_noise
from sims.core.simulator import Channel, Simulator
from sims.core.user_messages import align_columns, format_count, format_run_names, format_unit
from sims.recording.recording import Recording, Run
from sims.robot.robot_simulator import RobotSimulator


class RunStatistics(NamedTuple):
    """Statistics of one run.

    Attributes:
        name: Name of the run.
        held_out: Whether the run is excluded from fits.
        samples: Number of samples.
        seconds: Time from the first sample to the last, s.
        rate: Sampling rate in Hz from the median interval, which gaps do not change.
        shortest: Shortest interval between two samples, s.
        median: Median interval between two samples, s.
        longest: Longest interval between two samples, s.
        gaps: Number of intervals that are far longer than the others.
        missing: Number of empty cells in its channels.
    """

    name: str
    held_out: bool
    samples: int
    seconds: float
    rate: float
    shortest: float
    median: float
    longest: float
    gaps: int
    missing: int


class SignalStatistics(NamedTuple):
    """Statistics of one input or channel over all runs.

    Attributes:
        name: Name of the signal.
        kind: input or channel.
        unit: Unit of all values below.
        low: Smallest value.
        high: Largest value.
        missing: Share of missing samples.
        stated: Noise in the description, 1 sigma; None if there is none.
        estimated: Noise estimated from the signal, 1 sigma; NaN if it cannot be estimated.
        step: Quantisation step; 0 if the signal is not quantised.
    """

    name: str
    kind: str
    unit: str
    low: float
    high: float
    missing: float
    stated: float | None
    estimated: float
    step: float


def compute_run_statistics(run: Run) -> RunStatistics:
    """Count samples, gaps and missing values of a run, and measure its duration and intervals.

    Durations are in seconds; the rate in Hz follows from the median interval.

    Args:
        run: Run with its sample times and channels.
    """
    intervals = np.diff(run.times)
    median = float(np.median(intervals))
    return RunStatistics(
        name=run.name,
        held_out=run.held_out,
        samples=int(run.times.size),
        seconds=float(run.times[-1] - run.times[0]),
        rate=1.0 / median,
        shortest=float(intervals.min()),
        median=median,
        longest=float(intervals.max()),
        gaps=count_gaps(run.times),
        missing=sum(int(np.isnan(values).sum()) for values in run.channels.values()),
    )


def compute_signal_statistics(
    recording: Recording, channel: Channel, kind: str
) -> SignalStatistics:
    """Compute range, missing share and noise of a signal over all runs.

    Args:
        recording: Recording with the signal.
        channel: Declaration of the signal.
        kind: input or channel.
    """
    signals = [(run.times, {**run.inputs, **run.channels}[channel.name]) for run in recording.runs]
    values = np.concatenate([run_values for _, run_values in signals])
    # An input is what was commanded, so it has no noise.
    noise = estimate_noise(signals) if kind == "channel" else NoiseEstimate(np.nan, 0.0)
    return SignalStatistics(
        name=channel.name,
        kind=kind,
        unit=channel.unit,
        low=float(np.nanmin(values)),
        high=float(np.nanmax(values)),
        missing=float(np.isnan(values).mean()),
        stated=recording.noise.get(channel.name),
        estimated=noise.sigma,
        step=noise.step,
    )


def list_recorded_signals(recording: Recording, kind: type[Simulator]) -> list[tuple[Channel, str]]:
    """Return the recorded inputs and channels, each with its kind: input or channel.

    Args:
        recording: Recording whose first run decides which signals are recorded.
        kind: Simulator class of its system.
    """
    first = recording.runs[0]
    inputs = [(c, "input") for c in kind.inputs if c.name in first.inputs]
    return inputs + [(c, "channel") for c in kind.channels if c.name in first.channels]


def to_document(recording: Recording, kind: type[Simulator]) -> dict[str, Any]:
    """Build the JSON document with the statistics of a recording.

    Of each constant it has the value that holds for all runs, whether the description states it or
    it is the default of the system, and the runs with a value of their own.

    Args:
        recording: Recording to summarise.
        kind: Simulator class of its system.
    """
    return {
        "recording": recording.path,
        "system": recording.system,
        "title": recording.title,
        "runs": [compute_run_statistics(run)._asdict() for run in recording.runs],
        "signals": [
            compute_signal_statistics(recording, channel, role)._asdict()
            for channel, role in list_recorded_signals(recording, kind)
        ],
        "constants": {
            constant.name: {
                "value": recording.constants.get(constant.name, constant.value),
                "unit": constant.unit,
                "stated": constant.name in recording.constants,
                "by_run": {
                    run.name: run.constants[constant.name]
                    for run in recording.runs
                    if constant.name in run.constants
                },
            }
            for constant in kind.constants
        },
    }


_MAX_LISTED_RUNS = 40
"""Maximum number of runs that are listed."""
_MAX_LISTED_NAMES = 12
"""Maximum number of runs that are named in one line."""
_CAVEAT = (
    "estimated: from second and third differences, white noise assumed; it is too small "
    "for coloured noise, and too large if the motion is fast compared with the sampling"
)
_RUN_HEAD = (
    "run",
    "use",
    "samples",
    "seconds",
    "rate [Hz]",
    "intervals [ms]: min",
    "median",
    "max",
    "gaps",
    "missing",
)
_SIGNAL_HEAD = ("signal", "kind", "unit", "min", "max", "missing", "noise: stated", "estimated", "")


def format_summary(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield the lines of a text summary of a recording.

    Args:
        recording: Recording to summarise.
        kind: Simulator class of its system.
    """
    runs = recording.runs
    samples = sum(run.times.size for run in runs)
    seconds = sum(run.times[-1] - run.times[0] for run in runs)
    held_out = len(recording.held_out())
    yield recording.title
    run_count = len({run.name for run in runs})
    if recording.folds():  # cross-validation
        held_out_text = "each left out in turn"
    elif run_count < len(runs):  # a single run, divided into two parts with the same name
        held_out_text = "its last third is held out"
    else:
        held_out_text = f"{held_out} held out"
    size = f"{format_count(run_count, 'run')} ({held_out_text}), {samples} samples, {seconds:.4g} s"
    yield f"{recording.path}: system {recording.system}, {size}"
    yield from recording.notes
    yield ""
    yield from align_columns([_RUN_HEAD, *map(_run_row, runs[:_MAX_LISTED_RUNS])], left_columns=2)
    if len(runs) > _MAX_LISTED_RUNS:
        yield f"... and {len(runs) - _MAX_LISTED_RUNS} more runs"
    yield ""
    yield from align_columns([_SIGNAL_HEAD, *_iterate_signal_rows(recording, kind)], left_columns=3)
    yield _CAVEAT
    yield ""
    yield from _format_constants(recording, kind)


def _run_row(run: Run) -> tuple[str, ...]:
    """Format the statistics of a run as a table row; sampling intervals are in milliseconds.

    Args:
        run: Run with its channels, and whether it is fitted, held out or left out in turn.
    """
    statistics = compute_run_statistics(run)
    if run.fold is not None:  # cross-validation
        use = "left out in turn"
    elif run.held_out:
        use = "held out"
    else:
        use = "fitting"
    return (
        statistics.name,
        use,
        str(statistics.samples),
        f"{statistics.seconds:.4g}",
        f"{statistics.rate:.4g}",
        *(f"{1e3 * t:.4g}" for t in (statistics.shortest, statistics.median, statistics.longest)),
        str(statistics.gaps),
        str(statistics.missing),
    )


def _iterate_signal_rows(recording: Recording, kind: type[Simulator]) -> Iterator[tuple[str, ...]]:
    """Yield a row of the table of signals for each channel and input.

    It has the unit, the range, the share of missing samples, and the noise as the description
    states it and as it is estimated. The stated noise is "-" for a channel whose noise is not
    stated, and empty for an input, which has none; steps are quantisation steps.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: simulator class, which declares the signals.
    """
    for channel, role in list_recorded_signals(recording, kind):
        statistics = compute_signal_statistics(recording, channel, role)
        unknown_noise = "-" if role == "channel" else ""
        yield (
            statistics.name,
            role,
            format_unit(statistics.unit) or "1",
            f"{statistics.low:.4g}",
            f"{statistics.high:.4g}",
            f"{statistics.missing:.1%}" if statistics.missing else "0",
            unknown_noise if statistics.stated is None else f"{statistics.stated:.3g}",
            f"{statistics.estimated:.3g}" if np.isfinite(statistics.estimated) else "",
            f"in steps of {statistics.step:.3g}" if statistics.step else "",
        )


def _format_constants(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield a line for each constant of the system, and one for the stated initial states.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: class of the simulator, which declares the constants.
    """
    for constant in kind.constants:
        yield _format_constant(recording, constant.name, constant.value, constant.unit)
    run_texts = []
    for run in recording.runs:
        if run.initial:
            states = ", ".join(f"{name} = {value:g}" for name, value in run.initial.items())
            run_texts.append(f"{run.name} ({states})")
    if run_texts:
        yield f"initial states stated: {', '.join(run_texts[:_MAX_LISTED_RUNS])}"


def _format_constant(recording: Recording, name: str, default: float, unit: str) -> str:
    """Format a constant's value in one line, and list the runs with each value if it differs.

    A run may state its own value; the value of the recording, or else the default, holds for the
    other runs.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        name: name of the constant.
        default: value if the recording states none.
        unit: unit of the value.
    """
    common_value = recording.constants.get(name, default)
    runs_by_value: dict[float, list[str]] = {}
    for run in recording.runs:
        runs_by_value.setdefault(run.constants.get(name, common_value), []).append(run.name)
    unit = f" {format_unit(unit)}".rstrip()
    if len(runs_by_value) > 1:
        parts = [
            f"{value:g}{unit} in {format_run_names(runs, _MAX_LISTED_NAMES)}"
            for value, runs in runs_by_value.items()
        ]
        return f"{name} differs by run: {'; '.join(parts)}"
    # All runs have the same value.
    value = next(iter(runs_by_value))
    is_stated = name in recording.constants or any(name in run.constants for run in recording.runs)
    note = "" if is_stated else " (the system's default; not stated)"
    return f"{name} = {value:g}{unit}{note}"


def format_robot_summary(kind: type[Simulator]) -> Iterator[str]:
    """Yield lines about the robot of a simulator: its file, its parts and notes on repairs.

    Nothing is yielded for a simulator of another system.

    Args:
        kind: simulator class; `has_model` means that it simulates a robot from its model file.
    """
    if not kind.has_model:
        return
    simulator = cast(type[RobotSimulator], kind)
    robot = simulator.robot
    counts = (
        (len(robot.joints), "joint"),
        (len(robot.actuators), "actuator"),
        (len(robot.bodies), "moving body"),
        (len(robot.sensors), "sensor row"),
    )
    words = ", ".join(format_count(n, word) for n, word in counts if n)
    step, integrator, *_ = simulator.numerics
    form = robot.format.upper()
    yield f"robot {robot.path} ({form}): {words}; {integrator} at {1e3 * step:g} ms"
    yield from (f"note: {note}" for note in robot.notes)
