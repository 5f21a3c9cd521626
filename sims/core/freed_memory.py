"""Keep freed memory for the next arrays, or return it to the operating system."""

from __future__ import annotations

import contextlib
import ctypes

# Parameters of glibc's mallopt (malloc.h) and their values in bytes.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_KEPT_BYTES = 64 << 20
_GROWTH_BYTES = 16 << 20
_LARGEST_BLOCK_BYTES = 32 << 20


def keep_freed_memory() -> None:
    """Have the C library keep up to 64 MB of freed memory for the next arrays.

    glibc raises its limits to these values by itself, but only as larger blocks are freed. Until
    then each array of a search costs a page fault per 4 kB. Other C libraries need no such call.
    """
    limits = {
        _TRIM_THRESHOLD: _KEPT_BYTES,
        _TOP_PAD: _GROWTH_BYTES,
        _MMAP_THRESHOLD: _LARGEST_BLOCK_BYTES,
    }
    with contextlib.suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        for parameter, value in limits.items():
            library.mallopt(parameter, value)


def release_free_memory() -> None:
    """Return freed memory to the operating system if the C library retains it.

    The allocator of glibc retains free memory below memory in use: after the meshes of a model are
    freed, this is hundreds of megabytes, which are missing on workers and laptops. Other C
    libraries have no such call and need none.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
