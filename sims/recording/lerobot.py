"""Datasets of LeRobot as folders of logs: an episode is a log, ``dataset/episode_000003/frames``.

A dataset (versions 2 and 3) has ``meta/info.json`` and ``data/**/*.parquet``: a file for each
episode, or several in one, told apart by the column ``episode_index``. Numbers of a list are named
as the dataset names them, ``observation.state.shoulder_pan.pos``, and by place where it does not.
Images and videos are left alone. (Layout: huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx.)
"""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from sims.base import Array, InputError
from sims.recording.columnar import columns_of, may_hold, unreadable

FRAMES = "frames"
"""The log of an episode."""
EPISODE = "episode_index"
"""The column that says which episode a row is of."""
_INSIDE = re.compile(r"episode_(?P<number>\d{1,9})/" + FRAMES)


def is_dataset(path: Path) -> bool:
    """Whether this is the folder of a dataset."""
    return (path / "meta" / "info.json").is_file() and (path / "data").is_dir()


def episode_of(path: Path) -> tuple[Path, int] | None:
    """The dataset that a path leads into, and the episode there; None where it leads into none."""
    if path.exists():
        return None
    dataset = path.parent.parent
    match = _INSIDE.fullmatch(path.relative_to(dataset).as_posix())
    return (dataset, int(match["number"])) if match and is_dataset(dataset) else None


def episodes(dataset: Path) -> list[Path]:
    """The log of each episode, in their order.

    Raises:
        InputError: a file cannot be read, or says no episode.
    """
    return [dataset / f"episode_{number:06d}" / FRAMES for number in sorted(_files(dataset))]


def files_of(dataset: Path, episode: int) -> list[Path]:
    """Where an episode stands.

    Raises:
        InputError: there is no such episode; else as `episodes`.
    """
    there = _files(dataset)
    if episode not in there:
        span = f"{min(there)} to {max(there)}" if there else "none"
        raise InputError(f"{dataset}: no episode {episode}; there are: {span}")
    return [dataset / "meta" / "info.json", *there[episode]]


def read_episode(dataset: Path, episode: int) -> tuple[dict[str, Array], list[str]]:
    """Numbers of an episode by name, (T,) or (T, k), and the names of what holds none.

    Raises:
        InputError: as `files_of`.
    """
    import pyarrow
    import pyarrow.parquet as parquet

    about, *files = files_of(dataset, episode)
    parts = []
    for file in files:
        try:
            # Images in a table are not read for their numbers' sake.
            kept = [field.name for field in parquet.read_schema(file) if may_hold(field.type)]
            rows = [(EPISODE, "==", episode)]
            parts.append(parquet.read_table(file, columns=kept, filters=rows))
            table = pyarrow.concat_tables(parts)
        except (pyarrow.ArrowException, OSError) as error:
            raise unreadable(file, error) from None
    found, texts = columns_of(table)
    columns: dict[str, Array] = {}
    for name, values in found.items():
        own = _names(about, name)
        if values.ndim == 2 and len(own) == values.shape[1] == len(set(own)):
            columns |= {f"{name}.{one}": values[:, k] for k, one in enumerate(own)}
        else:
            columns[name] = values
    return columns, texts


def _names(about: Path, feature: str) -> list[str]:
    """What the entries of a feature are called; nothing where that is not said."""
    try:
        said = json.loads(about.read_text(encoding="utf-8"))["features"][feature]["names"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    # Some name the entries by what they are: {"motors": [...]}.
    if isinstance(said, dict) and len(said) == 1:
        (said,) = said.values()
    return said if isinstance(said, list) and all(isinstance(one, str) for one in said) else []


def _files(dataset: Path) -> dict[int, list[Path]]:
    """The files of each episode."""
    files = sorted((dataset / "data").rglob("*.parquet"))
    stamps = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    return _episodes(stamps)


@lru_cache(maxsize=8)
def _episodes(stamps: tuple[tuple[Path, int, int], ...]) -> dict[int, list[Path]]:
    """The files of each episode, of files as they were when they changed last."""
    import pyarrow
    import pyarrow.parquet as parquet

    found: dict[int, list[Path]] = {}
    for file, *_ in stamps:
        try:
            column = parquet.read_table(file, columns=[EPISODE]).column(EPISODE)
            numbers = np.unique(column.to_numpy().astype(np.int64)).tolist()
        except (pyarrow.ArrowException, OSError, KeyError, ValueError, TypeError) as error:
            raise unreadable(file, error) from None
        for number in numbers:
            found.setdefault(number, []).append(file)
    return found
