"""Read logs in the formats of their loggers.

A log is a text table of any layout, a NumPy archive, a Parquet, HDF5 or PyTorch file, a topic of a
ROS bag, or an episode of a LeRobot dataset. Columns are named as in the log; ``positions[2]`` is
the third entry of a column that holds a list or a vector in each row. Nothing is unpickled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.files import require_file
from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats import hdf5_and_parquet, lerobot_dataset, ros_bags
from sims.recording.log_formats.column_names import name_array_entries
from sims.recording.log_formats.hdf5_and_parquet import read_numeric_columns
from sims.recording.log_formats.log_columns import LogFile, convert_read_errors
from sims.recording.log_formats.ros_bags import TIME_COLUMN
from sims.recording.log_formats.text_table import read_text_table

LOG_SUFFIXES = (
    ".csv",
    ".tsv",
    ".txt",
    ".dat",
    ".npz",
    ".parquet",
    ".pt",
    ".pth",
    ".h5",
    ".hdf5",
    ".hdf",
)
"""File name endings of the files that can be read."""
MAX_FILE_BYTES = 2_000_000_000
"""Maximum size of a file in bytes, because its content must fit into memory."""


def read_log(path: str | Path, columns_to_read: frozenset[str] = frozenset()) -> LogFile:
    """Read the columns of a log file in any supported format.

    The path may name a topic of a ROS bag, an episode of a LeRobot dataset, a group in an HDF5
    file, or a file. Logs are cached by path, size and modification time.

    Args:
        path: Path of the log.
        columns_to_read: Columns that will be used; all if empty. They matter only for a bag, which
            may be larger than the memory: only these are stored, if it has all of them.

    Raises:
        InputError: The log cannot be read; the message is one line.
    """
    path = Path(path)
    bag_and_topic = ros_bags.split_bag_path(path)
    if bag_and_topic is not None:
        bag, topic = bag_and_topic
        log = _read_files([bag], _read_topic, path, bag, topic, columns_to_read)
        column_names = {name.lower() for name in log.columns}
        if {name.strip().lower() for name in columns_to_read} <= column_names:
            return log
        # All columns are read, because the error for a missing one lists them.
        return _read_files([bag], _read_topic, path, bag, topic)
    episode = lerobot_dataset.split_episode_path(path)
    if episode is not None:
        files = lerobot_dataset.list_episode_files(*episode)
        return _read_files(files, _read_episode, path, *episode)
    file_and_group = hdf5_and_parquet.split_group_path(path)
    if file_and_group is not None:
        file, group = file_and_group
        return _read_files([file], _read_group, path, file, group)
    if ros_bags.is_bag(path):
        topics = ", ".join(ros_bags.list_topics(path))
        raise InputError(f"{path}: a bag; name a topic of it, as {path.name}/TOPIC: {topics}")
    require_file(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        kinds = ", ".join(LOG_SUFFIXES)
        raise InputError(f"{path}: expected a log that ends in one of {kinds}, found '{suffix}'")
    file_size = path.stat().st_size
    if file_size > MAX_FILE_BYTES:
        raise InputError(f"{path}: has {file_size / 1e9:.1f} GB; at most 2 are read")
    return _read_files([path], _READERS[suffix], path)


def _read_files(
    files: Iterable[Path], read: Callable[..., LogFile], path: Path, *arguments: Any
) -> LogFile:
    """Read a log, or take it from the cache if none of its files has changed.

    Args:
        files: Files that hold the log.
        read: Function that reads it.
        path: Path of the log, the first argument of the function.
        arguments: Further arguments of the function.
    """
    file_stats = [file.stat() for file in files]
    last_change = max(file_stat.st_mtime_ns for file_stat in file_stats)
    size = sum(file_stat.st_size for file_stat in file_stats)
    return _read_version(last_change, size, read, path, *arguments)


@lru_cache(maxsize=16)
def _read_version(
    last_change: int, size: int, read: Callable[..., LogFile], path: Path, *arguments: Any
) -> LogFile:
    """Read a log; cached by the version of its files, because logs are requested by column.

    Args:
        last_change: Time of the last change of its files in nanoseconds, part of the cache key.
        size: Their size in bytes, part of the cache key.
        read: Function that reads the log.
        path: Path of the log, the first argument of the function.
        arguments: Further arguments of the function.

    Raises:
        InputError: The log cannot be read, or has no numbers.
    """
    del last_change, size
    try:
        log = read(path, *arguments)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    lengths = {len(values) for values in log.columns.values()}
    if not log.columns or lengths == {0}:
        raise InputError(f"{path}: expected columns of numbers, found none")
    return log


def _read_topic(
    path: Path, bag: Path, topic: str, columns_to_read: frozenset[str] = frozenset()
) -> LogFile:
    """Read a topic of a bag.

    Args:
        path: Path of the log, which names the topic.
        bag: Path of the bag.
        topic: Name of the topic in the bag.
        columns_to_read: Columns to store; all if empty.

    Raises:
        InputError: The topic has no messages, or its messages have no numbers.
    """
    columns = ros_bags.read_topic(bag, topic, columns_to_read)
    # The time stamps are always a column. If wanted columns are missing, the caller reads the topic
    # again with all columns.
    has_only_stamps = len(columns) < 2 and not columns_to_read
    if has_only_stamps or not columns[TIME_COLUMN].size:
        raise InputError(f"{path}: expected messages with numbers, found none")
    return LogFile(path, columns, (), "message")


def _read_episode(path: Path, dataset: Path, episode: int) -> LogFile:
    """Read an episode of a LeRobot dataset."""
    columns, texts = lerobot_dataset.read_episode(dataset, episode)
    return LogFile(path, columns, tuple(texts), "frame")


def _read_group(path: Path, file: Path, group: str) -> LogFile:
    """Read a group of an HDF5 file."""
    return _make_array_log(path, *hdf5_and_parquet.read_group(file, group))


def _read_npz(path: Path) -> LogFile:
    """Read the arrays of a NumPy archive (.npz), one row per sample.

    Arrays of texts may name the entries of the others, for example the joints.
    """
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    # Opened here, because numpy does not close a file that is not an archive.
    with (
        convert_read_errors(path, "an archive of arrays of numbers"),
        path.open("rb") as file,
        np.load(file, allow_pickle=False) as arrays,
    ):
        for name in arrays.files:
            values = arrays[name]
            if values.dtype.kind in "fiub" and values.ndim in (1, 2):  # numbers and booleans
                columns[name] = make_read_only(values.astype(np.float64))
            else:
                is_text_list = values.dtype.kind == "U" and values.ndim == 1
                texts[name] = values.tolist() if is_text_list else []
    return _make_array_log(path, columns, texts)


def _make_array_log(path: Path, columns: dict[str, Array], texts: dict[str, list[str]]) -> LogFile:
    """Make a log of the arrays of a file, such as an .npz archive.

    Shapes: T rows.

    Args:
        path: the file.
        columns: numbers (T,), or (T, k) with k columns, by the name of their array.
        texts: lists of texts by the name of their array, empty for arrays of another type. A list
            with as many texts as a matrix has columns, such as joint names, names these columns.

    Returns:
        The log. Its messages call a row "entry" and count from 0. A matrix whose columns are named
        can still be read by its own name, but is left out of lists of columns.
    """
    lists_of_texts = {name: text_list for name, text_list in texts.items() if text_list}
    named_columns, unlisted = name_array_entries(columns, lists_of_texts)
    return LogFile(
        path, {**columns, **named_columns}, tuple(texts), "entry", unlisted=unlisted, first=0
    )


def _read_torch_file(path: Path) -> LogFile:
    """Read the tensors of a PyTorch file, one row per sample."""
    # Imported here, because few logs are PyTorch files.
    from sims.recording.log_formats.torch_tensors import read_tensors

    return _make_array_log(path, *read_tensors(path))


def _read_parquet(path: Path) -> LogFile:
    """Read the columns of a Parquet file, including lists."""
    import pyarrow.parquet as parquet

    with convert_read_errors(path, "a Parquet file"):
        table = parquet.read_table(path)
    columns, texts = read_numeric_columns(table)
    return LogFile(path, columns, tuple(texts), "row")


_READERS: Mapping[str, Callable[[Path], LogFile]] = {
    ".csv": read_text_table,
    ".tsv": read_text_table,
    ".txt": read_text_table,
    ".dat": read_text_table,
    ".npz": _read_npz,
    ".parquet": _read_parquet,
    ".pt": _read_torch_file,
    ".pth": _read_torch_file,
}


def list_logs(folder: Path) -> Iterator[Path]:
    """Yield the logs of a folder, topics of a bag or episodes of a dataset, ordered by name.

    Args:
        folder: Folder of files, ROS bag, or LeRobot dataset.
    """
    if lerobot_dataset.is_dataset(folder):
        yield from lerobot_dataset.list_episodes(folder)
        return
    if ros_bags.is_bag(folder):
        yield from (folder / topic for topic in ros_bags.list_topics(folder))
        return
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in LOG_SUFFIXES and path.is_file():
            yield path
