"""The census of a recording: what its clock, its values and its channels tell of the log itself,
before any model is asked. Each finding is one line with its remedy.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.recordings.census import clock, drift, rates, values
from bench.recordings.census.finding import Finding
from sims.base import Simulator
from sims.recording.recording import Recording


def census(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    """Everything found: of the clock, of single signals, of signals beside each other.

    Args:
        recording: as it was read.
        kind: a simulator of its system.
    """
    yield from clock.intervals(recording)
    yield from clock.repeated(recording)
    yield from drift.drifts(recording, kind)
    yield from values.steps(recording, kind)
    yield from values.saturated(recording, kind)
    yield from values.still(recording, kind)
    yield from rates.contradictions(recording, kind)
