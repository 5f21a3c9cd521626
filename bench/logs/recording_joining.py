"""Join several recordings of one system into one recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.logs.recording_loading import load_recording
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import InputError, Simulator
from sims.core.user_messages import format_count
from sims.recording.recording import MAX_FOLDS, Recording, split_held_out


def load_joined(
    sources: Sequence[str | Path | Recording],
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    prepared: Callable[[Recording, type[Simulator]], Recording] | None = None,
    fix_base: bool = False,
) -> tuple[Recording, type[Simulator]]:
    """Read several recordings, join them into one, and find their simulator.

    Up to `MAX_FOLDS` runs in total, none of them marked as held out, are cross-validated.
    Otherwise each recording holds out the runs that it would hold out alone, at least one.

    Args:
        sources: Paths of the tables, or recordings in memory.
        system: Registered system to use instead of the one that the recordings name.
        model: Model file of a robot to use instead of the one that the recordings name.
        free: Numbers of a robot's model file to tune; empty for those of the description.
        prepared: Function applied to each recording before its runs are divided; None for none.
        fix_base: Whether to fix floating bodies of a robot in the pose of its model file.

    Returns:
        The joined recording, and the simulator class of its system.

    Raises:
        InputError: One cannot be read, or they are not of one system with the same channels.
    """
    # Runs are divided for fitting and validation below, when their total number is known.
    loaded = [
        load_recording(source, system, model, free, divide=False, fix_base=fix_base)
        for source in sources
    ]
    if prepared is not None:
        loaded = [(prepared(recording, kind), kind) for recording, kind in loaded]
    first_recording, kind = loaded[0]
    if len(loaded) == 1:
        return split_held_out(first_recording, folds=True), kind
    for recording, other_kind in loaded[1:]:
        _check_joinable(first_recording, kind, recording, other_kind)
    recordings = [recording for recording, _ in loaded]
    # A fold is one run that is left out in turn, so few runs are cross-validated.
    all_runs = [run for recording in recordings for run in recording.runs]
    is_cross_validated = len(all_runs) <= MAX_FOLDS and not any(run.held_out for run in all_runs)
    if is_cross_validated:
        # The joined recording is divided into folds.
        return split_held_out(_join_recordings(recordings, kind), folds=True), kind
    return _join_recordings(list(map(split_held_out, recordings)), kind), kind


def _join_recordings(recordings: Sequence[Recording], kind: type[Simulator]) -> Recording:
    """Join recordings of one system into one.

    * Runs get the name of their log in front, since several logs may have the same run names.
    * A constant that the recordings state differently becomes a constant of the runs.
    * The noise of a channel is the root mean square of the stated noises; it is unknown if some
      recording states none.

    Args:
        recordings: recordings with the same channels and inputs.
        kind: simulator class of their system, which declares the constants.
    """
    first_recording = recordings[0]
    names = make_log_names([recording.path for recording in recordings])
    common_constants = {
        key: value
        for key, value in first_recording.constants.items()
        if all(recording.constants.get(key) == value for recording in recordings)
    }
    default_values = {c.name: c.value for c in kind.constants}
    stated_keys = {key for recording in recordings for key in recording.constants}
    differing = stated_keys - common_constants.keys()
    # A constant of a run is the first of these: its own, that of its recording, or the default of
    # the system. The later entry of the dict below takes precedence.
    runs = [
        replace(
            run,
            name=f"{name}: {run.name}",
            log=name,
            constants={
                **{key: default_values.get(key, np.nan) for key in differing},
                **{key: value for key, value in recording.constants.items() if key in differing},
                **run.constants,
            },
        )
        for name, recording in zip(names, recordings, strict=True)
        for run in recording.runs
    ]
    return replace(
        first_recording,
        title=f"{first_recording.title or first_recording.path.stem} and "
        + format_count(len(recordings) - 1, "more log"),
        constants=common_constants,
        noise={
            name: compute_rms([recording.noise[name] for recording in recordings])
            for name in first_recording.noise
            if all(name in recording.noise for recording in recordings)
        },
        runs=tuple(runs),
        notes=tuple(note for recording in recordings for note in recording.notes),
    )


def _check_joinable(
    first: Recording, kind: type[Simulator], other: Recording, other_kind: type[Simulator]
) -> None:
    """Check that a recording can be joined with the first one.

    Both must be of one system (robots: one model file) and have the same channels and inputs, since
    the joined recording is fitted with one simulator.

    Args:
        first: first recording.
        kind: simulator class of its system.
        other: another recording.
        other_kind: simulator class of the system of the other recording.

    Raises:
        InputError: System, model file, channels or inputs of the recordings differ.
    """
    if kind.has_model != other_kind.has_model or other_kind.name != kind.name:
        raise InputError(
            f"{other.path}: expected a log of {kind.name} as {first.path}, found one of "
            f"{other_kind.name}; explain it by itself"
        )
    # The digest of a robot covers its model file, added actuators and free numbers.
    if kind.has_model and vars(other_kind)["source_digest"] != vars(kind)["source_digest"]:
        raise InputError(
            f"{other.path}: expected the model file, the actuators and the free numbers of "
            f"{first.path}, found others; state the same, or give --model and --free"
        )
    first_run, other_run = first.runs[0], other.runs[0]
    for signal_type, first_names, other_names in (
        ("channels", set(first_run.channels), set(other_run.channels)),
        ("inputs", set(first_run.inputs), set(other_run.inputs)),
    ):
        if first_names != other_names:
            raise InputError(
                f"{other.path}: expected the {signal_type} of {first.path}, "
                f"{', '.join(sorted(first_names))}, found "
                f"{', '.join(sorted(other_names)) or 'none'}"
            )


def make_log_names(paths: Sequence[Path]) -> list[str]:
    """Return a different name for each log.

    It is the stem of its path; with its folder if stems repeat, and with its number if these
    repeat, too.

    Args:
        paths: paths of the logs.
    """
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    qualified_names = [f"{path.parent.name}/{path.stem}" for path in paths]
    if len(set(qualified_names)) == len(qualified_names):
        return qualified_names
    return [f"{number}/{name}" for number, name in enumerate(qualified_names, start=1)]
