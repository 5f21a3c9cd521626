"""Fork server from which tuner processes start in a few milliseconds.

It is a new interpreter without any information about the study. It has loaded numpy, the tuner
interface and packages that tuners need, but never a plugin, because the next run would inherit the
effects of its code. For each request it forks a supervisor, which sets up the isolation layers that
need a parent process. The supervisor forks the process that runs the tuner's code, waits for it,
and reports its exit code. It kills that process when the client closes the control socket, and the
kernel kills both when the fork server ends.
"""

from __future__ import annotations

import importlib
import json
import os
import select
import shutil
import signal
import socket
import struct
import warnings
from contextlib import suppress
from typing import Any

from bench.benchmark.isolation import isolation_layers
from bench.benchmark.isolation.linux_syscalls import set_parent_death_signal
from bench.benchmark.isolation.message_channel import MessageChannel

EXIT_CODE = struct.Struct("<i")
"""Report of a supervisor: exit code, or minus the number of the signal that killed the process."""
_LENGTH_FORMAT = struct.Struct("<I")
_POLL_MILLISECONDS = 20
"""Interval in which a supervisor looks after its process, if the system has no pidfd."""


def send_request(link: socket.socket, request: Any, descriptors: tuple[int, ...]) -> None:
    """Send a request with open files to a fork server, and wait until it is done.

    Args:
        link: socket to the fork server.
        request: JSON content.
        descriptors: file descriptors to pass.

    Raises:
        OSError: the fork server is gone.
    """
    body = json.dumps(request).encode()
    socket.send_fds(link, [_LENGTH_FORMAT.pack(len(body))], descriptors)
    link.sendall(body)
    # The server confirms with one byte; nothing is received if it has ended.
    if not link.recv(1):
        raise BrokenPipeError


def _receive_request(link: socket.socket) -> tuple[dict[str, Any], list[int]] | None:
    """Return a request with its open files; None if the client has closed its socket.

    A request is its length, to which up to three file descriptors are attached, and then JSON.
    """
    head, descriptors, _, _ = socket.recv_fds(link, _LENGTH_FORMAT.size, 3)
    if len(head) < _LENGTH_FORMAT.size:
        return None
    (size,) = _LENGTH_FORMAT.unpack(head)
    body = link.recv(size, socket.MSG_WAITALL)
    return json.loads(body), list(descriptors)


def serve_fork_requests(descriptor: int) -> None:
    """Serve requests until the client closes the socket or has ended.

    Each request names modules to import, and may ask for a new process, which this process forks.
    The fork becomes a supervisor; this process continues with the next request.

    Args:
        descriptor: file descriptor of the socket to the client.
    """
    link = socket.socket(fileno=descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Supervisors that have ended need no parent that waits for them.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    layers = isolation_layers.enter_namespaces()
    with suppress(OSError):
        while (received := _receive_request(link)) is not None:
            request, descriptors = received
            _preload_modules(request["modules"])
            # Only a request for a process has descriptors; `fork` returns 0 in the new process.
            if descriptors and not os.fork():
                link.close()
                try:
                    _supervise_service(request, descriptors, layers)
                finally:
                    # Without the exit, the fork would continue as a second fork server.
                    os._exit(1)
            # The fork has its own copies of the descriptors.
            for descriptor_copy in descriptors:
                os.close(descriptor_copy)
            link.sendall(b"K")
    # The server works in a scratch folder of its own.
    shutil.rmtree(os.getcwd(), ignore_errors=True)


def _preload_modules(modules: list[str]) -> None:
    """Preload modules, so that the runs need not import them.

    An import error is ignored here, because the run will raise it again.
    """
    for name in modules:
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(name)


def _supervise_service(request: dict[str, Any], descriptors: list[int], layers: list[str]) -> None:
    """Act as supervisor: fork the process that runs the service, and report how it ended.

    The supervisor enters a new process namespace, which begins with its next child, and mounts the
    empty folder of the process. It never runs the tuner's code. It reports the exit code on the
    control socket, and kills the process if that socket is closed.

    Args:
        request: request of the harness: function of the service, its folder, readable paths and
            memory limit.
        descriptors: control socket and the two pipes.
        layers: names of the isolation layers that are active already.
    """
    set_parent_death_signal()
    # The fork server ignores this signal, and a fork inherits this. The kernel would then discard
    # the exit code of a child before it could be read.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    control, *pipes = descriptors
    layers = [
        *layers,
        *isolation_layers.mount_empty_folder(request["folder"]),
        *isolation_layers.enter_process_namespace(),
    ]
    child = os.fork()
    if not child:
        set_parent_death_signal()
        # A new session keeps signals to the process's group away from the fork server.
        os.setsid()
        try:
            _run_service(request, pipes, layers)
        except BaseException:
            os._exit(1)
        os._exit(0)
    for pipe in pipes:
        os.close(pipe)
    code = _wait_for_child(child, control)
    socket.socket(fileno=control).sendall(EXIT_CODE.pack(code))


def _wait_for_child(child: int, control: int) -> int:
    """Wait for the end of a process, and kill it when the client closes the control socket.

    Its end is signalled by a pidfd, a descriptor that becomes readable then. On a system without
    it, the process is checked every `_POLL_MILLISECONDS`.

    Args:
        child: id of the process.
        control: descriptor of the control socket.

    Returns:
        Its exit code, or minus the number of the signal that killed it.
    """
    events = select.poll()
    events.register(control, select.POLLIN)
    poll_interval = None
    try:
        events.register(os.pidfd_open(child), select.POLLIN)
    except (AttributeError, OSError):
        poll_interval = _POLL_MILLISECONDS
    while True:
        # The client never sends anything, so this event means that it has closed the socket.
        if control in dict(events.poll(poll_interval)):
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            return os.waitstatus_to_exitcode(status)
        ended_child, status = os.waitpid(child, os.WNOHANG)
        if ended_child:
            return os.waitstatus_to_exitcode(status)


def _run_service(request: dict[str, Any], pipes: list[int], layers: list[str]) -> None:
    """Apply the last isolation layers, and run the service, such as that of a tuner.

    The two pipes become the descriptors 100 and 101. All others but the standard streams are
    closed, so that code of a tuner cannot reach anything of the harness through an open file.

    Args:
        request: What to run (`service`, as "module:function"), and the folder, readable paths and
            memory of the process.
        pipes: Two descriptors, to read from and to write to.
        layers: Names of the isolation layers that the kernel permits.
    """
    _discard_output()
    reading, writing = (os.dup2(pipe, 100 + i) for i, pipe in enumerate(pipes))
    # All open files but the standard streams (0 to 2) and the two pipes.
    os.closerange(3, 100)
    os.closerange(102, 4096)
    policy = isolation_layers.AccessPolicy(
        request["folder"], tuple(request["readable"]), request["memory"]
    )
    os.environ.update({"HOME": policy.folder, "TMPDIR": policy.folder})
    module, _, function = request["service"].partition(":")
    serve = getattr(importlib.import_module(module), function)
    # The layer "memory" consists of a user namespace.
    layers = [*layers, *isolation_layers.lock_down(policy, "memory" in layers)]
    serve(MessageChannel(reading, writing), policy, isolation_layers.sort_layers(layers))


def _discard_output() -> None:
    """Discard output and close the input, which code of a tuner could use to reach the terminal."""
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null_device, descriptor)
    os.close(null_device)
