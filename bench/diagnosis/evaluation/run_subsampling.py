"""Subsampling of long runs: keep every n-th sample, at most one longest engine step apart.

If motion is sampled much faster than it changes, a search takes many steps and gains little
information. The first of every n samples is kept, and an input is replaced by its mean over them,
which transfers the same momentum as the original input.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import MAX_TIME_STEP, Indices, RunEvaluator
from sims.core.simulator import Array
from sims.recording.recording import Run

MIN_SAMPLES_TO_THIN = 5_000
"""Minimum total number of samples of all runs for which they are thinned."""
MIN_THINNED_SAMPLES = 2_000
"""Minimum total number of samples after thinning."""
MIN_CHANNEL_SAMPLE_SHARE = 0.5
"""Minimum number of samples of a channel after thinning, as a share of the expected number.

A channel that is sampled rarely might otherwise lose all its samples.
"""


def thin_runs(evaluator: RunEvaluator) -> RunEvaluator | None:
    """Return a `RunEvaluator` with thinned runs and the same parameters.

    Args:
        evaluator: the runs.

    Returns:
        The thinned runs, or None if there are few samples, if the sample interval is already as
        long as an engine step, or if a channel would lose too many samples.
    """
    total = int(evaluator.lengths.sum())
    max_factor = total // MIN_THINNED_SAMPLES
    factors = [min(_compute_factor(run), max_factor) for run in evaluator.runs]
    if total < MIN_SAMPLES_TO_THIN or max(factors) < 2:
        return None
    runs = [
        _take_every_nth(run, factor) for run, factor in zip(evaluator.runs, factors, strict=True)
    ]
    if not all(
        _keeps_samples(thinned_run, run, factor)
        for thinned_run, run, factor in zip(runs, evaluator.runs, factors, strict=True)
    ):
        return None
    return evaluator.with_runs(runs)


def _compute_factor(run: Run) -> int:
    """Return the number of sample intervals within one engine step."""
    intervals = np.diff(run.times)
    if not intervals.size:
        return 1
    # The small addend keeps rounding from reducing a whole number of intervals by one.
    return max(int(MAX_TIME_STEP / float(np.median(intervals)) + 1e-6), 1)


def _take_every_nth(run: Run, factor: int) -> Run:
    """Return the run with every n-th sample of its channels; n is `factor`.

    An input becomes its mean between the kept samples, so that it has the same effect.
    """
    first = np.arange(0, run.times.size, factor)
    return replace(
        run,
        times=run.times[first],
        channels={name: values[first] for name, values in run.channels.items()},
        inputs={
            name: _average_input(run.times, values, first) for name, values in run.inputs.items()
        },
        extra={},
    )


def _average_input(times: Array, values: Array, first: Indices) -> Array:
    """Return the mean (K,) of an input over the samples from each kept sample to the next one.

    Args:
        times: (T,) sample times in seconds.
        values: (T,) input, held from each sample to the next one.
        first: (K,) indices of the kept samples.

    Returns:
        Means, weighted by duration; after the last kept sample, the mean of the rest of the run.
    """
    durations = np.diff(times, append=times[-1])
    # The last sample has no duration; a tiny one avoids 0 / 0 in its block.
    durations[-1] = 1e-9 * max(float(times[-1] - times[0]), 1e-9)
    means: Array = np.add.reduceat(values * durations, first) / np.add.reduceat(durations, first)
    return means


def _keeps_samples(thinned_run: Run, run: Run, factor: int) -> bool:
    """Return whether every channel keeps about its expected number of recorded samples.

    A channel that is recorded at a lower rate than the others could lose nearly all its samples.

    Args:
        thinned_run: the run after subsampling.
        run: the run before.
        factor: every `factor`-th sample was kept.
    """
    for name, values in run.channels.items():
        sample_count = int(np.isfinite(values).sum())
        thinned_count = int(np.isfinite(thinned_run.channels[name]).sum())
        if thinned_count < MIN_CHANNEL_SAMPLE_SHARE * sample_count / factor:
            return False
    return True
