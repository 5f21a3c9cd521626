"""Limit the memory of a process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sims.core.simulator import InputError


@contextmanager
def limited_memory(mebibytes: int) -> Iterator[None]:
    """Limit the additional memory of this process within the block; 0 for no limit.

    Allocations beyond the limit fail with `MemoryError`. Linux counts private writable memory
    (RLIMIT_DATA), so mapped files and libraries are not counted.

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
