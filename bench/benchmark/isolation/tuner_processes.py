"""Processes of isolated tuners, seen from the harness: exchange of messages, and end."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation import fork_server
from bench.benchmark.isolation.cpu_affinity import AffinityController
from bench.benchmark.isolation.message_channel import (
    MAX_PROPOSAL_BYTES,
    MAX_TEXT_BYTES,
    Message,
    MessageChannel,
    MessageKind,
    PeerClosedError,
    ProtocolError,
    pack_arrays,
    to_printable,
)
from bench.benchmark.isolation.process_errors import (
    KilledExternallyError,
    RunEndedError,
    describe_exit,
    with_isolation,
)
from methods.tuner import (
    Array,
    Proposal,
    Task,
    TunerGenerator,
)

START_TIMEOUT_SECONDS = 60.0
"""Timeout in seconds for the start of a process and for building a tuner."""
_EXTERNAL_KILL_SIGNALS = (-9, -15)
"""Exit codes of processes that were killed externally: SIGKILL and SIGTERM.

SIGKILL is also sent by the kernel if memory is exhausted.
"""


_SHUTDOWN_TIMEOUT_SECONDS = 1.0
"""Timeout in seconds for the end of a process that has closed its pipe."""
_REPORT_TIMEOUT_SECONDS = 1.0
"""Timeout in seconds for a process's report of the files that it has written."""
_MAX_REPORTED_FILES = 1_000_000
"""Maximum reported number of files; larger reports are cut to it."""


class Written(NamedTuple):
    """Files that a tuner has written to the folder that is deleted with its process.

    Attributes:
        files: number of files.
        names: names of the first files.
    """

    files: int
    names: tuple[str, ...]


NOTHING_WRITTEN = Written(0, ())


def _format_file_name(name: object) -> str:
    """Convert a file name to text that fits into one line."""
    return " ".join(to_printable(str(name)[:100]).split())


