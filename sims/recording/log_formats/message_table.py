"""Numbers of the messages of one topic, by name.

A message is a dataclass of rosbags, a dictionary decoded from JSON, or a Protobuf message. Entries
are named as in the message, ``velocity[2]``, or by the names in it where it has some:
``position.elbow`` of parallel lists, ``joints.elbow.position`` of a list of named objects.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from sims.core.simulator import Array, make_read_only

TIME_COLUMN = "time"
"""Name of the column of time stamps."""
MAX_LIST_LENGTH = 64
"""Maximum length of a list whose entries become columns; longer lists are skipped."""
MAX_MESSAGE_DEPTH = 6
"""Maximum depth of nested messages that are read."""
STAMP_FIELDS = ("timestamp", "stamp")
"""Names of the fields of a message that hold its time stamp; ``header`` may contain them."""
SECONDS_FIELDS = ("sec", "secs", "seconds")
NANOSECONDS_FIELDS = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")
"""Names of the parts of a time stamp."""
NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second."""
_SECONDS_PER_NANOSECOND = 1e-9


class MessageTable:
    """Table to which the messages of a topic are added one by one.

    Args:
        wanted_names: Names of the numbers to store, in any case; all if empty.
    """

    def __init__(self, wanted_names: Collection[str] = ()) -> None:
        """Start with no messages; the wanted names are compared in lower case.

        `_stamps` and `_written` hold the times of the messages in seconds: from their
        headers, and when they were written to the log.
        """
        # A column named run may number the runs of the log.
        self._wanted = (
            {name.strip().lower() for name in (*wanted_names, "run")} if wanted_names else set()
        )
        self._stamps = array("d")
        self._written = array("d")
        self._numbers: dict[str, array[float]] = {}

    def add(self, message: Any, written: int) -> None:
        """Append the numbers of one message; numbers missing from it become NaN.

        Args:
            message: Decoded message.
            written: Time of writing in nanoseconds.
        """
        row = len(self._stamps)
        self._stamps.append(_get_stamp(message))
        self._written.append(_SECONDS_PER_NANOSECOND * written)
        for name, value in _iterate_numbers("", message, 0):
            if self._wanted and name.lower() not in self._wanted:
                continue
            column = self._numbers.setdefault(name, array("d"))
            column.extend([np.nan] * (row - len(column)))
            # A list of named objects may contain a name twice; its first number counts.
            if len(column) == row:
                column.append(value)

    def columns(self) -> dict[str, Array]:
        """Return all columns (T,) by name, ordered by time stamp.

        A number that a message lacks is NaN. The table is empty afterwards, since columns
        are released.
        """
        rows = len(self._stamps)
        stamps = np.array(self._stamps)
        # Header stamps of zero were not filled in: use the times of writing instead.
        times = stamps if rows and (stamps > 0).all() else np.array(self._written)
        order = None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")
        result = {TIME_COLUMN: make_read_only(times if order is None else times[order])}
        for name in list(self._numbers):
            # Release each column after conversion; otherwise a long bag would be in memory twice.
            column = self._numbers.pop(name)
            column.extend([np.nan] * (rows - len(column)))
            values = np.frombuffer(column)
            result[name] = make_read_only(values if order is None else values[order])
        return result


def _get_fields(value: Any) -> dict[str, Any] | None:
    """Return the fields of a message by name; None if the value is not a message."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.name != "__msgtype__"]
        return {name: getattr(value, name) for name in names}
    if isinstance(value, Mapping):
        return {str(name): entry for name, entry in value.items()}
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        # An alternative (oneof) that is not set has a default value, which is not a measurement.
        names = [
            field.name
            for field in descriptor.fields
            if field.containing_oneof is None or value.HasField(field.name)
        ]
        return {name: getattr(value, name) for name in names}
    return None


def _get_stamp(message: Any) -> float:
    """Return the time stamp of a message in seconds; 0 if it has none."""
    fields = _get_fields(message) or {}
    for table in (_get_fields(fields.get("header")) or {}, fields):
        for name in STAMP_FIELDS:
            parts = _get_fields(table.get(name)) or {}
            seconds = [parts[key] for key in SECONDS_FIELDS if key in parts]
            nanoseconds = [parts[key] for key in NANOSECONDS_FIELDS if key in parts]
            if seconds and all(
                isinstance(part, int | np.integer) for part in (*seconds, *nanoseconds)
            ):
                # Whole nanoseconds, so that equal stamps of two topics become equal numbers.
                return _SECONDS_PER_NANOSECOND * _to_float(
                    NANOSECONDS * int(seconds[0]) + sum(map(int, nanoseconds[:1]))
                )
    return 0.0


def _to_float(number: Any) -> float:
    """Convert a number; an integer that is too large becomes infinite."""
    try:
        return float(number)
    except OverflowError:
        return np.inf


def _iterate_numbers(path: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """Iterate over the numbers of a message with their names.

    `path` is the name of the value so far, and `depth` the number of messages around it. Texts
    and long lists, such as images, are left out.
    """
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield path, _to_float(value)
        return
    message = _get_fields(value)
    if message is not None:
        if depth < MAX_MESSAGE_DEPTH:
            yield from _iterate_message_numbers(path, message, depth)
        return
    if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        return
    if 0 < len(value) <= MAX_LIST_LENGTH:
        for index, entry in enumerate(value):
            name = (_get_fields(entry) or {}).get("name")
            entry_path = f"{path}.{name}" if name and isinstance(name, str) else f"{path}[{index}]"
            yield from _iterate_numbers(entry_path, entry, depth + 1)


def _iterate_message_numbers(
    path: str, message: Mapping[str, Any], depth: int
) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their names, except its time stamp.

    A field with one number for each of the message's names, such as the joints of a JointState,
    is named by them: ``position.elbow``. `depth` counts the levels of nested messages.
    """
    names = message.get("name") or message.get("names") or message.get("joint_names") or ()
    for field, value in message.items():
        # The stamp is the column of times.
        if field == "header" or (field in STAMP_FIELDS and _get_fields(value) is not None):
            continue
        field_path = f"{path}.{field}" if path else field
        if _is_named(value, names):
            for name, number in zip(names, value, strict=True):
                yield f"{field_path}.{name}", _to_float(number)
        else:
            yield from _iterate_numbers(field_path, value, depth + 1)


def _is_named(values: Any, names: Any) -> bool:
    """Return whether a list has a name for each of its numbers."""
    if isinstance(names, str) or not _is_list(names) or not all(isinstance(n, str) for n in names):
        return False
    if isinstance(values, np.ndarray):
        is_numeric = values.ndim == 1 and values.dtype.kind in "fiu"
    else:
        is_numeric = _is_list(values) and all(isinstance(x, int | float) for x in values)
    return bool(len(names) and is_numeric and len(values) == len(names))


def _is_list(value: Any) -> bool:
    """Return whether a value is a list, also one of a Protobuf message."""
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)
