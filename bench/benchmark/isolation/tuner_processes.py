"""Processes of isolated tuners, seen from the harness: start, exchange of messages, and end.

Folders of killed processes are deleted by the next process that makes one.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation import fork_server
from bench.benchmark.isolation.isolation_layers import (
    PROJECT_ROOT,
    AffinityController,
    KilledExternallyError,
    RunEndedError,
    describe_exit,
    list_readable_paths,
    with_isolation,
)
from bench.benchmark.isolation.message_channel import (
    MAX_PROPOSAL_BYTES,
    MAX_TEXT_BYTES,
    Message,
    MessageChannel,
    PeerClosedError,
    ProtocolError,
    pack_arrays,
    to_printable,
)
from methods.tuner import Array, Proposal, Task, TunerGenerator
from sims.core.files import lock_file
from sims.engines.compiled import machine_code as compiled

_FOLDER_PREFIX = "simgap-tuner-"
_EXIT_WAIT_SECONDS = 5.0
"""Time in seconds that the fork server has to end after its link is closed."""


class LockedFolder(NamedTuple):
    """Temporary folder that is locked by this process.

    Attributes:
        path: path of the folder.
        lock: file descriptor with the lock; the folder is in use while it is open.
    """

    path: str
    lock: int

    def remove(self) -> None:
        """Delete the folder and release its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)


def create_locked_folder() -> LockedFolder:
    """Create a new locked folder.

    The lock shows other processes that the folder is in use; folders of ended processes are removed
    first.

    Returns:
        The folder and its open lock, which is held until the process ends.
    """
    remove_stale_folders()
    while True:
        path = tempfile.mkdtemp(prefix=_FOLDER_PREFIX)
        lock = _lock_folder(path, is_blocking=True)
        # Between creation and lock another process may have removed the folder as unused.
        if lock is not None and os.path.isdir(path):
            return LockedFolder(path, lock)


