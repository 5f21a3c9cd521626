"""Read ROS bags as folders of logs, one log per topic.

The log ``drive.mcap/joint_states`` is the topic ``/joint_states``. Bags of ROS 1 (``.bag``) and ROS
2 (a folder with its ``metadata.yaml``, ``.db3``, ``.mcap``) are read message by message with
rosbags, and only the numbers of a message are stored. Entries are named as in ROS, ``velocity[2]``,
or by the names in the message where it has some, ``position.elbow``. The column ``time`` holds the
stamps in seconds: those of the message headers, or the times of writing where there is no header.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""File name endings of bags that are single files."""
TIME_COLUMN = "time"
"""Name of the column of time stamps."""
MAX_LIST_LENGTH = 64
"""Maximum length of a list whose entries become columns; longer lists are skipped."""
MAX_MESSAGE_DEPTH = 6
"""Maximum depth of nested messages that are read."""
_NANO = 1e-9


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag, as a file or a folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in BAG_SUFFIXES and path.is_file()


def split_bag_path(path: Path) -> tuple[Path, str] | None:
    """Split a path into a bag and a topic inside it; None if the path is not inside a bag."""
    for parent in path.parents:
        if parent.exists():
            if not is_bag(parent):
                return None
            return parent, "/" + path.relative_to(parent).as_posix()
    return None


def list_topics(bag: Path) -> list[str]:
    """List the topics of a bag, without their leading slash.

    Raises:
        InputError: The bag cannot be read, or rosbags is not installed.
    """
    with _opened(bag) as reader:
        return sorted({connection.topic.lstrip("/") for connection in reader.connections})


def read_topic(bag: Path, topic: str, wanted: Collection[str] = ()) -> dict[str, Array]:
    """Read the numbers of a topic, ordered by time stamp.

    Args:
        bag: Bag file or folder.
        topic: Name of the topic with its leading slash.
        wanted: Names of the numbers to store, in any case; all if empty.

    Returns:
        Columns (T,) by name, including the time stamps.

    Raises:
        InputError: The bag has no such topic, or its messages cannot be read.
    """
    table = _Table(wanted)
    with _opened(bag) as reader:
        mine = [one for one in reader.connections if one.topic == topic]
        if not mine:
            there = ", ".join(sorted({one.topic.lstrip("/") for one in reader.connections}))
            raise InputError(f"{bag}: unknown topic '{topic[1:]}'; there are: {there or 'none'}")
        for connection, stamp, raw in reader.messages(connections=mine):
            message = reader.deserialize(raw, connection.msgtype)
            table.add(message, stamp)
    return table.columns()


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f"{bag}: needs rosbags to read it, not installed (pip install rosbags)"
        ) from None
    try:
        # Bags of ROS 2 store their message types only since Iron; older ones are read with
        # Humble's.
        usual = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([bag], default_typestore=usual) as reader:
            yield reader
    except (InputError, MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # the readers of the three formats raise many kinds of errors
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{bag}: not a bag that can be read: {what[:300]}") from None


class _Table:
    """Numbers of the messages of one topic, by name."""

    def __init__(self, wanted: Collection[str] = ()) -> None:
        # A column named run may number the runs of the log.
        self.wanted = {name.strip().lower() for name in (*wanted, "run")} if wanted else set()
        self.stamps = array("d")
        self.written = array("d")
        self.numbers: dict[str, array[float]] = {}

    def add(self, message: Any, written: int) -> None:
        """Append the numbers of one message; numbers missing from it become NaN.

        Args:
            message: Deserialised message.
            written: Time of writing in nanoseconds.
        """
        row = len(self.stamps)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        seconds = 0.0 if stamp is None else stamp.sec + _NANO * stamp.nanosec
        self.stamps.append(seconds)
        self.written.append(_NANO * written)
        for name, value in _numbers("", message, 0):
            if self.wanted and name.lower() not in self.wanted:
                continue
            column = self.numbers.setdefault(name, array("d"))
            column.extend([np.nan] * (row - len(column)))
            column.append(value)

    def columns(self) -> dict[str, Array]:
        """Return all columns (T,) by name, ordered by time stamp."""
        rows = len(self.stamps)
        stamps = np.array(self.stamps)
        # Header stamps of zero were not filled in: use the times of writing instead.
        times = stamps if rows and (stamps > 0).all() else np.array(self.written)
        order = None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")
        result = {TIME_COLUMN: make_read_only(times if order is None else times[order])}
        for name in list(self.numbers):
            # Release each column after conversion; otherwise a long bag would be in memory twice.
            column = self.numbers.pop(name)
            column.extend([np.nan] * (rows - len(column)))
            values = np.frombuffer(column)
            result[name] = make_read_only(values if order is None else values[order])
        return result


def _numbers(path: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """Iterate over the numbers of a message with their names.

    Entries of a list get the names in the message where it has some, as in joint states.
    """
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield path, float(value)
    elif is_dataclass(value) and depth < MAX_MESSAGE_DEPTH:
        names = getattr(value, "name", None) or getattr(value, "joint_names", None) or ()
        for field in fields(value):
            if field.name in ("header", "__msgtype__"):
                continue
            inner = f"{path}.{field.name}" if path else field.name
            own = getattr(value, field.name)
            if _named(own, names):
                for name, number in zip(names, own, strict=True):
                    yield f"{inner}.{name}", float(number)
            else:
                yield from _numbers(inner, own, depth + 1)
    elif isinstance(value, list | tuple | np.ndarray) and 0 < len(value) <= MAX_LIST_LENGTH:
        for place, entry in enumerate(value):
            yield from _numbers(f"{path}[{place}]", entry, depth + 1)


def _named(values: Any, names: Any) -> bool:
    """Return whether a list has a name for each of its numbers."""
    if not isinstance(names, Sequence) or isinstance(names, str) or not names:
        return False
    listed = isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "fiu"
    return bool(listed and len(values) == len(names) and all(isinstance(n, str) for n in names))
