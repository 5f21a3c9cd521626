"""Read ROS bags and MCAP files as folders of logs, one log per topic.

The packages mcap and mcap-protobuf-support are imported when such a file is read. (Format:
mcap.dev/spec, message encodings ``json`` and ``protobuf``.)

A message is a dataclass of rosbags, a dictionary decoded from JSON, or a Protobuf message. Entries
are named as in the message, ``velocity[2]``, or by the names in it where it has some:
``position.elbow`` of parallel lists, ``joints.elbow.position`` of a list of named objects.

The log ``drive.mcap/joint_states`` is the topic ``/joint_states``. Bags of ROS 1 (``.bag``) and ROS
2 (a folder with its ``metadata.yaml``, ``.db3``, ``.mcap``) are read message by message with
rosbags, MCAP files of JSON or Protobuf messages with mcap, and only the numbers of a message are
stored (`MessageTable`). The column ``time`` holds the stamps in seconds: those of the message
headers, or the times of writing where there is no header.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats.log_columns import convert_read_errors

ENCODINGS = ("json", "protobuf")
"""Encodings of messages that are read here."""
INSTALL_HINT = (
    ""
    if find_spec("mcap")
    else '; if its messages are JSON or Protobuf: pip install ".[mcap]" in the clone'
)
"""Advice for a file that rosbags cannot read, where mcap is not installed."""


def list_mcap_topics(path: Path) -> list[str]:
    """List the topics of an MCAP file with messages in JSON or Protobuf, without a leading slash.

    The list is empty for any other file, and for one that cannot be read.
    """
    if path.suffix.lower() != ".mcap" or not path.is_file() or find_spec("mcap") is None:
        return []
    try:
        return sorted({topic.lstrip("/") for topic in _list_topics(path)})
    except InputError:  # Reported by the reader of ROS bags.
        return []


def read_messages(path: Path, topic: str) -> Iterator[tuple[Any, int]]:
    """Iterate over the messages of a topic, each with its time of writing in nanoseconds.

    Args:
        path: MCAP file.
        topic: Name of the topic without a leading slash.

    Raises:
        InputError: A message cannot be decoded.
    """
    names = [name for name in _list_topics(path) if name.lstrip("/") == topic]
    # A channel is the part of a topic with one encoding and one schema of messages.
    decoders: dict[int, Callable[[bytes], Any]] = {}
    with _open_file(path) as reader:
        for schema, channel, message in reader.iter_messages(topics=names):
            if channel.id not in decoders:
                decoders[channel.id] = _make_decoder(path, channel.message_encoding, schema)
            yield decoders[channel.id](message.data), message.log_time


def _make_decoder(path: Path, encoding: str, schema: Any) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a channel, JSON or Protobuf.

    A channel is the part of a topic with one encoding and one schema.

    Args:
        path: path of the bag, for messages.
        encoding: encoding of the messages, ``json`` or ``protobuf``.
        schema: schema of the channel.

    Raises:
        InputError: the package for Protobuf is not installed, or the channel has no schema.
    """
    if encoding == "json":
        return json.loads
    try:
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError:
        raise InputError(
            f"{path}: needs mcap-protobuf-support to read Protobuf messages, not installed "
            '(pip install ".[mcap]" in the clone of simgap)'
        ) from None
    decode: Callable[[bytes], Any] | None = DecoderFactory().decoder_for(encoding, schema)
    if decode is None:
        raise InputError(f"{path}: expected the Protobuf schema of each message, found none")
    return decode


def _list_topics(path: Path) -> set[str]:
    """Return the names of the topics with messages in JSON or Protobuf.

    They are in the summary at the end of the file. Without one, all messages are read.

    Args:
        path: MCAP file.
    """
    with _open_file(path) as reader:
        summary = reader.get_summary()
        if summary is not None and summary.channels:
            channels = list(summary.channels.values())
        else:
            channels = [channel for _, channel, _ in reader.iter_messages()]
    return {channel.topic for channel in channels if channel.message_encoding in ENCODINGS}


