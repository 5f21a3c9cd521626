"""Cut long recordings of robots into segments with their own initial states.

Long recordings are cut because a search costs simulator steps, and segments from all over a
recording are nearly as informative as the whole. Recordings of drifting or unstable motion, which
no simulation follows for long, are cut if the user requests it.

A search costs about

    steps x evaluations of a step x (joints + 3)                                                (1)

as measured with one joint and with six. Segments are spread evenly over each run and begin where
its commands have been quiet, so that the effect of earlier commands has nearly decayed; the earlier
samples that drives may still depend on are kept with each segment.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError, Simulator
from sims.recording.drive_switches import Mask, spans
from sims.recording.recording import Recording, Run

MAX_RECORDING_COST = 1.6e5
"""Cost (1) above which a recording is cut: 35 s of six joints at a step of 2 ms."""
SEGMENT_SECONDS = 2.0
"""Duration of a segment in seconds, unless runs are shorter."""
MIN_SEGMENT_INTERVALS = 20
"""Minimum number of sampling intervals of a segment."""
ROUNDING_SECONDS = 1e-9
"""Tolerance in seconds for rounding errors at the end of a segment."""
QUIET_LEAD_SECONDS = 0.2
"""Duration in seconds before a segment in which its commands should change little."""


STEP_COST_BY_INTEGRATOR = {"RK4": 2.0}
"""Cost of a step by integrator, 1 otherwise: half of RK4's four evaluations is saved elsewhere."""


class SegmentedRecording(NamedTuple):
    """A segmented recording and a message about it, which is empty if the recording is whole."""

    recording: Recording
    note: str


def segment_recording(
    recording: Recording,
    kind: type[Simulator],
    seconds: float | None = None,
    whole: bool = False,
) -> SegmentedRecording:
    """Cut the runs of a recording into segments if it is too long or if the user requests it.

    The runs for fitting are reduced to segments that together cost `MAX_RECORDING_COST` to
    simulate, and so are the held-out runs. All of these runs are reduced by the same factor, but at
    least one segment of each is kept. Of robots with floating bodies only the beginnings of runs
    are used, because the pose of the body is known there only.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system; without a model file it is cut only on request.
        seconds: Duration of a segment if every run is to be cut; None to cut long recordings only,
            into segments of `SEGMENT_SECONDS` seconds.
        whole: Whether to allow any cost: all segments are kept, or the recording is left whole if
            `seconds` is None.

    Returns:
        The recording, with a message for the user.

    Raises:
        InputError: Segments are requested for a robot with floating bodies.
    """
    if seconds is None and (whole or not kind.has_model):
        return SegmentedRecording(recording, "")
    robot: Any = kind
    is_floating = kind.has_model and bool(robot.system.required_state_units)
    if is_floating and seconds is not None:
        raise InputError(
            f"{recording.path}: expected no --pieces: {recording.system} has a floating base, "
            "whose pose at the start of a piece is not known; leave it out"
        )
    is_limited = kind.has_model and not whole
    affordable_seconds = _compute_affordable_seconds(kind) if is_limited else np.inf
    segments: list[Run] = []
    notes = []
    # The limit holds for the runs for fitting and for the held-out runs separately.
    for purpose, runs in (("fitting", recording.training()), ("measuring", recording.held_out())):
        total_seconds = sum(map(_compute_duration, runs))
        if total_seconds <= affordable_seconds and seconds is None:
            segments += runs
            continue
        share = min(affordable_seconds / total_seconds, 1.0) if total_seconds > 0 else 1.0
        cut_run = _take_beginning if is_floating else _cut_run
        new_segments = [
            segment
            for run in runs
            for segment in cut_run(run, share * _compute_duration(run), seconds or SEGMENT_SECONDS)
        ]
        segments += new_segments
        used_seconds = sum(map(_compute_duration, new_segments))
        notes.append(
            f"{used_seconds:.3g} s of {total_seconds:.4g} s for {purpose}, "
            f"in {len(new_segments)} pieces"
        )
    if not notes:
        return SegmentedRecording(recording, "")
    summary = " and ".join(notes)
    is_reduced = affordable_seconds < sum(map(_compute_duration, recording.training()))
    origin_note = " from the whole recording (--whole uses all of it)" if is_reduced else ""
    note = f"of the recording {summary} were used{origin_note}"
    return SegmentedRecording(replace(recording, runs=tuple(segments)), note)


