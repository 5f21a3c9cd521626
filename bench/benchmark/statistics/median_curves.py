"""Medians over targets with 95 % percentile-bootstrap intervals, for figures and the report.

Errors are given against the number of simulations and against the target's distance from the
training range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from bench.benchmark.statistics.bootstrap import (
    compute_bootstrap_interval,
    compute_resampled_medians,
)
from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.error_floor import ERROR_FLOOR
from bench.benchmark.statistics.error_table import compute_target_curves, select_checkpoints
from sims.core.simulator import Array

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
_MAX_GROUPS = 4
"""Maximum number of groups of targets outside the training range."""
_MIN_GROUP_SIZE = 4
"""Minimum number of targets in a group outside the training range.

A group can be smaller if there are fewer targets in total. The interval of a smaller group would
say little.
"""
_BOOTSTRAP_RESAMPLES = 500
"""Number of bootstrap resamples; enough for an interval band a few pixels wide."""
_CURVE_POINT_COUNT = 40
"""Number of points of a curve, on a logarithmic scale of simulations."""
_MAX_INVISIBLE_DIFFERENCE = 0.02
"""Relative difference of errors that is not visible on a logarithmic axis."""
_DISTANCE_CHECKPOINTS = (3, 10)
"""Numbers of simulations for plots of error against distance, in addition to the whole budget."""


def select_curve_points(budget: int) -> list[int]:
    """Return the numbers of simulations of a curve's points, including those of the tables."""
    log_points = np.unique(np.geomspace(1, budget, _CURVE_POINT_COUNT).astype(int))
    return sorted({*select_checkpoints(budget), *log_points.tolist()})


def select_distance_checkpoints(budget: int) -> list[int]:
    """Return the numbers of simulations at which errors are plotted against distance."""
    return [k for k in _DISTANCE_CHECKPOINTS if k < budget] + [budget]


