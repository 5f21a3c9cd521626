"""Where tuners' processes come from: a fresh interpreter that knows nothing, and makes copies of
itself in a few milliseconds.

It has loaded numpy, the contract of tuners and such packages as tuners need, and never a line of a
plugin: what a plugin did here, the next run would inherit. For each request it starts a keeper,
which puts the seals on that need a parent, and the keeper starts the one that runs the tuner's
code. Kill the keeper, and all of it is gone.
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

from bench.sealing import seals
from bench.sealing.kernel import die_with_parent
from bench.sealing.wire import Channel

_LENGTH = struct.Struct("<I")
_PATIENCE = 1.0
"""Seconds in which who has closed its pipe must be gone."""
SERVICES = (
    "bench.sealing.inside:serve",
    "bench.runs.survey:describe",
    "bench.diagnosis.inside:serve",
)
"""What a child may be for: a function that gets its channel."""


def send(link: socket.socket, document: Any, descriptors: tuple[int, ...] = ()) -> None:
    """Write a request or an answer, and hand over open files with it."""
    body = json.dumps(document).encode()
    socket.send_fds(link, [_LENGTH.pack(len(body))], descriptors)
    link.sendall(body)


def receive(link: socket.socket) -> tuple[Any, list[int]]:
    """Read one, and the files with it.

    Raises:
        EOFError: the other side is gone.
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


def main(descriptor: int) -> None:
    """Serve requests until the other side is gone.

    Args:
        descriptor: the socket on which they come.
    """
    link = socket.socket(fileno=descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    held = seals.leave_the_world()
    children: set[int] = set()
    try:
        while True:
            request, descriptors = receive(link)
            match request["do"]:
                case "load":
                    _load(request["modules"])
                    send(link, {})
                case "start":
                    keeper = _start(link, request, descriptors, held)
                    children.add(keeper)
                    send(link, {"keeper": keeper})
                case "end":
                    children.discard(request["keeper"])
                    send(link, {"exit": _end(request["keeper"], request["kill"])})
    except (EOFError, OSError):
        # Whoever asked is gone, however it ended: so is all that was done for it.
        for keeper in children:
            _end(keeper, kill=True)
        shutil.rmtree(os.getcwd(), ignore_errors=True)


def _load(modules: list[str]) -> None:
    """Load packages ahead, so that no run need do it; one that cannot be loaded is the run's to
    say.
    """
    for name in modules:
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(name)


def _start(
    link: socket.socket, request: dict[str, Any], descriptors: list[int], held: list[str]
) -> int:
    """Start a keeper and, in it, the process that serves the channel; the keeper's number."""
    service = request["service"]
    if service not in SERVICES:
        raise ValueError(f"no service {service!r:.80}")
    reach = seals.Reach(request["folder"], tuple(request["readable"]), request["memory"])
    keeper = os.fork()
    if keeper:
        for descriptor in descriptors:
            os.close(descriptor)
        return keeper
    link.close()
    try:
        _keep(service, descriptors, reach, held)
    finally:
        # A copy that went on would take itself for the nursery, and clear up after it.
        os._exit(1)
    raise AssertionError


def _keep(service: str, descriptors: list[int], reach: seals.Reach, held: list[str]) -> NoReturn:
    """Be a keeper: start the process that serves the channel, and end as it does."""
    die_with_parent()
    held = [*held, *seals.empty_folder(reach.folder), *seals.own_processes()]
    if child := os.fork():
        for descriptor in descriptors:
            os.close(descriptor)
        _, ended = os.waitpid(child, 0)
        _end_as(ended)
    die_with_parent()
    # Not of the nursery's group: what is done to a group would reach it.
    os.setsid()
    code = 1
    try:
        _serve(service, descriptors, reach, held)
        code = 0
    finally:
        os._exit(code)


def _serve(service: str, descriptors: list[int], reach: seals.Reach, held: list[str]) -> None:
    """Put the last seals on, and be of service."""
    _silence()
    reading, writing = (os.dup2(one, 100 + i) for i, one in enumerate(descriptors))
    os.closerange(3, 100)
    os.closerange(102, 4096)
    os.environ.update({"HOME": reach.folder, "TMPDIR": reach.folder})
    module, _, function = service.partition(":")
    work = getattr(importlib.import_module(module), function)
    held = seals.listed([*held, *seals.shut(reach, "memory" in held)])
    channel = Channel(reading, writing)
    work(channel, reach, held)


def _end_as(ended: int) -> NoReturn:
    """End this process as another has ended: a number would not tell a signal from an exit by the
    tuner's own will.
    """
    if os.WIFSIGNALED(ended):
        number = os.WTERMSIG(ended)
        # A second dump of the same memory helps nobody.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError, ValueError):
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(os.WEXITSTATUS(ended) if os.WIFEXITED(ended) else 1)


def _silence() -> None:
    """Send what is printed to nowhere, and read nothing."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _end(keeper: int, kill: bool) -> int | None:
    """How a keeper's process ended: its code, or minus the number of the signal that killed it;
    None where it had to be ended.
    """
    with suppress(ProcessLookupError):
        if kill:
            os.kill(keeper, signal.SIGKILL)
    with suppress(ChildProcessError):
        ended = _waited(keeper)
        if ended is None or kill:
            return None
        return -os.WTERMSIG(ended) if os.WIFSIGNALED(ended) else os.WEXITSTATUS(ended)
    return None


def _waited(keeper: int) -> int | None:
    """The end of a keeper; None where it took its time and was killed."""
    patience = perf_counter() + _PATIENCE
    while perf_counter() < patience:
        gone, ended = os.waitpid(keeper, os.WNOHANG)
        if gone:
            return ended
        sleep(0.0005)
    os.kill(keeper, signal.SIGKILL)
    os.waitpid(keeper, 0)
    return None
