"""Error against number of simulations: of all runs, as tables, and as medians with intervals.

All statistics of a comparison start from the matrices of all runs (`RunCurves`).

A run that ended early counts with its last recommendation. A target's value is the mean over its
seeds. Median and mean are over targets, and `low`..`high` is a 95 % percentile-bootstrap interval
of the mean over targets (Efron & Tibshirani 1993, ch. 13). Seeds of one target are therefore not
counted as independent evidence.

Errors are given against the number of simulations and against the target's distance from the
training range. Rankings and paired tests use the logarithms of errors by target and tuner.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.statistics.bootstrap import (
    compute_bootstrap_interval,
    compute_resampled_means,
    compute_resampled_medians,
)
from bench.benchmark.storage.run_status import FAILED_STATUSES
from bench.benchmark.storage.table_schemas import ERROR_FLOOR, ERROR_METRICS
from sims.core.simulator import Array

MIN_ERROR = 1e-12
"""Errors below this value count as equal, because they consist of rounding."""
_FAILED_RUN_LOG_ERROR = 1e3
"""Logarithm that represents a failed run: larger than any error, and equal for all failures."""
RUN_KEY_COLUMNS = ["run", "experiment", "tuner", "range", "target", "seed"]
"""Columns that are equal in all rows of one run."""
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
_DISTANCE_CHECKPOINTS = (3, 10)
"""Numbers of simulations for plots of error against distance, in addition to the whole budget."""


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

    def select(self, **values: object) -> RunCurves:
        """Return the runs whose key columns have the given values."""
        mask = np.ones(len(self.keys), dtype=bool)
        for name, value in values.items():
            mask &= (self.keys[name] == value).to_numpy(dtype=bool)
        return self.select_mask(mask)

    def split_problems(self) -> Iterator[tuple[str, str, RunCurves]]:
        """Iterate over the experiments and ranges; yield both names and the runs there."""
        for (experiment, kind), _ in self.keys.groupby(["experiment", "range"], sort=False):
            yield str(experiment), str(kind), self.select(experiment=experiment, range=kind)

    def list_tuners(self) -> list[str]:
        """Return the tuner labels in the order of their first run."""
        return [str(t) for t in dict.fromkeys(self.keys["tuner"])]

    def group_by_target(self) -> tuple[list[str], list[NDArray[np.int64]]]:
        """Group the runs by target.

        Returns:
            Sorted names of the targets, and the row indices of each target.
        """
        # The code of a run is the position of its target in `names`.
        codes, names = pd.factorize(self.keys["target"], sort=True)
        group_ends = np.cumsum(np.bincount(codes, minlength=len(names)))
        groups = np.split(np.argsort(codes, kind="stable"), group_ends[:-1])
        # Without runs, `split` still returns one empty group.
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


class RunRowTable:
    """Table of runs.parquet, arranged once so that a matrix of any column can be built from it."""

    def __init__(self, runs: pd.DataFrame, statuses: pd.DataFrame, budget: int) -> None:
        """Assign a matrix row to every run, and a matrix column to every number of simulations k.

        The table has one row for each run and k. `_matrix_rows` and `_k` are the matrix row and
        column of each table row. For R runs: `keys` (R rows) has tuner, target and seed, `used`
        (R,) is the last k of each run, and `failed` (R,) marks runs with a failed status.

        Args:
            runs: rows with at least the columns `RUN_KEY_COLUMNS`, k and the metrics.
            statuses: rows of status.csv.
            budget: largest number of simulations that is used.
        """
        self._runs, self._budget = runs, budget
        # The matrices of all metrics use the same row and column indices.
        matrix_rows, names = pd.factorize(runs["run"])
        self._matrix_rows, self._k = matrix_rows, runs["k"].to_numpy(dtype=np.int64)
        # Table row at which each run begins. It is assigned in reverse order, so that the first row
        # of each run remains.
        first = np.zeros(len(names), dtype=np.int64)
        first[matrix_rows[::-1]] = np.arange(len(matrix_rows))[::-1]
        self.keys = (
            runs[[c for c in RUN_KEY_COLUMNS if c in runs]].iloc[first].reset_index(drop=True)
        )
        # The largest k among the table rows of each run.
        self.used = np.zeros(len(names), dtype=np.int64)
        np.maximum.at(self.used, matrix_rows, self._k)
        failed_runs = set(statuses.loc[statuses["status"].isin(FAILED_STATUSES), "run"])
        self.failed = self.keys["run"].isin(failed_runs).to_numpy(dtype=bool)

    def build_matrix(self, name: str) -> Array:
        """Arrange a column as a matrix of runs and numbers of simulations.

        Args:
            name: Column of the table, such as "param_error".

        Returns:
            (R, budget + 1) values; NaN after the end of a run.
        """
        values = np.full((len(self.keys), self._budget + 1), np.nan)
        is_within_budget = self._k <= self._budget
        column = self._runs[name].to_numpy(dtype=np.float64)
        rows, columns = self._matrix_rows[is_within_budget], self._k[is_within_budget]
        values[rows, columns] = column[is_within_budget]
        return values

    def build_curves(self, metric: str) -> RunCurves:
        """Build the curves of a metric; a run that ended early keeps its last value.

        Args:
            metric: column of the table, such as "param_error".
        """
        values = self.build_matrix(metric)
        # Matrix column from which each value is taken: k, or the last k of a run that has ended.
        last = np.minimum(self.used, self._budget)[:, None]
        columns = np.minimum(np.arange(self._budget + 1)[None], last)
        return RunCurves(
            self.keys, np.take_along_axis(values, columns, axis=1), self.used, self.failed
        )

    def build_cumulative_seconds(self, name: str) -> Array:
        """Compute the cumulative seconds of a column.

        Args:
            name: Column of the table with the seconds of each simulation, such as "tuner_seconds".

        Returns:
            (R, budget + 1) seconds summed over the simulations so far.
        """
        return np.nancumsum(self.build_matrix(name), axis=1)


def average_over_seeds(values: Array, groups: Sequence[NDArray[np.int64]]) -> Array:
    """Compute the mean over the runs of each target, which differ in their seeds, ignoring NaN.

    Args:
        values: (R, ...) one row per run.
        groups: row indices of each target.

    Returns:
        (targets, ...) means; NaN where all values of a target are NaN.
    """
    target_means = np.empty((len(groups), *values.shape[1:]))
    # Number of runs of each target.
    counts = np.array([len(run_rows) for run_rows in groups])
    with warnings.catch_warnings():
        # NumPy warns about the mean of NaN alone; the result NaN is intended.
        warnings.simplefilter("ignore", RuntimeWarning)
        # Targets with the same number of runs are averaged in one array operation.
        for count in np.unique(counts):
            target_indices = np.flatnonzero(counts == count).tolist()
            run_rows = np.array([groups[target] for target in target_indices])
            target_means[target_indices] = np.nanmean(values[run_rows], axis=1)
    return target_means


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

    Directions are combinations of parameters: the data determine stiff ones well, sloppy ones not.

    * If some target has sloppy directions, it is the error along stiff directions, because the data
      do not determine the others. A target without a stiff direction is then left out.
    * Otherwise it is the parameter error if the true parameters are known, else the error on
      held-out runs, else that on the fitted runs.

    Args:
        runs: rows of runs.parquet.
    """
    sloppy = "sloppy_error" in runs and runs["sloppy_error"].notna().any()
    if sloppy and runs["stiff_error"].notna().any():
        return PrimaryMetric("stiff_error", runs[runs["stiff_error"].notna()], in_widths=True)
    candidates: tuple[Any, ...] = ("param_error", "heldout_error", "obs_error")
    metric = next(str(m) for m in candidates if m in runs and runs[m].notna().any())
    return PrimaryMetric(metric, runs, metric == "param_error")


