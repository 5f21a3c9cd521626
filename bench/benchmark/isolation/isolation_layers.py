"""Isolation layers around a tuner's process.

Each layer is applied if the kernel permits it, and the active layers are reported. Landlock and the
filter of system calls need nothing but Linux; namespaces may be forbidden to users without
privileges.
"""

from __future__ import annotations

import os
import site
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from bench.benchmark.isolation import linux_syscalls, seccomp_filter
from bench.benchmark.isolation.resource_limits import (
    MAX_FOLDER_BYTES,
    limit_memory,
    set_resource_limits,
)

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
    """List the files and folders that a tuner process may read; see `list_readable_paths`.

    A folder of packages that contains a hidden one is left out, and of the project only the folders
    with code are listed. The result is cached, because every start of a tuner process needs it.

    Args:
        hidden: folders that must not be accessible.
        packages: present value of `sys.path`, on which the cached result depends.
    """
    hidden_paths = [Path(path).resolve() for path in hidden]
    interpreter = {sys.prefix, sys.base_prefix, sys.exec_prefix, sys.base_exec_prefix}
    candidates = [
        *sorted(interpreter),
        *site.getsitepackages(),
        site.getusersitepackages(),
        *packages,
    ]
    # If this project is installed as a wheel, its root is the folder of all packages, and readable.
    # The root of a source folder is not, because it also has results and tests.
    is_checkout = not (PROJECT_ROOT / "numpy").exists()
    readable_paths = []
    for text in candidates:
        # An empty entry of `sys.path` is the current folder.
        folder = Path(text or ".").resolve()
        contains_hidden = any(path.is_relative_to(folder) for path in hidden_paths)
        if not contains_hidden and not (is_checkout and folder == PROJECT_ROOT):
            readable_paths.append(str(folder))
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
        # File times and permissions could pass information to other runs. This comes before the
        # mount of the writable folder, which it would make read-only too.
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
    set_resource_limits(has_user_namespace)
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


def sort_layers(active_layers: Iterable[str]) -> list[str]:
    """Return the active isolation layers in the order of `ISOLATION_LAYERS`."""
    active = {"process", *active_layers}
    return [name for name in ISOLATION_LAYERS if name in active]
