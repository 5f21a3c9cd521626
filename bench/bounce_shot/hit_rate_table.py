"""Results table of a bounce-shot study: hits with Wilson intervals, and prediction errors."""

from __future__ import annotations

import math

import pandas as pd

from bench.benchmark.statistics.proportion_interval import compute_proportion_interval
from bench.benchmark.storage.run_status import FAILED_STATUSES

ALL_BALLS = "all"
"""Value of the column ball for all kinds of balls together."""
RESULT_COLUMNS = [
    "method",
    "ball",
    "shots",
    "hits",
    "rate",
    "low",
    "high",
    "off_median",
    "off_90",
    "prediction_error_median",
    "prediction_error_mean",
    "simulations",
    "seconds",
    "failures",
]
NO_SHOT_STATUSES = (*FAILED_STATUSES, "no plan", "no recording")
"""Statuses of a method without a shot, or without one that was planned in a tuned model."""


def build_result_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Build the results table: one line per method and ball, and one per method for all balls.

    Distances are in m. `off` is the distance from the hoop's centre in the plane of the hoop; it is
    infinite for a shot that never meets the plane.

    Args:
        rows: rows of shots.csv, one per method and shot.
    """
    lines = []
    for method, rows_of_method in rows.groupby("method", sort=False):
        groups = [*rows_of_method.groupby("ball", sort=False), (ALL_BALLS, rows_of_method)]
        lines += [_compute_table_row(str(method), str(ball), group) for ball, group in groups]
    return pd.DataFrame(lines, columns=RESULT_COLUMNS)


def _compute_table_row(method: str, ball: str, part: pd.DataFrame) -> list[object]:
    """Compute one line of the results table, in the order of `RESULT_COLUMNS`.

    A shot that never meets the plane of the hoop counts as infinitely far off. The quantiles of the
    distances are therefore not interpolated: they are the next higher value.

    Args:
        method: label of the method.
        ball: kind of ball, or `ALL_BALLS`.
        part: rows of shots.csv of this method and ball.
    """
    shots, hits = len(part), int(part["hit"].sum())
    miss_distances = part["off"].abs().fillna(math.inf)
    errors = part["prediction_error"]
    failures = int(part["status"].isin(NO_SHOT_STATUSES).sum())
    miss_quantiles = miss_distances.quantile([0.5, 0.9], interpolation="higher").tolist()
    return [
        method,
        ball,
        shots,
        hits,
        hits / shots,
        *compute_proportion_interval(hits, shots),
        *miss_quantiles,
        errors.median(),
        errors.mean(),
        part["simulations"].mean(),
        part["seconds"].mean(),
        failures,
    ]
