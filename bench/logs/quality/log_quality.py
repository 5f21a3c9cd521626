"""Run all quality checks of a log: clock, signal values and consistency of channels.

The checks need no fitted model. Each finding is one line with its remedy.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.logs.quality import clock_checks, pose_check, signal_checks
from bench.logs.quality.quality_finding import QualityFinding
from sims.core.simulator import Simulator
from sims.recording.recording import Recording


def check_log_quality(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Run all quality checks: clock, single signals, and consistency between signals.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        Findings in the order of the checks.
    """
    yield from clock_checks.check_intervals(recording)
    yield from clock_checks.check_repeated_samples(recording)
    yield from clock_checks.check_clock_drift(recording, kind)
    yield from signal_checks.check_quantisation(recording, kind)
    yield from signal_checks.check_saturation(recording, kind)
    yield from signal_checks.check_standstill(recording, kind)
    yield from signal_checks.check_velocities(recording, kind)
    yield from pose_check.find_overlaps(recording, kind)
