"""Statistics of each run and each signal of a recording."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bench.logs.quality.noise_estimation import NoiseEstimate, count_gaps, estimate_noise
from sims.core.simulator import Array, Channel, Simulator
from sims.recording.recording import Recording, Run


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
    """Count samples, gaps and missing values of a run, and measure its duration and intervals."""
    intervals = np.diff(run.times)
    median = float(np.median(intervals))
    missing = sum(int(np.isnan(v).sum()) for v in run.channels.values())
    return RunStatistics(
        run.name,
        run.held_out,
        int(run.times.size),
        float(run.times[-1] - run.times[0]),
        1.0 / median,
        float(intervals.min()),
        median,
        float(intervals.max()),
        count_gaps(run.times),
        missing,
    )


def compute_signal_statistics(
    recording: Recording, channel: Channel, kind: str
) -> SignalStatistics:
    """Compute the statistics of a signal over all runs.

    Args:
        recording: Recording with the signal.
        channel: Declaration of the signal.
        kind: input or channel.
    """
    signals = [(run.times, _get_signal(run, channel.name)) for run in recording.runs]
    values = np.concatenate([v for _, v in signals])
    # An input is what was commanded, so it has no noise.
    noise = estimate_noise(signals) if kind == "channel" else NoiseEstimate(np.nan, 0.0)
    return SignalStatistics(
        channel.name,
        kind,
        channel.unit,
        float(np.nanmin(values)),
        float(np.nanmax(values)),
        float(np.isnan(values).mean()),
        recording.noise.get(channel.name),
        noise.sigma,
        noise.step,
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


def _get_signal(run: Run, name: str) -> Array:
    return run.channels[name] if name in run.channels else run.inputs[name]
