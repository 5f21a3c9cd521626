"""Logs as their loggers wrote them: a CSV of any layout, a NumPy archive, a Parquet file, a topic
of a bag, an episode of a dataset.

A column is named as the log names it, ``positions[2]`` being the third entry of what holds a list
or a vector in each row. Nothing is unpickled.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.base import Array, InputError, frozen
from sims.files import require_file
from sims.recording import bags, lerobot
from sims.recording.columnar import WIDEST, columns_of, unreadable
from sims.user_toml import shown

FORMATS = (".csv", ".tsv", ".txt", ".npz", ".parquet")
"""What can be read, by the name's ending."""
LARGEST = 2_000_000_000
"""Bytes of a file: more would not fit beside what is made of it."""
SEPARATORS = (",", ";", "\t")
"""Between the cells of a table."""
_ENTRY = re.compile(r"(?P<base>.*)\[(?P<place>\d{1,5})\]")
_NUMBERS = re.compile(r"[\[\(](?P<inside>[^\]\)]*)[\]\)]")


class Stamp(NamedTuple):
    """When a file was read: another one of that name later is another one."""

    path: Path
    changed: int
    size: int


@dataclass(frozen=True)
class Log:
    """The columns of one file.

    Attributes:
        path: of it.
        columns: by name, (T,) or (T, k) numbers, NaN where missing; what holds no numbers is left
            out.
        texts: names of the columns that hold none.
        rows: which row of the file each row is, for messages.
    """

    path: Path
    columns: Mapping[str, Array]
    texts: tuple[str, ...] = ()
    rows: str = "row"

    def column(self, name: str) -> Array:
        """(T,) one column, or one entry of a list.

        Raises:
            InputError: there is none, in one line.
        """
        if name in self.columns:
            values = self.columns[name]
            if values.ndim == 1:
                return values
            last = values.shape[1] - 1
            entries = f"its entries are {name}[0] to {name}[{last}]"
            raise InputError(f"{self.path}: column '{name}' holds lists; {entries}")
        base, place = self._entry(name)
        values = self.columns[base]
        if place is None and values.ndim == 1:
            return values
        if place is None or values.ndim == 1 or place >= values.shape[1]:
            raise self._none(name)
        return frozen(values[:, place])

    def _entry(self, name: str) -> tuple[str, int | None]:
        """The column's own name, whatever its case, and the place in its lists."""
        match = _ENTRY.fullmatch(name)
        for base, place in (
            ((name, None), (match["base"], int(match["place"]))) if match else ((name, None),)
        ):
            found = [own for own in self.columns if own.strip().lower() == base.strip().lower()]
            if base in self.columns:
                return base, place
            if len(found) == 1:
                return found[0], place
        raise self._none(name)

    def _none(self, name: str) -> InputError:
        if name in self.texts:
            return InputError(f"{self.path}: column '{name}': expected numbers, found text")
        there = ", ".join(self.names()) or "none"
        return InputError(f"{self.path}: unknown column '{name}'; there are: {there}")

    def names(self) -> list[str]:
        """All columns of numbers; those that hold lists by their entries."""
        result = []
        for name, values in self.columns.items():
            if values.ndim == 1:
                result.append(name)
            else:
                result += [f"{name}[{k}]" for k in range(values.shape[1])]
        return result


def read_log(path: str | Path, wanted: frozenset[str] = frozenset()) -> Log:
    """The columns of a log.

    Args:
        path: of it.
        wanted: columns that will be asked for: of a bag, which may be larger than the memory, no
            others are kept if it has these; all where none are given.

    Raises:
        InputError: it cannot be read, in one line.
    """
    path = Path(path)
    bag = bags.bag_of(path)
    if bag is not None:
        about = bag[0].stat()
        stamp = Stamp(path, about.st_mtime_ns, about.st_size)
        log = _read_topic(stamp, wanted)
        kept = {name.lower() for name in log.columns}
        # What is missing is to be said with all that there is.
        return log if {name.strip().lower() for name in wanted} <= kept else _read_topic(stamp)
    episode = lerobot.episode_of(path)
    if episode is not None:
        abouts = [file.stat() for file in lerobot.files_of(*episode)]
        changed = max(about.st_mtime_ns for about in abouts)
        return _read_episode(Stamp(path, changed, sum(about.st_size for about in abouts)))
    if bags.is_bag(path):
        there = ", ".join(bags.topics(path))
        raise InputError(f"{path}: a bag; name a topic of it, as {path.name}/TOPIC: {there}")
    require_file(path)
    kind = path.suffix.lower()
    if kind not in _READERS:
        kinds = ", ".join(FORMATS)
        raise InputError(f"{path}: expected a log that ends in one of {kinds}, found '{kind}'")
    about = path.stat()
    if about.st_size > LARGEST:
        raise InputError(f"{path}: has {about.st_size / 1e9:.1f} GB; at most 2 are read")
    return _read(Stamp(path, about.st_mtime_ns, about.st_size))


@lru_cache(maxsize=8)
def _read_topic(stamp: Stamp, wanted: frozenset[str] = frozenset()) -> Log:
    """A topic of a bag, read once."""
    bag = bags.bag_of(stamp.path)
    assert bag is not None  # it is one that was asked for
    columns = bags.read_topic(*bag, wanted)
    if (len(columns) < 2 and not wanted) or not columns[bags.TIME].size:
        raise InputError(f"{stamp.path}: expected messages with numbers, found none")
    return Log(stamp.path, columns, (), "message")


