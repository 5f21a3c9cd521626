"""Results of all runs as matrices, with a row per run and a column per number of simulations.

All statistics of a comparison start from these matrices.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.storage.run_status import FAILED_STATUSES
from sims.core.simulator import Array


@dataclass(frozen=True)
class RunCurves:
    """Values of one metric for all runs.

    Attributes:
        keys: one row per run with the columns run, experiment, tuner, range, target and seed.
        values: (R, K + 1) metric after k simulations; a run that ended early keeps its last value.
        used: (R,) number of simulations of each run.
        failed: (R,) True for a run that crashed, timed out or diverged.
    """

    keys: pd.DataFrame
    values: Array
    used: NDArray[np.int64]
    failed: NDArray[np.bool_]

    def select_mask(self, mask: NDArray[np.bool_]) -> RunCurves:
        """Return the runs selected by a boolean mask (R,)."""
        return RunCurves(
            self.keys[mask].reset_index(drop=True),
            self.values[mask],
            self.used[mask],
            self.failed[mask],
        )

    def select(self, **values: str) -> RunCurves:
        """Return the runs whose key columns have the given values."""
        mask = np.ones(len(self.keys), dtype=bool)
        for name, value in values.items():
            mask &= (self.keys[name] == value).to_numpy(dtype=bool)
        return self.select_mask(mask)

    def list_tuners(self) -> list[str]:
        """Return the tuner labels in the order of their first run."""
        return [str(t) for t in dict.fromkeys(self.keys["tuner"])]

    def group_by_target(self) -> tuple[list[str], list[NDArray[np.int64]]]:
        """Group the runs by target.

        Returns:
            Sorted names of the targets, and the row indices of each target.
        """
        codes, names = pd.factorize(self.keys["target"], sort=True)
        group_ends = np.cumsum(np.bincount(codes, minlength=len(names)))
        groups = np.split(np.argsort(codes, kind="stable"), group_ends[:-1])
        return [str(n) for n in names], groups[: len(names)]

    def after(self, k: int) -> Array:
        """Return the metric after k simulations, shape (R,).

        A failed run has an infinite value at every k, because its recommendations cannot be
        trusted.
        """
        values = self.values[:, k]
        return np.where(self.failed | np.isnan(values), np.inf, values)

    def compute_final_values(self) -> Array:
        """Return the metric after all simulations, shape (R,); see `after`."""
        return self.after(-1)


RUN_KEY_COLUMNS = ["run", "experiment", "tuner", "range", "target", "seed"]
"""Columns that are equal in all rows of one run."""


class RunRowTable:
    """Table of runs.parquet, arranged once so that a matrix of any column can be built from it.

    Args:
        runs: rows with at least the columns `RUN_KEY_COLUMNS`, k and the metrics.
        statuses: rows of status.csv.
        budget: largest number of simulations that is used.
    """

    def __init__(self, runs: pd.DataFrame, statuses: pd.DataFrame, budget: int) -> None:
        """Assign a matrix row to every run, and a matrix column to every number of simulations k.

        For R runs: `_codes` is the matrix row of each table row, `keys` (R rows) has tuner, target
        and seed, `used` (R,) is the last k of each run, and `failed` (R,) marks runs with a failed
        status.
        """
        self._runs, self._budget = runs, budget
        # The matrices of all metrics use the same row and column indices.
        codes, names = pd.factorize(runs["run"])
        self._codes, self._k = codes, runs["k"].to_numpy(dtype=np.int64)
        # The assignment runs in reverse order, so that the first row of each run remains.
        first = np.zeros(len(names), dtype=np.int64)
        first[codes[::-1]] = np.arange(len(codes))[::-1]
        self.keys = (
            runs[[k for k in RUN_KEY_COLUMNS if k in runs]].iloc[first].reset_index(drop=True)
        )
        self.used = np.zeros(len(names), dtype=np.int64)
        np.maximum.at(self.used, codes, self._k)
        failed_runs = set(statuses.loc[statuses["status"].isin(FAILED_STATUSES), "run"])
        self.failed = self.keys["run"].isin(failed_runs).to_numpy(dtype=bool)

    def build_matrix(self, name: str) -> Array:
        """Arrange a column as a matrix of runs and numbers of simulations.

        Returns:
            (R, budget + 1) values; NaN after the end of a run.
        """
        values = np.full((len(self.keys), self._budget + 1), np.nan)
        is_within_budget = self._k <= self._budget
        column = self._runs[name].to_numpy(dtype=np.float64)
        values[self._codes[is_within_budget], self._k[is_within_budget]] = column[is_within_budget]
        return values

    def build_curves(self, metric: str) -> RunCurves:
        """Build the curves of a metric; a run that ended early keeps its last value."""
        values = self.build_matrix(metric)
        # After the end of a run, its last recommendation is used.
        last = np.minimum(self.used, self._budget)[:, None]
        columns = np.minimum(np.arange(self._budget + 1)[None], last)
        return RunCurves(
            self.keys, np.take_along_axis(values, columns, axis=1), self.used, self.failed
        )

    def build_cumulative_seconds(self, name: str) -> Array:
        """Compute the cumulative seconds of a column.

        Returns:
            (R, budget + 1) seconds summed over the simulations so far.
        """
        return np.nancumsum(self.build_matrix(name), axis=1)


def average_over_seeds(values: Array, groups: Sequence[NDArray[np.int64]]) -> Array:
    """Compute the mean of each target's rows, ignoring NaN.

    Args:
        values: (R, ...) one row per run.
        groups: row indices of each target.

    Returns:
        (targets, ...) means; NaN where all values of a target are NaN.
    """
    result = np.empty((len(groups), *values.shape[1:]))
    counts = np.array([len(rows) for rows in groups])
    with warnings.catch_warnings():
        # NumPy warns about the mean of NaN alone; the result NaN is intended.
        warnings.simplefilter("ignore", RuntimeWarning)
        # Targets with the same number of seeds are averaged in one array operation.
        for count in np.unique(counts):
            target_indices = np.flatnonzero(counts == count).tolist()
            rows = np.array([groups[target] for target in target_indices])
            result[target_indices] = np.nanmean(values[rows], axis=1)
    return result


class PrimaryMetric(NamedTuple):
    """Metric that decides a comparison.

    Attributes:
        metric: column name of the metric.
        runs: runs that have a value of the metric.
        in_widths: True if the metric is measured in widths of the training range.
    """

    metric: str
    runs: pd.DataFrame
    in_widths: bool


def select_primary_metric(runs: pd.DataFrame) -> PrimaryMetric:
    """Select the metric that decides a comparison.

    It is the parameter error if the true parameters are known, otherwise the error on held-out
    runs. If some target has sloppy directions, it is the error along stiff directions, because the
    data do not determine the others. A target without a stiff direction is then left out.
    """
    sloppy = "sloppy_error" in runs and runs["sloppy_error"].notna().any()
    if sloppy and runs["stiff_error"].notna().any():
        return PrimaryMetric("stiff_error", runs[runs["stiff_error"].notna()], in_widths=True)
    candidates: tuple[Any, ...] = ("param_error", "heldout_error", "obs_error")
    metric = next(str(m) for m in candidates if m in runs and runs[m].notna().any())
    return PrimaryMetric(metric, runs, metric == "param_error")
