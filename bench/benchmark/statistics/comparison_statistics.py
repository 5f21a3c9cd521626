"""Compute the statistics of one comparison once each, and the tables that are made from them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.statistics.error_curves import (
    RunCurves,
    RunRowTable,
    build_error_table,
    compute_median_curves,
    compute_medians_by_distance,
    select_primary_metric,
)
from bench.benchmark.statistics.expected_running_time import (
    build_ert_table,
    build_runtime_table,
    select_thresholds,
)
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.training_amortisation import (
    TuningCost,
    TuningCosts,
    build_break_even_tables,
    build_fastest_tuner_table,
    compute_tuning_costs,
)
from bench.benchmark.statistics.tuner_ranking import (
    rank_after_budget,
    rank_tuners,
)
from bench.benchmark.storage.result_folder import StoredComparison

PRICED_LEVEL_COUNT = 3
"""Number of thresholds for which costs are computed, the loosest first.

Few tuners reach the tighter ones.
"""

REQUIRED_RUN_COLUMNS = (
    "run",
    "experiment",
    "tuner",
    "target",
    "seed",
    "range",
    "k",
    "param_error",
    "param_abs_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
    "outside",
    "tuner_seconds",
    "simulator_seconds",
)
"""Columns of the runs that tables and figures use."""


class ComparisonStatistics:
    """Statistics of one comparison: the deciding metric, rankings, medians and costs.

    Attributes:
        experiment: configuration of the comparison.
        metric: name of the deciding metric, see `select_primary_metric`.
        runs: runs that have the deciding metric.
        curves: deciding metric of every run.
        runtime_thresholds: thresholds of the runtime distribution.
        levels: thresholds of the tables.
        all_runs: all runs, including those without the deciding metric.
        floor: errors of the deciding metric below this value count as equal to it.
    """

    def __init__(self, stored: StoredComparison) -> None:
        """Select the deciding metric, its curves (errors by number of simulations) and thresholds.

        Other statistics are computed when they are used. `floor` is the error below which tuners
        count as equal. `_curves` and `_medians` cache the results of other metrics by name.

        Args:
            stored: the stored comparison; it has at least one run.
        """
        self.metric, self.runs, in_widths = select_primary_metric(stored.runs)
        self._statuses, self._costs = stored.statuses, stored.costs
        self.experiment, self._budget = stored.experiment, stored.experiment.budget
        self._rows = self._make_run_rows(self.runs)
        self.curves = self._rows.build_curves(self.metric)
        self.runtime_thresholds, self.levels = select_thresholds(self.curves, in_widths)
        self.floor = stored.experiment.negligible_error
        if not in_widths:
            # A recording has errors that no parameters could remove, so tuners that are close to
            # the smallest median error count as equal. The
            # experiment's negligible error is then a share of this smallest one.
            self.floor = (1.0 + self.floor) * _find_lowest_median(self.curves)
        self.all_runs = stored.runs
        self._curves: dict[str, RunCurves] = {}
        self._medians: dict[tuple[str, str], pd.DataFrame] = {}

    def select_range(self, kind: str) -> pd.DataFrame:
        """Return all rows of a range."""
        return self.all_runs[self.all_runs["range"] == kind]

    @cached_property
    def target_counts(self) -> dict[str, int]:
        """Number of targets of each range that has runs."""
        counts = self.all_runs.groupby("range", sort=False)["target"].nunique()
        return {str(kind): int(count) for kind, count in counts.items()}

    @cached_property
    def ranking(self) -> pd.DataFrame:
        """Ranks of the tuners in each range; see `tuner_ranking.rank_tuners`."""
        return rank_tuners(self.curves, self._budget, self.floor)

    @cached_property
    def order(self) -> list[str]:
        """Tuners ranked over all ranges, the best first; the order of legends.

        Tuners without a run that has the deciding metric come last.
        """
        order = rank_after_budget(self.curves, self._budget, self.floor)
        return [*order, *(t for t in self._all_runs.keys["tuner"].unique() if t not in order)]

    def order_in(self, kind: str) -> list[str]:
        """Return the tuners of one range after all simulations, the best first."""
        last = self.ranking[self.ranking["simulations"] == self._budget]
        ranked = list(last.loc[last["range"] == kind, "tuner"])
        return [*ranked, *(t for t in self.order if t not in ranked)]

    def sort_rows(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Sort the rows of a table range by range, and in each range the best tuner first.

        Rows of tuners that could not be used, which have no range, come last.

        Args:
            frame: Table with the columns `range` and `tuner`.

        Returns:
            The sorted table with a new index.
        """
        kinds = [str(kind) for kind in dict.fromkeys(self._all_runs.keys["range"])]
        order = [(kind, tuner) for kind in kinds for tuner in self.order_in(kind)]
        position_of_key = {key: position for position, key in enumerate(order)}
        keys = [
            position_of_key.get(key, len(position_of_key))
            for key in zip(frame["range"], frame["tuner"], strict=True)
        ]
        return frame.iloc[np.argsort(keys, kind="stable")].reset_index(drop=True)

    @cached_property
    def notes(self) -> dict[str, str]:
        """Notes of legends and tables about tuners with failed runs, by tuner label.

        Tuners without failed runs have no entry.
        """
        failed = pd.Series(self._all_runs.failed).groupby(self._all_runs.keys["tuner"], sort=False)
        return {
            str(tuner): "all runs failed"
            if is_failed.all()
            else f"{is_failed.sum()} of {len(is_failed)} runs failed"
            for tuner, is_failed in failed
            if is_failed.any()
        }

    def get_error_floor(self, metric: str) -> float | None:
        """Return the error below which tuners count as equal, in the unit of a metric.

        The absolute error of a single parameter (`param_abs_error`) is its relative error
        (`param_error`) in another unit, so it decides too if the relative error does.

        Args:
            metric: name of the metric.

        Returns:
            Error; None for a metric that does not decide the comparison.
        """
        if metric == self.metric:
            return self.floor
        is_same_error = self.metric == "param_error" and metric == "param_abs_error"
        return self.floor * self.unit if is_same_error else None

    def format_label(self, tuner: str) -> str:
        """Return the tuner's name, with its number of failed runs if there are any."""
        return f"{tuner} [{self.notes[tuner]}]" if tuner in self.notes else tuner

    @cached_property
    def unit(self) -> float:
        """Factor that converts the floor and the medians to the unit of the single parameter.

        They are in widths of the training range, so the factor is this width. It is 1
        if there are several parameters, or none whose true value is known.
        """
        if self.metric != "param_error" or "param_abs_error" not in self.runs:
            return 1.0
        # The absolute error is the relative error times the width of the training range.
        largest = float(self.runs["param_error"].max())
        return float(self.runs["param_abs_error"].max()) / largest if largest > 0 else 1.0

    def compute_median_curves(self, metric: str, kind: str) -> pd.DataFrame:
        """Return medians of a metric against simulations in a range, of the runs that have it.

        See `bench.benchmark.statistics.error_curves.compute_median_curves`.

        Args:
            metric: name of the metric.
            kind: range of the targets.
        """
        key = metric, kind
        if key not in self._medians:
            curves = self._get_curves_of_all_runs(metric).select(range=kind)
            self._medians[key] = compute_median_curves(curves, metric, self._budget)
        return self._medians[key]

    def _get_curves_of_all_runs(self, metric: str) -> RunCurves:
        """Return the curves of a metric for all runs that have it, from a cache if possible."""
        if metric not in self._curves:
            has_metric = self.all_runs[metric].notna()
            rows = (
                self._all_runs
                if has_metric.all()
                else self._make_run_rows(self.all_runs[has_metric])
            )
            self._curves[metric] = rows.build_curves(metric)
        return self._curves[metric]

    @cached_property
    def _all_runs(self) -> RunRowTable:
        """Table of all runs; equal to the table of the deciding runs if these are all runs."""
        is_complete = len(self.runs) == len(self.all_runs)
        return self._rows if is_complete else self._make_run_rows(self.all_runs)

    def _make_run_rows(self, runs: pd.DataFrame) -> RunRowTable:
        return RunRowTable(runs, self._statuses, self._budget)

    @property
    def parameter_error_metric(self) -> str:
        """Name of the parameter error: absolute for one parameter, else in training widths."""
        return "param_abs_error" if "param_abs_error" in self.all_runs else "param_error"

    @cached_property
    def medians_by_distance(self) -> pd.DataFrame:
        """Errors by distance from the training range, for targets of the range `wide`.

        See `error_curves.compute_medians_by_distance`.
        """
        # All rows of a target have the same distance, so the first one is used.
        wide_targets = self.select_range("wide").drop_duplicates("target").set_index("target")
        distances = wide_targets["outside"].sort_index()
        curves = self._get_curves_of_all_runs(self.parameter_error_metric).select(range="wide")
        return compute_medians_by_distance(curves, distances, self._budget)

    @cached_property
    def runtime_distribution(self) -> pd.DataFrame:
        """Runtime distribution of every range; see `expected_running_time.build_runtime_table`."""
        return build_runtime_table(self.curves, self.runtime_thresholds)

    @cached_property
    def running_times(self) -> pd.DataFrame:
        """Expected running times of every range; see `expected_running_time.build_ert_table`."""
        return build_ert_table(self.curves, self.levels, self._budget)

    @cached_property
    def tuning_costs(self) -> TuningCosts:
        """Cost of every tuner by threshold (the first `PRICED_LEVEL_COUNT`), by range, by tuner."""
        return {
            level: self._compute_tuning_costs(level) for level in self.levels[:PRICED_LEVEL_COUNT]
        }

    def _compute_tuning_costs(self, level: float) -> dict[str, dict[str, TuningCost]]:
        """Compute what each tuner costs to reach an error threshold.

        Costs are the simulations, the seconds in the tuner and in the simulator, and the training.

        Args:
            level: error threshold of the deciding metric.

        Returns:
            Cost by range, and then by tuner.
        """
        in_tuner = self._rows.build_cumulative_seconds("tuner_seconds")
        in_simulator = self._rows.build_cumulative_seconds("simulator_seconds")
        ranges = self.curves.keys["range"]
        costs_by_range = {}
        for kind in dict.fromkeys(ranges):
            mask = (ranges == kind).to_numpy(dtype=bool)
            costs_by_range[str(kind)] = compute_tuning_costs(
                self.curves.select_mask(mask),
                level,
                self._budget,
                in_tuner[mask],
                in_simulator[mask],
                self._costs,
            )
        return costs_by_range

    @cached_property
    def reference_level(self) -> float:
        """Tightest threshold that at least half of the tuners reach in every range.

        It is the loosest threshold if there is no such threshold.
        """
        for level in sorted(self.tuning_costs):
            if all(_is_reached_by_half(by_tuner) for by_tuner in self.tuning_costs[level].values()):
                return level
        return max(self.tuning_costs)