def remove_stale_folders() -> None:
    """Delete the folders of processes that were killed."""
    for path in Path(tempfile.gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        lock = _lock_folder(str(path), is_blocking=False)
        if lock is not None:
            LockedFolder(str(path), lock).remove()


def _lock_folder(path: str, is_blocking: bool) -> int | None:
    """Lock a folder, so that no other process uses or deletes it, and return the descriptor.

    Args:
        path: path of the folder.
        is_blocking: True to wait for the lock.

    Returns:
        File descriptor; None if another process has the lock, or the folder does not exist.
    """
    try:
        lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        lock_file(lock, is_blocking)
    except OSError:
        os.close(lock)
        return None
    return lock


_BOOTSTRAP_CODE = (
    "import sys; sys.path[:] = {path!r}; "
    "from bench.benchmark.isolation.fork_server import serve_fork_requests; "
    "serve_fork_requests({descriptor})"
)
_PRELOADED_MODULES = ("numpy.random", "bench.benchmark.isolation.tuner_server")
_NUMERICAL_VARIABLE_PREFIXES = ("OPENBLAS_", "MKL_", "OMP_", "NPY_")
"""Prefixes of environment variables that determine how numerical libraries compute."""
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


class ForkServerClient:
    """Client of the fork server that starts tuner processes; see `isolation.fork_server`."""

    def __init__(self) -> None:
        """Start the fork server in a new interpreter, which imports the modules that tuners need.

        The server runs in an empty scratch folder (`_folder`, locked while in use) and searches no
        current folder for modules. `_loaded` are the modules that it has already imported;
        processes that it forks start fast, because they inherit these modules.
        """
        self._place: LockedFolder | None = create_locked_folder()
        self._folder = self._place.path
        self._loaded: set[str] = set()
        self._link, server_link = socket.socketpair()
        path = [place for place in sys.path if place not in ("", str(PROJECT_ROOT))] + [
            str(PROJECT_ROOT)
        ]
        code = _BOOTSTRAP_CODE.format(path=path, descriptor=server_link.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            pass_fds=[server_link.fileno()],
            env=_make_environment(self._folder),
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        server_link.close()
        atexit.register(self.close)
        self._send_request({}, _PRELOADED_MODULES)

    def _send_request(
        self, request: Mapping[str, Any], modules: Iterable[str], descriptors: tuple[int, ...] = ()
    ) -> None:
        """Send a request, with modules to be loaded that have not been loaded before.

        Args:
            request: request as JSON values.
            modules: names of modules that the service will need.
            descriptors: file descriptors to pass to the server.
        """
        missing = [name for name in dict.fromkeys(modules) if name not in self._loaded]
        try:
            fork_server.send_request(self._link, {**request, "modules": missing}, descriptors)
        except OSError:
            self.close()
            raise KilledExternallyError("the fork server has ended") from None
        self._loaded.update(missing)

    @property
    def is_alive(self) -> bool:
        """True if the fork server can start another process."""
        return self._process.poll() is None

    def start_process(
        self,
        service: str,
        files: Iterable[str] = (),
        memory: int = 0,
        hidden: Iterable[str] = (),
        modules: Iterable[str] = (),
    ) -> IsolatedProcess:
        """Start an isolated process, by a request to the fork server.

        Two pipes for messages and a control socket to its supervisor are made. Their ends for the
        process are sent with the request and closed here.

        Args:
            service: module and function that the process runs, as ``MODULE:FUNCTION``; it gets a
                message channel, the access policy and the active isolation layers.
            files: files that it may read, in addition to Python and its packages.
            memory: memory limit in MiB; 0 for no limit.
            hidden: folders that it must not access, in addition to the working directory.
            modules: modules that the fork server loads first; never those of plugins, because the
                next process would inherit their effects.

        Returns:
            Handle of the process.

        Raises:
            KilledExternallyError: the fork server is gone.
        """
        request = {
            "service": service,
            "folder": self._folder,
            "readable": [*list_readable_paths((*hidden, str(Path.cwd()))), *files],
            "memory": memory,
        }
        (reading, child_writing), (child_reading, writing) = os.pipe(), os.pipe()
        control, child_control = socket.socketpair()
        descriptors = child_control.fileno(), child_reading, child_writing
        try:
            self._send_request(request, modules, descriptors)
        except KilledExternallyError:
            control.close()
            os.close(reading)
            os.close(writing)
            raise
        finally:
            child_control.close()
            os.close(child_reading)
            os.close(child_writing)
        return IsolatedProcess(self, control, MessageChannel(reading, writing))

    def empty_shared_folder(self) -> None:
        """Delete the content of the folder that processes without their own folder share."""
        for path in Path(self._folder).iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """End the fork server and every process that it started, and delete their scratch folder.

        The server ends by itself when its link is closed; it is killed if this takes longer than
        `_EXIT_WAIT_SECONDS`.
        """
        atexit.unregister(self.close)
        self._link.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=_EXIT_WAIT_SECONDS)
        self._process.kill()
        self._process.wait()
        if self._place is not None:
            self._place.remove()
            self._place = None
        # Workers that have ended may have left their folders.
        remove_stale_folders()


def _make_environment(folder: str) -> dict[str, str]:
    """Return the environment variables of tuner processes.

    Only variables that numerical libraries and Python need are inherited, because others could pass
    information to a tuner. Unless the user has set it, the number of numerical threads is one.

    Args:
        folder: Private folder of the process, which becomes its home and its place for temporary
            files.
    """
    inherited_names = (
        "PATH",
        "LANG",
        "LC_ALL",
        "LD_LIBRARY_PATH",
        "CUDA_VISIBLE_DEVICES",
        "SYSTEMROOT",
    )
    variables = {name: os.environ[name] for name in inherited_names if name in os.environ}
    # Libraries would otherwise compute differently, and results would differ in the last digits.
    variables |= {
        name: value
        for name, value in os.environ.items()
        if name.startswith(_NUMERICAL_VARIABLE_PREFIXES)
    }
    # Compiled steps are loaded from the cache folder before the process is isolated.
    variables["SIMGAP_COMPILED"] = str(compiled.get_cache_folder())
    single_thread = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )
    return {
        **single_thread,
        **variables,
        "HOME": folder,
        "TMPDIR": folder,
        "PYTHONDONTWRITEBYTECODE": "1",
    }


