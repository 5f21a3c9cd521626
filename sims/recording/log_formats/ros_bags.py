"""Read ROS bags as folders of logs, one log per topic.

The log ``drive.mcap/joint_states`` is the topic ``/joint_states``. Bags of ROS 1 (``.bag``) and ROS
2 (a folder with its ``metadata.yaml``, ``.db3``, ``.mcap``) are read message by message with
rosbags, MCAP files of JSON or Protobuf messages with mcap, and only the numbers of a message are
stored (`message_table`). The column ``time`` holds the stamps in seconds: those of the message
headers, or the times of writing where there is no header.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sims.core.simulator import Array, InputError
from sims.recording.log_formats import mcap_messages
from sims.recording.log_formats.message_table import MessageTable
from sims.recording.log_formats.read_errors import convert_read_errors

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""File name endings of bags that are single files."""


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
    topics = mcap_messages.list_topics(bag)
    if topics:
        return topics
    with _open_bag(bag) as reader:
        return sorted({connection.topic.lstrip("/") for connection in reader.connections})


def read_topic(bag: Path, topic: str, wanted_names: Collection[str] = ()) -> dict[str, Array]:
    """Read the numbers of a topic, ordered by time stamp.

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
    topics = mcap_messages.list_topics(bag)
    if topics:
        # Topics of other loggers need not begin with a slash.
        if topic.lstrip("/") not in topics:
            raise _make_unknown_topic_error(bag, topic, topics)
        for message, stamp in mcap_messages.read_messages(bag, topic.lstrip("/")):
            table.add(message, stamp)
        return table.columns()
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
    hint = mcap_messages.INSTALL_HINT if bag.suffix.lower() == ".mcap" else ""
    with convert_read_errors(bag, "a bag", hint):
        # Bags of ROS 2 store their message types only since Iron; older ones are read with
        # Humble's.
        usual = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([bag], default_typestore=usual) as reader:
            yield reader
