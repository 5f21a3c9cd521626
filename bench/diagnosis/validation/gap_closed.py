"""Share of the gap that an extended model closes on held-out runs, with a bootstrap interval.

The share of the gap closed is, for the RMS errors b before and a after and the noise floor n,

    closed = (b - max(a, n)) / (b - n)                                                         (1)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.benchmark.statistics.bootstrap import INTERVAL_QUANTILES
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array

BOOTSTRAP_RESAMPLES = 2000
"""Number of bootstrap samples."""
SINGLE_RUN_SEGMENTS = 10
"""Number of segments into which a run is divided for resampling if there are too few runs."""
MIN_REPORTED_GAIN = -9.0
"""Lower limit of the reported share of the gap closed; for a failed model the exact value has no
meaning.
"""


@dataclass(frozen=True)
class HeldOutGain:
    """Held-out errors and the share of the gap closed.

    Attributes:
        base: RMS error of the base model, in the unit of the channels.
        extended: RMS error of the extended model.
        floor: RMS of the noise.
        gap_closed: Share of the gap closed, eq. (1) of the module docstring.
        low: Lower end of its 95 % interval; NaN if there is none.
        high: Upper end of its 95 % interval; NaN if there is none.
    """

    base: float
    extended: float
    floor: float
    gap_closed: float
    low: float
    high: float


def compute_held_out_gain(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    floor: float,
    rng: np.random.Generator,
    resamples_segments: bool = False,
) -> HeldOutGain:
    """Compute the share of the gap closed, with a 95 % bootstrap interval over runs.

    For RMS errors b before and a after and the noise floor n, it is (b - max(a, n)) / (b - n) (1).
    Whole runs are drawn with replacement, because samples of one run depend on each other. With a
    single run, or on request, segments of the runs are drawn instead (D. N. Politis, J. P. Romano
    1992). A single segment gives no interval, as all resamples would be equal.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the held-out runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
        channels: Indices of the channels that count; they share a unit.
        floor: RMS of the noise over these channels.
        rng: Random generator of the resampling.
        resamples_segments: Whether the bootstrap draws segments of the runs instead of whole runs;
            two or three runs are too few to draw from.
    """
    # Each row is a part, a run or a segment, with the squared errors of both models and the number
    # of samples.
    sums = _sum_squared_errors(evaluator, before, after, channels, resamples_segments)
    rms_before, rms_after = _compute_rms_errors(sums.sum(axis=0))
    part_count = len(sums)
    # A resample draws as many parts as there are, with replacement.
    drawn_parts = rng.integers(part_count, size=(BOOTSTRAP_RESAMPLES, part_count))
    resampled = sums[drawn_parts].sum(axis=1)
    shares = compute_closed_share(*_compute_rms_errors(resampled), floor)
    low = high = np.nan
    if part_count > 1:
        low, high = np.quantile(shares, INTERVAL_QUANTILES).tolist()
    gap_closed = float(compute_closed_share(rms_before, rms_after, floor))
    return HeldOutGain(float(rms_before), float(rms_after), floor, gap_closed, low, high)


def _sum_squared_errors(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    resamples_segments: bool,
) -> Array:
    """Sum up the squared errors of two models over each run or segment, for the bootstrap.

    The bootstrap draws rows and adds them, so that no error is computed again. Each row (n, 3) has
    the sum of squares of the base model, that of the extended model, and the number of samples.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: the predicted runs.
        before: (R, T, C) prediction of the base model.
        after: (R, T, C) prediction of the extended model.
        channels: indices of the channels that count.
        resamples_segments: whether the rows are segments of runs, because there are too few runs to
            resample.
    """
    part_sums = []
    for run, part in _list_resampled_parts(evaluator, resamples_segments):
        observed = evaluator.observed[run, part][:, channels]
        observed_mask = np.isfinite(observed)
        # A part without samples would be a row of zeros with an undefined error.
        if not observed_mask.any():
            continue
        errors = [
            (observed - simulated[run, part][:, channels])[observed_mask]
            for simulated in (before, after)
        ]
        part_sums.append([*(float(error @ error) for error in errors), float(observed_mask.sum())])
    return np.array(part_sums)


def _list_resampled_parts(
    evaluator: RunEvaluator, resamples_segments: bool
) -> list[tuple[int, slice]]:
    """List the parts that the bootstrap resamples: whole runs, or segments of too few runs.

    Whole runs are better, because neighbouring segments depend on each other.

    Args:
        evaluator: the predicted runs.
        resamples_segments: whether the parts are segments even if there are several runs.

    Returns:
        Index of the run and slice of its samples, for each part.
    """
    count = len(evaluator.prepared_runs)
    if count > 1 and not resamples_segments:
        return [(run, slice(None)) for run in range(count)]
    parts = []
    for run, length in enumerate(evaluator.lengths.tolist()):
        samples = np.linspace(0, length, SINGLE_RUN_SEGMENTS + 1).astype(int).tolist()
        # A run of few samples has empty segments.
        parts += [(run, slice(begin, end)) for begin, end in pairwise(samples) if end > begin]
    return parts


def _compute_rms_errors(sums: Array) -> tuple[Array, Array]:
    """Compute RMS errors before and after from sums (..., 3) of squares, and numbers of samples."""
    before, after, counts = np.moveaxis(sums, -1, 0)
    return np.sqrt(before / counts), np.sqrt(after / counts)


def compute_closed_share(base: Array | float, extended: Array | float, floor: float) -> Array:
    """Compute the share of the gap closed of any number of models; 0 without a gap.

    For RMS errors b before and a after and the noise floor n, it is (b - max(a, n)) / (b - n) (1).
    The lower limit is `MIN_REPORTED_GAIN`.

    Args:
        base: RMS errors before.
        extended: RMS errors after.
        floor: RMS of the noise.
    """
    gap = base - floor
    # An error below the noise floor closes the gap, but no more.
    reached_error = np.maximum(extended, floor)
    with np.errstate(all="ignore"):
        share = (base - reached_error) / np.asarray(gap)  # (1)
    # A gap below rounding errors would give an arbitrary share, and a resample may have no gap.
    shares = np.where(gap > 1e-3 * floor, share, 0.0)
    return np.clip(shares, MIN_REPORTED_GAIN, 1.0)
