"""When lanes that are integrated together step, and which of their states are kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sims.base import Array
from sims.engines.external import Lane


class Table:
    """The steps of lanes, the longest lane first.

    Attributes:
        steps: (L, S) seconds; behind the end of a shorter lane stands its last step.
        paced: (S + 1,) whether any lane's step is another than the one before; True at the first.
        rows: (S + 1,) under which number the state after so many steps is kept; -1 where none is.
        kept: how many states are kept.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.sizes = np.array([lane.steps.size for lane in lanes])
        self.steps = filled([lane.steps for lane in lanes])
        size = self.steps.shape[1]
        self.paced = np.zeros(size + 1, dtype=bool)
        self.paced[0] = True
        self.paced[1:size] = (np.diff(self.steps, axis=1) != 0.0).any(axis=0)
        keeps = np.zeros(size + 1, dtype=bool)
        # Lanes of one run share the array.
        for kept in {id(lane.kept): lane.kept for lane in lanes}.values():
            keeps[kept] = True
        self.rows = np.where(keeps, np.cumsum(keeps) - 1, -1)
        self.kept = int(keeps.sum())

    def phases(self) -> Iterator[tuple[int, int, int]]:
        """First step and the one after the last, and how many lanes are under way in between."""
        begin = 0
        for end in np.unique(self.sizes).tolist():
            yield begin, end, int((self.sizes >= end).sum())
            begin = end


def filled(rows: Sequence[Array]) -> Array:
    """Rows of several sizes as (L, S), the last value of a shorter one over and over."""
    size = max(row.size for row in rows)
    return np.stack([np.concatenate([row, np.full(size - row.size, row[-1])]) for row in rows])
