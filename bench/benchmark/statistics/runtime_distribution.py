"""Runtime distributions: the share of (run, threshold) pairs reached within k simulations."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.error_table import select_checkpoints
from bench.benchmark.statistics.expected_running_time import compute_hitting_times
from sims.core.simulator import Array

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
        (P,) shares.
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
