"""Run all quality checks of a log: clock, signal values and consistency of channels.

The checks need no fitted model. Each finding is one line with its remedy.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.recordings.census import clock, drift, rates, values
from bench.recordings.census.finding import Finding
from sims.base import Simulator
from sims.recording.recording import Recording


def census(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    """Run all quality checks: clock, single signals, and consistency between signals.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        Findings in the order of the checks.
    """
    yield from clock.intervals(recording)
    yield from clock.repeated(recording)
    yield from drift.drifts(recording, kind)
    yield from values.steps(recording, kind)
    yield from values.saturated(recording, kind)
    yield from values.still(recording, kind)
    yield from rates.contradictions(recording, kind)