class IsolatedProcess:
    """Handle of an isolated process, with the channel to it.

    Attributes:
        channel: message channel to the process.
        seals: Names of the active isolation layers, once the process is ready.
    """

    def __init__(
        self,
        channel: MessageChannel,
        control: socket.socket,
        empty_shared_folder: Callable[[], None],
    ) -> None:
        """Store the connections to a process.

        Args:
            channel: channel for the messages of the tuner.
            control: socket to the supervisor, the parent of the process: it reports the exit code
                of the process, and kills it when this socket is closed.
            empty_shared_folder: deletes the content of the folder that processes share if the
                kernel does not permit a folder of their own.
        """
        self.channel, self._control = channel, control
        self._empty_shared_folder = empty_shared_folder
        self._open = True
        self.seals: list[str] = []

    @property
    def is_alive(self) -> bool:
        """True if the process has not been ended."""
        return self._open

    def wait_until_ready(self) -> None:
        """Wait until the process is ready; it then reports its active isolation layers.

        Raises:
            KilledExternallyError: the process did not start.
        """
        try:
            self.seals = self.channel.receive(
                deadline=perf_counter() + START_TIMEOUT_SECONDS
            ).to_document()
        except (PeerClosedError, TimeoutError, ProtocolError):
            raise KilledExternallyError(f"a tuner's process did not start ({self.end()})") from None

    def end(self, kill: bool = True) -> int | None:
        """End the process, and return its exit code.

        Closing the channel asks the process to end by itself. If it does not, or if it is to be
        killed, closing the control socket makes its supervisor kill it.

        Args:
            kill: True to kill it at once; False to let it end by itself first.

        Returns:
            Its exit code; None if it had to be killed, or was ended before.
        """
        if not self._open:
            return None
        self._open = False
        self.channel.close()
        code = None if kill else self._wait_for_exit_code(_SHUTDOWN_TIMEOUT_SECONDS)
        if code is None:
            # The supervisor kills the process when this side of the socket is closed. The other
            # side stays open, so that its report can be awaited.
            with contextlib.suppress(OSError):
                self._control.shutdown(socket.SHUT_WR)
            self._wait_for_exit_code(START_TIMEOUT_SECONDS)
        self._control.close()
        # Without the layer "disk", the process had no folder of its own.
        if "disk" not in self.seals:
            self._empty_shared_folder()
        return code

    def _wait_for_exit_code(self, seconds: float) -> int | None:
        """Wait for the report of the supervisor.

        Args:
            seconds: Longest time to wait.

        Returns:
            Exit code of the process; None if it has not ended in time. A supervisor without a
            report was killed externally, and its process with it.
        """
        self._control.settimeout(seconds)
        try:
            report = self._control.recv(fork_server.EXIT_CODE.size)
        except TimeoutError:
            return None
        except OSError:
            report = b""
        return fork_server.EXIT_CODE.unpack(report)[0] if report else -signal.SIGKILL

    def receive(self, limit: int = MAX_TEXT_BYTES, deadline: float = float("inf")) -> Message:
        """Receive the next message of the process.

        Args:
            limit: maximum size of the message in bytes.
            deadline: latest time, as of `perf_counter`.

        Raises:
            RunEndedError: the tuner failed, took too long or is gone; its process may have ended.
            KilledExternallyError: the process was killed externally.
        """
        try:
            message = self.channel.receive(limit, deadline)
        except TimeoutError:
            self.end()
            raise RunEndedError("timeout", "") from None
        except ProtocolError as error:
            raise self.fail_with_protocol_error(str(error)) from None
        except PeerClosedError:
            raise self._make_exit_error() from None
        if message.kind == MessageKind.FAILURE:
            raise RunEndedError("crashed", with_isolation(message.to_text()))
        return message

    def written(self) -> Written:
        """Return the files that the tuner has written to its folder since the last call.

        The result is empty if the process does not answer; its report is optional.
        """
        if not self._open:
            return NOTHING_WRITTEN
        deadline = perf_counter() + _REPORT_TIMEOUT_SECONDS
        try:
            self.send(MessageKind.WRITTEN_FILES, deadline=deadline)
            report = self.receive(deadline=deadline).to_document()
            # Code of the tuner may have made the report, so its size is limited.
            count = max(0, min(int(report["count"]), _MAX_REPORTED_FILES))
            return Written(
                count, tuple(map(_format_file_name, report["names"][:3])) if count else ()
            )
        except (RunEndedError, KilledExternallyError, ProtocolError):
            return NOTHING_WRITTEN
        except (TypeError, ValueError, LookupError, OverflowError):
            # The message is JSON, but has another content.
            return NOTHING_WRITTEN

    def send(self, kind: bytes, *parts: bytes | Array, deadline: float, **head: int) -> None:
        """Send a message to the process; raises the errors of `receive`.

        Args:
            kind: kind of the message, one byte.
            parts: content of the message.
            deadline: latest time, as of `perf_counter`.
            head: further fields of the message header.
        """
        # An answer sent before its question would seem to take no time.
        if self.channel.has_data:
            raise self.fail_with_protocol_error("it sent a message without a request")
        try:
            self.channel.send(kind, *parts, deadline=deadline, **head)
        except TimeoutError:
            self.end()
            raise RunEndedError("timeout", "") from None
        except PeerClosedError:
            raise self._make_exit_error() from None

    def fail_with_protocol_error(self, violation: str) -> RunEndedError:
        """End a process that violated the protocol, and return the error to raise."""
        self.end()
        return RunEndedError(
            "crashed", f"the tuner's process violated the message protocol: {violation}"
        )

    def _make_exit_error(self) -> RunEndedError | KilledExternallyError:
        """Return the error for a process that has closed its pipe, after waiting for its exit code.

        A kill from outside by SIGKILL or SIGTERM, such as by the kernel when memory is exhausted,
        gives KilledExternallyError, and the run is repeated; every other end is a crash of the
        tuner.
        """
        code = self.end(kill=False)
        if code in _EXTERNAL_KILL_SIGNALS:
            return KilledExternallyError(f"the tuner's process was killed by signal {-code}")
        return RunEndedError("crashed", describe_exit("the tuner's process", code))


_CLOSE_TIMEOUT_SECONDS = 10.0
"""Maximum timeout in seconds for the tuner to close its resources at the end of a run."""


@dataclass(frozen=True)
class TunerSpec:
    """Specification of a tuner to be built in an isolated process.

    Attributes:
        name: registered name.
        module: module of an installed tuner.
        file: plugin file of the tuner; empty if it is installed.
        options: options of its entry.
        modules: packages that it needs, to be preloaded.
    """

    name: str
    module: str
    file: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()

    def describe(self) -> dict[str, Any]:
        """Return what an isolated process needs to find and build the tuner, as JSON values."""
        return {
            "name": self.name,
            "module": self.module,
            "file": self.file,
            "options": dict(self.options),
        }


def relocate(tuned: TunerSpec, new_paths: Mapping[Path, Path]) -> TunerSpec:
    """Return a specification with another path of its plugin file, if it has one.

    Args:
        tuned: specification of a tuner.
        new_paths: new path of each file by its present path.
    """
    return replace(tuned, file=str(new_paths[Path(tuned.file)])) if tuned.file else tuned


