"""Step schedule of batch elements that are integrated together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.external_engine import ElementWork


class StepSchedule:
    """Step schedule of batch elements; the longest element is the first.

    Attributes:
        sizes: (L,) number of steps of each element.
        steps: (L, S) step sizes in seconds; shorter elements are padded with their last step.
        paced: (S + 1,) whether the step size of any element changes here; True at the first step.
        rows: (S + 1,) index of the record of the state after this number of steps; -1 for none.
        kept: number of recorded states.
    """

    def __init__(self, lanes: Sequence[ElementWork]) -> None:
        self.sizes = np.array([lane.steps.size for lane in lanes])
        self.steps = pad_rows([lane.steps for lane in lanes])
        size = self.steps.shape[1]
        self.paced = np.zeros(size + 1, dtype=bool)
        self.paced[0] = True
        self.paced[1:size] = (np.diff(self.steps, axis=1) != 0.0).any(axis=0)
        keeps = np.zeros(size + 1, dtype=bool)
        # Elements of one run share the array.
        for kept in {id(lane.recorded_steps): lane.recorded_steps for lane in lanes}.values():
            keeps[kept] = True
        self.rows = np.where(keeps, np.cumsum(keeps) - 1, -1)
        self.kept = int(keeps.sum())

    def list_phases(self) -> Iterator[tuple[int, int, int]]:
        """Yield first step, end step (exclusive) and number of active elements of each phase."""
        begin = 0
        for end in np.unique(self.sizes).tolist():
            yield begin, end, int((self.sizes >= end).sum())
            begin = end


def pad_rows(rows: Sequence[Array]) -> Array:
    """Stack rows of different sizes as (L, S); repeat the last value of shorter ones."""
    size = max(row.size for row in rows)
    return np.stack([np.concatenate([row, np.full(size - row.size, row[-1])]) for row in rows])