def compute_median_curves(curves: RunCurves, metric: str, budget: int) -> pd.DataFrame:
    """Compute each tuner's median of a metric over targets, by number of simulations.

    A target's value is the mean over its seeds. A tuner has no rows if all its runs failed.

    Args:
        curves: values of the metric.
        metric: name of the metric, for the random stream of the bootstrap.
        budget: largest number of simulations.

    Returns:
        Table with the columns `MEDIAN_COLUMNS`.
    """
    points = select_curve_points(budget)
    parts = []
    for tuner in curves.list_tuners():
        lines = np.maximum(
            _get_values(compute_target_curves(curves.select(tuner=tuner), points)), ERROR_FLOOR
        )
        # A target whose runs all failed has no curve; failures are counted in the table.
        lines = lines[np.isfinite(lines).all(axis=1)]
        if not len(lines):
            continue
        low, high = compute_bootstrap_interval(
            lines,
            compute_resampled_medians,
            "figure",
            tuner,
            metric,
            resamples=_BOOTSTRAP_RESAMPLES,
        )
        columns = (tuner, points, np.median(lines, axis=0), low, high, len(lines))
        parts.append(pd.DataFrame(dict(zip(MEDIAN_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=MEDIAN_COLUMNS)


def find_coinciding_curves(
    curves_by_tuner: Mapping[str, Sequence[pd.Series[float]]],
) -> dict[str, str]:
    """Find curves that cannot be seen because another one is drawn above them.

    A curve coincides with a later one up to k if the two differ by less than
    `_MAX_INVISIBLE_DIFFERENCE` in every panel up to k, and if they have halved the initial error by
    then. Before that most tuners are equal.

    Args:
        curves_by_tuner: curves of each tuner in drawing order, one per panel: medians by number of
            simulations.

    Returns:
        Note by tuner whose curve is covered: ``same as hybrid up to 2``, or ``same as hybrid``.
    """
    notes = {}
    names = list(curves_by_tuner)
    for place, name in enumerate(names):
        longest = 0
        for upper_name in names[place + 1 :]:
            if len(curves_by_tuner[upper_name]) != len(curves_by_tuner[name]):
                continue
            pairs = list(zip(curves_by_tuner[name], curves_by_tuner[upper_name], strict=True))
            upto = min(
                _count_equal_simulations(hidden_curve, upper_curve)
                for hidden_curve, upper_curve in pairs
            )
            has_progress = any(
                (hidden_curve.loc[:upto] < 0.5 * hidden_curve.iloc[0]).any()
                for hidden_curve, _ in pairs
            )
            if upto > longest and has_progress:
                longest = upto
                is_complete = all(upto == hidden_curve.index[-1] for hidden_curve, _ in pairs)
                notes[name] = f"same as {upper_name}" + ("" if is_complete else f" up to {upto}")
    return notes


def _count_equal_simulations(first: pd.Series[float], second: pd.Series[float]) -> int:
    """Return the largest number of simulations up to which two curves look the same; 0 for none."""
    points = first.index.intersection(second.index)
    a, b = first[points].to_numpy(), second[points].to_numpy()
    is_equal = np.logical_and.accumulate(
        np.abs(a - b) <= _MAX_INVISIBLE_DIFFERENCE * np.maximum(a, b)
    )
    return int(points[is_equal][-1]) if is_equal.any() else 0


def compute_medians_by_distance(
    curves: RunCurves, distances: pd.Series[float], budget: int
) -> pd.DataFrame:
    """Compute median errors by distance from the training range, after few and all simulations.

    Targets inside the training range are one group (bin 0). Those outside are sorted by distance
    and divided into at most `_MAX_GROUPS` groups of equal size.

    Args:
        curves: error of the runs in the range `wide`.
        distances: distance of each target from the training range, by target name.
        budget: largest number of simulations.

    Returns:
        One row per number of simulations, tuner and group, columns `DISTANCE_COLUMNS`; `beyond` and
        `to` are the smallest and largest distance in the group.
    """
    groups = _group_by_distance(distances)
    points = select_distance_checkpoints(budget)
    errors = {
        t: compute_target_curves(curves.select(tuner=t), points) for t in curves.list_tuners()
    }
    lines = []
    for k in points:
        for tuner, by_target in errors.items():
            values = by_target[k].dropna().clip(lower=ERROR_FLOOR)
            for b, names in groups.items():
                part = values.reindex(names).dropna().to_numpy()
                if len(part):
                    distance_limits = float(distances[names].min()), float(distances[names].max())
                    lines.append(
                        (
                            k,
                            tuner,
                            b,
                            *distance_limits,
                            len(names),
                            *_compute_median_with_interval(part, tuner, b),
                        )
                    )
    return pd.DataFrame(lines, columns=DISTANCE_COLUMNS)


def _get_values(frame: pd.DataFrame) -> Array:
    return frame.to_numpy(dtype=np.float64)


def _group_by_distance(distances: pd.Series[float]) -> dict[int, list[str]]:
    """Return the target names of each group: 0 inside the training range, then by distance."""
    names_inside = list(distances.index[distances <= 0])
    outside = list(distances[distances > 0].sort_values(kind="stable").index)
    count = min(max(len(outside) // _MIN_GROUP_SIZE, 1), _MAX_GROUPS)
    parts = [list(part) for part in np.array_split(np.array(outside, dtype=object), count)]
    return {b: names for b, names in enumerate([names_inside, *parts]) if names}


def _compute_median_with_interval(
    values: Array, tuner: str, group: int
) -> tuple[float, float, float]:
    """Return the median of values (n,) with its interval; the interval of one value is NaN."""
    # The stream's name numbers the group inside the training range -1.
    names = ("distance", tuner, str(group - 1))
    low, high = compute_bootstrap_interval(
        values[:, None], compute_resampled_medians, *names, resamples=_BOOTSTRAP_RESAMPLES
    )
    return float(np.median(values)), float(low[0]), float(high[0])


def format_bin_labels(table: pd.DataFrame) -> list[str]:
    """Return labels of the groups of `compute_medians_by_distance`, with numbers of targets."""
    first = {int(row["bin"]): row for row in table.drop_duplicates("bin").to_dict("records")}
    names = []
    for b in range(max(first, default=0) + 1):
        row = first.get(b)
        if row is None:
            names.append("inside\nn=0")
            continue
        limits = [f"{row[end]:.2f}" for end in ("beyond", "to")]
        name = "–".join(dict.fromkeys(limits)) if b else "inside"
        names.append(f"{name}\nn={row['targets']}")
    return names
