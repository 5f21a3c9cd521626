"""What goes through the pipe between the harness and a tuner's process: plain arrays and JSON,
never objects.

A message is a head (kind, flags, size, length of what follows) and bytes. Each side speaks when it
has been spoken to. The tuner's side may write whatever it likes: what is no message ends its run,
and lengths are bounded before anything is allocated.
"""

from __future__ import annotations

import json
import os
import select
import struct
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from methods.base import Array

_HEAD = struct.Struct("<cBxxIQ")
"""Kind, flags, size, bytes that follow."""
_BUFFER = 1 << 20
"""Bytes that are read at once."""
_TYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|b1")
"""Of arrays that a tuner may have learned."""
_ARRAYS = 10_000
"""How many it may have."""
_NAMES = 1 << 20
"""Bytes that their names and shapes may take."""

_LONGEST = float((1 << 31) - 1)
"""Milliseconds that the kernel waits at most."""

TEXT_LIMIT = 1 << 16
"""Bytes of a message that is text."""
ASKED_LIMIT = 1 << 28
"""Bytes of proposals."""
STATE_LIMIT = 1 << 31
"""Bytes of what was learned."""


class GoneError(Exception):
    """The other side has ended."""


class FoulError(Exception):
    """The other side said what is no message, or more than was asked."""


class Message(NamedTuple):
    """What came through the pipe.

    Attributes:
        kind: one byte; see `bench.sealing.inside` and `bench.sealing.outside`.
        flags: of the kind.
        size: likewise.
        body: bytes; valid until the next message is read.
    """

    kind: bytes
    flags: int
    size: int
    body: memoryview

    def numbers(self) -> Array:
        """The body as a fresh array (n,).

        Raises:
            FoulError: it is none.
        """
        if len(self.body) % 8:
            raise FoulError("it sent half a number")
        return np.frombuffer(self.body, dtype="<f8").astype(np.float64)

    def document(self, limit: int = TEXT_LIMIT) -> Any:
        """The body as JSON.

        Args:
            limit: bytes that it may have, since what it becomes takes much more.

        Raises:
            FoulError: it is none, or longer.
        """
        if len(self.body) > limit:
            raise FoulError(f"it sent {len(self.body)} bytes of JSON, {limit} are allowed")
        try:
            return json.loads(bytes(self.body))
        except (ValueError, RecursionError):
            raise FoulError("it sent what is no JSON") from None

    def text(self) -> str:
        """The body as text that can stand in a table."""
        return printable(bytes(self.body[:TEXT_LIMIT]).decode("utf-8", "replace"))


