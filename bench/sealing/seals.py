"""The seals around a tuner's process: which there are, what each keeps it from, and how they are
put on.

Every seal is put on where the kernel lets it, and which hold is known afterwards: Landlock and the
filter of system calls need nothing but Linux, namespaces may be forbidden to users without rights.
"""

from __future__ import annotations

import os
import resource
import site
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from bench.sealing import calls, kernel
from bench.sealing.memory import limit_memory

SEALS = {
    "process": "the tuner has a process of its own, with a task and a pipe and nothing else",
    "files": "it reads Python and its packages, and no results or recordings (Landlock)",
    "disk": "it writes to an empty folder in memory that is gone with it (tmpfs)",
    "network": "it reaches no network",
    "processes": "it sees no other process, and what it starts dies with it (process namespace)",
    "calls": "it starts no process, looks into none, and mounts nothing (seccomp)",
    "memory": "nobody reads the harness's memory (user namespace, not dumpable)",
    "names": "it shares no memory, queue or semaphore by name (IPC namespace)",
}
"""What each seal keeps a tuner from, in the order in which they are listed."""

FOLDER_BYTES = 64 << 20
"""What a tuner's own folder can hold."""
_FILES = 512
"""Files that it may hold open."""
_THREADS = 1024
"""Threads that a user's tuners may have; a superuser's are not counted."""

ROOT = Path(__file__).resolve().parents[2]
"""Where this project's packages lie."""
_ROOMS = ("bench", "methods", "sims", "simgap.py")
"""What a tuner may import of this project; its results and tests lie beside them."""
_SYSTEM = (
    "/usr", "/lib", "/lib64", "/lib32", "/etc/ld.so.cache", "/etc/localtime", "/dev/urandom",
    "/dev/random", "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat",
    "/sys/devices/system/cpu", "/sys/devices/system/node",
)  # fmt: skip
"""What Python and numerical libraries read of a machine."""
_DEVICES = ("/dev/null", "/dev/zero", "/dev/nvidia0", "/dev/nvidiactl", "/dev/nvidia-uvm")
"""What they write to: nothing, and a graphics card."""


class Reach(NamedTuple):
    """What a tuner's process may reach.

    Attributes:
        folder: its own, empty.
        readable: files and folders.
        memory: MiB that it may take beside what it begins with; 0 for no limit.
    """

    folder: str
    readable: tuple[str, ...]
    memory: int = 0


def readable(hidden: tuple[str, ...]) -> tuple[str, ...]:
    """Files and folders that Python, its packages and this project's code need.

    Args:
        hidden: folders that must not be reached, such as the one of the results; a folder of
            packages that one of them lies in is left out.
    """
    # A notebook may have added a folder since.
    return _readable(hidden, tuple(sys.path))


@cache
def _readable(hidden: tuple[str, ...], packages: tuple[str, ...]) -> tuple[str, ...]:
    kept = [Path(path).resolve() for path in hidden]
    interpreter = {sys.prefix, sys.base_prefix, sys.exec_prefix, sys.base_exec_prefix}
    places = [*sorted(interpreter), *site.getsitepackages(), site.getusersitepackages(), *packages]
    found = []
    for text in places:
        place = Path(text or ".").resolve()
        own = place == ROOT and not (ROOT / "numpy").exists()
        if not own and not any(path.is_relative_to(place) for path in kept):
            found.append(str(place))
    libraries = [str(Path(prefix) / "lib") for prefix in sorted(interpreter)]
    rooms = [str(ROOT / room) for room in _ROOMS]
    return tuple(dict.fromkeys([*found, *libraries, *rooms, *_SYSTEM]))


def leave_the_world() -> list[str]:
    """Leave the user's rights, the network and shared memory; what this process starts has none of
    them either. Says which seals hold.
    """
    user, group = os.geteuid(), os.getegid()
    held = []
    if _put_on(lambda: _leave(kernel.NEW_USER)) and _put_on(
        lambda: kernel.keep_identity(user, group)
    ):
        held.append("memory")
    # A superuser can leave these without the first.
    if _put_on(lambda: _leave(kernel.NEW_NETWORK)):
        held.append("network")
    if _put_on(lambda: _leave(kernel.NEW_IPC)):
        held.append("names")
    return held


def empty_folder(folder: str) -> list[str]:
    """Give this process and what it starts an empty folder in memory; says whether that holds."""

    def put() -> None:
        _leave(kernel.NEW_MOUNTS)
        kernel.private_mounts()
        # Before its own folder, which it may write to; times and rights of files would tell others.
        _put_on(kernel.read_only_mounts)
        kernel.mount("tmpfs", folder, f"size={FOLDER_BYTES},nr_inodes=4096,mode=700")

    return ["disk"] if _put_on(put) else []


def own_processes() -> list[str]:
    """Let the next process that this one starts be the first of its world; says whether it will."""
    return ["processes"] if _put_on(lambda: _leave(kernel.NEW_PROCESSES)) else []


def shut(reach: Reach, own_user: bool) -> list[str]:
    """Take from this process, for good, what is left; says which seals hold.

    Args:
        reach: what it may reach.
        own_user: whether it has a user namespace.
    """
    held = []
    # One's own; where it cannot be had, the files seal leaves of the other one's no more than this.
    _put_on(lambda: kernel.mount("proc", "/proc"))
    os.chdir(reach.folder)
    _limit(own_user)
    # Before the files seal: without a /proc of its own it may be refused to look into itself.
    limit_memory(reach.memory)
    # Short of memory the kernel ends the tuner first, and no rival.
    _put_on(lambda: _write("/proc/self/oom_score_adj", "1000"))
    if _put_on(lambda: kernel.landlock(reach.readable, [reach.folder, *_DEVICES])):
        held.append("files")
    _put_on(calls.drop_capabilities)
    if _put_on(lambda: calls.refuse_processes(limited=reach.memory > 0)):
        held += ["calls", "network"]
    return held


def _leave(flags: int) -> None:
    kernel.unshare(flags)


def _write(path: str, text: str) -> None:
    Path(path).write_text(text, encoding="ascii")


def _put_on(seal: Callable[[], None]) -> bool:
    """Whether a seal could be put on."""
    try:
        seal()
    except (OSError, KeyError, AttributeError):
        return False
    return True


def _limit(own_user: bool) -> None:
    """No dumps, few files, and few threads where a user's are counted apart."""
    wanted = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: _FILES,
        resource.RLIMIT_FSIZE: FOLDER_BYTES,
        **({resource.RLIMIT_NPROC: _THREADS} if own_user else {}),
    }
    for limit, most in wanted.items():
        hard = resource.getrlimit(limit)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(limit, (least, least))


def listed(held: Iterable[str]) -> list[str]:
    """The seals that hold, in the order of `SEALS`."""
    there = {"process", *held}
    return [name for name in SEALS if name in there]