@contextmanager
def _open_file(path: Path) -> Iterator[Any]:
    """Open an MCAP file, and convert the errors of its reader to one line."""
    from mcap.reader import make_reader

    with convert_read_errors(path, "an MCAP file"), path.open("rb") as file:
        yield make_reader(file)


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
    """Table to which the messages of a topic are added one by one."""

    def __init__(self, wanted_names: Collection[str] = ()) -> None:
        """Start with no messages.

        `_stamps` and `_written` hold the times of the messages in seconds: from their headers (0 if
        they have none), and when they were written to the log. `_numbers` has all other columns.

        Args:
            wanted_names: Names of the numbers to store, in any case; all if empty.
        """
        self._wanted_names = {name.strip().lower() for name in wanted_names}
        if self._wanted_names:
            # A column named run may number the runs of the log.
            self._wanted_names.add("run")
        self._stamps = array("d")
        self._written = array("d")
        self._numbers: dict[str, array[float]] = {}

    def add(self, message: Any, written: int) -> None:
        """Append a row with the numbers of one message.

        A column that begins with this message has NaN in all rows before.

        Args:
            message: Decoded message.
            written: Time of writing in nanoseconds.
        """
        row = len(self._stamps)
        self._stamps.append(_get_stamp(message))
        self._written.append(_SECONDS_PER_NANOSECOND * written)
        for name, value in _iterate_numbers("", message, 0):
            if self._wanted_names and name.lower() not in self._wanted_names:
                continue
            column = self._numbers.setdefault(name, array("d"))
            # Earlier messages may have lacked this number.
            column.extend([np.nan] * (row - len(column)))
            # A list of named objects may contain a name twice; its first number counts.
            if len(column) == row:
                column.append(value)

    def columns(self) -> dict[str, Array]:
        """Return all columns (T,) by name, ordered by time stamp, and empty the table.

        Shapes: T messages.

        A number that a message lacks is NaN. The time stamps are those of the message headers, or
        if some message has none, the times of writing.
        """
        message_count = len(self._stamps)
        stamps = np.array(self._stamps)
        # Header stamps of zero were not filled in.
        times = stamps if message_count and (stamps > 0).all() else np.array(self._written)
        order = None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")
        result = {TIME_COLUMN: make_read_only(times if order is None else times[order])}
        for name in list(self._numbers):
            # Release each column after conversion; otherwise a long bag would be in memory twice.
            column = self._numbers.pop(name)
            column.extend([np.nan] * (message_count - len(column)))
            values = np.frombuffer(column)
            result[name] = make_read_only(values if order is None else values[order])
        return result


def _get_fields(value: Any) -> dict[str, Any] | None:
    """Return the fields of a message by name; None if the value is not a message.

    A message of ROS is a dataclass, a JSON message a mapping, and a Protobuf message has a
    descriptor of its fields.

    Args:
        value: Message or part of a message.
    """
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
    """Return the time stamp of a message in seconds; 0 if it has none.

    The stamp is in the header of a ROS message, else in the message itself, in one of the fields
    `STAMP_FIELDS`. It has a whole number of seconds, and perhaps one of nanoseconds.

    Args:
        message: Message of any encoding.
    """
    fields = _get_fields(message) or {}
    header = _get_fields(fields.get("header")) or {}
    for table in (header, fields):
        for name in STAMP_FIELDS:
            parts = _get_fields(table.get(name)) or {}
            seconds = [parts[key] for key in SECONDS_FIELDS if key in parts]
            nanoseconds = [parts[key] for key in NANOSECONDS_FIELDS if key in parts]
            if seconds and all(isinstance(n, int | np.integer) for n in (*seconds, *nanoseconds)):
                # Whole nanoseconds, so that equal stamps of two topics become equal numbers.
                total = NANOSECONDS * int(seconds[0]) + int(nanoseconds[0] if nanoseconds else 0)
                return _SECONDS_PER_NANOSECOND * _to_float(total)
    return 0.0


def _to_float(number: Any) -> float:
    """Convert a number; an integer that is too large becomes infinite."""
    try:
        return float(number)
    except OverflowError:
        return np.inf