def printable(text: str) -> str:
    """A text without what would move a terminal's cursor or end a table's row."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in text)


class Channel:
    """One side of a pair of pipes.

    Args:
        reading: file descriptor.
        writing: file descriptor.
    """

    def __init__(self, reading: int, writing: int) -> None:
        self._reading, self._writing = reading, writing
        self._buffer = bytearray(_BUFFER)
        self._view = memoryview(self._buffer)
        self._incoming, self._outgoing = select.poll(), select.poll()
        self._incoming.register(reading, select.POLLIN)
        self._outgoing.register(writing, select.POLLOUT)
        # Who does not read must not make the other side wait for ever.
        os.set_blocking(writing, False)

    def close(self) -> None:
        """Close both pipes; the other side learns of it."""
        for descriptor in (self._reading, self._writing):
            os.close(descriptor)

    @property
    def spoken_to(self) -> bool:
        """Whether there is something to be read."""
        return any(event & select.POLLIN for _, event in self._incoming.poll(0))

    def send(
        self,
        kind: bytes,
        *parts: bytes | memoryview | Array,
        flags: int = 0,
        size: int = 0,
        deadline: float = float("inf"),
    ) -> None:
        """Write a message.

        Args:
            kind: one byte.
            parts: of the body; arrays are float64.
            flags: 0 to 255.
            size: at least 0.
            deadline: by `time.perf_counter`.

        Raises:
            GoneError: nobody reads any more.
            TimeoutError: nobody reads in time.
        """
        body = b"".join([part if isinstance(part, bytes) else bytes(part) for part in parts])
        self._write(_HEAD.pack(kind, flags, size, len(body)) + body, deadline)

    def send_document(self, kind: bytes, document: Any, flags: int = 0) -> None:
        """Write a message whose body is JSON."""
        self.send(kind, json.dumps(document).encode(), flags=flags)

    def _write(self, whole: bytes, deadline: float) -> None:
        left = memoryview(whole)
        while left:
            try:
                left = left[os.write(self._writing, left) :]
            except BlockingIOError:
                if not self._outgoing.poll(_milliseconds(deadline)):
                    raise TimeoutError from None
            except OSError:
                raise GoneError from None

    def receive(self, limit: int = TEXT_LIMIT, deadline: float = float("inf")) -> Message:
        """The next message.

        Args:
            limit: bytes that its body may have.
            deadline: by `time.perf_counter`.

        Raises:
            GoneError: the other side has ended.
            FoulError: that is no message.
            TimeoutError: there is none in time.
        """
        there = self._read(self._view, deadline)
        while there < _HEAD.size:
            there += self._read(self._view[there:], deadline)
        kind, flags, size, length = _HEAD.unpack_from(self._buffer)
        if length > limit:
            raise FoulError(f"it sent {length} bytes at once, {limit} are allowed")
        if there > _HEAD.size + length:
            raise FoulError("it spoke without having been asked")
        there -= _HEAD.size
        if _HEAD.size + length > _BUFFER:
            return Message(kind, flags, size, self._long(there, length, deadline))
        body = self._view[_HEAD.size : _HEAD.size + length]
        while there < length:
            there += self._read(body[there:], deadline)
        return Message(kind, flags, size, body)

    def _long(self, there: int, length: int, deadline: float) -> memoryview:
        """A body that is longer than the buffer; it takes no more memory than has been sent."""
        body = bytearray(self._view[_HEAD.size : _HEAD.size + there])
        while len(body) < length:
            part = self._view[: min(_BUFFER, length - len(body))]
            body += part[: self._read(part, deadline)]
        return memoryview(body)

    def _read(self, into: memoryview, deadline: float) -> int:
        # Waiting and reading: a read that waits could not be ended at the deadline.
        if not self._incoming.poll(_milliseconds(deadline)):
            raise TimeoutError
        try:
            size = os.readv(self._reading, [into])
        except OSError:
            raise GoneError from None
        if not size:
            raise GoneError
        return size


def _milliseconds(deadline: float) -> float | None:
    left = (deadline - perf_counter()) * 1e3
    # A limit of years is none, and more than poll takes.
    return None if left > _LONGEST else max(0.0, left)


def packed(arrays: Mapping[str, NDArray[Any]]) -> tuple[bytes, ...]:
    """Named arrays as the parts of a body: a line of JSON that says what they are, then their
    bytes.

    Raises:
        ValueError: an array of another type than numbers have.
    """
    held = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    for name, array in held.items():
        if array.dtype.str not in _TYPES:
            raise ValueError(f"array {name!r:.80}: expected numbers, found {array.dtype}")
    says = [[name, array.dtype.str, array.shape] for name, array in held.items()]
    return json.dumps(says).encode() + b"\n", *(array.tobytes() for array in held.values())


def unpacked(body: memoryview) -> dict[str, NDArray[Any]]:
    """The arrays of a body that `packed` made.

    Raises:
        FoulError: it is none.
    """
    line, _, _ = bytes(body[:_NAMES]).partition(b"\n")
    rest = body[len(line) + 1 :]
    try:
        says = json.loads(line)
        arrays, place = {}, 0
        for name, kind, shape in says[:_ARRAYS]:
            array, place = _array(rest, place, kind, shape)
            arrays[_name(name)] = array
    except (ValueError, TypeError, KeyError, RecursionError):
        raise FoulError("it sent what are no arrays") from None
    if place != len(rest) or not len(arrays) == len(says) <= _ARRAYS:
        raise FoulError("it sent more or less than the arrays that it names")
    return arrays


def _name(name: object) -> str:
    """The name of an array, which becomes one of a file's.

    Raises:
        ValueError: it cannot.
    """
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) < _NAME_LENGTH:
        raise ValueError
    return name


_NAME_LENGTH = 500
"""Characters of an array's name."""


def _array(
    data: memoryview, place: int, kind: str, shape: Sequence[int]
) -> tuple[NDArray[Any], int]:
    """The array that begins at a place, and where it ends.

    Raises:
        ValueError: there is none.
    """
    if kind not in _TYPES or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape):
        raise ValueError
    size = int(np.dtype(kind).itemsize)
    for n in shape:
        size *= n
    if size > len(data) - place:
        raise ValueError
    array = np.frombuffer(data[place : place + size], dtype=kind).reshape(shape)
    return array.copy(), place + size
