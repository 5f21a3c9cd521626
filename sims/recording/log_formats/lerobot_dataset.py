"""Read LeRobot datasets, one log per episode, and the calibration files that give their angles.

The log of an episode is ``dataset/episode_000003/frames``. A dataset (versions 2 and 3) has
``meta/info.json`` and ``data/**/*.parquet``: one file per episode, or several episodes per file,
distinguished by the column ``episode_index``. Entries of a list are named as in the dataset,
``observation.state.shoulder_pan.pos``, or numbered where the dataset has no names. Images and
videos are not read. (Layout: huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx.)

A calibration file has a table for each motor, ``{"elbow_flex": {"id": 3, "drive_mode": 0,
"homing_offset": 85, "range_min": 820, "range_max": 3110}}``, in counts of the encoder.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.core.files import require_file
from sims.core.simulator import Array, InputError
from sims.recording.log_formats.hdf5_and_parquet import is_numeric_type, read_numeric_columns
from sims.recording.log_formats.log_columns import convert_read_errors

FRAMES_LOG = "frames"
"""Name of the log of an episode."""
EPISODE_COLUMN = "episode_index"
"""Name of the column with the number of the episode of each row."""
_INSIDE = re.compile(r"episode_(?P<number>\d{1,9})/" + FRAMES_LOG)


def is_dataset(path: Path) -> bool:
    """Return whether a path is the folder of a LeRobot dataset."""
    return (path / "meta" / "info.json").is_file() and (path / "data").is_dir()


def split_episode_path(path: Path) -> tuple[Path, int] | None:
    """Split a path into a dataset and an episode number; None if it is not inside a dataset."""
    if path.exists():
        return None
    dataset = path.parent.parent
    match = _INSIDE.fullmatch(path.relative_to(dataset).as_posix())
    return (dataset, int(match["number"])) if match and is_dataset(dataset) else None


def list_episodes(dataset: Path) -> list[Path]:
    """List the logs of all episodes, ordered by episode number.

    Raises:
        InputError: A file cannot be read, or has no episode numbers.
    """
    return [
        dataset / f"episode_{number:06d}" / FRAMES_LOG
        for number in sorted(_find_episode_files(dataset))
    ]


def list_episode_files(dataset: Path, episode: int) -> list[Path]:
    """List the files that hold an episode: ``meta/info.json``, then its Parquet files.

    Args:
        dataset: Folder of the dataset.
        episode: Number of the episode.

    Raises:
        InputError: There is no such episode, or a file cannot be read.
    """
    files_by_episode = _find_episode_files(dataset)
    if episode not in files_by_episode:
        span = f"{min(files_by_episode)} to {max(files_by_episode)}" if files_by_episode else "none"
        raise InputError(f"{dataset}: no episode {episode}; there are: {span}")
    return [dataset / "meta" / "info.json", *files_by_episode[episode]]


def read_episode(dataset: Path, episode: int) -> tuple[dict[str, Array], list[str]]:
    """Read an episode of a dataset: its rows in all files that have some, without images.

    Shapes: T rows.

    A column of lists whose entries the dataset names becomes a column for each entry, such as
    ``observation.state.elbow_flex.pos``.

    Args:
        dataset: Folder of the dataset.
        episode: Number of the episode.

    Returns:
        Numeric columns by name, (T,), or (T, k) for lists of k numbers; and the names of the
        columns without numbers.

    Raises:
        InputError: There is no such episode, or a file cannot be read.
    """
    import pyarrow
    import pyarrow.parquet as parquet

    info_file, *files = list_episode_files(dataset, episode)
    parts = []
    for file in files:
        with convert_read_errors(file, "a Parquet file"):
            # Images stored in the table are not loaded.
            column_names = [
                field.name for field in parquet.read_schema(file) if is_numeric_type(field.type)
            ]
            row_filter = [(EPISODE_COLUMN, "==", episode)]
            parts.append(parquet.read_table(file, columns=column_names, filters=row_filter))
            # Joined here, so that the error for a file with other columns names that file.
            table = pyarrow.concat_tables(parts)
    numeric_columns, texts = read_numeric_columns(table)
    columns: dict[str, Array] = {}
    for name, values in numeric_columns.items():
        entry_names = _list_feature_names(info_file, name)
        if values.ndim == 2 and len(entry_names) == values.shape[1] == len(set(entry_names)):
            columns |= {
                f"{name}.{entry_name}": values[:, k] for k, entry_name in enumerate(entry_names)
            }
        else:
            columns[name] = values
    return columns, texts


def _list_feature_names(info_file: Path, feature: str) -> list[str]:
    """Return the names of the entries of a feature (a column); empty where none are stated.

    Args:
        info_file: path of ``meta/info.json``.
        feature: name of the feature, such as ``observation.state``.
    """
    try:
        info = json.loads(info_file.read_text(encoding="utf-8"))
        entry_names = info["features"][feature]["names"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    # Some datasets group the names by kind: {"motors": [...]}.
    if isinstance(entry_names, dict) and len(entry_names) == 1:
        (entry_names,) = entry_names.values()
    is_list = isinstance(entry_names, list)
    return entry_names if is_list and all(isinstance(name, str) for name in entry_names) else []


def _find_episode_files(dataset: Path) -> dict[int, list[Path]]:
    """Return the files that hold each episode."""
    files = sorted((dataset / "data").rglob("*.parquet"))
    stamps = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    return _find_cached_episode_files(stamps)


@lru_cache(maxsize=8)
def _find_cached_episode_files(stamps: tuple[tuple[Path, int, int], ...]) -> dict[int, list[Path]]:
    """Return the files that hold each episode, by episode number; cached for unchanged files.

    Args:
        stamps: Path, time of last change (ns) and size (bytes) of each file. The last two are part
            of the cache key only.
    """
    import pyarrow.parquet as parquet

    files_by_episode: dict[int, list[Path]] = {}
    for file, *_ in stamps:
        with convert_read_errors(file, "a Parquet file"):
            column = parquet.read_table(file, columns=[EPISODE_COLUMN]).column(EPISODE_COLUMN)
            numbers = np.unique(column.to_numpy().astype(np.int64)).tolist()
        for number in numbers:
            files_by_episode.setdefault(number, []).append(file)
    return files_by_episode


MAX_FILE_BYTES = 1_000_000
"""Maximum size of a file that is read as a possible calibration, in bytes."""
_KEYS = ("range_min", "range_max")


class MotorRange(NamedTuple):
    """Calibrated range of one motor in counts, and whether its sign is reversed."""

    lowest: float
    highest: float
    reversed: bool


def read_calibration(path: Path) -> dict[str, MotorRange]:
    """Read the ranges of all motors from a calibration file of LeRobot.

    The file states which positions of a motor, in encoder counts, are the ends of the normalised
    range, and whether its sign is reversed (``drive_mode``).

    Args:
        path: JSON file with a table for each motor.

    Returns:
        Range of each motor by name.

    Raises:
        InputError: The file is not a calibration file, or a range is empty; the message is one
            line.
    """
    require_file(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{path}: expected JSON, a calibration file of LeRobot") from None
    motors = _get_motor_tables(document)
    if motors is None:
        raise InputError(
            f"{path}: expected a calibration file of LeRobot, a table for each motor with "
            "range_min and range_max"
        )
    ranges = {}
    for name, motor in motors.items():
        lowest, highest = float(motor["range_min"]), float(motor["range_max"])
        if not lowest < highest:
            raise InputError(
                f"{path}: {name}: expected range_min below range_max, found {lowest:g} and "
                f"{highest:g}; calibrate the robot again"
            )
        ranges[name] = MotorRange(lowest, highest, bool(motor.get("drive_mode", 0)))
    return ranges


def find_calibration(folders: Iterable[Path]) -> Path | None:
    """Return the only calibration file in some folders; None if there is none or more than one.

    A calibration is recognised by its tables of motors, whatever the name of the file.

    Args:
        folders: Folders in which a calibration may be.
    """
    calibration_files = []
    for folder in folders:
        if not folder.is_dir():
            continue
        for path in sorted(folder.glob("*.json")):
            try:
                if path.stat().st_size > MAX_FILE_BYTES:
                    continue
                document = json.loads(path.read_text(encoding="utf-8-sig"))
            except (OSError, ValueError, RecursionError):
                continue
            if _get_motor_tables(document) is not None:
                calibration_files.append(path)
    return calibration_files[0] if len(calibration_files) == 1 else None


def _get_motor_tables(document: Any) -> Mapping[str, Mapping[str, Any]] | None:
    """Return the tables of the motors by name; None if the document is not a calibration.

    It is one if each entry is a table with the numbers `range_min` and `range_max`.

    Args:
        document: Content of a JSON file.
    """
    if not isinstance(document, dict) or not document:
        return None
    for motor in document.values():
        if not isinstance(motor, dict):
            return None
        if not all(isinstance(motor.get(key), int | float) for key in _KEYS):
            return None
    return document
