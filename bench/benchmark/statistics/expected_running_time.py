"""Expected running time (ERT) and runtime distributions over error thresholds, as in COCO.

Sources: N. Hansen, A. Auger, D. Brockhoff, T. Tusar, Anytime performance assessment in blackbox
optimization benchmarking, IEEE TEVC 26(6), 2022, sections III and IV; N. Hansen, A. Auger, R. Ros,
S. Finck, P. Posik, Comparing results of 31 algorithms from BBOB-2009, GECCO 2010, for ERT.

Two definitions differ on purpose. A run has reached a threshold after the simulation from which on
its recommendation *stays* within the threshold, because a user without the true parameters cannot
know when an error is below it for the first time. A failed run has reached no threshold, and counts
with its whole budget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.statistics.bootstrap import (
    compute_percentile_interval,
    draw_target_resamples,
)
from bench.benchmark.statistics.error_curves import RunCurves, select_checkpoints
from sims.core.simulator import Array

RUNTIME_THRESHOLDS: Array = np.logspace(0, -8, 51)
"""Thresholds of the runtime distribution in widths of the training range; 51 as in COCO."""
ERT_TARGET_LEVELS = (0.1, 0.01, 1e-3, 1e-4, 1e-6)
"""Thresholds of the ERT table in widths of the training range."""


def select_thresholds(curves: RunCurves, simulated: bool) -> tuple[Array, tuple[float, ...]]:
    """Choose error thresholds of the runtime distribution and of the table of running times.

    The running times are expected running times (ERT), the numbers of simulations per success.

    In simulation the thresholds are fixed shares of the training range. For a recording, whose
    errors have other units, they are between the median initial error and the smallest final error.

    Args:
        curves: values of the deciding metric.
        simulated: True if errors are in widths of the training range.

    Returns:
        Thresholds of the distribution, and thresholds of the table.
    """
    if simulated:
        return RUNTIME_THRESHOLDS, ERT_TARGET_LEVELS
    start = float(np.nanmedian(curves.values[:, 0]))
    # At most half of the initial error, so that thresholds differ even if no tuner improved.
    best = min(float(np.nanmin(curves.compute_final_values())), 0.5 * start)
    # Slightly above the smallest error, so that the best run reaches it despite rounding.
    thresholds = np.geomspace(start, 1.001 * best, 21)
    # The table has five of the 21 thresholds, more of the tight (last) ones.
    return thresholds, tuple(float(x) for x in thresholds[[5, 10, 15, 18, 20]])


def compute_hitting_times(curves: RunCurves, threshold: float) -> Array:
    """Compute the number of simulations after which the error stays at or below a threshold.

    An error that rises above it again later does not count, because a user cannot know when it is
    low for the first time. A failed run reaches nothing.

    Args:
        curves: values of the metric.
        threshold: error threshold.

    Returns:
        (R,) numbers of simulations; infinite for runs that do not reach the threshold.
    """
    # The comparison is negated, so that NaN counts as above the threshold.
    is_above = ~(curves.values <= threshold)
    steps = is_above.shape[1]
    # Index after the last value above the threshold; 0 if no value is above it. If even the last
    # value is above it, the index is `steps`, beyond the end.
    last = steps - np.argmax(is_above[:, ::-1], axis=1)
    last = np.where(is_above.any(axis=1), last, 0)
    return np.where((last >= steps) | curves.failed, np.inf, last.astype(np.float64))


@dataclass(frozen=True)
class ThresholdEffort:
    """Effort to reach a threshold, by target.

    Attributes:
        simulations: (targets,) simulations of all runs of a target, until the threshold or the end.
        seconds: (targets,) seconds in the tuner, until the threshold or the end.
        successes: (targets,) number of runs that reached the threshold.
        runs: number of all runs.
    """

    simulations: Array
    seconds: Array
    successes: NDArray[np.int64]
    runs: int

    def compute_ert(self, picked: NDArray[np.int64] | None = None) -> Array:
        """Compute the expected running time: simulations per success.

        Args:
            picked: (..., n) indices of the targets that are used; None for all targets.

        Returns:
            (...) expected running time; infinite without a success.
        """
        return _divide_by_successes(self.simulations, self.successes, picked)

    def compute_tuner_seconds(self) -> float:
        """Return the seconds in the tuner per success."""
        return float(_divide_by_successes(self.seconds, self.successes, None))


def _divide_by_successes(
    efforts: Array, successes: NDArray[np.int64], resample: NDArray[np.int64] | None
) -> Array:
    """Divide the total effort by the number of successes; infinite without a success.

    So failed runs make a success more costly (expected running time).

    Args:
        efforts: (targets,) effort of all runs of each target, in simulations or seconds.
        successes: (targets,) number of runs of each target that reached the threshold.
        resample: (..., n) indices of the used targets, such as bootstrap resamples; None for all.

    Returns:
        (...) effort per success.
    """
    if resample is not None:
        efforts, successes = efforts[resample], successes[resample]
    total, count = efforts.sum(axis=-1), successes.sum(axis=-1)
    result: Array = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return result


def compute_effort(
    curves: RunCurves, threshold: float, budget: int, tuner_seconds: Array | None = None
) -> ThresholdEffort:
    """Compute the effort of one tuner's runs to reach a threshold, added up for each target.

    A run counts with its simulations until it reaches the threshold; one that does not, with all of
    its simulations, and a failed one with the whole budget.

    Args:
        curves: curves of one tuner and range.
        threshold: threshold of the metric.
        budget: number of simulations that a failed run counts with.
        tuner_seconds: (R, K + 1) cumulative seconds in the tuner of R runs after 0 to K
            simulations; None if they are not needed.

    Returns:
        Simulations, seconds and successes of each target, in the sorted order of target names; the
        seconds are 0 without `tuner_seconds`.
    """
    times = compute_hitting_times(curves, threshold)
    success = np.isfinite(times)
    unsuccessful = np.where(curves.failed, budget, curves.used)
    simulations = np.where(success, times, unsuccessful)
    seconds = np.zeros(len(simulations))
    if tuner_seconds is not None:
        # A run that exceeded the budget counts with its seconds at the budget.
        column = np.minimum(simulations, tuner_seconds.shape[1] - 1).astype(np.int64)
        seconds = tuner_seconds[np.arange(len(simulations)), column]
    _, groups = curves.group_by_target()
    return ThresholdEffort(
        simulations=np.array([simulations[rows].sum() for rows in groups]),
        seconds=np.array([seconds[rows].sum() for rows in groups]),
        successes=np.array([success[rows].sum() for rows in groups]),
        runs=len(simulations),
    )


ERT_COLUMNS = [
    "experiment",
    "range",
    "tuner",
    "threshold",
    "ert",
    "low",
    "high",
    "successes",
    "runs",
    "failures",
]


def build_ert_table(curves: RunCurves, levels: tuple[float, ...], budget: int) -> pd.DataFrame:
    """Compute the expected running time of each tuner with 95 % bootstrap intervals.

    Args:
        curves: values of the deciding metric.
        levels: error thresholds.
        budget: largest number of simulations.

    Returns:
        Table with the columns `ERT_COLUMNS`; the intervals are over targets.
    """
    lines = []
    for experiment, kind, range_curves in curves.split_problems():
        for tuner in range_curves.list_tuners():
            tuner_curves = range_curves.select(tuner=tuner)
            for level in levels:
                effort = compute_effort(tuner_curves, level, budget)
                # All tuners use the same draws, so that differences between targets cancel in
                # comparisons.
                resamples = draw_target_resamples(len(effort.successes), experiment, kind)
                low, high = compute_percentile_interval(effort.compute_ert(resamples))
                counts = int(effort.successes.sum()), effort.runs, int(tuner_curves.failed.sum())
                lines.append(
                    (
                        experiment,
                        kind,
                        tuner,
                        level,
                        float(effort.compute_ert()),
                        low,
                        high,
                        *counts,
                    )
                )
    return pd.DataFrame(lines, columns=ERT_COLUMNS)


RUNTIME_SHARE_COLUMNS = ["range", "tuner", "simulations", "share"]
_RUNTIME_POINT_COUNT = 60
"""Number of points of a runtime distribution, on a logarithmic scale of simulations."""


def compute_solved_fraction(
    curves: RunCurves, thresholds: Array, points: NDArray[np.int64]
) -> Array:
    """Compute the share of (run, threshold) pairs that are reached.

    Args:
        curves: values of the deciding metric.
        thresholds: thresholds of that metric.
        points: (P,) numbers of simulations.

    Returns:
        (P,) shares of the pairs that are reached after at most this number of simulations.
    """
    times = np.concatenate([compute_hitting_times(curves, float(t)) for t in thresholds])
    return np.array([(times <= k).mean() for k in points])


def build_runtime_table(curves: RunCurves, thresholds: Array) -> pd.DataFrame:
    """Compute runtime distributions: the share of (run, threshold) pairs that are reached.

    The numbers of simulations are those on a logarithmic scale and those of the tables.

    Args:
        curves: values of the deciding metric in all ranges.
        thresholds: thresholds of that metric.

    Returns:
        Table with the columns `RUNTIME_SHARE_COLUMNS`.
    """
    budget = curves.values.shape[1] - 1
    log_points = np.geomspace(1, budget, _RUNTIME_POINT_COUNT).astype(int)
    points = np.unique(np.concatenate([[0], log_points, select_checkpoints(budget)]))
    parts = []
    for kind in dict.fromkeys(curves.keys["range"]):
        range_curves = curves.select(range=str(kind))
        for tuner in range_curves.list_tuners():
            share = compute_solved_fraction(range_curves.select(tuner=tuner), thresholds, points)
            columns = (str(kind), tuner, points, share)
            parts.append(pd.DataFrame(dict(zip(RUNTIME_SHARE_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True)


def compute_runtime_shares(curves: RunCurves, thresholds: Array) -> list[dict[str, Array]]:
    """Compute the share of thresholds that each tuner has reached after 0..100 % of the budget.

    Problems have different budgets, so shares of it make them comparable. A pair of run and
    threshold counts as reached if the error of the run stays at or below the threshold.

    Args:
        curves: errors of all runs of one comparison.
        thresholds: thresholds of the runtime distribution.

    Returns:
        For each range: the shares (101,) by tuner.
    """
    budget = curves.values.shape[1] - 1
    points = np.floor(np.linspace(0, budget, 101)).astype(np.int64)
    shares = []
    for kind in dict.fromkeys(curves.keys["range"]):
        range_curves = curves.select(range=str(kind))
        shares.append(
            {
                t: compute_solved_fraction(range_curves.select(tuner=t), thresholds, points)
                for t in range_curves.list_tuners()
            }
        )
    return shares