def _find_lowest_median(curves: RunCurves) -> float:
    """Return the smallest median final error of any tuner; 0 if every run failed."""
    medians = [
        float(np.median(curves.select(tuner=t).compute_final_values()))
        for t in curves.list_tuners()
    ]
    return min((m for m in medians if np.isfinite(m)), default=0.0)


def _is_reached_by_half(by_tuner: Mapping[str, TuningCost]) -> bool:
    reaching = sum(np.isfinite(price.effort.compute_ert()) for price in by_tuner.values())
    return bool(2 * reaching >= len(by_tuner))


def add_trust_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `trusted`, True if the tuners ran without isolation.

    Args:
        frame: any table of the comparison.
        experiment: configuration of the experiment.
    """
    return frame.assign(trusted=experiment.trusted)


def add_salt_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `salt`: ``secret`` if the salt is committed by a hash, else ``public``.

    Args:
        frame: any table of the comparison.
        experiment: configuration of the experiment.
    """
    return frame.assign(salt="secret" if experiment.salt_sha256 else "public")


def build_tables(
    stored: StoredComparison, statistics: ComparisonStatistics | None = None
) -> dict[str, pd.DataFrame]:
    """Build the tables of a comparison: table, ert, ranking, pairs, break_even and who_wins.

    Args:
        stored: stored comparison, from `bench.benchmark.storage.result_folder.read_comparison`.
        statistics: statistics of the comparison; None to compute them.

    Returns:
        Tables by name; no table without a run. ``table`` has the errors, ``ert`` the expected
        running times, ``pairs`` the tests of all pairs of tuners, ``break_even`` the numbers of
        targets from which a training pays, ``who_wins`` the fastest tuners.
    """
    if stored.runs.empty:
        return {}
    experiment = stored.experiment
    statistics = statistics or ComparisonStatistics(stored)
    lines = build_error_table(stored.runs, stored.statuses, experiment.budget, stored.costs)
    frames = {
        "table": statistics.sort_rows(add_salt_column(lines, experiment)),
        "ert": statistics.sort_rows(statistics.running_times),
        "ranking": statistics.ranking,
        "pairs": compare_all_pairs(statistics.curves, statistics.floor),
        "break_even": build_break_even_tables(experiment.name, statistics.tuning_costs),
        "who_wins": build_fastest_tuner_table(experiment.name, statistics.tuning_costs),
    }
    return {name: add_trust_column(frame, experiment) for name, frame in frames.items()}
