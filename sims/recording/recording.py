"""Recordings: a table `NAME.csv` and its description `NAME.toml`, read and checked.

The table has the columns `run`, `t` (seconds, increasing within a run) and one for each channel and
input, in the units that the description states; an empty cell is a missing sample. Values are
converted to SI units. Nothing is guessed, and the files are not changed. Every error is one line:
file, row, column, what was expected, what was found.

The runs are divided into runs for fitting and held-out runs or cross-validation folds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.core.angles_and_quaternions import unwrap_angle
from sims.core.simulator import Array, InputError, make_read_only
from sims.core.toml_validation import check_known_names
from sims.recording.column_mapping import RecordingSources
from sims.recording.csv_table import CsvRun, has_run_column, read_table
from sims.recording.drive_switches import apply_drive_switches
from sims.recording.log_time_alignment import read_logs
from sims.recording.recorded_poses import convert_quaternions
from sims.recording.recording_description import (
    DeclaredSignals,
    ModelFileReference,
    RecordingDescription,
    RunMetadata,
    check_description,
    get_model_reference,
    read_meta,
    read_system_name,
)
from sims.recording.unit_conversion import convert_values

__all__ = ["DeclaredSignals", "Recording", "Run", "read_recording", "read_system_name"]

Mask = NDArray[np.bool_]
Number = TypeVar("Number", bound=np.generic)

INPUT_HISTORY_SECONDS = 2.0
"""Input history stored with a part of a run, in seconds.

