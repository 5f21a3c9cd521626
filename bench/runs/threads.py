"""Arithmetic in one thread: processes share the cores, and sums come out the same."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What tells numerical libraries how many threads they may have."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Within the block arithmetic has one thread, as in a worker."""
    from threadpoolctl import threadpool_limits

    # For libraries that are loaded within the block; threadpoolctl knows those that are there.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    with threadpool_limits(limits=1):
        yield
