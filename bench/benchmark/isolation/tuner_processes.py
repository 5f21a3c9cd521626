"""Processes of isolated tuners, seen from the harness: messages of runs and trainings, and end."""

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
    EVALUATION_SIMULATOR_FLAG,
    MAX_PROPOSAL_BYTES,
    MAX_STATE_BYTES,
    MAX_TEXT_BYTES,
    SIMULATE_FLAG,
    Message,
    MessageChannel,
    MessageKind,
    PeerClosedError,
    ProtocolError,
    decode_rng_state,
    encode_rng_state,
    pack_arrays,
    to_printable,
    unpack_arrays,
)
from bench.benchmark.isolation.process_errors import (
    KilledExternallyError,
    RunEndedError,
    describe_exit,
    with_isolation,
)
from methods.tuner import (
    Array,
    BudgetExceededError,
    Proposal,
    Task,
    TrainingCallback,
    TrainingSimulator,
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
_NO_DEADLINE = float("inf")
"""Deadline of a training, in seconds: none."""
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

        They are deleted with the process, so a note informs the author of the tuner. The
        result is empty if the process does not answer; its report is optional.
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
                    # The flags tell the process on which processor to run, which is faster if
                    # messages alternate quickly.
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
        # 8 bytes per float64, for a recommendation, all points of the budget, and one more point,
        # by which a tuner exceeds its budget.
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


def train_remotely(
    child: IsolatedProcess,
    simulator: TrainingSimulator,
    stream: NDArray[np.uint32],
    callback: TrainingCallback | None,
) -> dict[str, Array]:
    """Train a tuner in its isolated process, while this process simulates for it.

    The training is started by a message. Then the tuner's messages are answered: requests of
    simulations and reports of progress, until it sends its trained arrays.

    Args:
        child: process of the tuner.
        simulator: training simulator, which counts the simulations.
        stream: seed of the tuner's random generator.
        callback: training callback; None for none.

    Returns:
        Trained arrays by name.

    Raises:
        RunEndedError: the tuner failed.
        KilledExternallyError: its process was killed externally.
    """
    request = {"stream": stream.astype(np.int64), "budget": np.array(simulator.budget)}
    child.send(
        MessageKind.FIT,
        *pack_arrays(request),
        flags=callback is not None,  # whether to report progress
        deadline=_NO_DEADLINE,
    )
    # That for evaluation is added when it is first used.
    simulators: list[TrainingSimulator] = [simulator]
    while True:
        message = child.receive(MAX_STATE_BYTES, _NO_DEADLINE)
        try:
            if message.kind == MessageKind.WEIGHTS:
                return unpack_arrays(message.body)
            _handle_training_message(child, message, simulators, callback)
        except ProtocolError as error:
            raise RunEndedError(
                "crashed", f"the tuner's process violated the message protocol: {error}"
            ) from None


def _handle_training_message(
    child: IsolatedProcess,
    message: Message,
    simulators: list[TrainingSimulator],
    callback: TrainingCallback | None,
) -> None:
    """Answer one message of a tuner during its training.

    A report of progress is confirmed. A request of simulations is served; with
    `EVALUATION_SIMULATOR_FLAG` it uses the simulator for evaluation, which exists only if there is
    a callback. `SIMULATE_FLAG` is read in `_serve_simulation`.

    Args:
        child: process of the tuner.
        message: its message.
        simulators: training simulators that it may use; that for evaluation is added on its first
            use.
        callback: receives the progress; None for no progress.

    Raises:
        ProtocolError: the message is not valid here.
    """
    # The position of the simulator in the list: 0 for training, 1 for evaluation (flag value 1).
    simulator_index = message.flags & EVALUATION_SIMULATOR_FLAG
    has_known_flags = message.flags <= EVALUATION_SIMULATOR_FLAG | SIMULATE_FLAG
    is_request = message.kind == MessageKind.TRAINING_REQUEST and has_known_flags
    if message.kind == MessageKind.PROGRESS and callback is not None:
        callback.epoch(*_parse_progress(message.to_document()))
        child.send(MessageKind.DONE, deadline=_NO_DEADLINE)
    elif is_request and (callback is not None or not simulator_index):
        if simulator_index and callback is not None and len(simulators) == 1:
            # `ground` is the simulator with which the callback evaluates the tuner.
            simulators.append(callback.ground)
        _serve_simulation(child, message, simulators[simulator_index])
    else:
        raise ProtocolError("it sent a message of an unexpected kind")


def _parse_progress(document: Any) -> tuple[str, int, int, float, float]:
    """Parse a progress message: stage, epoch, number of epochs, training and held-out loss.

    Code of the tuner may have sent any values, so they are converted to the expected types.

    Raises:
        ProtocolError: the message has another content.
    """
    try:
        stage, epoch, epochs, loss, held_out = document
        return to_printable(str(stage)[:80]), int(epoch), int(epochs), float(loss), float(held_out)
    except (TypeError, ValueError, OverflowError):
        raise ProtocolError("its report of progress is not valid") from None


def _serve_simulation(
    child: IsolatedProcess, message: Message, simulator: TrainingSimulator
) -> None:
    """Send the properties of a simulator, and simulate if the message requests it.

    It serves a learned tuner that trains in an isolated process. Without `SIMULATE_FLAG` only the
    properties are sent. A request that is not valid, or beyond the budget, is answered by a
    refusal, and the training can continue.

    Properties: `training` (2, dim) is the range in the unit cube, `scale` (C,) the scale of each
    channel, `lengths` the number of samples of each run, `scene` the present scenario (initial
    values and inputs).

    Args:
        child: isolated process with the tuner.
        message: request of the tuner.
        simulator: training simulator, which counts the simulations.
    """
    arrays: dict[str, NDArray[Any]] = {}
    if message.flags & SIMULATE_FLAG:
        try:
            arrays = _simulate_points(message, simulator)
        except (ValueError, BudgetExceededError) as error:
            kind = "budget" if isinstance(error, BudgetExceededError) else "value"
            refusal = json.dumps({"kind": kind, "says": str(error)}).encode()
            child.send(MessageKind.REFUSAL, refusal, deadline=_NO_DEADLINE)
            return
    properties = {
        "training": simulator.training,
        "scale": simulator.scale,
        "lengths": np.array(simulator.lengths, dtype=np.int64),
        "initial": simulator.scene.initial,
        "inputs": simulator.scene.inputs,
        "counts": np.array([simulator.used, simulator.budget], dtype=np.int64),
    }
    child.send(
        MessageKind.PROPERTIES, *pack_arrays({**properties, **arrays}), deadline=_NO_DEADLINE
    )


def _simulate_points(message: Message, simulator: TrainingSimulator) -> dict[str, NDArray[Any]]:
    """Simulate the points that an isolated tuner has requested in its training.

    Args:
        message: message with the points of the unit cube and the state of the tuner's random
            generator.
        simulator: training simulator.

    Returns:
        The observations, and the state of the random generator after drawing the scenario.

    Raises:
        ProtocolError: the message has no points of this dimension.
        ValueError: the state is not that of a generator, or a point is outside the training range.
        BudgetExceededError: more simulations are requested than the budget allows.
    """
    request = unpack_arrays(message.body)
    points = request.get("points", np.empty(0))
    if points.dtype != np.float64 or points.ndim != 2 or points.shape[1] != simulator.dim:
        raise ProtocolError("it requested no points")
    generator = np.random.Generator(np.random.PCG64())
    generator.bit_generator.state = decode_rng_state(request.get("rng", np.empty(0)))
    observations = simulator.simulate(generator, points)
    return {"observations": observations, "rng": encode_rng_state(generator.bit_generator.state)}
