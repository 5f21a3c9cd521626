"""Build the table of error against number of simulations of a comparison.

A run that ended early counts with its last recommendation. A target's value is the mean over its
seeds. Median and mean are over targets, and `low`..`high` is a 95 % percentile-bootstrap interval
of the mean over targets (Efron & Tibshirani 1993, ch. 13). Seeds of one target are therefore not
counted as independent evidence.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.statistics.bootstrap import compute_bootstrap_interval, compute_resampled_means
from bench.benchmark.statistics.error_curves import RunCurves, RunRowTable, average_over_seeds
from bench.benchmark.storage.table_schemas import ERROR_METRICS
from sims.core.simulator import Array

CHECKPOINTS = (0, 1, 2, 3, 5, 10, 20, 50, 100)
"""Numbers of simulations that are used in tables and on axes."""
ERROR_TABLE_COLUMNS = [
    "experiment",
    "tuner",
    "range",
    "simulations",
    "metric",
    "median",
    "mean",
    "low",
    "high",
    "runs",
    "failures",
    "fit_simulations",
    "fit_seconds",
    "tuner_seconds",
    "simulator_seconds",
]


def select_checkpoints(budget: int) -> list[int]:
    """Return the standard numbers of simulations up to the budget, and the budget itself."""
    return sorted({k for k in CHECKPOINTS if k <= budget} | {budget})


def build_error_table(
    runs: pd.DataFrame,
    statuses: pd.DataFrame,
    budget: int,
    trainings: Mapping[str, tuple[float, float]] | None = None,
) -> pd.DataFrame:
    """Build the table of a comparison in long form.

    Args:
        runs: rows of runs.parquet.
        statuses: rows of status.csv.
        budget: largest number of simulations in the table.
        trainings: simulations and seconds of one training, by tuner.

    Returns:
        Table with the columns `ERROR_TABLE_COLUMNS`.
    """
    points = select_checkpoints(budget)
    rows = RunRowTable(runs, statuses, budget)
    timed = ("tuner_seconds", "simulator_seconds")
    spent_seconds = [
        rows.build_cumulative_seconds(name) if name in runs else None for name in timed
    ]
    curves = {m: rows.build_curves(m) for m in ERROR_METRICS if m in runs and runs[m].notna().any()}
    lines = []
    for (experiment, tuner, kind), part in rows.keys.groupby(
        ["experiment", "tuner", "range"], sort=False
    ):
        tuner_rows = part.index.to_numpy()
        fit = (trainings or {}).get(str(tuner), (0.0, 0.0))
        seconds = [
            np.full(len(points), np.nan) if s is None else s[tuner_rows][:, points].mean(axis=0)
            for s in spent_seconds
        ]
        counts = len(tuner_rows), int(rows.failed[tuner_rows].sum())
        for metric, curve in curves.items():
            values = _summarise_over_targets(
                curve, tuner_rows, points, (str(tuner), str(kind), metric)
            )
            for i, k in enumerate(points):
                errors, times = values[:, i], (seconds[0][i], seconds[1][i])
                key = (experiment, tuner, kind, k, metric)
                lines.append((*key, *errors, *counts, *fit, *times))
    # A tuner that could not be used has a row too, so that the table names every tuner.
    skipped = statuses[statuses["status"] == "skipped"]
    name = runs["experiment"].iloc[0] if len(runs) else ""
    empty_cells = (0, "", *[np.nan] * 4, 0, 1, 0.0, 0.0, np.nan, np.nan)
    lines += [(name, tuner, "", *empty_cells) for tuner in skipped["tuner"]]
    return pd.DataFrame(lines, columns=ERROR_TABLE_COLUMNS)


def _summarise_over_targets(
    curves: RunCurves,
    rows: NDArray[np.int64],
    points: list[int],
    names: tuple[str, str, str],
) -> Array:
    """Compute median, mean, low and high over targets of the runs in `rows`.

    Returns:
        (4, len(points)) values.
    """
    _, groups = curves.select_mask(np.isin(np.arange(len(curves.used)), rows)).group_by_target()
    values = average_over_seeds(curves.values[rows][:, points], groups)
    low, high = compute_bootstrap_interval(values, compute_resampled_means, *names)
    with warnings.catch_warnings():
        # NumPy warns about columns of NaN alone; the result NaN is shown in the table.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.array([np.nanmedian(values, axis=0), np.nanmean(values, axis=0), low, high])


def compute_target_curves(curves: RunCurves, points: list[int]) -> pd.DataFrame:
    """Compute the mean over seeds for each target.

    Args:
        curves: values of the metric.
        points: numbers of simulations.

    Returns:
        Table with one row per target (sorted) and one column per number of simulations.
    """
    names, groups = curves.group_by_target()
    values = average_over_seeds(curves.values[:, points], groups)
    return pd.DataFrame(values, index=pd.Index(names, name="target"), columns=points)


def build_summary(
    table: pd.DataFrame, metric: str, kind: str, order: Sequence[str]
) -> pd.DataFrame:
    """Tabulate median errors by tuner and number of simulations.

    Args:
        table: rows of `build_error_table`.
        metric: name of the metric.
        kind: range of the targets.
        order: order of the tuners.

    Returns:
        Medians with one row per tuner and one column per number of simulations.
    """
    part = table[(table["metric"] == metric) & (table["range"] == kind)]
    medians = part.pivot(index="tuner", columns="simulations", values="median")
    return medians.reindex([tuner for tuner in order if tuner in medians.index])
