"""Isolation layers around a tuner's process, its limits of memory and processor, and its errors.

Each layer is applied if the kernel permits it, and the active layers are reported. Landlock and the
filter of system calls need nothing but Linux; namespaces may be forbidden to users without
privileges.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
import signal
import site
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from bench.benchmark.isolation import linux_syscalls, seccomp_filter
from sims.core.simulator import InputError

ISOLATION_NOTE = (
    "tuners run isolated: no files, no processes, no network; use --trust while developing"
)
"""Note that is added to an error that the isolation of the tuner may have caused."""


_REFUSED_ACCESS_PATTERN = re.compile(
    r"^[\w.]*(PermissionError|BlockingIOError|FileNotFoundError|Connection\w*Error|gaierror"
    r"|BrokenProcessPool|TerminatedWorkerError)\b"
    r"|Permission denied|Operation not permitted|Read-only file system|No such file or directory"
    r"|Resource temporarily unavailable|Function not implemented|No space left on device"
    r"|File too large|Too many open files|can't start new thread|Network is unreachable"
)
"""Pattern of exception lines after the kernel refused a file, a process or a socket."""


class RunEndedError(Exception):
    """A run has ended, because the tuner failed or took too long.

    Attributes:
        status: status as in status.csv.
        reason: reason as text; the tuner's traceback if it crashed.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason

    def __reduce__(self) -> tuple[type[RunEndedError], tuple[str, str]]:
        # Workers pickle errors; by default unpickling calls the class with the message alone.
        return RunEndedError, (self.status, self.reason)


def with_isolation(reason: str) -> str:
    """Return a reason with `ISOLATION_NOTE` at its end, if the isolation may be the cause.

    It may be if an exception in the traceback is about an access that the isolation refuses.

    Args:
        reason: traceback of an isolated tuner.
    """
    # Lines without indentation are those of exceptions; the others are frames and source code.
    if any(
        _REFUSED_ACCESS_PATTERN.search(line) for line in reason.splitlines() if line[:1].strip()
    ):
        return f"{reason.rstrip()}; {ISOLATION_NOTE}"
    return reason


def without_isolation(reason: str) -> str:
    """Return a reason without the text that `with_isolation` has added."""
    return reason.removesuffix(f"; {ISOLATION_NOTE}")


class KilledExternallyError(Exception):
    """A process was killed externally, which gives no information about its work."""


def describe_exit(process: str, code: int | None) -> str:
    """Describe how a process ended.

    Args:
        process: name of the process.
        code: its exit code, or minus the number of the signal that killed it; None if it closed its
            pipe and had to be killed.
    """
    if code is None:
        return f"{process} closed its pipe and was ended"
    if code >= 0:
        return f"{process} exited with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"{process} was killed by {name}"