class IsolatedTuner:
    """Tuner that has been built in an isolated process.

    Attributes:
        import_seconds: seconds to build the tuner, nearly all for imports of its file.

    Raises:
        RunEndedError: the tuner cannot be built; the caller ends the process if it still runs.
    """

    def __init__(
        self,
        child: IsolatedProcess,
        tuned: TunerSpec,
        state: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        """Send the specification of the tuner to its process, then the weights if there are any.

        The tuner has been built when the process has answered.

        Args:
            child: process of the tuner.
            tuned: specification of the tuner.
            state: trained weights of a learned tuner.
        """
        self.child = child
        child.wait_until_ready()
        started = perf_counter()
        deadline = started + START_TIMEOUT_SECONDS
        child.send(MessageKind.BUILD, json.dumps(tuned.describe()).encode(), deadline=deadline)
        child.receive(deadline=deadline)
        self.import_seconds = perf_counter() - started
        if state is not None:
            child.send(MessageKind.WEIGHTS, *pack_arrays(state), deadline=deadline)
            child.receive(deadline=deadline)


@dataclass(frozen=True)
class IsolatedRun:
    """Isolated tuner for one run, with the method `tune` of a tuner.

    Attributes:
        tuner: isolated tuner.
        stream: seed of the run's random generator.
        seconds: time limit of the run.
    """

    tuner: IsolatedTuner
    stream: NDArray[np.uint32]
    seconds: float

    def tune(self, task: Task, _: np.random.Generator) -> TunerGenerator:
        """Run the tuner; its random numbers are drawn in the isolated process.

        The process starts the tuner when it has got the task. When the generator is closed while
        the tuner waits for an evaluation, the tuner is closed, too, and the process may serve
        another run.

        Args:
            task: task of the target; its budget is limited to 2^62, so that it fits into an int64.
            _: not used.

        Yields:
            Points to simulate.

        Returns:
            Reason for which the tuner has stopped.

        Raises:
            RunEndedError: a message is not valid, the process failed, or the time limit was
                reached.
        """
        child, deadline = self.tuner.child, perf_counter() + self.seconds
        affinity_controller = AffinityController()
        packed_arrays = pack_arrays(
            {
                "start": task.start,
                "observed": task.observed,
                "scale": task.scale,
                "training": task.training,
                "budget": np.array(min(task.budget, 1 << 62)),
                "lengths": np.array(task.lengths, dtype=np.int64),
                "initial": task.scene.initial,
                "inputs": task.scene.inputs,
                "stream": self.stream.astype(np.int64),
            }
        )
        child.send(MessageKind.TASK, *packed_arrays, deadline=deadline)
        try:
            while True:
                answer = self._receive_answer(task, deadline)
                if isinstance(answer, str):
                    return answer
                try:
                    evaluation = yield answer
                except GeneratorExit:
                    self._close_tuner()
                    raise
                child.send(
                    MessageKind.EVALUATION,
                    evaluation.proposals.tobytes(),
                    evaluation.losses.tobytes(),
                    evaluation.observations.tobytes(),
                    # They tell the process on which processor to run.
                    flags=affinity_controller.record_exchange(),
                    size=len(evaluation.losses),
                    deadline=deadline,
                )
        finally:
            affinity_controller.release_affinity()

    def _receive_answer(self, task: Task, deadline: float) -> Array | Proposal | str:
        """Receive the tuner's answer: points to simulate, or the reason of its end.

        The body of proposals is [recommended point (dim,), if flags is 1] and then n points
        (n, dim), with n in the field `size`. Any other message ends the process, because code of a
        tuner may send any bytes.

        Args:
            task: task of the target.
            deadline: end of the whole run.

        Returns:
            Points (n, dim), with the tuner's recommendation if it states one; or the reason for
            which the tuner has stopped.

        Raises:
            RunEndedError: the message is not valid, the process failed, or the time limit was
                reached.
        """
        child = self.tuner.child
        # 8 bytes per float64, for all points of the budget and a recommendation.
        limit = min(MAX_PROPOSAL_BYTES, 8 * task.dim * (task.budget + 2))
        message = child.receive(max(limit, MAX_TEXT_BYTES), deadline)
        if message.kind == MessageKind.STOPPED:
            return message.to_text()
        dim, point_count = task.dim, message.size
        try:
            coordinates = message.to_array()
        except ProtocolError as error:
            raise child.fail_with_protocol_error(str(error)) from None
        recommends = message.flags == 1
        if (
            message.kind != MessageKind.PROPOSALS
            or not point_count
            or coordinates.size != (point_count + recommends) * dim
        ):
            raise child.fail_with_protocol_error("it requested no points")
        if recommends:
            return Proposal(coordinates[dim:].reshape(point_count, dim), coordinates[:dim])
        return coordinates.reshape(point_count, dim)

    def _close_tuner(self) -> None:
        """Close the tuner, which waits for an evaluation.

        Raises:
            RunEndedError: the tuner failed while it was closed.
        """
        child = self.tuner.child
        deadline = perf_counter() + min(self.seconds, _CLOSE_TIMEOUT_SECONDS)
        child.send(MessageKind.CLOSE, deadline=deadline)
        child.receive(deadline=deadline)