Delays, rate limits and motion profiles do not depend on earlier inputs.
"""

_UNMARKED = RunMetadata({}, {}, None)
"""Metadata of a run that the description does not mention."""

MAX_FOLDS = 3
"""Maximum number of unmarked runs for cross-validation; of more, every third is held out."""

_HELD_OUT_STRIDE = 3
"""Every third run, or the last third of the samples of a single run, is held out."""


@dataclass(frozen=True, repr=False)
class Run:
    """One run of a recording.

    Attributes:
        name: Name, as in the `run` column.
        times: (T,) sample times, s.
        channels: Measured signals by name, each (T,), SI units, NaN where missing.
        inputs: Input signals by name, each (T,), SI units.
        constants: Constants stated for this run alone, SI units.
        initial: Known initial state, SI units.
        held_out: Whether the run is used for validation only, never for fitting.
        extra: Columns that are neither channel nor input of the system, each (T,), in the units in
            which they are written.
        linear: Inputs that are interpolated linearly between samples; the others are held.
        offset: Delay of the inputs relative to their stamps, s.
        log: Name of the log that the run is from, if several recordings were joined.
        fold: Number of the cross-validation fold that leaves this run out and predicts it; None
            without cross-validation.
        before: Inputs before the start of a part of a run, as in `Scenario`.
        off: Whether actuators of a robot are switched off, each (T,), by name.
        memory: Length of the input history that is stored with a part of this run, s.
    """

    name: str
    times: Array
    channels: Mapping[str, Array]
    inputs: Mapping[str, Array]
    constants: Mapping[str, float]
    initial: Mapping[str, float]
    held_out: bool
    extra: Mapping[str, Array] = field(default_factory=dict)
    linear: frozenset[str] = frozenset()
    offset: float = 0.0
    log: str = ""
    fold: int | None = None
    before: Mapping[str, Array] = field(default_factory=dict)
    off: Mapping[str, Mask] = field(default_factory=dict)
    memory: float = INPUT_HISTORY_SECONDS

    def __repr__(self) -> str:
        """Return a summary in one line: name, number of samples, duration and use."""
        # Without this, a notebook cell that ends in a run would print all of its samples.
        seconds = self.times[-1] - self.times[0] if self.times.size else 0.0
        use = "held out" if self.held_out else "for fitting"
        if self.fold is not None:
            use += f", left out of fold {self.fold + 1}"
        return f"<run {self.name}: {self.times.size} samples, {seconds:.4g} s, {use}>"

    def part(self, rows: slice, name: str = "") -> Run:
        """Return a part of the run as a run of its own.

        It is used to divide a long run into segments, for example. Inputs before the part are
        stored as its history, for effects such as a delay.

        Args:
            rows: Samples of the part; a slice with a step thins the run.
            name: Name of the part; that of the run if empty.
        """

        def cut(signals: Mapping[str, NDArray[Number]]) -> dict[str, NDArray[Number]]:
            return {key: values[rows] for key, values in signals.items()}

        return replace(
            self,
            name=name or self.name,
            times=self.times[rows],
            channels=cut(self.channels),
            inputs=cut(self.inputs),
            # The known initial state belongs to the first sample of the whole run. A start of None
            # or 0 is this sample.
            initial={} if rows.start else self.initial,
            extra=cut(self.extra),
            off=cut(self.off),
            before={name: self._get_input_history(name, rows.start or 0) for name in self.inputs},
        )

    def _get_input_history(self, name: str, row: int) -> Array:
        """Return the history of an input before a sample, which is stored with a part of a run.

        Effects such as a delay need the inputs before the part. The history that the run itself has
        comes first; everything older than `memory` seconds is dropped.

        Args:
            name: Name of the input.
            row: Index of the sample.

        Returns:
            (2, K) times relative to the sample (s, negative) and values, K of each.
        """
        # Times in this history are relative to the first sample of the run.
        earlier_times, earlier_values = self.before.get(name, np.empty((2, 0)))
        times = np.concatenate([earlier_times + self.times[0], self.times[:row]]) - self.times[row]
        values = np.concatenate([earlier_values, self.inputs[name][:row]])
        return np.stack([times, values])[:, times >= -self.memory]


@dataclass(frozen=True, repr=False)
class Recording:
    """Recording of a system, in SI units.

    Attributes:
        path: Path of the table.
        system: Name of the recorded system.
        title: Title in one line.
        constants: Known constants, SI units.
        noise: Standard deviation of each channel's noise where stated, SI units.
        runs: All runs, in order.
        extra: Units of the columns that belong to no channel or input, such as pixels of a tracked
            film.
        model: Model file, if the system is a robot.
        notes: Remarks on how the logs were read, such as samples that were left out, or times in
            which drives are off.
    """

    path: Path
    system: str
    title: str
    constants: Mapping[str, float]
    noise: Mapping[str, float]
    runs: tuple[Run, ...]
    extra: Mapping[str, str] = field(default_factory=dict)
    model: ModelFileReference | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return a summary in one line: table, system, number of runs, and channels."""
        first = self.runs[0] if self.runs else None
        channels = ", ".join(first.channels) if first else "none"
        runs = f"{len(self.runs)} runs, {len(self.held_out())} of them held out"
        if self.folds():
            runs = f"{len(self.runs)} runs, cross-validated in {len(self.folds())} folds"
        return f"<recording {self.path.name}: {self.system}, {runs}, channels {channels}>"

    def training(self) -> tuple[Run, ...]:
        """Return the runs for fitting."""
        return tuple(run for run in self.runs if not run.held_out)

    def held_out(self) -> tuple[Run, ...]:
        """Return the held-out runs, which are used for validation only."""
        return tuple(run for run in self.runs if run.held_out)

    def folds(self) -> tuple[int, ...]:
        """Return the numbers of the cross-validation folds; empty if runs are held out instead."""
        return tuple(sorted({run.fold for run in self.runs if run.fold is not None}))


