"""Time, inputs and recorded states of each batch element."""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array
from sims.core.system import IntegrationBatch, Trajectories
from sims.engines.ground_contact import Indices, Mask


class ElementClocks:
    """Clock of every batch element.

    While all elements are in the same step, whole rows are read and written. From the first time
    that they differ, elements are handled one by one.

    Attributes:
        t: (L, 1) seconds since the start of the run.
        left: (L, 1) seconds to the end of the element's step.
        over: whether every element has made all its steps.
    """

    def __init__(self, lanes: IntegrationBatch) -> None:
        count, self._end = lanes.steps.shape
        # Elements with the same steps share one row: a stride of zero shows that there is only one
        # row.
        steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
        none = np.zeros((1, len(steps)))
        ends = np.cumsum(steps, axis=1)
        # There is one row per step, and a last row of zeros in which finished elements wait. The
        # arrays must be contiguous, because values are looked up by flat index.
        self._steps = np.ascontiguousarray(np.concatenate([steps.T, none]))
        self._starts = np.ascontiguousarray(np.concatenate([none, ends.T]))
        self._inputs = {}
        for name, values in lanes.inputs.items():
            self._inputs[name] = np.ascontiguousarray(values.T)
        self._every = lanes.steps_per_sample
        records = self._end // lanes.steps_per_sample + 1
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

    def get_inputs(self) -> dict[str, Array]:
        """Return the inputs (L, 1) by name; after the last step, those of the last step."""
        if self._common is not None:
            row = min(self._common, self._end - 1)
            return {name: values[row][:, None] for name, values in self._inputs.items()}
        rows = np.minimum(self._step, self._end - 1)
        return {name: values[rows, self._lane][:, None] for name, values in self._inputs.items()}

    def record_states(self, state: Array) -> None:
        """Record the state (3 D, L) of elements that begin a step at a sample time."""
        if self._common is not None:
            if self._common % self._every == 0:
                # Whole rows, without search for elements: most calls never leave this branch.
                self._kept[self._common // self._every] = state.T
            return
        due = self._step % self._every == 0
        lanes = np.flatnonzero(self._begins & due)
        if lanes.size:
            records = self._step[lanes] // self._every
            self._kept[records, lanes] = state[:, lanes].T

    def finish_step(self, ended: Mask | None = None) -> None:
        """Advance the elements `ended` (L,), or all, to their next step."""
        if ended is not None and not ended.all():
            self._part()
        if self._common is not None:
            self._common += 1
            self.over = self._common == self._end
            self.left[:, 0] = self._steps[self._common]
            self.t[:, 0] = self._starts[self._common]
            return
        assert ended is not None
        # A finished element must not advance: it would run past the end of the table.
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

    def advance_time(self, h: Array) -> None:
        """Advance the time by h (L, 1) seconds, at most to the end of the step."""
        self.t += h
        # By rounding, parts of a step may add up to more than its length; a negative rest would run
        # backwards in time.
        self.left = np.maximum(self.left - h, 0.0)

    def _part(self) -> None:
        """Handle elements one by one from now on."""
        if self._common is not None:
            self._step[:] = self._common
            self._common = None

    def abandon(self, lanes: Mask, state: Array) -> None:
        """End the integration of some elements.

        Args:
            lanes: (L,) elements to end.
            state: (3 D, L) state that is recorded as that of the last sample.
        """
        self._part()
        self._step[lanes] = self._end
        # The engine recognises failed elements by their last recorded state.
        self._kept[-1, lanes] = state[:, lanes].T
        self.left[lanes] = 0.0
        self.t[lanes] = 0.0
        self._begins &= ~lanes
        self.over = bool(self._step.min() == self._end)

    def shift_time(self, lanes: Indices, h: Array) -> None:
        """Move the clocks of the elements `lanes` (n,) by h (n, 1) seconds."""
        self.t[lanes] += h
        self.left[lanes] = np.maximum(self.left[lanes] - h, 0.0)

    def get_trajectories(self) -> Trajectories:
        """Return the recorded trajectories."""
        x, v, a = np.split(self._kept.transpose(1, 0, 2), 3, axis=2)
        return Trajectories(x, v, a)
