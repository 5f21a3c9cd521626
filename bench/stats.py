"""Error against number of simulations: the table of a comparison.

A run that ended early counts with its last recommendation. A target's value is the mean over its seeds; median and
mean are over targets, and `low`..`high` is a 95 % percentile-bootstrap interval of the mean over targets (Efron &
Tibshirani 1993, ch. 13), so that seeds of one target are not taken for independent evidence.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from bench.seeds import rng_for
from methods.base import Array

CHECKPOINTS = (0, 1, 2, 3, 5, 10, 20, 50, 100)
METRICS = ("param_abs_error", "param_error", "obs_error", "heldout_error")
FAILURES = ("crashed", "timeout", "diverged", "skipped")
COLUMNS = [
    "experiment", "tuner", "range", "simulations", "metric", "median", "mean", "low", "high",
    "runs", "failures", "fit_simulations", "fit_seconds",
]  # fmt: skip


def checkpoints(budget: int) -> list[int]:
    """The standard numbers of simulations up to the budget, and the budget itself."""
    return sorted({k for k in CHECKPOINTS if k <= budget} | {budget})


def table(
    runs: pd.DataFrame,
    statuses: pd.DataFrame,
    budget: int,
    trainings: Mapping[str, tuple[float, float]] | None = None,
    resamples: int = 2000,
) -> pd.DataFrame:
    """The table of a comparison in long form, columns as `COLUMNS`.

    Args:
        runs: rows of runs.parquet.
        statuses: rows of status.csv.
        budget: largest number of simulations to report.
        trainings: simulations and seconds of one training, by tuner.
        resamples: bootstrap resamples.
    """
    points = checkpoints(budget)
    failed = statuses[statuses["status"].isin(FAILURES)].groupby("run").size()
    lines = []
    metrics = [m for m in METRICS if m in runs and runs[m].notna().any()]
    for (experiment, tuner, kind), group in runs.groupby(["experiment", "tuner", "range"], sort=False):
        names = group["run"].unique()
        fit = (trainings or {}).get(str(tuner), (0.0, 0.0))
        for metric in metrics:
            curves = target_curves(group, metric, points).to_numpy(dtype=np.float64)
            low, high = interval(curves, np.mean, str(tuner), str(kind), metric, resamples=resamples)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # a column of failures alone has no mean: NaN, shown
                median, mean = np.nanmedian(curves, axis=0), np.nanmean(curves, axis=0)
            for i, k in enumerate(points):
                values = (median[i], mean[i], low[i], high[i], len(names), int(failed.reindex(names).sum()), *fit)
                lines.append((experiment, tuner, kind, k, metric, *values))
    skipped = statuses[statuses["status"] == "skipped"]
    nothing = (0, "", *[np.nan] * 4, 0, 1, 0.0, 0.0)
    lines += [(runs["experiment"].iloc[0] if len(runs) else "", t, "", *nothing) for t in skipped["tuner"]]
    return pd.DataFrame(lines, columns=COLUMNS)


def run_curves(runs: pd.DataFrame, metric: str, points: list[int]) -> pd.DataFrame:
    """One row a run (index target, run), one column for each of `points`: the metric after so many simulations."""
    wide = runs.pivot(index=["target", "run"], columns="k", values=metric)
    return wide.reindex(columns=range(max(points) + 1)).ffill(axis=1)[points]


def target_curves(runs: pd.DataFrame, metric: str, points: list[int]) -> pd.DataFrame:
    """One row a target (sorted), one column for each of `points`: the mean over the seeds of its runs."""
    return run_curves(runs, metric, points).groupby(level="target").mean()


def interval(values: Array, statistic: Callable[..., Any], *names: str, resamples: int = 2000) -> tuple[Array, Array]:
    """95 % percentile-bootstrap interval of a statistic over rows of `values` (n, m); NaN for fewer than two rows.

    Args:
        values: what was measured, one row a target.
        statistic: np.mean or np.median.
        names: what the resampling's random stream depends on.
        resamples: number of resamples.
    """
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return np.full(values.shape[1], np.nan), np.full(values.shape[1], np.nan)
    from scipy.stats import bootstrap

    rng = rng_for("bootstrap", *names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a constant column: the interval is that constant
        found = bootstrap((values,), statistic, n_resamples=resamples, method="percentile", vectorized=True, rng=rng)
    return np.asarray(found.confidence_interval.low), np.asarray(found.confidence_interval.high)


def summary(table: pd.DataFrame, metric: str, kind: str) -> pd.DataFrame:
    """Mean error by tuner (rows) and number of simulations (columns), best last column first."""
    part = table[(table["metric"] == metric) & (table["range"] == kind)]
    means = part.pivot(index="tuner", columns="simulations", values="mean")
    return means.sort_values(by=means.columns[-1])
