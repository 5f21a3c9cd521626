"""Memory that has been freed, back to the operating system."""

from __future__ import annotations

import contextlib
import ctypes


def release_free_memory() -> None:
    """Give memory that is free back to the operating system, where the C library keeps it.

    The allocator of glibc keeps what lies below memory in use: after the meshes of a model are
    freed these are hundreds of megabytes, which workers and laptops lack. Other C libraries have
    no such call and need none.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
