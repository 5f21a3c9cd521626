"""Medians over targets with 95 % percentile-bootstrap intervals: against simulations, and against
the target's distance from the training range. The figures draw them, and the page holds them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from bench.analysis.curves import Curves
from bench.analysis.resampling import interval, medians
from bench.analysis.rounding import FLOOR
from bench.analysis.table import checkpoints, target_curves
from sims.base import Array

MEDIAN_COLUMNS = ["tuner", "simulations", "median", "low", "high", "targets"]
DISTANCE_COLUMNS = [
    "simulations",
    "tuner",
    "bin",
    "beyond",
    "to",
    "targets",
    "median",
    "low",
    "high",
]
BINS = 4
"""Of distances outside the training range; targets within it make one more."""
_RESAMPLES = 500
"""Of the bootstrap: enough for a band a few pixels wide."""
_POINTS = 40
"""Numbers of simulations of a curve, on a logarithmic scale."""
_MOMENTS = (3, 10)
"""Numbers of simulations at which errors are put against distance, beside the whole budget."""


def drawn(budget: int) -> list[int]:
    """Numbers of simulations at which a curve has points: those of the tables, and some between."""
    between = np.unique(np.geomspace(1, budget, _POINTS).astype(int))
    return sorted({*checkpoints(budget), *between.tolist()})


def moments(budget: int) -> list[int]:
    """Numbers of simulations at which errors are put against distance."""
    return [k for k in _MOMENTS if k < budget] + [budget]


def median_curves(curves: Curves, metric: str, budget: int) -> pd.DataFrame:
    """Each tuner's median of a metric over targets against simulations, `MEDIAN_COLUMNS`.

    A target's value is the mean over its seeds. A tuner all of whose runs failed has no rows.
    """
    points = drawn(budget)
    parts = []
    for tuner in curves.tuners():
        lines = np.maximum(_values(target_curves(curves.of(tuner=tuner), points)), FLOOR)
        # A target whose runs all failed has no curve; failures are counted in the table.
        lines = lines[np.isfinite(lines).all(axis=1)]
        if not len(lines):
            continue
        low, high = interval(lines, medians, "figure", tuner, metric, resamples=_RESAMPLES)
        columns = (tuner, points, np.median(lines, axis=0), low, high, len(lines))
        parts.append(pd.DataFrame(dict(zip(MEDIAN_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=MEDIAN_COLUMNS)


def by_distance(curves: Curves, distances: pd.Series[float], budget: int) -> pd.DataFrame:
    """Median error after few, some and all simulations by how far the target lies outside the
    training range, `DISTANCE_COLUMNS`: bin 0 is inside it, the others are of one width.

    Args:
        curves: of the error, in the range `wide`.
        distances: of each target from the training range, by its name.
        budget: largest number of simulations.
    """
    bins, edges = _binned(distances)
    points = moments(budget)
    errors = {t: target_curves(curves.of(tuner=t), points) for t in curves.tuners()}
    lines = []
    for k in points:
        for tuner, by_target in errors.items():
            values = by_target[k].dropna().clip(lower=FLOOR)
            places = bins[values.index].to_numpy()
            lines += [
                (k, tuner, b, *edges[b], int((bins == b).sum()), *_middle(part, tuner, b))
                for b in range(BINS + 1)
                if len(part := values.to_numpy()[places == b])
            ]
    return pd.DataFrame(lines, columns=DISTANCE_COLUMNS)


def _values(frame: pd.DataFrame) -> Array:
    return frame.to_numpy(dtype=np.float64)


def _binned(distances: pd.Series[float]) -> tuple[pd.Series[Any], list[tuple[float, float]]]:
    """The bin of each target, and where each bin begins and ends."""
    # Bins of one width; targets on the edge of the training range are within it.
    edges = np.linspace(0.0, float(distances.max()), BINS + 1)
    outside = 1 + np.searchsorted(edges[1:-1], distances, side="left")
    bins = pd.Series(np.where(distances > 0, outside, 0), index=distances.index)
    ends = [(float(edges[b]), float(edges[b + 1])) for b in range(BINS)]
    return bins, [(0.0, 0.0), *ends]


def _middle(values: Array, tuner: str, place: int) -> tuple[float, float, float]:
    """Median of (n,) values with its interval; NaN for that of a single one."""
    # The stream's name counts targets inside as the bin before the first.
    names = ("distance", tuner, str(place - 1))
    low, high = interval(values[:, None], medians, *names, resamples=_RESAMPLES)
    return float(np.median(values)), float(low[0]), float(high[0])


def bin_names(table: pd.DataFrame) -> list[str]:
    """What the bins of `by_distance` are called, with their numbers of targets."""
    first = table.drop_duplicates("bin").to_dict("records")
    counts = {int(row["bin"]): row["targets"] for row in first}
    # Bins outside are of one width; one without a target has no row to say so.
    width = max((row["to"] / row["bin"] for row in first if row["bin"]), default=0.0)
    ranges = ["inside", *(f"{b * width:.2f}–{(b + 1) * width:.2f}" for b in range(BINS))]
    return [f"{name}\nn={counts.get(b, 0)}" for b, name in enumerate(ranges)]