@lru_cache(maxsize=8)
def _read_episode(stamp: Stamp) -> Log:
    """An episode of a dataset, read once."""
    episode = lerobot.episode_of(stamp.path)
    assert episode is not None  # it is one that was asked for
    columns, texts = lerobot.read_episode(*episode)
    return Log(stamp.path, columns, tuple(texts), "frame")


@lru_cache(maxsize=8)
def _read(stamp: Stamp) -> Log:
    """A log is asked for column by column, and read once."""
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


def _table(path: Path) -> Log:
    """A table whose separator and decimals are found out."""
    import pandas

    separator = _separator(path)
    try:
        cells = pandas.read_csv(
            path,
            sep=separator,
            dtype=str,
            keep_default_na=False,
            encoding="utf-8-sig",
            skipinitialspace=True,
        )
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected UTF-8 text; save it as UTF-8") from None
    except (pandas.errors.ParserError, pandas.errors.EmptyDataError, ValueError) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: not a table: {what}") from None
    if cells.shape[1] > WIDEST:
        raise InputError(f"{path}: expected at most {WIDEST} columns, found {cells.shape[1]}")
    columns, texts = {}, []
    for name in cells.columns:
        values = _numbers(path, str(name), cells[name].to_numpy(dtype=object), separator)
        if values is None:
            texts.append(str(name).strip())
        else:
            columns[str(name).strip()] = frozen(values)
    return Log(path, columns, tuple(texts), "row")


def _separator(path: Path) -> str:
    """What divides the header most often outside of quotes and brackets."""
    with path.open("rb") as file:
        head = file.readline(1 << 20)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: expected UTF-8 text, found UTF-16; save it as UTF-8")
    text = head.decode("utf-8-sig", errors="replace")
    counts = {mark: len(next(csv.reader([text], delimiter=mark), [])) for mark in SEPARATORS}
    return max(counts, key=lambda mark: counts[mark])


def _numbers(path: Path, name: str, cells: Any, separator: str) -> Array | None:
    """(T,) or (T, k) numbers; None where the column holds text."""
    import pandas

    texts = pandas.Series(cells).str.strip()
    filled = texts[texts != ""]
    if filled.empty:
        return np.full(len(texts), np.nan)
    if _NUMBERS.fullmatch(filled.iloc[0]):
        return _lists(path, name, texts.tolist())
    if separator != ",":
        # Of European tables: a comma within a number.
        texts = texts.str.replace(",", ".", n=1, regex=False)
    values = pandas.to_numeric(texts.where(texts != "", "nan"), errors="coerce")
    result = np.asarray(values, dtype=np.float64)
    bad = np.flatnonzero(np.isnan(result) & (texts != "").to_numpy() & ~_nan(texts))
    if bad.size == 0:
        return result
    if bad.size > 0.5 * len(filled):
        return None
    row = int(bad[0])
    raise InputError(
        f"{path}, row {row + 2}, column {name}: expected a number, found {shown(cells[row])}"
    )


def _nan(texts: Any) -> Any:
    """Where a cell says that there is no number."""
    return texts.str.lower().isin(("nan", "null", "none", "na", "n/a")).to_numpy()


def _lists(path: Path, name: str, texts: list[str]) -> Array:
    """(T, k) of cells such as ``[0.1, 0.2]``."""
    rows: list[list[float]] = []
    for number, text in enumerate(texts):
        match = _NUMBERS.fullmatch(text)
        try:
            inside = match["inside"].replace(",", " ").split() if match else None
            row = [float(part) for part in inside] if inside is not None else None
        except ValueError:
            row = None
        if row is None or (rows and len(row) != len(rows[0])) or len(row) > WIDEST:
            wanted = f"a list of {len(rows[0])} numbers" if rows else "a list of numbers"
            raise InputError(
                f"{path}, row {number + 2}, column {name}: expected {wanted}, found {shown(text)}"
            )
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(len(rows), -1)


# -- arrays


def _archive(path: Path) -> Log:
    """The arrays of a NumPy archive, one row an instant."""
    columns: dict[str, Array] = {}
    texts = []
    try:
        # Opened here: what is no archive would be left open by its reader.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            for name in arrays.files:
                values = arrays[name]
                if values.dtype.kind not in "fiub" or not 1 <= values.ndim <= 2:
                    texts.append(name)
                else:
                    columns[name] = frozen(values.astype(np.float64))
    except (ValueError, EOFError, KeyError, OSError) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: not an archive of arrays of numbers: {what}") from None
    except Exception as error:  # the reader of the archive raises what it likes
        raise InputError(f"{path}: not a NumPy archive: {type(error).__name__}") from None
    return Log(path, columns, tuple(texts), "entry")


def _parquet(path: Path) -> Log:
    """The columns of a Parquet file, lists too."""
    import pyarrow
    import pyarrow.parquet as parquet

    try:
        table = parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise unreadable(path, error) from None
    columns, texts = columns_of(table)
    return Log(path, columns, tuple(texts), "row")


_READERS: Mapping[str, Callable[[Path], Log]] = {
    ".csv": _table,
    ".tsv": _table,
    ".txt": _table,
    ".npz": _archive,
    ".parquet": _parquet,
}


def logs_in(folder: Path) -> Iterator[Path]:
    """The logs of a folder, the topics of a bag, the episodes of a dataset, in order of name."""
    if lerobot.is_dataset(folder):
        yield from lerobot.episodes(folder)
        return
    if bags.is_bag(folder):
        yield from (folder / topic for topic in bags.topics(folder))
        return
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in FORMATS and path.is_file():
            yield path
