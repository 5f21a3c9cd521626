"""Which step each lane is in, what it feels there, and which of its states are kept."""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.engines.ground import Indices, Mask
from sims.system import Lanes, Motion


class Clock:
    """A clock for every lane.

    While all lanes are in the same step they are served by whole rows; from the first time that
    they differ, one by one.

    Attributes:
        t: (L, 1) seconds since the start of the run.
        left: (L, 1) seconds to the end of the lane's step.
        over: whether every lane has made all its steps.
    """

    def __init__(self, lanes: Lanes) -> None:
        count, self._end = lanes.steps.shape
        # Lanes that share their steps share the row: a stride of zero says that it is one row.
        steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
        none = np.zeros((1, len(steps)))
        ends = np.cumsum(steps, axis=1)
        # One row a step, and one of zeros behind the last, in which finished lanes wait. Rows must
        # lie together: they are looked up by place.
        self._steps = np.ascontiguousarray(np.concatenate([steps.T, none]))
        self._starts = np.ascontiguousarray(np.concatenate([none, ends.T]))
        self._inputs = {}
        for name, values in lanes.inputs.items():
            self._inputs[name] = np.ascontiguousarray(values.T)
        self._every = lanes.every
        records = self._end // lanes.every + 1
        width = 3 * lanes.x.shape[1]
        self._kept = np.empty((records, count, width))
        self._lane = np.arange(count)
        self._stride = self._steps.shape[1]
        self._column = self._lane if self._stride > 1 else np.zeros_like(self._lane)
        self._common: int | None = 0
        self._step = np.zeros(count, dtype=np.intp)
        self._begins = np.ones(count, dtype=bool)
        self.over = self._end == 0
        self.t = np.zeros((count, 1))
        self.left = np.empty((count, 1))
        self.left[:, 0] = self._steps[0]

    def inputs(self) -> dict[str, Array]:
        """(L, 1) by name; behind the last step, the last."""
        if self._common is not None:
            row = min(self._common, self._end - 1)
            return {name: values[row][:, None] for name, values in self._inputs.items()}
        rows = np.minimum(self._step, self._end - 1)
        return {name: values[rows, self._lane][:, None] for name, values in self._inputs.items()}

    def keep(self, state: Array) -> None:
        """Keep the state (3 D, L) of lanes that begin a step behind a sample."""
        if self._common is not None:
            if self._common % self._every == 0:
                # Whole rows, without looking for lanes: most calls never leave this branch.
                self._kept[self._common // self._every] = state.T
            return
        due = self._step % self._every == 0
        lanes = np.flatnonzero(self._begins & due)
        if lanes.size:
            records = self._step[lanes] // self._every
            self._kept[records, lanes] = state[:, lanes].T

    def finish(self, ended: Mask | None = None) -> None:
        """Lanes `ended` (L,), or all, go on to their next step."""
        if ended is not None and not ended.all():
            self._part()
        if self._common is not None:
            self._common += 1
            self.over = self._common == self._end
            self.left[:, 0] = self._steps[self._common]
            self.t[:, 0] = self._starts[self._common]
            return
        assert ended is not None
        # A lane that has made all its steps goes on to no other: it would run off the table.
        ended = ended & (self._step < self._end)
        self._begins = ended
        if ended.any():
            self._step += ended.astype(np.intp)
            place = self._step * self._stride + self._column
            lengths = self._steps.take(place)
            starts = self._starts.take(place)
            np.copyto(self.left[:, 0], lengths, where=ended)
            np.copyto(self.t[:, 0], starts, where=ended)
            self.over = bool(self._step.min() == self._end)

    def spend(self, h: Array) -> None:
        """Let h (L, 1) seconds pass, at most what is left."""
        self.t += h
        # Steps add up to a little more than what was left; a rest below zero would run backwards.
        self.left = np.maximum(self.left - h, 0.0)

    def _part(self) -> None:
        """From now on lanes are served one by one."""
        if self._common is not None:
            self._step[:] = self._common
            self._common = None

    def give_up(self, lanes: Mask, state: Array) -> None:
        """Lanes (L,) have made their last step; keep the state (3 D, L) as what is behind their
        last sample.
        """
        self._part()
        self._step[lanes] = self._end
        # The engine tells lost lanes by the last state that was kept.
        self._kept[-1, lanes] = state[:, lanes].T
        self.left[lanes] = 0.0
        self.t[lanes] = 0.0
        self._begins &= ~lanes
        self.over = bool(self._step.min() == self._end)

    def correct(self, lanes: Indices, h: Array) -> None:
        """Move the clocks of some lanes (n,) by h (n, 1) seconds."""
        self.t[lanes] += h
        self.left[lanes] = np.maximum(self.left[lanes] - h, 0.0)

    def motion(self) -> Motion:
        """What was kept."""
        x, v, a = np.split(self._kept.transpose(1, 0, 2), 3, axis=2)
        return Motion(x, v, a)
