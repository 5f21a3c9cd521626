"""Messages between the harness and a tuner's process: arrays, JSON, proposals, random generators.

Objects are never sent. A message has a head (kind, flags, size, length of the body) and a body.
Each side sends only in response to the other. The tuner's side may write anything: an invalid
message ends its run, and lengths are checked before memory is allocated.
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

from methods.tuner import Array

_HEADER = struct.Struct("<cBxxIQ")
"""Head of a message: kind, flags, size, number of bytes in the body."""
_MAX_READ_BYTES = 1 << 20
"""Maximum number of bytes per read."""
_ARRAY_TYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|b1")
"""Permitted types of the arrays of a trained tuner."""
_MAX_ARRAYS = 10_000
"""Maximum number of arrays in a message."""
_MAX_NAMES_BYTES = 1 << 20
"""Maximum size of the names and shapes of the arrays in bytes."""

_MAX_POLL_MILLISECONDS = float((1 << 31) - 1)
"""Maximum timeout of `poll` in milliseconds."""

MAX_TEXT_BYTES = 1 << 16
"""Maximum size of a text message in bytes."""
MAX_PROPOSAL_BYTES = 1 << 28
"""Maximum size of proposals in bytes."""
MAX_STATE_BYTES = 1 << 31
"""Maximum size of trained weights in bytes."""
MAX_HARNESS_MESSAGE_BYTES = 1 << 40
"""Maximum size of a message from the harness in bytes; practically unlimited, as it is trusted."""


class MessageKind:
    """Kinds of messages, one byte each; the comments say who sends them, and their content."""

    READY = b"R"  # process: it has started; the active isolation layers
    BUILD = b"B"  # harness: build a tuner; its specification
    DONE = b"K"  # both: the request was executed; its result, if it has one
    WEIGHTS = b"L"  # both: trained arrays, to be loaded by the tuner or to be stored
    TASK = b"T"  # harness: run the tuner on a task; the task
    PROPOSALS = b"A"  # process: points to simulate, and the point that is recommended
    EVALUATION = b"E"  # harness: points, losses and observations
    STOPPED = b"S"  # process: the tuner has stopped by itself; its reason
    CLOSE = b"C"  # harness: the run is over; the tuner must close its resources
    FIT = b"F"  # harness: train the tuner; the budget and the seed
    TRAINING_REQUEST = b"P"  # process: properties of a simulator, or points to simulate
    PROPERTIES = b"O"  # harness: properties of the simulator, and observations if requested
    REFUSAL = b"X"  # harness: the request is not valid, or beyond the budget; the reason
    PROGRESS = b"W"  # process: losses of one epoch of the training
    FAILURE = b"D"  # process: code of the tuner has failed; the traceback
    WRITTEN_FILES = b"N"  # both: question for the files that the tuner wrote, and the answer
    QUESTION = b"Q"  # harness: which plugin to describe, or which case to diagnose
    ANSWER = b"A"  # process of a diagnoser: its diagnosis of the case


EVALUATION_SIMULATOR_FLAG = 1
"""Flag of a training request: it concerns the simulator for evaluation, not for training."""
SIMULATE_FLAG = 2
"""Flag of a training request: points are to be simulated."""


class PeerClosedError(Exception):
    """The process on the other side has ended."""


class ProtocolError(Exception):
    """The other side sent an invalid or an unexpected message."""


class Message(NamedTuple):
    """Message received through the pipe.

    Attributes:
        kind: one byte, see `MessageKind`.
        flags: number whose meaning depends on the kind.
        size: number whose meaning depends on the kind.
        body: content; valid until the next message is read.
    """

    kind: bytes
    flags: int
    size: int
    body: memoryview

    def to_array(self) -> Array:
        """Return the body, which consists of n float64 numbers, as a new array (n,).

        Raises:
            ProtocolError: its size is not a multiple of that of a number.
        """
        if len(self.body) % 8:  # bytes per float64
            raise ProtocolError("it sent an incomplete number")
        return np.frombuffer(self.body, dtype="<f8").astype(np.float64)

    def to_document(self, limit: int = MAX_TEXT_BYTES) -> Any:
        """Return the body as a JSON document.

        Args:
            limit: maximum size in bytes, because the parsed document takes much more memory.

        Raises:
            ProtocolError: the body is not JSON, or longer.
        """
        if len(self.body) > limit:
            raise ProtocolError(f"it sent {len(self.body)} bytes of JSON, {limit} are allowed")
        try:
            return json.loads(bytes(self.body))
        except (ValueError, RecursionError):
            raise ProtocolError("it sent invalid JSON") from None

    def to_text(self) -> str:
        """Return the body as printable text."""
        return to_printable(bytes(self.body[:MAX_TEXT_BYTES]).decode("utf-8", "replace"))


def to_printable(text: str) -> str:
    """Replace characters that would move a terminal's cursor or end a table's row."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in text)