def _compute_affordable_seconds(kind: type[Simulator]) -> float:
    """Return the seconds of a robot's motion that cost `MAX_RECORDING_COST`.

    The cost of a simulation is (number of steps) (evaluations per step) (number of joints + 3) (1);
    the evaluations depend on the integrator.

    Args:
        kind: Simulator class of the robot.
    """
    robot: Any = kind
    step, integrator, *_ = robot.numerics  # step in s
    joints = sum(joint.has_one_coordinate for joint in robot.robot.joints)
    return float(
        MAX_RECORDING_COST * step / (joints + 3) / STEP_COST_BY_INTEGRATOR.get(integrator, 1.0)
    )


def _compute_duration(run: Run) -> float:
    return float(run.times[-1] - run.times[0])


def _cut_run(run: Run, seconds: float, max_length: float) -> list[Run]:
    """Cut segments out of a run that last about `seconds` in total.

    The run is divided into equal parts, one for each segment. Within its part, a segment begins at
    the sample before which the commands have changed least: the unknown motion before it then
    matters least. The samples between the segments are not used.

    Args:
        run: run to cut.
        seconds: total duration of the segments.
        max_length: longest duration of a segment, s.

    Returns:
        The segments in order, each a run that is named after its begin.
    """
    length = min(max_length, seconds)
    # A segment needs a few samples, even if only little of a run may be kept.
    length = max(length, MIN_SEGMENT_INTERVALS * float(np.median(np.diff(run.times))))
    # Number of segments, rounded to the nearest one.
    count = max(int(seconds / length + 0.5), 1)
    spacing = _compute_duration(run) / count
    length = min(length, spacing)
    change = _compute_command_changes(run)
    segments = []
    for number in range(count):
        # A segment may begin anywhere in its part of the run that leaves enough room for it.
        first = run.times[0] + number * spacing
        first_allowed, end_allowed = np.searchsorted(
            run.times, (first, first + max(spacing - length, 0.0))
        )
        end_allowed = max(end_allowed, first_allowed + 1)
        begin = int(first_allowed + np.argmin(change[first_allowed:end_allowed]))
        # The sample at its very end is the first sample of the next segment.
        end = int(np.searchsorted(run.times, run.times[begin] + length - ROUNDING_SECONDS))
        name = f"{run.name} from {run.times[begin]:.4g} s"
        segments.append(run.part(slice(begin, end), name))
    return segments


def _take_beginning(run: Run, seconds: float, _: float) -> list[Run]:
    """Return the beginning of a run, the only part with a known pose of floating bodies.

    Args:
        run: recorded run: times, channels and inputs.
        seconds: length of the beginning.
        _: unused, for the signature of `_cut_run`.

    Returns:
        One segment of at least `MIN_SEGMENT_INTERVALS` samples.
    """
    end = int(np.searchsorted(run.times, run.times[0] + seconds - ROUNDING_SECONDS))
    return [
        run.part(
            slice(0, max(end, MIN_SEGMENT_INTERVALS)), f"{run.name}, its first {seconds:.4g} s"
        )
    ]


def _compute_command_changes(run: Run) -> Array:
    """Return (T,) how much the commands change before each sample.

    It is the sum of the absolute changes within the last `QUIET_LEAD_SECONDS`, each divided by the
    range of its command, over all commands; 0 means that the commands were constant.

    Args:
        run: Run with its inputs.
    """
    # Index of the sample at which the time considered begins.
    lead_starts = np.searchsorted(run.times, run.times - QUIET_LEAD_SECONDS)
    total = np.zeros(run.times.size)
    for values in run.inputs.values():
        spread = float(np.ptp(values))
        if spread > 0:
            cumulative_change = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(values)))]) / spread
            total += cumulative_change - cumulative_change[lead_starts]
    return total


MIN_PART_SAMPLES = 10
"""Minimum number of samples of a part of a run; fewer determine no more than an initial state."""


def split_without_masked(run: Run, mask: Mask) -> list[Run]:
    """Cut the samples that a mask marks out of a run, and return the remaining parts.

    Parts of fewer than `MIN_PART_SAMPLES` samples, or without any measurement, are left out. If the
    mask is set nowhere, the run itself is returned.

    Args:
        run: recorded run: times, channels and inputs.
        mask: (T,) whether a sample is cut out.
    """
    if not mask.any():
        return [run]
    split_runs = []
    for first, end in spans(~mask):
        if end - first < MIN_PART_SAMPLES:
            continue
        name = f"{run.name} from {run.times[first]:.4g} s" if first else run.name
        part = run.part(slice(first, end), name)
        if any(np.isfinite(values).any() for values in part.channels.values()):
            split_runs.append(part)
    return split_runs