def read_recording(path: str | Path, declared: DeclaredSignals, whole: bool = False) -> Recording:
    """Read `NAME.csv` and `NAME.toml` and check them against a system.

    Channels, inputs, constants and states must be those of the system. The description decides
    which of these is read:

    * a table in the format of simgap, whose columns have the names of the system's signals
    * such a table with other names of columns
    * logs, perhaps in several files, which are joined by their time stamps

    Args:
        path: Path of the table.
        declared: System, or simulator of it; `read_system_name` reads which system the recording
            states.
        whole: Whether to hold out only the runs that the description marks; False to hold out every
            third run, or the last third of a single run, if no run is marked.

    Raises:
        InputError: The recording is malformed; the message is one line.
    """
    table = Path(path)
    description_path, meta = read_meta(table)
    description = check_description(description_path, meta, declared)
    channels, inputs = list(description.channels), list(description.inputs)
    csv_path = table.with_suffix(".csv") if table.suffix == ".toml" else table
    sources = description.sources
    if not sources.stated or (sources.is_renaming and has_run_column(csv_path)):
        table = csv_path
        parts = _read_own_table(csv_path, sources, channels, inputs, list(description.extra))
    else:
        parts = read_logs(table.with_suffix(".csv"), sources, channels, inputs, description.linear)
    model = get_model_reference(description_path, meta)
    recording = assemble_recording(table, parts, description, description_path, model)
    if whole:
        return recording
    return replace(recording, runs=_split_runs(description_path, recording.runs, folds=False))


def assemble_recording(
    table: Path,
    parts: Sequence[CsvRun],
    description: RecordingDescription,
    description_path: Path,
    model: ModelFileReference | None,
) -> Recording:
    """Make a recording in SI units from the tables of its runs and its description.

    All ways to read a recording end here: from a table, from logs or from a data frame.

    Args:
        table: path of the table.
        parts: table of each run, in the units of the file.
        description: checked description.
        description_path: its path, for messages.
        model: model file of a robot; None for a system.
    """
    check_known_names(
        f"entry in [runs] of {description_path}", description.runs, [part.name for part in parts]
    )
    switched = apply_drive_switches(
        table, [_make_run(table, part, description) for part in parts], description.switches
    )
    return Recording(
        path=table,
        system=description.system,
        title=description.title,
        constants=description.constants,
        noise=description.noise,
        runs=switched.runs,
        extra=description.extra,
        model=model,
        notes=(*(note for part in parts for note in part.notes), *switched.notes),
    )


def _read_own_table(
    path: Path,
    sources: RecordingSources,
    channels: Sequence[str],
    inputs: Sequence[str],
    extra: Sequence[str],
) -> list[CsvRun]:
    """Read a table in the format of simgap, whose columns the description may rename.

    Args:
        path: Path of the table.
        sources: Column of each signal.
        channels: Names of the channels.
        inputs: Names of the inputs.
        extra: Names of the other columns.

    Returns:
        The runs, with columns by the names of the signals.
    """

    def columns_of(names: Sequence[str]) -> list[str]:
        """Return the columns of some signals, each once; a signal may combine several."""
        return list(dict.fromkeys(c for name in names for c in sources.signals[name].columns))

    channel_columns = columns_of(channels)
    input_columns = [column for column in columns_of(inputs) if column not in channel_columns]
    # An extra column is never a sum of several.
    extra_columns = {name: sources.extra[name].columns[0] for name in extra}
    renamed_runs = []
    for part in read_table(path, channel_columns, input_columns, list(extra_columns.values())):
        values = {
            name: sources.signals[name].combine(part.columns.__getitem__)
            for name in (*channels, *inputs)
        }
        values |= {name: part.columns[column] for name, column in extra_columns.items()}
        renamed_runs.append(part._replace(columns=values))
    return renamed_runs