def _iterate_numbers(path: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """Iterate over the numbers in a value of a message with their names.

    A number in a nested message is named ``pose.x``, and one in a list ``velocity[2]``, or by the
    name of the entry if it has one: ``joints.elbow.position``. Texts, long lists such as images,
    and messages nested deeper than `MAX_MESSAGE_DEPTH` are left out.

    Args:
        path: name of the value, empty for a whole message.
        value: number, list, message, or anything else.
        depth: number of lists and messages around it.
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
    is named by them: ``position.elbow``.

    Args:
        path: name of the message, empty for the outermost one.
        message: its fields by name.
        depth: number of lists and messages around it.
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
    """Return whether a list of numbers has a name for each of them.

    Args:
        values: field of a message, of any type.
        names: field of the same message that may hold names.
    """
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


BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""File name endings of bags that are single files."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag, as a file or a folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in BAG_SUFFIXES and path.is_file()


def split_bag_path(path: Path) -> tuple[Path, str] | None:
    """Split a path into a bag and a topic inside it; None if the path is not inside a bag.

    The path ``drive.bag/joint_states`` names the topic ``/joint_states`` of the bag ``drive.bag``.
    It does not exist on disk; the first of its parents that exists is the bag.
    """
    container = next((parent for parent in path.parents if parent.exists()), None)
    if container is None or not is_bag(container):
        return None
    return container, "/" + path.relative_to(container).as_posix()


def list_topics(bag: Path) -> list[str]:
    """List the topics of a bag in alphabetical order, without their leading slash.

    Raises:
        InputError: The bag cannot be read, or rosbags is not installed.
    """
    topics = list_mcap_topics(bag)
    if topics:
        return topics
    with _open_bag(bag) as reader:
        return sorted({connection.topic.lstrip("/") for connection in reader.connections})


def read_topic(bag: Path, topic: str, wanted_names: Collection[str] = ()) -> dict[str, Array]:
    """Read the numbers of a topic, ordered by time stamp.

    Shapes: T messages.

    Args:
        bag: Bag file or folder.
        topic: Name of the topic with its leading slash.
        wanted_names: Names of the numbers to store, in any case; all if empty.

    Returns:
        Columns (T,) by name, including the time stamps.

    Raises:
        InputError: The bag has no such topic, or its messages cannot be read.
    """
    table = MessageTable(wanted_names)
    # An MCAP file with messages in JSON or Protobuf.
    topics = list_mcap_topics(bag)
    if topics:
        # Topics of other loggers need not begin with a slash.
        if topic.lstrip("/") not in topics:
            raise _make_unknown_topic_error(bag, topic, topics)
        for message, stamp in read_messages(bag, topic.lstrip("/")):
            table.add(message, stamp)
        return table.columns()
    # Any other bag, with messages of ROS.
    with _open_bag(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        if not connections:
            topics = sorted({c.topic.lstrip("/") for c in reader.connections})
            raise _make_unknown_topic_error(bag, topic, topics)
        for connection, stamp, raw in reader.messages(connections=connections):
            table.add(reader.deserialize(raw, connection.msgtype), stamp)
    return table.columns()


def _make_unknown_topic_error(bag: Path, topic: str, topics: list[str]) -> InputError:
    """Make the error for a topic that a bag lacks; it lists the existing topics."""
    names = ", ".join(topics) or "none"
    return InputError(f"{bag}: unknown topic '{topic.lstrip('/')}'; there are: {names}")


@contextmanager
def _open_bag(bag: Path) -> Iterator[Any]:
    """Open a bag for reading with rosbags, and convert the errors of its reader to one line.

    Raises:
        InputError: rosbags is not installed, or the bag cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f"{bag}: needs rosbags to read it, not installed (pip install rosbags)"
        ) from None
    hint = INSTALL_HINT if bag.suffix.lower() == ".mcap" else ""
    with convert_read_errors(bag, "a bag", hint):
        # Bags of ROS 2 store their message types only since Iron; older ones are read with
        # Humble's.
        usual = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([bag], default_typestore=usual) as reader:
            yield reader
