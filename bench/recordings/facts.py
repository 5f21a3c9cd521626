"""What is in a recording, as numbers: of each run and of each signal."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bench.recordings.noise import NoiseEstimate, estimated, gaps
from sims.base import Array, Channel, Simulator
from sims.recording.recording import Recording, Run


class RunFacts(NamedTuple):
    """One run.

    Attributes:
        name: of it.
        held_out: whether no fit may see it.
        samples: how many.
        seconds: from the first to the last.
        rate: Hz, by the median interval: the mean would be drawn away by a gap.
        shortest: interval between two samples, s.
        median: likewise.
        longest: likewise.
        gaps: intervals that are far longer than the others.
        missing: empty cells of its channels.
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


class SignalFacts(NamedTuple):
    """One input or channel over all runs.

    Attributes:
        name: of it.
        kind: input or channel.
        unit: of all that follows.
        low: the least value.
        high: the largest one.
        missing: share of the samples.
        stated: noise, 1 sigma, as the description has it; None where it has none.
        estimated: noise, 1 sigma, judged from the signal; NaN where it cannot be told.
        step: by which a quantised signal changes; 0 where it is not.
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


def run_facts(run: Run) -> RunFacts:
    """What a run is like."""
    intervals = np.diff(run.times)
    median = float(np.median(intervals))
    missing = sum(int(np.isnan(v).sum()) for v in run.channels.values())
    return RunFacts(
        run.name,
        run.held_out,
        int(run.times.size),
        float(run.times[-1] - run.times[0]),
        1.0 / median,
        float(intervals.min()),
        median,
        float(intervals.max()),
        gaps(run.times),
        missing,
    )


def signal_facts(recording: Recording, channel: Channel, kind: str) -> SignalFacts:
    """What a signal is like."""
    signals = [(run.times, _of(run, channel.name)) for run in recording.runs]
    values = np.concatenate([v for _, v in signals])
    # An input is what was commanded: it has no noise.
    noise = estimated(signals) if kind == "channel" else NoiseEstimate(np.nan, 0.0)
    return SignalFacts(
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


def declared(recording: Recording, kind: type[Simulator]) -> list[tuple[Channel, str]]:
    """The recorded inputs and channels, each with the word for what it is."""
    first = recording.runs[0]
    inputs = [(c, "input") for c in kind.inputs if c.name in first.inputs]
    return inputs + [(c, "channel") for c in kind.channels if c.name in first.channels]


def document(recording: Recording, kind: type[Simulator]) -> dict[str, Any]:
    """All of it for programs."""
    return {
        "recording": recording.path,
        "system": recording.system,
        "title": recording.title,
        "runs": [run_facts(run)._asdict() for run in recording.runs],
        "signals": [
            signal_facts(recording, channel, what)._asdict()
            for channel, what in declared(recording, kind)
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


def _of(run: Run, name: str) -> Array:
    return run.channels[name] if name in run.channels else run.inputs[name]
