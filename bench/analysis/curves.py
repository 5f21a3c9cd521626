"""Runs as one matrix: a row a run, a column for each number of simulations; what all statistics
start from.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.store.status import FAILED
from sims.base import Array


@dataclass(frozen=True)
class Curves:
    """One metric of all runs.

    Attributes:
        keys: a row a run: run, experiment, tuner, range, target, seed.
        values: (R, K + 1) the metric after k simulations; a run that ended early keeps its last
            value.
        used: (R,) simulations that each run made.
        failed: (R,) whether it crashed, timed out or diverged.
    """

    keys: pd.DataFrame
    values: Array
    used: NDArray[np.int64]
    failed: NDArray[np.bool_]

    def where(self, mask: NDArray[np.bool_]) -> Curves:
        """The runs for which `mask` (R,) holds."""
        return Curves(
            self.keys[mask].reset_index(drop=True),
            self.values[mask],
            self.used[mask],
            self.failed[mask],
        )

    def of(self, **values: str) -> Curves:
        """The runs whose keys have these values."""
        mask = np.ones(len(self.keys), dtype=bool)
        for name, value in values.items():
            mask &= (self.keys[name] == value).to_numpy(dtype=bool)
        return self.where(mask)

    def tuners(self) -> list[str]:
        """Labels in the order in which they first come."""
        return [str(t) for t in dict.fromkeys(self.keys["tuner"])]

    def by_target(self) -> tuple[list[str], list[NDArray[np.int64]]]:
        """Names of the targets, sorted, and the rows of each."""
        codes, names = pd.factorize(self.keys["target"], sort=True)
        ends = np.cumsum(np.bincount(codes, minlength=len(names)))
        groups = np.split(np.argsort(codes, kind="stable"), ends[:-1])
        return [str(n) for n in names], groups[: len(names)]

    def after(self, k: int) -> Array:
        """(R,) the metric after k simulations; infinite for a run that failed, now or later: what
        it recommended cannot be trusted.
        """
        values = self.values[:, k]
        return np.where(self.failed | np.isnan(values), np.inf, values)

    def final(self) -> Array:
        """(R,) the metric after all simulations, see `after`."""
        return self.after(-1)


KEYS = ["run", "experiment", "tuner", "range", "target", "seed"]
"""Columns that are the same in every row of a run."""


class Rows:
    """Rows of runs.parquet, laid out once for every metric that is asked for.

    Args:
        runs: at least `KEYS`, k and the metrics.
        statuses: rows of status.csv.
        budget: largest number of simulations of interest.
    """

    def __init__(self, runs: pd.DataFrame, statuses: pd.DataFrame, budget: int) -> None:
        self._runs, self._budget = runs, budget
        # Every metric fills a matrix by the same places: they are worked out once.
        codes, names = pd.factorize(runs["run"])
        self._codes, self._k = codes, runs["k"].to_numpy(dtype=np.int64)
        # Written from behind, so that what stays is the place of each run's first row.
        first = np.zeros(len(names), dtype=np.int64)
        first[codes[::-1]] = np.arange(len(codes))[::-1]
        self.keys = runs[[k for k in KEYS if k in runs]].iloc[first].reset_index(drop=True)
        self.used = np.zeros(len(names), dtype=np.int64)
        np.maximum.at(self.used, codes, self._k)
        bad = set(statuses.loc[statuses["status"].isin(FAILED), "run"])
        self.failed = self.keys["run"].isin(bad).to_numpy(dtype=bool)

    def matrix(self, name: str) -> Array:
        """(R, budget + 1) a column of the rows, run by run; NaN behind the end of a run."""
        values = np.full((len(self.keys), self._budget + 1), np.nan)
        within = self._k <= self._budget
        column = self._runs[name].to_numpy(dtype=np.float64)
        values[self._codes[within], self._k[within]] = column[within]
        return values

    def curves(self, metric: str) -> Curves:
        """A metric after k simulations; a run that ended early keeps its last value."""
        values = self.matrix(metric)
        # Behind its end a run stands by its last recommendation.
        last = np.minimum(self.used, self._budget)[:, None]
        columns = np.minimum(np.arange(self._budget + 1)[None], last)
        return Curves(
            self.keys, np.take_along_axis(values, columns, axis=1), self.used, self.failed
        )

    def spent(self, name: str) -> Array:
        """(R, budget + 1) a column of seconds, added up over the simulations so far."""
        return np.nancumsum(self.matrix(name), axis=1)


def mean_over_seeds(values: Array, groups: Sequence[NDArray[np.int64]]) -> Array:
    """(targets, ...) the mean of each target's rows of `values` (R, ...), without those that are
    NaN.
    """
    result = np.empty((len(groups), *values.shape[1:]))
    counts = np.array([len(rows) for rows in groups])
    with warnings.catch_warnings():
        # Nothing but NaN has no mean: NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        # Targets with as many seeds are laid side by side.
        for count in np.unique(counts):
            places = np.flatnonzero(counts == count).tolist()
            rows = np.array([groups[place] for place in places])
            result[places] = np.nanmean(values[rows], axis=1)
    return result


class Decisive(NamedTuple):
    """What decides a comparison: a metric, the runs that have it, and whether it counts in training
    widths.
    """

    metric: str
    runs: pd.DataFrame
    in_widths: bool


def primary(runs: pd.DataFrame) -> Decisive:
    """The metric that decides: the parameters' error where the truth is known, else the error on
    held-out runs.

    Where some target's data leave a direction sloppy, it is the error along stiff directions:
    nobody could know the others. A target without a stiff direction then decides nothing.
    """
    sloppy = "sloppy_error" in runs and runs["sloppy_error"].notna().any()
    if sloppy and runs["stiff_error"].notna().any():
        return Decisive("stiff_error", runs[runs["stiff_error"].notna()], in_widths=True)
    candidates: tuple[Any, ...] = ("param_error", "heldout_error", "obs_error")
    metric = next(str(m) for m in candidates if m in runs and runs[m].notna().any())
    return Decisive(metric, runs, metric == "param_error")