class IsolatedProcess:
    """Handle of an isolated process, with the channel to it.

    Attributes:
        channel: message channel to the process.
        seals: Names of the active isolation layers, once the process is ready.
    """

    def __init__(
        self, server: ForkServerClient, control: socket.socket, channel: MessageChannel
    ) -> None:
        """Store the connections to a process.

        `channel` carries the messages of the tuner. `control` is the socket to its supervisor, the
        parent process that reports its exit code, and kills it when the socket is closed.
        """
        self._server, self._control, self.channel = server, control, channel
        self._open = True
        self.seals: list[str] = []

    @property
    def is_alive(self) -> bool:
        """True if the process has not been ended."""
        return self._open

    def wait_until_ready(self) -> None:
        """Wait until the process is ready.

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
            # The supervisor kills the process.
            with contextlib.suppress(OSError):
                self._control.shutdown(socket.SHUT_WR)
            self._wait_for_exit_code(START_TIMEOUT_SECONDS)
        self._control.close()
        if "disk" not in self.seals:
            self._server.empty_shared_folder()
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
        if message.kind == b"D":
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
            self.send(b"N", deadline=deadline)
            report = self.receive(deadline=deadline).to_document()
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


def relocate(tuned: TunerSpec, places: Mapping[Path, Path]) -> TunerSpec:
    """Return a specification with another path of its file.

    Args:
        tuned: specification of a tuner.
        places: new path of each file by its present path.
    """
    return replace(tuned, file=str(places[Path(tuned.file)])) if tuned.file else tuned


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

        The tuner has been built when the process has answered. Message kinds: B builds, L loads
        weights.

        Args:
            child: process of the tuner.
            tuned: specification of the tuner.
            state: trained weights of a learned tuner.
        """
        self.child = child
        child.wait_until_ready()
        started = perf_counter()
        deadline = started + START_TIMEOUT_SECONDS
        child.send(b"B", json.dumps(tuned.describe()).encode(), deadline=deadline)
        child.receive(deadline=deadline)
        self.import_seconds = perf_counter() - started
        if state is not None:
            child.send(b"L", *pack_arrays(state), deadline=deadline)
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
        child.send(b"T", *packed_arrays, deadline=deadline)
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
                    b"E",
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
        """Receive the tuner's answer: points to simulate (A), or the reason of its end (S).

        The body of a message ``A`` is [recommended point (dim,), if flags is 1] and then n points
        (n, dim), with n in the field `size`. Any other message ends the process, because code of a
        tuner may send any bytes.

        Args:
            task: task of the target.
            deadline: end of the whole run.

        Raises:
            RunEndedError: the message is not valid, the process failed, or the time limit was
                reached.
        """
        child = self.tuner.child
        # 8 bytes per float64, for all points of the budget and a recommendation.
        limit = min(MAX_PROPOSAL_BYTES, 8 * task.dim * (task.budget + 2))
        message = child.receive(max(limit, MAX_TEXT_BYTES), deadline)
        if message.kind == b"S":
            return message.to_text()
        dim, point_count = task.dim, message.size
        try:
            coordinates = message.to_array()
        except ProtocolError as error:
            raise child.fail_with_protocol_error(str(error)) from None
        recommends = message.flags == 1
        if (
            message.kind != b"A"
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
        child.send(b"C", deadline=deadline)
        child.receive(deadline=deadline)
