"""Limits of the memory, threads, open files and file sizes of a process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sims.core.simulator import InputError

MAX_FOLDER_BYTES = 64 << 20
"""Size of a tuner's own folder in bytes."""
_MAX_OPEN_FILES = 512
"""Maximum number of open files of a tuner."""
_MAX_THREADS = 1024
"""Maximum number of threads of a user's tuners; those of a superuser are not counted."""


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
    previous_soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    # The limit is relative to the present size, which depends on the packages loaded.
    limit = _read_data_bytes() + mebibytes * 2**20
    if hard_limit != resource.RLIM_INFINITY:
        limit = min(limit, hard_limit)
    # Only the soft limit is lowered, because a process cannot raise its hard limit again.
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard_limit))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (previous_soft_limit, hard_limit))


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


def set_resource_limits(has_user_namespace: bool) -> None:
    """Limit core dumps, open files and file sizes, and threads if they are counted separately.

    Threads are counted for each user of the machine. Without a user namespace, those of the user's
    other programs would count too, so the number is not limited then.

    Args:
        has_user_namespace: Whether the process has a user namespace of its own.
    """
    import resource

    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: _MAX_OPEN_FILES,
        resource.RLIMIT_FSIZE: MAX_FOLDER_BYTES,
        **({resource.RLIMIT_NPROC: _MAX_THREADS} if has_user_namespace else {}),
    }
    for limit, maximum in limits.items():
        _, hard_limit = resource.getrlimit(limit)
        value = maximum if hard_limit == resource.RLIM_INFINITY else min(maximum, hard_limit)
        resource.setrlimit(limit, (value, value))


THREAD_COUNT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that set the number of threads of numerical libraries."""


def set_default_thread_count() -> None:
    """Make numerical libraries that are loaded later use one thread, unless the user has set it."""
    for name in THREAD_COUNT_VARIABLES:
        os.environ.setdefault(name, "1")


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit numerical libraries to one thread within the block, as in a worker."""
    from threadpoolctl import threadpool_limits

    # The variables are for libraries loaded within the block; threadpoolctl limits loaded ones.
    set_default_thread_count()
    with threadpool_limits(limits=1):
        yield
