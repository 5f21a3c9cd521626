"""Read MCAP files whose messages are JSON or Protobuf (Foxglove, own loggers), without ROS.

The packages mcap and mcap-protobuf-support are imported when such a file is read. (Format:
mcap.dev/spec, message encodings ``json`` and ``protobuf``.)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sims.core.simulator import InputError
from sims.recording.log_formats.read_errors import convert_read_errors

ENCODINGS = ("json", "protobuf")
"""Encodings of messages that are read here."""
INSTALL_HINT = (
    ""
    if find_spec("mcap")
    else '; if its messages are JSON or Protobuf: pip install ".[mcap]" in the clone'
)
"""Advice for a file that rosbags cannot read, where mcap is not installed."""


def list_topics(path: Path) -> list[str]:
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
    decoders: dict[int, Callable[[bytes], Any]] = {}
    with _open_file(path) as reader:
        for schema, channel, message in reader.iter_messages(topics=names):
            if channel.id not in decoders:
                decoders[channel.id] = _make_decoder(path, channel.message_encoding, schema)
            yield decoders[channel.id](message.data), message.log_time


def _make_decoder(path: Path, encoding: str, schema: Any) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a channel, JSON or Protobuf.

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
    """Return the topics with messages in JSON or Protobuf."""
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
