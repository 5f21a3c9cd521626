"""Run all checks of a log: clock, signal values and consistency of channels.

The checks need no fitted model. Quality checks give findings, each with its remedy; implausible
logs are refused.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.core.resource_estimates import FORCE_HINT
from bench.logs.importing.normalised_positions import check_normalised_positions
from bench.logs.quality import (
    clock_checks,
    pose_check,
    range_checks,
    servo_checks,
    signal_checks,
    velocity_checks,
)
from bench.logs.quality.quality_finding import Anomaly, QualityFinding
from sims.core.simulator import InputError, Simulator
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
    yield from velocity_checks.check_velocities(recording, kind)
    yield from pose_check.find_overlaps(recording, kind)


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
        *clock_checks.find_anomalies(recording, kind),
        *pose_check.find_missing_base_poses(recording, kind),
        *(
            Anomaly(overlap.text_line, False)
            for overlap in pose_check.find_overlaps(recording, kind)
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
