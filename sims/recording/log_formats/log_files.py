"""Read logs in the formats of their loggers.

A log is a text table of any layout, a NumPy archive, a Parquet, HDF5 or PyTorch file, a topic of a
ROS bag, or an episode of a LeRobot dataset. Columns are named as in the log; ``positions[2]`` is
the third entry of a column that holds a list or a vector in each row. Nothing is unpickled.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sims.core.files import require_file
from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats import hdf5_and_parquet, lerobot_dataset, ros_bags
from sims.recording.log_formats.column_names import arrays_by_name
from sims.recording.log_formats.hdf5_and_parquet import make_unreadable_error, read_numeric_columns
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
_LIST_ENTRY_PATTERN = re.compile(r"(?P<base>.*)\[(?P<place>\d{1,5})\]")


class FileVersion(NamedTuple):
    """Version of a file, as a cache key: path, time of last change (ns) and size (bytes)."""

    path: Path
    changed: int
    size: int


@dataclass(frozen=True)
class LogFile:
    """Columns of one log.

    Attributes:
        path: Path of the log.
        columns: Numbers by column name, (T,) or (T, k), NaN where missing; columns without numbers
            are left out.
        texts: Names of the columns without numbers.
        rows: Word for a row in messages, such as "row" or "message".
        units: Unit of each column for which a row of the file states one.
        unlisted: Columns that `list_columns` leaves out, because another one holds the same numbers
            under the name of their joint.
        named: Whether the file names its columns.
        first: Number of the first row in the file, for messages.
    """

    path: Path
    columns: Mapping[str, Array]
    texts: tuple[str, ...] = ()
    rows: str = "row"
    units: Mapping[str, str] = field(default_factory=dict)
    unlisted: frozenset[str] = frozenset()
    named: bool = True
    first: int = 2

    def get_column(self, name: str) -> Array:
        """Return one column (T,), or one entry of a column of lists, such as ``position[2]``.

        Raises:
            InputError: There is no such column; the message is one line.
        """
        if name in self.columns:
            values = self.columns[name]
            if values.ndim == 1:
                return values
            last = values.shape[1] - 1
            entries = f"its entries are {name}[0] to {name}[{last}]"
            raise InputError(f"{self.path}: column '{name}' contains lists; {entries}")
        base, place = self._find_column(name)
        values = self.columns[base]
        if place is None and values.ndim == 1:
            return values
        if place is None or values.ndim == 1 or place >= values.shape[1]:
            raise self._make_missing_column_error(name)
        return make_read_only(values[:, place])

    def _find_column(self, name: str) -> tuple[str, int | None]:
        """Find a column regardless of case, and the index into its lists if the name has one.

        `position[2]` is entry 2 of a list column, unless a column has this very name.

        Args:
            name: Name as a description or a user wrote it.

        Returns:
            Name in the file, and the index of the list entry, else None.
        """
        match = _LIST_ENTRY_PATTERN.fullmatch(name)
        for base, entry in (
            ((name, None), (match["base"], int(match["place"]))) if match else ((name, None),)
        ):
            matches = [
                column for column in self.columns if column.strip().lower() == base.strip().lower()
            ]
            if base in self.columns:
                return base, entry
            if len(matches) == 1:
                return matches[0], entry
        raise self._make_missing_column_error(name)

    def _make_missing_column_error(self, name: str) -> InputError:
        """Return the error for a column that does not exist, or that holds text."""
        if name in self.texts:
            return InputError(f"{self.path}: column '{name}': expected numbers, found text")
        column_list = ", ".join(self.list_columns()) or "none"
        return InputError(f"{self.path}: unknown column '{name}'; there are: {column_list}")

    def list_columns(self) -> list[str]:
        """List all numeric columns; columns of lists by their entries."""
        column_names = []
        for name, values in self.columns.items():
            if name in self.unlisted:
                continue
            if values.ndim == 1:
                column_names.append(name)
            else:
                column_names += [f"{name}[{k}]" for k in range(values.shape[1])]
        return column_names


def read_log(path: str | Path, columns_to_read: frozenset[str] = frozenset()) -> LogFile:
    """Read the columns of a log file in any supported format.

    The path may name a file, a topic of a ROS bag, an episode of a LeRobot dataset, or a group in
    an HDF5 file. Logs are cached by path, size and modification time.

    Args:
        path: Path of the log.
        columns_to_read: Columns that will be used; all if empty. Of a bag, which may be larger than
            the memory, only these are stored if it has all of them.

    Raises:
        InputError: The log cannot be read; the message is one line.
    """
    path = Path(path)
    bag = ros_bags.split_bag_path(path)
    if bag is not None:
        file_stat = bag[0].stat()
        stamp = FileVersion(path, file_stat.st_mtime_ns, file_stat.st_size)
        log = _read_topic(stamp, columns_to_read)
        column_names = {name.lower() for name in log.columns}
        # The error for a missing column lists all columns of the log.
        if {name.strip().lower() for name in columns_to_read} <= column_names:
            return log
        return _read_topic(stamp)
    episode = lerobot_dataset.split_episode_path(path)
    if episode is not None:
        file_stats = [file.stat() for file in lerobot_dataset.list_episode_files(*episode)]
        changed = max(file_stat.st_mtime_ns for file_stat in file_stats)
        return _read_episode(
            FileVersion(path, changed, sum(file_stat.st_size for file_stat in file_stats))
        )
    group = hdf5_and_parquet.group_of(path)
    if group is not None:
        file_stat = group[0].stat()
        return _read_group(FileVersion(path, file_stat.st_mtime_ns, file_stat.st_size))
    if ros_bags.is_bag(path):
        topics = ", ".join(ros_bags.list_topics(path))
        raise InputError(f"{path}: a bag; name a topic of it, as {path.name}/TOPIC: {topics}")
    require_file(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        kinds = ", ".join(LOG_SUFFIXES)
        raise InputError(f"{path}: expected a log that ends in one of {kinds}, found '{suffix}'")
    file_stat = path.stat()
    if file_stat.st_size > MAX_FILE_BYTES:
        raise InputError(f"{path}: has {file_stat.st_size / 1e9:.1f} GB; at most 2 are read")
    return _read_cached(FileVersion(path, file_stat.st_mtime_ns, file_stat.st_size))


@lru_cache(maxsize=8)
def _read_topic(stamp: FileVersion, columns_to_read: frozenset[str] = frozenset()) -> LogFile:
    """Read a topic of a bag; cached by file version.

    Args:
        stamp: version of the bag, whose path names the topic.
        columns_to_read: columns that hold text, and are read too.
    """
    bag = ros_bags.split_bag_path(stamp.path)
    assert bag is not None  # the caller checked the path
    columns = ros_bags.read_topic(*bag, columns_to_read)
    if (len(columns) < 2 and not columns_to_read) or not columns[TIME_COLUMN].size:
        raise InputError(f"{stamp.path}: expected messages with numbers, found none")
    return LogFile(stamp.path, columns, (), "message")


@lru_cache(maxsize=8)
def _read_episode(stamp: FileVersion) -> LogFile:
    """Read an episode of a dataset; cached by file version."""
    episode = lerobot_dataset.split_episode_path(stamp.path)
    assert episode is not None  # the caller checked the path
    columns, texts = lerobot_dataset.read_episode(*episode)
    return LogFile(stamp.path, columns, tuple(texts), "frame")


@lru_cache(maxsize=8)
def _read_group(stamp: FileVersion) -> LogFile:
    """Read a group of an HDF5 file; cached by file version."""
    group = hdf5_and_parquet.group_of(stamp.path)
    assert group is not None  # the caller checked the path
    return _make_array_log(stamp.path, *hdf5_and_parquet.read_group(*group))


@lru_cache(maxsize=8)
def _read_cached(stamp: FileVersion) -> LogFile:
    """Read a log file; cached by file version, because logs are requested column by column.

    Args:
        stamp: Path with size and modification time; a changed file is read again.
    """
    path = stamp.path
    try:
        log = _READERS[path.suffix.lower()](path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    lengths = {len(values) for values in log.columns.values()}
    if not log.columns or lengths == {0}:
        raise InputError(f"{path}: expected columns of numbers, found none")
    return log


# -- tables of text


def _read_text_table(path: Path) -> LogFile:
    """Read a text table of any layout as a log."""
    table = read_text_table(path)
    return LogFile(
        path,
        table.columns,
        table.texts,
        "row",
        table.units,
        table.unlisted,
        table.named,
        table.first,
    )


# -- arrays


def _read_npz(path: Path) -> LogFile:
    """Read the arrays of a NumPy archive (.npz), one row per sample.

    Arrays of texts may name the entries of the others, for example the joints.
    """
    columns: dict[str, Array] = {}
    texts = []
    names: dict[str, list[str]] = {}
    try:
        # Opened here, because numpy does not close a file that is not an archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            for name in arrays.files:
                values = arrays[name]
                if values.dtype.kind not in "fiub" or not 1 <= values.ndim <= 2:
                    texts.append(name)
                    if values.dtype.kind == "U" and values.ndim == 1:
                        names[name] = values.tolist()
                else:
                    columns[name] = make_read_only(values.astype(np.float64))
    except (ValueError, EOFError, KeyError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not an archive of arrays of numbers: {reason}") from None
    except Exception as error:  # numpy raises many kinds of errors
        raise InputError(f"{path}: not a NumPy archive: {type(error).__name__}") from None
    named_columns, unlisted = arrays_by_name(columns, names)
    return LogFile(path, {**columns, **named_columns}, tuple(texts), "entry", unlisted=unlisted)


def _make_array_log(path: Path, columns: dict[str, Array], texts: dict[str, list[str]]) -> LogFile:
    """Make a log of the arrays of a file, such as an .npz archive.

    Args:
        path: the file.
        columns: numbers (T,) or (T, k) by the name of their array.
        texts: lists of texts in the file, by their name. A list with as many texts as a matrix has
            columns, such as joint names, names each of these columns.

    Returns:
        The log. Its messages call a row "entry" and count from 0. A matrix whose columns are named
        so can still be read, but is left out of lists of columns.

    Raises:
        InputError: the file has no array of numbers.
    """
    if not columns:
        raise InputError(f"{path}: expected columns of numbers, found none")
    named_columns, unlisted = arrays_by_name(
        columns, {name: name_list for name, name_list in texts.items() if name_list}
    )
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
    import pyarrow
    import pyarrow.parquet as parquet

    try:
        table = parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise make_unreadable_error(path, error) from None
    columns, texts = read_numeric_columns(table)
    return LogFile(path, columns, tuple(texts), "row")


_READERS: Mapping[str, Callable[[Path], LogFile]] = {
    ".csv": _read_text_table,
    ".tsv": _read_text_table,
    ".txt": _read_text_table,
    ".dat": _read_text_table,
    ".npz": _read_npz,
    ".parquet": _read_parquet,
    ".pt": _read_torch_file,
    ".pth": _read_torch_file,
}


def list_logs(folder: Path) -> Iterator[Path]:
    """List the logs of a folder, topics of a bag or episodes of a dataset, ordered by name.

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
