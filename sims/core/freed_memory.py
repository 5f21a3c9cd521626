"""Return freed memory to the operating system."""

from __future__ import annotations

import contextlib
import ctypes


def release_free_memory() -> None:
    """Return freed memory to the operating system if the C library retains it.

    The allocator of glibc retains free memory below memory in use: after the meshes of a model are
    freed, this is hundreds of megabytes, which are missing on workers and laptops. Other C
    libraries have no such call and need none.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