class MessageChannel:
    """One side of a pair of pipes."""

    def __init__(self, reading: int, writing: int) -> None:
        """Store the descriptors, and prepare polling.

        Polling is needed so that every read and write can have a deadline.

        Args:
            reading: file descriptor of the pipe from the other side.
            writing: file descriptor of the pipe to the other side.
        """
        self._reading, self._writing = reading, writing
        self._buffer = bytearray(_MAX_READ_BYTES)
        self._view = memoryview(self._buffer)
        self._incoming, self._outgoing = select.poll(), select.poll()
        self._incoming.register(reading, select.POLLIN)
        self._outgoing.register(writing, select.POLLOUT)
        # Non-blocking, so that a side that does not read cannot block the other one forever.
        os.set_blocking(writing, False)

    def close(self) -> None:
        """Close both pipes; the other side gets an end of file."""
        for descriptor in (self._reading, self._writing):
            os.close(descriptor)

    @property
    def has_data(self) -> bool:
        """True if there is data to read."""
        return any(event & select.POLLIN for _, event in self._incoming.poll(0))

    def send(
        self,
        kind: bytes,
        *parts: bytes | memoryview | Array,
        flags: int = 0,
        size: int = 0,
        deadline: float = float("inf"),
    ) -> None:
        """Send a message to the other side.

        Args:
            kind: one byte that says what the message means.
            parts: parts of the body; arrays are float64.
            flags: 0 to 255; the meaning depends on the kind.
            size: at least 0, such as the number of points; the meaning depends on the kind.
            deadline: latest time, as of `time.perf_counter`.

        Raises:
            PeerClosedError: the other side has closed its pipe.
            TimeoutError: the other side does not read in time.
        """
        body = b"".join([part if isinstance(part, bytes) else bytes(part) for part in parts])
        self._write_message(_HEADER.pack(kind, flags, size, len(body)) + body, deadline)

    def send_document(self, kind: bytes, document: Any) -> None:
        """Send a message whose body is JSON.

        Args:
            kind: one byte.
            document: JSON content.
        """
        self.send(kind, json.dumps(document).encode())

    def _write_message(self, message: bytes, deadline: float) -> None:
        """Write the whole message, in several parts if the pipe is full.

        Args:
            message: header and body.
            deadline: latest time, as of `perf_counter`.

        Raises:
            PeerClosedError: the other side has closed the pipe.
            TimeoutError: the other side does not read in time.
        """
        unsent = memoryview(message)
        while unsent:
            try:
                unsent = unsent[os.write(self._writing, unsent) :]
            except BlockingIOError:
                if not self._outgoing.poll(_compute_poll_timeout(deadline)):
                    raise TimeoutError from None
            except OSError:
                raise PeerClosedError from None

    def receive(self, limit: int = MAX_TEXT_BYTES, deadline: float = float("inf")) -> Message:
        """Receive the next message from the process at the other end.

        Its header says how long the body is. The length is checked before memory is allocated, and
        data after the message is an error, since each side sends only in response to the other. A
        message that fits into the buffer is returned as a view of it.

        Args:
            limit: maximum size of the body in bytes.
            deadline: latest time, as of `time.perf_counter`.

        Raises:
            PeerClosedError: the other side has ended.
            ProtocolError: the data are not a valid message.
            TimeoutError: there is no message in time.
        """
        received = self._read_available_bytes(self._view, deadline)
        while received < _HEADER.size:
            received += self._read_available_bytes(self._view[received:], deadline)
        kind, flags, size, length = _HEADER.unpack_from(self._buffer)
        if length > limit:
            raise ProtocolError(f"it sent {length} bytes at once, {limit} are allowed")
        if received > _HEADER.size + length:
            raise ProtocolError("it sent a message without a request")
        received -= _HEADER.size  # from here on, the number of bytes of the body
        if _HEADER.size + length > _MAX_READ_BYTES:
            return Message(kind, flags, size, self._read_long_body(received, length, deadline))
        body = self._view[_HEADER.size : _HEADER.size + length]
        while received < length:
            received += self._read_available_bytes(body[received:], deadline)
        return Message(kind, flags, size, body)

    def _read_long_body(self, received: int, length: int, deadline: float) -> memoryview:
        """Read a body that is longer than the buffer; memory grows only with the data received.

        Args:
            received: number of bytes of the body that are in the buffer already.
            length: number of bytes of the body.
            deadline: time limit on the clock `perf_counter`, in seconds.
        """
        body = bytearray(self._view[_HEADER.size : _HEADER.size + received])
        while len(body) < length:
            part = self._view[: min(_MAX_READ_BYTES, length - len(body))]
            body += part[: self._read_available_bytes(part, deadline)]
        return memoryview(body)

    def _read_available_bytes(self, into: memoryview, deadline: float) -> int:
        """Read the bytes that are available, at least one, and return their number.

        Args:
            into: buffer to which they are written, from its beginning; its length is the limit.
            deadline: latest time, as of `perf_counter`.

        Raises:
            PeerClosedError: the other side has closed the pipe.
            TimeoutError: nothing arrives before the deadline.
        """
        # `poll` comes before `readv`, because a blocking read could not stop at the deadline.
        if not self._incoming.poll(_compute_poll_timeout(deadline)):
            raise TimeoutError
        try:
            size = os.readv(self._reading, [into])
        except OSError:
            raise PeerClosedError from None
        if not size:
            raise PeerClosedError
        return size


