"""Check the sampling clock of a recording: jitter, lost samples and repeated samples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.logs.quality.noise_estimation import SIGMA_PER_MEDIAN
from bench.logs.quality.quality_finding import QualityFinding, format_names
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run

JITTER_THRESHOLD = 0.02
"""Smallest jitter that is reported, 1 sigma, as a fraction of the sampling interval."""
LOST_SAMPLE_SHARE_THRESHOLD = 0.002
"""Smallest share of lost or repeated samples that is reported."""
INTEGER_INTERVAL_TOLERANCE = 0.3
"""Tolerance for lost samples, as a fraction of the sampling interval.

An interval that is so close to a whole multiple of the median interval has lost the samples
between.
"""
FAST_SIGNAL_STEPS = 5.0
"""Smallest change of a signal per sample that counts as fast motion, in quantisation steps.

A signal that changes this fast does not repeat its value by coincidence.
"""
SIGNIFICANCE_SIGMAS = 4.0
"""Detection threshold in standard deviations."""


def check_intervals(recording: Recording) -> Iterator[QualityFinding]:
    """Find irregular sampling intervals (jitter) and lost samples, summarised over all runs."""
    jittered, jitters, lost_count, sample_count, lossy = [], [], 0, 0, []
    for run in recording.runs:
        steps = np.diff(_select_timestamps(run))
        if steps.size < 2:
            continue
        ratios = steps / np.median(steps)
        counts = np.maximum(np.round(ratios), 1.0)
        deviations = ratios - counts
        jitter = SIGMA_PER_MEDIAN * float(np.median(np.abs(deviations - np.median(deviations))))
        jitters.append(jitter)
        if jitter > JITTER_THRESHOLD:
            jittered.append(run.name)
        run_lost_count = int(
            (counts - 1)[np.abs(deviations) < max(INTEGER_INTERVAL_TOLERANCE, 3.0 * jitter)].sum()
        )
        # If the clock jitters strongly, a long interval means a lost sample only if no short
        # interval compensates for it.
        run_lost_count = min(run_lost_count, max(int(ratios.sum()) - steps.size, 0))
        if run_lost_count < SIGNIFICANCE_SIGMAS * jitter * steps.size**0.5:
            run_lost_count = 0
        lost_count, sample_count = (
            lost_count + run_lost_count,
            sample_count + steps.size + run_lost_count,
        )
        if run_lost_count:
            lossy.append(run.name)
    if jittered:
        yield QualityFinding(
            "clock",
            f"intervals vary by {max(jitters):.0%} of one (1 sigma) in {format_names(jittered)}",
            "every sample is simulated at its own stamp, so use the times of measurement as "
            "stamps, not the times of writing",
        )
    if sample_count and lost_count > LOST_SAMPLE_SHARE_THRESHOLD * sample_count:
        yield QualityFinding(
            "clock",
            f"{lost_count} samples ({lost_count / sample_count:.1%}) are lost in "
            f"{format_names(lossy)}",
            "nothing is interpolated, but commands in the gaps are not known: log commands "
            "in a separate file, or at a lower rate",
        )


def _select_timestamps(run: Run) -> Array:
    """Return the sample times of the sensor that was read most often.

    The sample times of a run also contain those of commands and of other sensors, which have their
    own clocks. All sample times are returned if they are at least as regular: the missing samples
    of the sensor are then empty cells.
    """
    recorded_masks = [np.isfinite(values) for values in run.channels.values()]
    is_recorded = max(
        recorded_masks, key=lambda mask: int(mask.sum()), default=np.ones(run.times.size, np.bool_)
    )
    sensor_times = run.times[is_recorded]
    return (
        run.times
        if _compute_uneven_share(run.times) <= _compute_uneven_share(sensor_times)
        else sensor_times
    )


def _compute_uneven_share(times: Array) -> float:
    """Return the share of intervals that differ from the median interval by more than 1 %."""
    steps = np.diff(times)
    if not steps.size:
        return 1.0
    median_step = float(np.median(steps))
    return float(np.mean(np.abs(steps - median_step) > 0.01 * median_step))


def check_repeated_samples(recording: Recording) -> Iterator[QualityFinding]:
    """Find samples that repeat the previous one in every channel although the system moves.

    Such samples were not measured anew, and look like a delay.
    """
    repeated_count, sample_count, runs = 0, 0, []
    for run in recording.runs:
        count, expected = _count_stale_samples(run)
        if count > expected + SIGNIFICANCE_SIGMAS * np.sqrt(max(expected, 1.0)):
            repeated_count += count
            runs.append(run.name)
        sample_count += run.times.size
    if repeated_count > LOST_SAMPLE_SHARE_THRESHOLD * sample_count:
        yield QualityFinding(
            "clock",
            f"{repeated_count} samples ({repeated_count / sample_count:.1%}) repeat the one before "
            f"in every channel while it moves, in {format_names(runs)}",
            "leave these rows out: a value that is one interval old looks like a delay",
        )


def _count_stale_samples(run: Run) -> tuple[int, float]:
    """Count samples that repeat the previous one during fast motion.

    Returns:
        The count, and its expected value under the null hypothesis.
    """
    signals = [values for values in run.channels.values() if np.isfinite(values).sum() > 3]
    if not signals or run.times.size < 4:
        return 0, 0.0
    changes = np.array([_count_quantisation_steps(values) for values in signals])
    is_unchanged = np.nan_to_num(changes, nan=0.0) == 0
    neighbour_changes = np.maximum(np.abs(changes[:, :-2]), np.abs(changes[:, 2:]))
    moving = (
        np.nan_to_num(np.max(neighbour_changes, axis=0, initial=0.0), nan=0.0) >= FAST_SIGNAL_STEPS
    )
    is_stale = is_unchanged.all(axis=0)[1:-1] & moving
    # A signal whose noise spans several steps repeats its value half as often as it changes by one
    # step in either direction.
    is_nearly_stale = (np.abs(np.nan_to_num(changes, nan=9.0)) < 1.5).all(axis=0)[1:-1] & moving
    one_step_count = int(is_nearly_stale.sum()) - int(is_stale.sum())
    return int(is_stale.sum()), one_step_count / max(3.0 ** len(signals) - 1.0, 1.0)


def _count_quantisation_steps(values: Array) -> Array:
    """Return the (T - 1,) changes of a signal in units of its smallest change."""
    changes = np.diff(values)
    sizes = np.abs(changes[np.isfinite(changes)])
    nonzero_sizes = sizes[sizes > 1e-9 * np.max(sizes, initial=0.0)]
    if not nonzero_sizes.size:
        return np.zeros_like(changes)
    # Without quantisation the smallest change is tiny, so that any motion is many steps.
    return np.asarray(np.round(changes / nonzero_sizes.min()), dtype=np.float64)