@contextmanager
def limited_memory(mebibytes: int) -> Iterator[None]:
    """Limit the additional memory of this process within the block; 0 for no limit.

    Allocations beyond the limit fail with `MemoryError`. Linux counts private writable memory
    (RLIMIT_DATA), so mapped files and libraries are not counted.

    Args:
        mebibytes: Limit in MiB, in addition to the present size.

    Raises:
        InputError: this system has no such limit.
    """
    if not mebibytes:
        yield
        return
    resource = import_resource_module()
    previous_limits = resource.getrlimit(resource.RLIMIT_DATA)
    # The limit is relative to the present size, which depends on the packages loaded.
    limit = _read_data_bytes() + mebibytes * 2**20
    soft = limit if previous_limits[1] == resource.RLIM_INFINITY else min(limit, previous_limits[1])
    resource.setrlimit(resource.RLIMIT_DATA, (soft, previous_limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, previous_limits)


def limit_memory(mebibytes: int) -> None:
    """Limit the additional memory of this process permanently; 0 for no limit.

    Args:
        mebibytes: Limit in MiB, in addition to the present size.

    Raises:
        InputError: this system has no such limit.
    """
    if mebibytes:
        resource = import_resource_module()
        limit = _read_data_bytes() + mebibytes * 2**20
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def import_resource_module() -> Any:
    """Return the module `resource` if this system can limit memory.

    Raises:
        InputError: this system has no such limit.
    """
    if not sys.platform.startswith("linux"):
        raise InputError(f"memory: a limit needs Linux, this is {sys.platform}; leave it out")
    import resource

    return resource


def _read_data_bytes() -> int:
    """Return the private writable memory of this process in bytes, as RLIMIT_DATA counts it."""
    with open("/proc/self/status", encoding="ascii") as lines:
        for line in lines:
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0


_FAST_EXCHANGE_SECONDS = 5e-4
"""Duration of an exchange in seconds below which both sides should share a processor."""
_MEASURED_EXCHANGES = 16
"""Number of exchanges that are measured before a decision."""
_REMEASURE_SECONDS = 1.0
"""Seconds after which the decision is repeated, because other work may use the processor."""


class AffinityController:
    """Controller that pins both sides of a run to one processor while they alternate quickly.

    For fast exchanges, waking another processor costs more than the work. The kernel by default
    uses two processors, which costs 60 us per exchange; on one processor it is 8 us. For slow
    exchanges there is no gain, and the choice is left to the kernel.
    """

    def __init__(self) -> None:
        self._count, self._since = 0, perf_counter()
        self._home = None if not hasattr(os, "sched_getaffinity") else os.sched_getaffinity(0)
        self._pinned = False

    def record_exchange(self) -> int:
        """Count an exchange of messages, and return flags that tell the other side where to run.

        0 means no change, 255 any processor, and n + 1 processor n. After every
        `_MEASURED_EXCHANGES` exchanges, their mean duration decides: fast exchanges pin both sides
        to one processor, slow ones release them. A pin is also released after some time, to measure
        without it.
        """
        self._count += 1
        if self._count % _MEASURED_EXCHANGES:
            return 0
        now = perf_counter()
        mean = (now - self._since) / _MEASURED_EXCHANGES
        self._since = now
        if self._pinned and (mean > _FAST_EXCHANGE_SECONDS or now > self._until):
            self.release_affinity()
            return 255
        if not self._pinned and mean < _FAST_EXCHANGE_SECONDS:
            return self._pin_to_current_processor(now)
        return 0

    def _pin_to_current_processor(self, now: float) -> int:
        """Pin this side to the processor that it uses now, until `now` plus `_REMEASURE_SECONDS`.

        Returns processor number + 1, the flag for the other side; 0 (no change) if the processor is
        unknown or its number does not fit into the flag, which is one byte (255 means any
        processor).
        """
        processor = _read_current_processor()
        if self._home is None or not 0 <= processor < 254:
            return 0
        os.sched_setaffinity(0, {processor})
        self._pinned, self._until = True, now + _REMEASURE_SECONDS
        return processor + 1

    def release_affinity(self) -> None:
        """Allow this side to run on its original processors again."""
        if self._pinned and self._home is not None:
            os.sched_setaffinity(0, self._home)
            self._pinned = False


def _read_current_processor() -> int:
    """Return the number of the processor that runs this process; -1 if unknown."""
    try:
        return int(ctypes.CDLL(None).sched_getcpu())
    except (AttributeError, OSError):
        return -1


ISOLATION_LAYERS = {
    "process": "the tuner runs in its own process, which gets only its task and a pipe",
    "files": "it reads Python and its packages, and no results or recordings (Landlock)",
    "disk": "it writes only to a temporary folder in memory, deleted at its end (tmpfs)",
    "network": "it has no network access",
    "processes": "it sees no other process, and its child processes end with it (PID namespace)",
    "calls": "it cannot start or trace a process, nor mount a file system (seccomp)",
    "memory": "it cannot read the memory of the harness (user namespace, not dumpable)",
    "names": "it has no access to named shared memory, queues or semaphores (IPC namespace)",
}
"""Isolation layers with what each one does, in the order of listings."""

MAX_FOLDER_BYTES = 64 << 20
"""Size of a tuner's own folder in bytes."""
_MAX_OPEN_FILES = 512
"""Maximum number of open files of a tuner."""
_MAX_THREADS = 1024
"""Maximum number of threads of a user's tuners; those of a superuser are not counted."""

PROJECT_ROOT = Path(__file__).resolve().parents[3]
"""Root folder of this project's packages."""
_IMPORTABLE_PATHS = ("bench", "methods", "sims", "simgap.py")
"""Parts of this project that a tuner may import; results and tests in the same folder are not."""
_SYSTEM_PATHS = (
    "/usr", "/lib", "/lib64", "/lib32", "/etc/ld.so.cache", "/etc/localtime", "/dev/urandom",
    "/dev/random", "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat",
    "/sys/devices/system/cpu", "/sys/devices/system/node",
)  # fmt: skip
"""Paths of the system that Python and numerical libraries read."""
_DEVICE_PATHS = ("/dev/null", "/dev/zero", "/dev/nvidia0", "/dev/nvidiactl", "/dev/nvidia-uvm")
"""Devices that they write to: null devices and a graphics card."""


class AccessPolicy(NamedTuple):
    """Access policy of a tuner's process.

    Attributes:
        folder: its own empty folder.
        readable_paths: readable files and folders.
        memory: limit of additional memory in MiB; 0 for no limit.
    """

    folder: str
    readable_paths: tuple[str, ...]
    memory: int = 0


def list_readable_paths(hidden: tuple[str, ...]) -> tuple[str, ...]:
    """Return the files and folders that Python, its packages and this project's code need.

    Args:
        hidden: folders that must not be accessible, such as the one of the results; a folder of
            packages that contains one of them is left out.
    """
    # A notebook may have added a folder to the path since the last call.
    return _list_readable_paths(hidden, tuple(sys.path))


@cache
def _list_readable_paths(hidden: tuple[str, ...], packages: tuple[str, ...]) -> tuple[str, ...]:
    """List the readable paths for given hidden folders and a given `sys.path` (`packages`).

    A folder of packages that contains a hidden one is left out, and of the project only the folders
    with code are listed. The result is cached, because every start of a tuner process needs it.
    """
    hidden_paths = [Path(path).resolve() for path in hidden]
    interpreter = {sys.prefix, sys.base_prefix, sys.exec_prefix, sys.base_exec_prefix}
    candidates = [
        *sorted(interpreter),
        *site.getsitepackages(),
        site.getusersitepackages(),
        *packages,
    ]
    readable_paths = []
    for text in candidates:
        place = Path(text or ".").resolve()
        is_project_root = place == PROJECT_ROOT and not (PROJECT_ROOT / "numpy").exists()
        if not is_project_root and not any(path.is_relative_to(place) for path in hidden_paths):
            readable_paths.append(str(place))
    libraries = [str(Path(prefix) / "lib") for prefix in sorted(interpreter)]
    project_packages = [str(PROJECT_ROOT / name) for name in _IMPORTABLE_PATHS]
    return tuple(dict.fromkeys([*readable_paths, *libraries, *project_packages, *_SYSTEM_PATHS]))


def enter_namespaces() -> list[str]:
    """Enter new user, network and IPC namespaces; children inherit them.

    In a namespace, a process has no access to the network, the shared memory and the privileges
    outside. What the kernel does not permit is left out.

    Returns:
        Names of the active isolation layers.
    """
    user, group = os.geteuid(), os.getegid()
    active: list[str] = []
    with _try_restriction(active, "memory"):
        linux_syscalls.unshare(linux_syscalls.CLONE_NEWUSER)
        linux_syscalls.map_identity(user, group)
    # A superuser can enter these namespaces without a user namespace.
    with _try_restriction(active, "network"):
        linux_syscalls.unshare(linux_syscalls.CLONE_NEWNET)
    with _try_restriction(active, "names"):
        linux_syscalls.unshare(linux_syscalls.CLONE_NEWIPC)
    return active


def mount_empty_folder(folder: str) -> list[str]:
    """Mount an empty folder in memory for this process and its children.

    Returns:
        Names of the active isolation layers.
    """
    active: list[str] = []
    with _try_restriction(active, "disk"):
        linux_syscalls.unshare(linux_syscalls.CLONE_NEWNS)
        linux_syscalls.make_mounts_private()
        # This comes before the mount of its own writable folder. File times and permissions could
        # pass information to other runs.
        with _try_restriction(active):
            linux_syscalls.make_mounts_read_only()
        linux_syscalls.mount_filesystem(
            "tmpfs", folder, f"size={MAX_FOLDER_BYTES},nr_inodes=4096,mode=700"
        )
    return active


def enter_process_namespace() -> list[str]:
    """Enter a new process namespace, in which the next child is the first process.

    Returns:
        Names of the active isolation layers.
    """
    active: list[str] = []
    with _try_restriction(active, "processes"):
        linux_syscalls.unshare(linux_syscalls.CLONE_NEWPID)
    return active


def lock_down(policy: AccessPolicy, has_user_namespace: bool) -> list[str]:
    """Apply the remaining restrictions to this process permanently, before it runs a tuner's code.

    They concern the file system, memory, open files and system calls.

    Args:
        policy: what the process may still access.
        has_user_namespace: True if the process has a user namespace.

    Returns:
        Names of the isolation layers that the kernel has permitted.
    """
    active: list[str] = []
    # If its own /proc cannot be mounted, Landlock allows only this process's part of the old one.
    with _try_restriction(active):
        linux_syscalls.mount_filesystem("proc", "/proc")
    os.chdir(policy.folder)
    _set_resource_limits(has_user_namespace)
    # This comes before Landlock, which may deny this process access to its own /proc entries.
    limit_memory(policy.memory)
    # If memory is exhausted, the kernel kills the tuner first, and no other process.
    with _try_restriction(active):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    with _try_restriction(active, "files"):
        writable = [policy.folder, *_DEVICE_PATHS]
        linux_syscalls.restrict_file_access(policy.readable_paths, writable)
    with _try_restriction(active, "calls", "network"):
        seccomp_filter.install_syscall_filter(has_memory_limit=policy.memory > 0)
    return active


@contextmanager
def _try_restriction(active: list[str], *names: str) -> Iterator[None]:
    """Apply a restriction in the block; if the kernel permits it, add the names to `active`."""
    with suppress(OSError, KeyError, AttributeError):
        yield
        active.extend(names)


def _set_resource_limits(has_user_namespace: bool) -> None:
    """Limit core dumps, open files and file sizes, and threads if they are counted separately.

    Threads are counted for each user of the machine. Without a user namespace, those of the user's
    other programs would count too, so the number is not limited then.

    Args:
        has_user_namespace: Whether the process has a user namespace of its own.
    """
    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: _MAX_OPEN_FILES,
        resource.RLIMIT_FSIZE: MAX_FOLDER_BYTES,
        **({resource.RLIMIT_NPROC: _MAX_THREADS} if has_user_namespace else {}),
    }
    for limit, maximum in limits.items():
        hard_limit = resource.getrlimit(limit)[1]
        value = maximum if hard_limit == resource.RLIM_INFINITY else min(maximum, hard_limit)
        resource.setrlimit(limit, (value, value))


def sort_layers(active_layers: Iterable[str]) -> list[str]:
    """Return the active isolation layers in the order of `ISOLATION_LAYERS`."""
    active = {"process", *active_layers}
    return [name for name in ISOLATION_LAYERS if name in active]
