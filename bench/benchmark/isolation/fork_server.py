"""Fork server from which tuner processes start in a few milliseconds.

It is a new interpreter without any information about the study. It has loaded numpy, the tuner
interface and packages that tuners need, but never a plugin, because the next run would inherit the
effects of its code. For each request it forks a supervisor, which sets up the isolation layers that
need a parent process. The supervisor forks the process that runs the tuner's code. Killing the
supervisor ends both.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import signal
import socket
import struct
import warnings
from contextlib import suppress
from time import perf_counter, sleep
from typing import Any, NoReturn

from bench.benchmark.isolation import isolation_layers
from bench.benchmark.isolation.linux_syscalls import set_parent_death_signal
from bench.benchmark.isolation.message_channel import MessageChannel

_LENGTH = struct.Struct("<I")
_SHUTDOWN_TIMEOUT_SECONDS = 1.0
"""Timeout in seconds for the end of a process that has closed its pipe."""
SERVICE_NAMES = (
    "bench.benchmark.isolation.tuner_server:serve_requests",
    "bench.benchmark.runner.plugin_discovery:serve_inspection",
    "bench.diagnosis_benchmark.diagnoser_process:serve_requests",
)
"""Purposes of isolated processes: functions that get the channel of the process."""


def send_message(link: socket.socket, document: Any, descriptors: tuple[int, ...] = ()) -> None:
    """Send a request or an answer with open files.

    Args:
        link: socket to the other side.
        document: JSON content.
        descriptors: file descriptors to pass.
    """
    body = json.dumps(document).encode()
    socket.send_fds(link, [_LENGTH.pack(len(body))], descriptors)
    link.sendall(body)


def receive_message(link: socket.socket) -> tuple[Any, list[int]]:
    """Receive a request or an answer with its open files.

    Raises:
        EOFError: the other side has closed the socket.
    """
    head, descriptors, _, _ = socket.recv_fds(link, _LENGTH.size, 2)
    if len(head) < _LENGTH.size:
        raise EOFError
    (left,) = _LENGTH.unpack(head)
    body = b""
    while left > len(body):
        part = link.recv(left - len(body))
        if not part:
            raise EOFError
        body += part
    return json.loads(body), list(descriptors)


def serve_fork_requests(descriptor: int) -> None:
    """Serve requests until the other side closes the socket.

    Args:
        descriptor: file descriptor of the socket.
    """
    link = socket.socket(fileno=descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    held = isolation_layers.enter_namespaces()
    children: set[int] = set()
    try:
        while True:
            request, descriptors = receive_message(link)
            match request["do"]:
                case "load":
                    _preload_modules(request["modules"])
                    send_message(link, {})
                case "start":
                    keeper = _start_supervisor(link, request, descriptors, held)
                    children.add(keeper)
                    send_message(link, {"keeper": keeper})
                case "end":
                    children.discard(request["keeper"])
                    send_message(
                        link, {"exit": _end_supervisor(request["keeper"], request["kill"])}
                    )
    except (EOFError, OSError):
        # When the client has ended for any reason, all its processes are ended too.
        for keeper in children:
            _end_supervisor(keeper, kill=True)
        shutil.rmtree(os.getcwd(), ignore_errors=True)


def _preload_modules(modules: list[str]) -> None:
    """Preload modules, so that the runs need not import them.

    An import error is ignored here, because the run will raise it again.
    """
    for name in modules:
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(name)


def _start_supervisor(
    link: socket.socket, request: dict[str, Any], descriptors: list[int], held: list[str]
) -> int:
    """Fork a supervisor that starts a process for a service.

    Returns:
        Process id of the supervisor.
    """
    service = request["service"]
    if service not in SERVICE_NAMES:
        raise ValueError(f"no service {service!r:.80}")
    reach = isolation_layers.AccessPolicy(
        request["folder"], tuple(request["readable"]), request["memory"]
    )
    keeper = os.fork()
    if keeper:
        for descriptor in descriptors:
            os.close(descriptor)
        return keeper
    link.close()
    try:
        _run_supervisor(service, descriptors, reach, held)
    finally:
        # Without the exit, the fork would continue as a second fork server.
        os._exit(1)
    raise AssertionError


def _run_supervisor(
    service: str, descriptors: list[int], reach: isolation_layers.AccessPolicy, held: list[str]
) -> NoReturn:
    """Act as supervisor: fork the process that runs the service, and exit in the same way."""
    set_parent_death_signal()
    held = [
        *held,
        *isolation_layers.mount_empty_folder(reach.folder),
        *isolation_layers.enter_process_namespace(),
    ]
    if child := os.fork():
        for descriptor in descriptors:
            os.close(descriptor)
        _, ended = os.waitpid(child, 0)
        _exit_like_child(ended)
    set_parent_death_signal()
    # A new session keeps signals to the process's group away from the fork server.
    os.setsid()
    code = 1
    try:
        _run_service(service, descriptors, reach, held)
        code = 0
    finally:
        os._exit(code)


def _run_service(
    service: str, descriptors: list[int], reach: isolation_layers.AccessPolicy, held: list[str]
) -> None:
    """Apply the last isolation layers, and run the service."""
    _discard_output()
    reading, writing = (os.dup2(one, 100 + i) for i, one in enumerate(descriptors))
    os.closerange(3, 100)
    os.closerange(102, 4096)
    os.environ.update({"HOME": reach.folder, "TMPDIR": reach.folder})
    module, _, function = service.partition(":")
    work = getattr(importlib.import_module(module), function)
    held = isolation_layers.sort_layers(
        [*held, *isolation_layers.lock_down(reach, "memory" in held)]
    )
    channel = MessageChannel(reading, writing)
    work(channel, reach, held)


def _exit_like_child(ended: int) -> NoReturn:
    """End this process in the same way as another one ended.

    If the other one was killed by a signal, this one kills itself with the same signal, because an
    exit code could also come from the tuner.
    """
    if os.WIFSIGNALED(ended):
        number = os.WTERMSIG(ended)
        # A second core dump of the same memory is not needed.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError, ValueError):
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(os.WEXITSTATUS(ended) if os.WIFEXITED(ended) else 1)


def _discard_output() -> None:
    """Discard output and close the input."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _end_supervisor(keeper: int, kill: bool) -> int | None:
    """End the process of a supervisor.

    Args:
        keeper: process id of the supervisor.
        kill: True to kill it at once.

    Returns:
        Its exit code, or minus the number of the signal that killed it; None if it had to be
        killed.
    """
    with suppress(ProcessLookupError):
        if kill:
            os.kill(keeper, signal.SIGKILL)
    with suppress(ChildProcessError):
        ended = _wait_for_supervisor(keeper)
        if ended is None or kill:
            return None
        return -os.WTERMSIG(ended) if os.WIFSIGNALED(ended) else os.WEXITSTATUS(ended)
    return None


def _wait_for_supervisor(keeper: int) -> int | None:
    """Wait for a supervisor's end, and kill it after `_SHUTDOWN_TIMEOUT_SECONDS`.

    Returns:
        Its wait status; None if it was killed here.
    """
    patience = perf_counter() + _SHUTDOWN_TIMEOUT_SECONDS
    while perf_counter() < patience:
        gone, ended = os.waitpid(keeper, os.WNOHANG)
        if gone:
            return ended
        sleep(0.0005)
    os.kill(keeper, signal.SIGKILL)
    os.waitpid(keeper, 0)
    return None
