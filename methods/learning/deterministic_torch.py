"""Reproducible training with torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


@contextmanager
def deterministic_training() -> Iterator[None]:
    """Make torch reproducible: one thread, so that sums have a fixed order.

    Other runs can use the machine's other cores.
    """
    import torch

    threads = torch.get_num_threads()
    # A sum that is distributed over threads depends on their number.
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