def build_log_error_table(curves: RunCurves, k: int = -1, floor: float = MIN_ERROR) -> pd.DataFrame:
    """Compute the logarithms of errors after k simulations, by target and tuner.

    The mean over seeds is taken first. A failure in one seed makes it infinite, so the tuner counts
    as failed on this target.

    Args:
        curves: error of every run.
        k: number of simulations; -1 for all.
        floor: errors below this value count as equal to it.

    Returns:
        Table with one row per target and one column per tuner.
    """
    columns = {}
    for tuner in curves.list_tuners():
        tuner_curves = curves.select(tuner=tuner)
        names, groups = tuner_curves.group_by_target()
        errors = average_over_seeds(tuner_curves.after(k), groups)
        columns[tuner] = pd.Series(compute_log_errors(errors, floor), index=names)
    return pd.DataFrame(columns)


def compute_log_errors(errors: Array, floor: float = MIN_ERROR) -> Array:
    """Return logarithms of errors (n,); errors below `floor` count as equal to it.

    An infinite error, as of a failed run, becomes a number that is larger than any error.

    Args:
        errors: (n,) errors.
        floor: smallest error that is distinguished.
    """
    logs: Array = np.where(
        np.isinf(errors), _FAILED_RUN_LOG_ERROR, np.log(np.maximum(errors, floor))
    )
    return logs


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

    There is one row per tuner, range, number of simulations and error measure: median, mean and
    interval over targets, counts of runs and failures, and training and tuning costs. A skipped
    tuner has one row without errors.

    Args:
        runs: rows of runs.parquet.
        statuses: rows of status.csv.
        budget: largest number of simulations in the table.
        trainings: simulations and seconds of one training, by tuner.

    Returns:
        Table with the columns `ERROR_TABLE_COLUMNS`. `fit_simulations` and `fit_seconds` are the
        costs of one training; `tuner_seconds` and `simulator_seconds` are the mean seconds of a run
        up to this number of simulations, NaN if `runs` has no times.
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
        is_part = rows.keys.index.isin(part.index)
        # Simulations and seconds of a training; zero for a tuner that is not trained.
        fit = (trainings or {}).get(str(tuner), (0.0, 0.0))
        # Mean seconds in the tuner and in the simulator, by number of simulations.
        tuner_seconds, simulator_seconds = (
            np.full(len(points), np.nan) if s is None else s[is_part][:, points].mean(axis=0)
            for s in spent_seconds
        )
        # Numbers of runs and of failed runs.
        counts = len(part), int(rows.failed[is_part].sum())
        for metric, curve in curves.items():
            values = _summarise_over_targets(
                curve.select_mask(is_part), points, (str(tuner), str(kind), metric)
            )
            for point_index, simulations in enumerate(points):
                errors = values[:, point_index]
                times = (tuner_seconds[point_index], simulator_seconds[point_index])
                key = (experiment, tuner, kind, simulations, metric)
                lines.append((*key, *errors, *counts, *fit, *times))
    # A tuner that could not be used has a row too, so that the table names every tuner.
    skipped = statuses[statuses["status"] == "skipped"]
    name = runs["experiment"].iloc[0] if len(runs) else ""
    # Columns from simulations on: no errors, 0 runs, 1 failure, no costs.
    empty_cells = (0, "", *[np.nan] * 4, 0, 1, 0.0, 0.0, np.nan, np.nan)
    lines += [(name, tuner, "", *empty_cells) for tuner in skipped["tuner"]]
    return pd.DataFrame(lines, columns=ERROR_TABLE_COLUMNS)


