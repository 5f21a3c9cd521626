"""Read LeRobot datasets as folders of logs, one log per episode.

The log of an episode is ``dataset/episode_000003/frames``. A dataset (versions 2 and 3) has
``meta/info.json`` and ``data/**/*.parquet``: one file per episode, or several episodes per file,
distinguished by the column ``episode_index``. Entries of a list are named as in the dataset,
``observation.state.shoulder_pan.pos``, or numbered where the dataset has no names. Images and
videos are not read. (Layout: huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx.)
"""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from sims.core.simulator import Array, InputError
from sims.recording.log_formats.parquet_columns import (
    is_numeric_type,
    make_unreadable_error,
    read_numeric_columns,
)

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
    """List the files that hold an episode, after the file ``meta/info.json``.

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
    """Read an episode of a dataset.

    Args:
        dataset: Folder of the dataset.
        episode: Number of the episode.

    Returns:
        Numeric columns by name, (T,) or (T, k), and the names of the columns without numbers.

    Raises:
        InputError: There is no such episode, or a file cannot be read.
    """
    import pyarrow
    import pyarrow.parquet as parquet

    info_file, *files = list_episode_files(dataset, episode)
    parts = []
    for file in files:
        try:
            # Images stored in the table are not loaded.
            column_names = [
                field.name for field in parquet.read_schema(file) if is_numeric_type(field.type)
            ]
            rows = [(EPISODE_COLUMN, "==", episode)]
            parts.append(parquet.read_table(file, columns=column_names, filters=rows))
            table = pyarrow.concat_tables(parts)
        except (pyarrow.ArrowException, OSError) as error:
            raise make_unreadable_error(file, error) from None
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
    """Return the names of the entries of a feature; empty where the dataset states none."""
    try:
        entry_names = json.loads(info_file.read_text(encoding="utf-8"))["features"][feature][
            "names"
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    # Some datasets group the names by kind: {"motors": [...]}.
    if isinstance(entry_names, dict) and len(entry_names) == 1:
        (entry_names,) = entry_names.values()
    return (
        entry_names
        if isinstance(entry_names, list)
        and all(isinstance(entry_name, str) for entry_name in entry_names)
        else []
    )


def _find_episode_files(dataset: Path) -> dict[int, list[Path]]:
    """Return the files that hold each episode."""
    files = sorted((dataset / "data").rglob("*.parquet"))
    stamps = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    return _find_cached_episode_files(stamps)


@lru_cache(maxsize=8)
def _find_cached_episode_files(stamps: tuple[tuple[Path, int, int], ...]) -> dict[int, list[Path]]:
    """Return the files that hold each episode; cached for unchanged files.

    Args:
        stamps: Path, time of last change (ns) and size (bytes) of each file.
    """
    import pyarrow
    import pyarrow.parquet as parquet

    files_by_episode: dict[int, list[Path]] = {}
    for file, *_ in stamps:
        try:
            column = parquet.read_table(file, columns=[EPISODE_COLUMN]).column(EPISODE_COLUMN)
            numbers = np.unique(column.to_numpy().astype(np.int64)).tolist()
        except (pyarrow.ArrowException, OSError, KeyError, ValueError, TypeError) as error:
            raise make_unreadable_error(file, error) from None
        for number in numbers:
            files_by_episode.setdefault(number, []).append(file)
    return files_by_episode
