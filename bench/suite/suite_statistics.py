"""Statistics of a benchmark suite over its cells: errors, running times, ranks, tests and profiles.

Sources: J. Demsar, Statistical comparisons of classifiers over multiple data sets, JMLR 7, 2006,
for ranks and signed-rank tests over problems; S. Holm, Scand. J. Statist. 6, 1979; N. Hansen et
al., Anytime performance assessment in blackbox optimization benchmarking, IEEE TEVC 26(6), 2022,
for expected running times.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.expected_running_time import (
    compute_effort,
    compute_percentile_interval,
    draw_target_resamples,
)
from bench.benchmark.statistics.paired_tests import (
    compare_pair,
    compute_log_errors,
    correct_holm,
)
from bench.core.random_streams import make_rng
from bench.suite.suite_runs import SuiteRuns
from sims.core.simulator import Array

CHECKPOINTS = (1, 3, 10, 30, 100)
"""Numbers of simulations after which tuners are compared."""
ERROR_LEVELS = (0.1, 0.01, 0.001)
"""Error levels of expected running times, in widths of the training range."""
MEASURED_LEVELS = (2.0, 1.1, 1.01)
"""Error levels for measured data, as multiples of the smallest median error of any tuner."""
TARGETS_SHARING_TRAINING = 10
"""Number of targets that share one training when its cost is counted."""
_RESAMPLE_COUNT = 2000
"""Number of bootstrap resamples of cells."""
ERROR_COLUMNS = ["cell", "tuner", "simulations", "median_error", "rank", "targets", "failures"]
RANK_COLUMNS = ["training", "simulations", "tuner", "mean_rank", "low", "high", "cells"]
PAIR_COLUMNS = [
    "training",
    "simulations",
    "best",
    "tuner",
    "cells",
    "best_better",
    "error_ratio",
    "p_value",
    "p_holm",
]
ERT_COLUMNS = [
    "cell",
    "tuner",
    "level",
    "threshold",
    "ert",
    "low",
    "high",
    "ert_with_training",
    "successes",
    "runs",
]
PROFILE_COLUMNS = ["property", "value", "simulations", "tuner", "mean_rank", "cells"]
FREE, COUNTED = "free", "counted"
"""Names of the two ways to count the cost of training: not at all, or shared by targets."""


@dataclass(frozen=True)
class SuiteTables:
    """Tables of a suite, each computed once.

    Attributes:
        suite: runs.
    """

    suite: SuiteRuns

    @cached_property
    def curves(self) -> dict[str, RunCurves]:
        """Error curves of each cell: the error of each run after 0, 1, 2, ... simulations.

        A cell is a problem with a range of targets, see `suite_runs`.
        """
        runs, curves_by_cell = self.suite.runs, {}
        for cell in self.suite.cells["cell"]:
            rows = (runs["cell"] == cell).to_numpy()
            keys = runs[rows].reset_index(drop=True)
            curves_by_cell[str(cell)] = RunCurves(
                keys,
                self.suite.errors[rows],
                keys["simulations"].to_numpy(dtype=np.int64),
                keys["failed"].to_numpy(dtype=bool),
            )
        return curves_by_cell

    @cached_property
    def floors(self) -> dict[str, float]:
        """Error of each cell below which tuners count as equal.

        For simulated targets it is the `negligible_error` of the experiment. For a recording, whose
        error cannot become zero, it is the smallest median error increased by that share.
        """
        floors = {}
        for row in self.suite.cells.itertuples():
            floor = float(row.negligible_error)  # type: ignore[arg-type]
            smallest = self._find_smallest_error(str(row.cell))
            measured = row.range == "real"
            floors[str(row.cell)] = (1.0 + floor) * smallest if measured else floor
        return floors

    def _find_smallest_error(self, cell: str) -> float:
        """Return the smallest median error of any tuner after all simulations.

        Args:
            cell: Name of the problem and range.
        """
        with np.errstate(invalid="ignore"):
            medians = [np.median(c.values[:, -1]) for c in self._tuner_curves[cell].values()]
        return min((float(m) for m in medians if np.isfinite(m)), default=0.0)

    @cached_property
    def checkpoints(self) -> tuple[int, ...]:
        """Numbers of simulations after which tuners are compared, within the budget."""
        return tuple(k for k in CHECKPOINTS if k <= self.suite.budget)

    def compute_log_errors(self, cell: str, k: int, training: str = FREE) -> pd.DataFrame:
        """Compute logarithms of errors after k simulations: a row per target, a column per tuner.

        With training counted, a trained tuner has k less its share of the training simulations, and
        no advance over the start before that. A regressor has its estimate of the parameters before
        any simulation of the target, but not before its training.

        Args:
            cell: name of the cell.
            k: number of simulations.
            training: `FREE` or `COUNTED`.
        """
        columns = {}
        for tuner, means in self._target_means[cell].items():
            share = self._get_training_share(cell, tuner) if training == COUNTED else 0.0
            target_means = means[max(int(k - share), 0)]
            if share > k:
                start_errors = self._start_errors[cell].reindex(target_means.index)
                target_means = start_errors.fillna(target_means)
            means_array: Array = np.asarray(target_means, dtype=np.float64)
            logs = compute_log_errors(means_array, self.floors[cell])
            columns[tuner] = pd.Series(logs, index=target_means.index)
        return pd.DataFrame(columns)

    @cached_property
    def _tuner_curves(self) -> dict[str, dict[str, RunCurves]]:
        """Curves of the runs of each tuner, by cell and tuner."""
        return {
            cell: {tuner: curves.select(tuner=tuner) for tuner in curves.list_tuners()}
            for cell, curves in self.curves.items()
        }

    @cached_property
    def _target_means(self) -> dict[str, dict[str, pd.DataFrame]]:
        """Mean errors over seeds, by cell and tuner.

        Each table has a row per target and a column per number of simulations.
        """
        return {
            cell: {
                tuner: pd.DataFrame(curves.values).groupby(curves.keys["target"]).mean()
                for tuner, curves in by_tuner.items()
            }
            for cell, by_tuner in self._tuner_curves.items()
        }

    @cached_property
    def _start_errors(self) -> dict[str, pd.Series[float]]:
        """Errors of the starts by target, for each cell: those of tuners without training.

        The start is the point at which a tuner begins, before any simulation of its own; trained
        tuners may begin elsewhere.
        """
        result = {}
        for cell, curves in self.curves.items():
            costs = {t: self._get_training_share(cell, t) for t in curves.list_tuners()}
            untrained = curves.keys["tuner"].map(costs) == 0.0
            errors = pd.Series(curves.values[untrained.to_numpy(), 0])
            targets = curves.keys.loc[untrained, "target"].reset_index(drop=True)
            result[cell] = errors.groupby(targets).min()
        return result

    def _get_training_share(self, cell: str, tuner: str) -> float:
        """Return a target's share of the training simulations of a tuner; 0 without training.

        Args:
            cell: name of the cell.
            tuner: label of the tuner.
        """
        return self._fit_simulations.get((cell, tuner), 0.0) / TARGETS_SHARING_TRAINING

    @cached_property
    def _fit_simulations(self) -> Mapping[tuple[str, str], float]:
        rows = self.suite.training.itertuples()
        return {(str(r.cell), str(r.tuner)): float(r.fit_simulations) for r in rows}  # type: ignore[arg-type]

    def get_trained_tuners(self) -> set[str]:
        """Return the tuners that need training simulations."""
        return {tuner for (_, tuner), cost in self._fit_simulations.items() if cost > 0}

    @cached_property
    def _median_log_errors(self) -> dict[tuple[str, int], pd.DataFrame]:
        """Median log errors over targets: a row per cell and a column per tuner.

        The key is (training, k): whether the simulations of a training are counted (COUNTED) or not
        (FREE), and the number of simulations.
        """
        errors_by_budget = {}
        for training in (FREE, COUNTED):
            for k in self.checkpoints:
                rows = {
                    cell: _compute_median_over_targets(self.compute_log_errors(cell, k, training))
                    for cell in self.curves
                }
                frame = pd.DataFrame(rows).T
                errors_by_budget[training, k] = frame[[t for t in self.suite.tuners if t in frame]]
        return errors_by_budget

    def get_medians(self, k: int, training: str = FREE) -> pd.DataFrame:
        """Return median log errors after k simulations: a row per cell, a column per tuner.

        Args:
            k: number of simulations.
            training: `FREE` or `COUNTED`.
        """
        return self._median_log_errors[training, k]

    def get_ranks(self, k: int) -> pd.DataFrame:
        """Rank the tuners in each cell; 1 is best, NaN where a tuner has no such run."""
        # Rounding gives errors that differ by the last bit the same rank.
        return self.get_medians(k).round(9).rank(axis=1)

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Median errors and ranks by cell, tuner and number of simulations.

        A cell is a problem with one range of targets. The columns are `ERROR_COLUMNS`.
        """
        lines = []
        for simulations in self.checkpoints:
            ranks = self.get_ranks(simulations)
            for cell, by_tuner in self._tuner_curves.items():
                for tuner, tuner_curves in by_tuner.items():
                    with np.errstate(invalid="ignore"):
                        median = float(np.median(tuner_curves.values[:, simulations]))
                    counts = tuner_curves.keys["target"].nunique(), int(tuner_curves.failed.sum())
                    lines.append((cell, tuner, simulations, median, ranks.at[cell, tuner], *counts))
        return pd.DataFrame(lines, columns=ERROR_COLUMNS)

    @cached_property
    def complete_tuners(self) -> list[str]:
        """Tuners with results in all cells at all checkpoints; only these are compared overall."""
        has_results = [self.get_medians(k).notna().all(axis=0) for k in self.checkpoints]
        return [t for t in self.suite.tuners if all(column.get(t, False) for column in has_results)]

    @cached_property
    def ranks(self) -> pd.DataFrame:
        """Mean ranks over cells with 95 % bootstrap intervals, best first.

        A cell is a problem with one range of targets. The cost of training is left out (FREE) or
        shared by the targets (COUNTED). The intervals come from resampled cells: they say how far
        the mean rank depends on the chosen problems. Only tuners with results in every cell are
        ranked.
        """
        lines = []
        for training in (FREE, COUNTED):
            for simulations in self.checkpoints:
                ranks = (
                    self.get_medians(simulations, training)[self.complete_tuners]
                    .round(9)
                    .rank(axis=1)
                )
                if ranks.empty:
                    continue
                rng = make_rng("suite ranks", simulations)
                resamples = rng.integers(len(ranks), size=(_RESAMPLE_COUNT, len(ranks)))
                for tuner, mean in ranks.mean().sort_values(kind="stable").items():
                    resampled = ranks[tuner].to_numpy()[resamples].mean(axis=1)
                    interval = compute_percentile_interval(resampled)
                    lines.append((training, simulations, tuner, mean, *interval, len(ranks)))
        return pd.DataFrame(lines, columns=RANK_COLUMNS)

    def find_best(self, k: int, training: str = FREE) -> str:
        """Return the tuner with the lowest mean rank after k simulations.

        Args:
            k: number of simulations.
            training: `FREE` or `COUNTED`.
        """
        rows = self.ranks
        rows = rows[(rows["training"] == training) & (rows["simulations"] == k)]
        return str(rows["tuner"].iloc[0])

    @cached_property
    def pairs(self) -> pd.DataFrame:
        """Test the best tuner against each other one over all cells.

        A cell is a problem with one range of targets. The test is Wilcoxon's signed-rank test of
        the median log errors, with Holm's correction for the number of tuners. One row per tuner,
        number of simulations, and with or without training cost.
        """
        lines = []
        for training in (FREE, COUNTED):
            for simulations in self.checkpoints:
                medians = self.get_medians(simulations, training)[self.complete_tuners]
                if medians.shape[1] < 2:
                    continue
                best = self.find_best(simulations, training)
                other_tuners = [tuner for tuner in medians if tuner != best]
                tests = {
                    t: compare_pair(medians[best].to_numpy(), medians[t].to_numpy())
                    for t in other_tuners
                }
                corrected = correct_holm(np.array([tests[t].p_value for t in other_tuners]))
                for tuner, p_holm in zip(other_tuners, corrected, strict=True):
                    test = tests[tuner]
                    values = test.targets, test.a_better, test.ratio, test.p_value, float(p_holm)
                    lines.append((training, simulations, best, tuner, *values))
        return pd.DataFrame(lines, columns=PAIR_COLUMNS)

    @cached_property
    def running_times(self) -> pd.DataFrame:
        """Compute expected running times to three error levels, also with the training's cost.

        The levels of a problem from recorded data are multiples of its smallest error, since its
        true parameters are unknown.
        """
        lines = []
        for row in self.suite.cells.itertuples():
            cell = str(row.cell)
            smallest = self._find_smallest_error(cell)
            levels = (
                [factor * smallest for factor in MEASURED_LEVELS]
                if row.range == "real"
                else list(ERROR_LEVELS)
            )
            for tuner, curves in self._tuner_curves[cell].items():
                share = self._get_training_share(cell, tuner)
                for number, threshold in enumerate(levels, 1):
                    lines.append(
                        (
                            cell,
                            tuner,
                            number,
                            threshold,
                            *self._compute_running_time(curves, threshold, share),
                        )
                    )
        return pd.DataFrame(lines, columns=ERT_COLUMNS)

    def _compute_running_time(
        self, curves: RunCurves, threshold: float, share: float
    ) -> tuple[float, ...]:
        """Compute the expected running time (ERT) to an error threshold, with interval and cost.

        Args:
            curves: errors of the runs of one tuner over the number of simulations.
            threshold: error to be reached.
            share: part of the training cost that falls on one target, in simulations.

        Returns:
            ERT, its 95 % interval (two numbers), ERT with training, successes and number of runs.
        """
        # Beyond the end of a smaller budget nothing is known.
        is_complete = ~np.isnan(curves.values).any(axis=1)
        budget = self.suite.budget if is_complete.all() else int(np.max(curves.used))
        effort = compute_effort(curves, threshold, budget)
        resamples = draw_target_resamples(len(effort.successes), "suite")
        low, high = compute_percentile_interval(effort.compute_ert(resamples))
        ert = float(effort.compute_ert())
        return ert, low, high, ert + share, int(effort.successes.sum()), effort.runs

    @cached_property
    def profile(self) -> pd.DataFrame:
        """Mean ranks by problem property: dimension, noise, range, misspecification and others.

        A row has the property and its value, the number of simulations, the tuner, its mean rank,
        and the number of cells.
        """
        lines = []
        groups = [
            (name, value, cells) for name, value, cells in self.list_properties() if len(cells)
        ]
        for simulations in self.checkpoints:
            ranks = self.get_medians(simulations)[self.complete_tuners].round(9).rank(axis=1)
            for name, value, cells in groups:
                for tuner, mean in ranks.loc[cells].mean().sort_values(kind="stable").items():
                    lines.append((name, value, simulations, tuner, mean, len(cells)))
        return pd.DataFrame(lines, columns=PROFILE_COLUMNS)

    def list_properties(self) -> Iterator[tuple[str, str, list[str]]]:
        """Yield each property of problems with one of its values, and the cells that have it.

        Cells are those of the tables: one problem with one range of targets each. The properties
        are the numbers of parameters, noise, range, simulator and data.
        """
        cells = self.suite.cells
        tags = cells["tags"].str.split(";")
        dimension = cells["parameters"].astype(int)
        kind = cells["range"]

        def list_cells(mask: pd.Series[bool]) -> list[str]:
            return [str(cell) for cell in cells.loc[mask, "cell"]]

        def find_tagged(tag: str) -> pd.Series[bool]:
            return tags.map(lambda words: tag in words).astype(bool)

        # Once explain has extended a simulator, nothing is missing any more.
        misspecified = find_tagged("misspecified") & (kind != "after")
        yield "parameters", "1", list_cells(dimension == 1)
        yield "parameters", "2 or 3", list_cells((dimension > 1) & (dimension <= 3))
        yield "parameters", "4 to 10", list_cells(dimension > 3)
        for tag in ("noise-free", "low-noise", "noisy"):
            yield "noise", tag, list_cells(find_tagged(tag))
        yield "range", "in range", list_cells(kind.isin(["in", "before", "after"]))
        yield "range", "wide", list_cells(kind == "wide")
        yield "simulator", "complete", list_cells(~misspecified & (kind != "real"))
        yield "simulator", "an effect is missing", list_cells(misspecified & (kind != "real"))
        yield "data", "measured", list_cells(kind == "real")
        yield "data", "robot from a model file", list_cells(find_tagged("robot"))

    def find_losses(self, tuner: str, k: int, factor: float = 3.0) -> pd.DataFrame:
        """Find the cells in which a tuner's error is larger than the best one's by a factor.

        Args:
            tuner: label of the tuner.
            k: number of simulations.
            factor: smallest ratio of the errors.

        Returns:
            Columns cell, winner and ratio; the largest ratio first.
        """
        medians = self.get_medians(k)
        if tuner not in medians:
            return pd.DataFrame(columns=["cell", "winner", "ratio"])
        lines = []
        smallest, winners = medians.min(axis=1), medians.idxmin(axis=1)
        excess = medians[tuner] - smallest
        for cell in medians.index[excess > np.log(factor)]:
            # exp(700) is close to the largest finite number.
            ratio = float(np.exp(min(float(excess[cell]), 700.0)))
            lines.append((str(cell), str(winners[cell]), ratio))
        frame = pd.DataFrame(lines, columns=["cell", "winner", "ratio"])
        return frame.sort_values("ratio", ascending=False, kind="stable", ignore_index=True)

    @cached_property
    def over_common_targets(self) -> SuiteTables:
        """Tables over the targets that every tuner of their cell ran.

        They compare slow tuners, which ran on some of the targets only, with the others. Without
        such tuners they are these tables.
        """
        runs = self.suite.runs
        tuner_counts = runs.groupby("cell")["tuner"].nunique()
        by_target = runs.groupby(["cell", "target"])["tuner"].transform("nunique")
        is_common = by_target == runs["cell"].map(tuner_counts)
        return self if is_common.all() else SuiteTables(self.suite.select(is_common))

    @property
    def has_partial_tuners(self) -> bool:
        """True if some tuners ran on some of the targets only."""
        return self.over_common_targets is not self

    @property
    def ranks_over_common_targets(self) -> pd.DataFrame:
        """Mean ranks over the targets that all tuners ran; empty if they ran on all targets."""
        return self.over_common_targets.ranks if self.has_partial_tuners else self.ranks.iloc[:0]

    def build_tables(self) -> dict[str, pd.DataFrame]:
        """Return all tables of the suite by name; the name is that of the CSV file."""
        return {
            "ranks_common_targets": self.ranks_over_common_targets,
            "errors": self.errors,
            "ranks": self.ranks,
            "pairs": self.pairs,
            "ert": self.running_times,
            "profile": self.profile,
        }


def _compute_median_over_targets(logs: pd.DataFrame) -> pd.Series[float]:
    """Return the median of each tuner; NaN where a target has no value."""
    values: Array = logs.to_numpy(dtype=np.float64)
    return pd.Series(np.median(values, axis=0), index=logs.columns)