def _summarise_over_targets(
    curves: RunCurves, points: list[int], names: tuple[str, str, str]
) -> Array:
    """Compute median and mean over targets, and the bootstrap interval of the mean.

    The value of a target is the mean over its seeds.

    Args:
        curves: values of the runs.
        points: numbers of simulations.
        names: names that determine the stream of the bootstrap.

    Returns:
        (4, len(points)) values: median, mean, and lower and upper bound of the 95 % interval.
    """
    values = _get_values(compute_target_curves(curves, points))
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
    tables = []
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
        tables.append(pd.DataFrame(dict(zip(MEDIAN_COLUMNS, columns, strict=True))))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=MEDIAN_COLUMNS)


def compute_medians_by_distance(
    curves: RunCurves, distances: pd.Series[float], budget: int
) -> pd.DataFrame:
    """Compute median errors by distance from the training range, after few and all simulations.

    It shows how well learned tuners do on targets that differ from those of their training.
    Targets inside the training range are one group (bin 0). Those outside are sorted by distance
    and divided into at most `_MAX_GROUPS` groups of equal size.

    Args:
        curves: error of the runs in the range `wide`.
        distances: distance of each target from the training range in widths of this range, by
            target name; 0 inside.
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
            for group, names in groups.items():
                group_values = values.reindex(names).dropna().to_numpy()
                if len(group_values):
                    distance_limits = float(distances[names].min()), float(distances[names].max())
                    lines.append(
                        (
                            k,
                            tuner,
                            group,
                            *distance_limits,
                            len(names),
                            *_compute_median_with_interval(group_values, tuner, group),
                        )
                    )
    return pd.DataFrame(lines, columns=DISTANCE_COLUMNS)


def _get_values(frame: pd.DataFrame) -> Array:
    return frame.to_numpy(dtype=np.float64)


def _group_by_distance(distances: pd.Series[float]) -> dict[int, list[str]]:
    """Group targets by their distance from the training range.

    Group 0 has the targets inside; those outside are divided into at most `_MAX_GROUPS` groups of
    about equal size, the nearest first. Empty groups are left out.

    Args:
        distances: distance of each target, by target name; 0 inside the training range.

    Returns:
        Names of the targets by number of the group.
    """
    names_inside = list(distances.index[distances <= 0])
    names_outside = list(distances[distances > 0].sort_values(kind="stable").index)
    # As many groups of the minimum size as there are, but at least one.
    count = min(max(len(names_outside) // _MIN_GROUP_SIZE, 1), _MAX_GROUPS)
    parts = [list(part) for part in np.array_split(np.array(names_outside, dtype=object), count)]
    return {group: names for group, names in enumerate([names_inside, *parts]) if names}


def _compute_median_with_interval(
    values: Array, tuner: str, group: int
) -> tuple[float, float, float]:
    """Return the median of values (n,) with its interval; the interval of one value is NaN.

    Args:
        values: (n,) values of the targets.
        tuner: label of the tuner, which is part of the stream's name.
        group: number of the group of targets.
    """
    # The stream's name numbers the group inside the training range -1.
    names = ("distance", tuner, str(group - 1))
    low, high = compute_bootstrap_interval(
        values[:, None], compute_resampled_medians, *names, resamples=_BOOTSTRAP_RESAMPLES
    )
    return float(np.median(values)), float(low[0]), float(high[0])


def replace_unknown_errors(
    curves: RunCurves, has_used_budget: NDArray[np.bool_], budget: int
) -> Array:
    """Return the errors of runs, with NaN where they are unknown and infinity where a run failed.

    A run that has used up a smaller budget than the experiment's says nothing about more
    simulations. A run that stopped by itself keeps its last error.

    Args:
        curves: errors of R runs after 0 to K simulations.
        has_used_budget: (R,) True for a run that ended because its budget was used up.
        budget: number of simulations of the experiment; a tuner may have a smaller one.

    Returns:
        (R, K + 1) errors.
    """
    errors = curves.values.copy()
    has_smaller_budget = has_used_budget & (curves.used < budget)
    is_after_end = np.arange(errors.shape[1]) > curves.used[:, None]
    errors[has_smaller_budget[:, None] & is_after_end] = np.nan
    errors[curves.failed] = np.inf
    return errors