def _make_run(table: Path, part: CsvRun, description: RecordingDescription) -> Run:
    """Make a run in SI units from its table and the metadata of the description.

    Units are converted, quaternions become angles, and wrapped angles are unwrapped (their whole
    turns are restored). The initial pose of a floating body, which no channel shows, is the first
    cell of an extra column (neither channel nor input), unless the description states it.

    Args:
        table: path of the table, for messages.
        part: columns of the run in the units of the file.
        description: units, scales and metadata from the TOML file.
    """
    metadata = description.runs.get(part.name, _UNMARKED)
    subject = f"{table}: run {part.name!r}"
    channels = {
        name: convert_values(part.columns[name], scale, f"{subject}, column {name}")
        for name, scale in description.channels.items()
    }
    inputs = {
        name: convert_values(part.columns[name], scale, f"{subject}, column {name}")
        for name, scale in description.inputs.items()
    }
    for base, reference in description.orientations.items():
        channels = convert_quaternions(channels, base, reference, subject)
    for name, command in description.wrapped.items():
        channels[name] = make_read_only(unwrap_angle(channels[name], inputs.get(command)))
    # Extra columns keep their unit, because no system reads them.
    extra = {name: part.columns[name] for name in description.extra if name in part.columns}
    initial_values = {
        name: scale.gain * extra[name][0] + scale.offset
        for name, scale in description.initial_pose_scales.items()
        if name in extra
    }
    initial_pose = {
        name: float(value) for name, value in initial_values.items() if np.isfinite(value)
    }
    return Run(
        name=part.name,
        times=part.times,
        channels=channels,
        inputs=inputs,
        constants=metadata.constants,
        initial={**initial_pose, **metadata.initial},
        held_out=bool(metadata.held_out),
        extra=extra,
        linear=description.linear,
        offset=description.sources.offset,
    )


def split_held_out(recording: Recording, folds: bool = False) -> Recording:
    """Divide the runs of a recording into runs for fitting and held-out runs.

    Marked runs are held out; without marks every third run, or the last third of a single run.

    Args:
        recording: Recording with its marks.
        folds: Whether to number two or three unmarked runs as cross-validation folds instead of
            holding one of them out.

    Raises:
        InputError: All runs are held out, or a single run is too short to be divided.
    """
    path = recording.path
    description = path.with_suffix(".toml") if path.suffix == ".csv" else path
    return replace(recording, runs=_split_runs(description, recording.runs, folds))


def _split_runs(path: Path, runs: Sequence[Run], folds: bool) -> tuple[Run, ...]:
    """Divide the runs into runs for fitting and held-out runs, on which predictions are tested.

    There are four cases:

    * Some runs are marked as held out: only these are.
    * A single run is divided into two; its last third is held out.
    * Two or three runs, with `folds`: each gets the number of a cross-validation fold, and is
      predicted from the others.
    * Otherwise every third run is held out; of two, the second.

    Args:
        path: path of the recording, for messages.
        runs: all runs.
        folds: whether to cross-validate two or three unmarked runs.

    Returns:
        The runs with `held_out` or `fold` set.

    Raises:
        InputError: all runs are marked as held out, or a single run is too short.
    """
    runs = [replace(run, fold=None) for run in runs]
    if any(run.held_out for run in runs):
        if all(run.held_out for run in runs):
            raise InputError(
                f"{path}: every run is marked held_out; "
                "expected at least one that is not, for fitting"
            )
        return tuple(runs)
    if len(runs) == 1:
        return _split_run(path, runs[0])
    if folds and len(runs) <= MAX_FOLDS:
        return tuple(replace(run, fold=number) for number, run in enumerate(runs))
    # The last of every three runs, so that the first ones are fitted.
    is_held_out = [
        i % _HELD_OUT_STRIDE == _HELD_OUT_STRIDE - 1 or (len(runs) == 2 and i == 1)
        for i in range(len(runs))
    ]
    return tuple(
        replace(run, held_out=held_out) for run, held_out in zip(runs, is_held_out, strict=True)
    )


def _split_run(path: Path, run: Run) -> tuple[Run, ...]:
    """Split a run into its first two thirds and its last third, which is held out.

    A recording needs data that no fit has seen, to validate the result.

    Args:
        path: path of the recording, for messages.
        run: recorded run: times, channels and inputs.

    Raises:
        InputError: a part would have too few samples.
    """
    count = len(run.times)
    split_index = (2 * count) // 3
    parts = (
        replace(run.part(slice(split_index)), held_out=False),
        replace(run.part(slice(split_index, None)), held_out=True),
    )
    for part in parts:
        is_measured = any(np.isfinite(values).any() for values in part.channels.values())
        if len(part.times) < 2 or not is_measured:
            raise InputError(
                f"{path}: the only run is too short to hold its last third out: {count} rows; "
                "expected at least 4, with samples in both parts"
            )
    return parts