def _compute_poll_timeout(deadline: float) -> float | None:
    remaining = (deadline - perf_counter()) * 1e3
    # A larger timeout exceeds the range of `poll`, and is replaced by no timeout.
    return None if remaining > _MAX_POLL_MILLISECONDS else max(0.0, remaining)


def pack_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[bytes, ...]:
    """Pack named arrays into the parts of a body: a line of JSON, then the bytes of the arrays.

    The line has the name, type and shape of each. Unlike pickle, reading them runs no code.

    Returns:
        The line, and the bytes of each array.

    Raises:
        ValueError: an array has a type that is not permitted.
    """
    contiguous = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    for name, array in contiguous.items():
        if array.dtype.str not in _ARRAY_TYPES:
            raise ValueError(f"array {name!r:.80}: expected numbers, found {array.dtype}")
    descriptions = [[name, array.dtype.str, array.shape] for name, array in contiguous.items()]
    return json.dumps(descriptions).encode() + b"\n", *(
        array.tobytes() for array in contiguous.values()
    )


def unpack_arrays(body: memoryview) -> dict[str, NDArray[Any]]:
    """Unpack the arrays of a body that `pack_arrays` made.

    The first line lists name, type and shape of each array; their bytes follow. Code of a tuner may
    have made the body, so everything is checked.

    Raises:
        ProtocolError: the body is not valid.
    """
    line, _, _ = bytes(body[:_MAX_NAMES_BYTES]).partition(b"\n")
    payload = body[len(line) + 1 :]
    try:
        descriptions = json.loads(line)
        arrays, offset = {}, 0
        for name, dtype, shape in descriptions[:_MAX_ARRAYS]:
            array, offset = _read_array(payload, offset, dtype, shape)
            arrays[_check_array_name(name)] = array
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ProtocolError("it sent invalid arrays") from None
    if offset != len(payload) or not len(arrays) == len(descriptions) <= _MAX_ARRAYS:
        raise ProtocolError("its message does not match the arrays that it lists")
    return arrays


def _check_array_name(name: object) -> str:
    """Check the name of an array, which is used as a name in a file.

    Raises:
        ValueError: the name is not valid.
    """
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) < _NAME_LENGTH:
        raise ValueError
    return name


_NAME_LENGTH = 500
"""Upper limit of the length of an array's name in characters."""


def _read_array(
    data: memoryview, offset: int, dtype: str, shape: Sequence[int]
) -> tuple[NDArray[Any], int]:
    """Read the array at a position of a message, after checking its type, shape and size.

    Args:
        data: bytes of all arrays.
        offset: position of the array in bytes.
        dtype: type of the array, such as ``<f8``.
        shape: shape of the array.

    Returns:
        The array, and the position of its end.

    Raises:
        ValueError: type or shape are not valid.
    """
    # `type` and not `isinstance`, because True is an integer too.
    if dtype not in _ARRAY_TYPES or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape):
        raise ValueError
    size = int(np.dtype(dtype).itemsize)
    for n in shape:
        size *= n
    if size > len(data) - offset:
        raise ValueError
    array = np.frombuffer(data[offset : offset + size], dtype=dtype).reshape(shape)
    return array.copy(), offset + size


def to_points(proposed: object, dim: int, label: str) -> Array:
    """Convert proposals or recommendations to a new array (n, dim).

    Its numbers are not checked: they may be outside the unit cube, or not finite.

    Args:
        proposed: points from the tuner.
        dim: number of parameters.
        label: name of the points, for messages.

    Raises:
        ValueError: the points have another shape.
    """
    # The array is copied, because the tuner may change its own.
    points = np.array(proposed, dtype=np.float64, ndmin=2)
    if points.ndim != 2 or points.shape[1] != dim or not len(points):
        raise ValueError(
            f"the tuner gave {label} of shape {points.shape}; expected (n, {dim}) with n >= 1"
        )
    return points


def encode_rng_state(state: Any) -> NDArray[np.uint8]:
    """Return the state of a PCG64 generator as JSON in an array of bytes."""
    return np.frombuffer(json.dumps(state).encode(), dtype=np.uint8)


def decode_rng_state(text: NDArray[Any]) -> dict[str, Any]:
    """Return the state of a PCG64 generator from the result of `encode_rng_state`.

    Raises:
        ValueError: the text is not a valid state.
    """
    generator = np.random.PCG64()
    try:
        state = json.loads(text.tobytes())
        generator.state = state
        # With an even increment the stream may be constant, and rejection sampling would never end.
        if generator.state == state and state["state"]["inc"] & 1:
            return dict(state)
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        pass
    raise ValueError("not the state of a random generator")
