"""Long runs with fewer samples: every n-th one, as far apart as the engine's longest step.

Motion that is sampled much more often than it changes costs a search many steps and tells it little
more. Of every n samples the first is kept, and an input holds its mean over them, which carries the
same momentum as the inputs that it stands for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.gap.model.world import TIME_STEP, Indices, World
from sims.base import Array
from sims.recording.recording import Run

LONG = 12_000
"""Samples of all runs together from which they are thinned."""
LEFT = 2_000
"""So many are left of them at least."""
SHOWN = 0.5
"""Share of a channel's samples, of those that thinning leaves, that must be there: one that is
sampled seldom might else lose them all.
"""


def thinned(world: World) -> World | None:
    """The world with fewer samples of the same runs, and the same parameters; None where there are
    few, or where they are as far apart as steps already.
    """
    total = int(world.lengths.sum())
    most = total // LEFT
    factors = [min(_factor(run), most) for run in world.runs]
    if total < LONG or max(factors) < 2:
        return None
    runs = [_every(run, factor) for run, factor in zip(world.runs, factors, strict=True)]
    if not all(
        _shown(few, run, factor) for few, run, factor in zip(runs, world.runs, factors, strict=True)
    ):
        return None
    return world.over(runs)


def _factor(run: Run) -> int:
    """How many of its intervals a step may hold."""
    intervals = np.diff(run.times)
    if not intervals.size:
        return 1
    return max(int(TIME_STEP / float(np.median(intervals)) + 1e-6), 1)


def _every(run: Run, factor: int) -> Run:
    """The run with every n-th sample."""
    first = np.arange(0, run.times.size, factor)
    return replace(
        run,
        times=run.times[first],
        channels={name: values[first] for name, values in run.channels.items()},
        inputs={name: _means(run.times, values, first) for name, values in run.inputs.items()},
        extra={},
    )


def _means(times: Array, values: Array, first: Indices) -> Array:
    """The mean of an input from each of the kept samples to the next; behind the last its value."""
    lasting = np.diff(times, append=times[-1])
    # the last sample lasts for nothing: a hair of time keeps its block from being 0 / 0
    lasting[-1] = 1e-9 * max(float(times[-1] - times[0]), 1e-9)
    means: Array = np.add.reduceat(values * lasting, first) / np.add.reduceat(lasting, first)
    return means


def _shown(few: Run, run: Run, factor: int) -> bool:
    """Whether every channel has kept about its part of the samples."""
    for name, values in run.channels.items():
        before = int(np.isfinite(values).sum())
        left = int(np.isfinite(few.channels[name]).sum())
        if left < SHOWN * before / factor:
            return False
    return True
