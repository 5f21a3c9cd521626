"""Limit numerical libraries to one thread.

Processes share the cores, and sums are reproducible with one thread.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

THREAD_COUNT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that set the number of threads of numerical libraries."""


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit numerical libraries to one thread within the block, as in a worker."""
    from threadpoolctl import threadpool_limits

    # The variables are for libraries loaded within the block; threadpoolctl limits loaded ones.
    for name in THREAD_COUNT_VARIABLES:
        os.environ.setdefault(name, "1")
    with threadpool_limits(limits=1):
        yield
