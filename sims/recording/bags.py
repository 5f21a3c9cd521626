"""ROS bags as folders of logs: a topic is a log, ``drive.mcap/joint_states`` that of
``/joint_states``.

Bags of ROS 1 (``.bag``) and ROS 2 (a folder with its ``metadata.yaml``, ``.db3``, ``.mcap``) are
read by rosbags, message by message: what is kept of one are its numbers. Entries are named as ROS
does, ``velocity[2]``, and by the message's own names where it has some, ``position.elbow``. Stamps
are those of the message's header, or of its writing where it has none, seconds in ``time``.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sims.base import Array, InputError, frozen

ENDINGS = (".bag", ".mcap", ".db3")
"""Of bags that are files."""
TIME = "time"
"""The column of stamps."""
LONGEST = 64
"""Entries of a list that are columns: an image is no signal."""
DEEPEST = 6
"""Messages within messages."""
_NANO = 1e-9


def is_bag(path: Path) -> bool:
    """Whether this is a bag, a file or a folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in ENDINGS and path.is_file()


def bag_of(path: Path) -> tuple[Path, str] | None:
    """The bag that a path leads into, and the topic there; None where it leads into none."""
    for parent in path.parents:
        if parent.exists():
            if not is_bag(parent):
                return None
            return parent, "/" + path.relative_to(parent).as_posix()
    return None


def topics(bag: Path) -> list[str]:
    """The topics of a bag, without the slash that they begin with.

    Raises:
        InputError: it cannot be read, or rosbags is not installed.
    """
    with _opened(bag) as reader:
        return sorted({connection.topic.lstrip("/") for connection in reader.connections})


def read_topic(bag: Path, topic: str, wanted: Collection[str] = ()) -> dict[str, Array]:
    """(T,) numbers of a topic by name, with its stamps, in their order.

    Args:
        bag: a file or folder.
        topic: with the slash that it begins with.
        wanted: names of numbers, in any case, that are kept; all where none are given.

    Raises:
        InputError: there is no such topic, or its messages cannot be read.
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
        # Bags of ROS 2 did not hold their types before Iron: those of Humble are assumed then.
        usual = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([bag], default_typestore=usual) as reader:
            yield reader
    except (InputError, MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # the readers of three formats raise what they like
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{bag}: not a bag that can be read: {what[:300]}") from None


class _Table:
    """Numbers of messages, by name."""

    def __init__(self, wanted: Collection[str] = ()) -> None:
        # Runs may be told apart by a number of their own.
        self.wanted = {name.strip().lower() for name in (*wanted, "run")} if wanted else set()
        self.stamps = array("d")
        self.written = array("d")
        self.numbers: dict[str, array[float]] = {}

    def add(self, message: Any, written: int) -> None:
        """The numbers of one more message; what an earlier one had and it lacks is missing."""
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
        """All of it, in the order of the stamps."""
        rows = len(self.stamps)
        stamps = np.array(self.stamps)
        # A header that nobody filled in says nothing.
        times = stamps if rows and (stamps > 0).all() else np.array(self.written)
        order = None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")
        result = {TIME: frozen(times if order is None else times[order])}
        for name in list(self.numbers):
            # Given back one by one: a long bag would stand in memory twice.
            column = self.numbers.pop(name)
            column.extend([np.nan] * (rows - len(column)))
            values = np.frombuffer(column)
            result[name] = frozen(values if order is None else values[order])
        return result


def _numbers(path: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """Every number of a message with its name; of lists with names, as joints' states, by these."""
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield path, float(value)
    elif is_dataclass(value) and depth < DEEPEST:
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
    elif isinstance(value, list | tuple | np.ndarray) and 0 < len(value) <= LONGEST:
        for place, entry in enumerate(value):
            yield from _numbers(f"{path}[{place}]", entry, depth + 1)


def _named(values: Any, names: Any) -> bool:
    """Whether a list has a name for each of its numbers."""
    if not isinstance(names, Sequence) or isinstance(names, str) or not names:
        return False
    listed = isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "fiu"
    return bool(listed and len(values) == len(names) and all(isinstance(n, str) for n in names))
