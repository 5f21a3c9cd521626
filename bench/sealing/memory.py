"""A limit on the memory that a process may take."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sims.base import InputError


@contextmanager
def memory_limit(mebibytes: int) -> Iterator[None]:
    """Within the block this process may take so much memory more than it has; 0 is no limit.

    What is asked for beyond it fails (`MemoryError`). Linux counts private writable memory
    (RLIMIT_DATA), so that mapped files and libraries are free.

    Raises:
        InputError: this system has no such limit.
    """
    if not mebibytes:
        yield
        return
    resource = limits()
    before = resource.getrlimit(resource.RLIMIT_DATA)
    # Beyond what the process has: how large that is depends on the packages it has loaded.
    wanted = _data_bytes() + mebibytes * 2**20
    soft = wanted if before[1] == resource.RLIM_INFINITY else min(wanted, before[1])
    resource.setrlimit(resource.RLIMIT_DATA, (soft, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def limit_memory(mebibytes: int) -> None:
    """Let this process take so much memory more than it has, for good; 0 is no limit.

    Raises:
        InputError: this system has no such limit.
    """
    if mebibytes:
        resource = limits()
        wanted = _data_bytes() + mebibytes * 2**20
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, wanted))


def limits() -> Any:
    """The module `resource` of a system that limits memory.

    Raises:
        InputError: it does not.
    """
    if not sys.platform.startswith("linux"):
        raise InputError(f"memory: a limit needs Linux, this is {sys.platform}; leave it out")
    import resource

    return resource


def _data_bytes() -> int:
    """Private writable memory of this process, as RLIMIT_DATA counts it."""
    with open("/proc/self/status", encoding="ascii") as lines:
        for line in lines:
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0
