"""Statistics of a benchmark suite over its cells: errors, running times, ranks, tests and profiles.

Sources: J. Demsar, Statistical comparisons of classifiers over multiple data sets, JMLR 7, 2006,
for ranks and signed-rank tests over problems; S. Holm, Scand. J. Statist. 6, 1979; N. Hansen et
al., Anytime performance assessment in blackbox optimization benchmarking, IEEE TEVC 26(6), 2022,
for expected running times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from bench.benchmark.statistics.bootstrap import compute_percentile_interval, draw_target_resamples
from bench.benchmark.statistics.error_curves import RunCurves, compute_log_errors
from bench.benchmark.statistics.expected_running_time import compute_effort
from bench.benchmark.statistics.paired_tests import compare_pair, correct_holm
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
FREE, COUNTED = "free", "counted"
"""Names of the two ways to count the cost of training: not at all, or shared by targets."""


@dataclass(frozen=True)
class SuiteTables:
    """Tables of a suite, each computed once.

    A cell is a problem with one range of targets, see `suite_runs`. The cost of training is left
    out (`FREE`), or shared by the targets (`COUNTED`).

    Attributes:
        suite: runs.
    """

    suite: SuiteRuns

    @cached_property
    def curves(self) -> dict[str, dict[str, RunCurves]]:
        """Error curves of the runs of each tuner, by cell (problem and range) and tuner."""
        curves: dict[str, dict[str, RunCurves]] = {str(c): {} for c in self.suite.cells["cell"]}
        for (cell, tuner), keys in self.suite.runs.groupby(["cell", "tuner"], sort=False):
            curves[str(cell)][str(tuner)] = RunCurves(
                keys.reset_index(drop=True),
                self.suite.errors[keys.index],
                keys["simulations"].to_numpy(dtype=np.int64),
                keys["failed"].to_numpy(dtype=bool),
            )
        return curves

    @cached_property
    def _smallest_errors(self) -> dict[str, float]:
        """Smallest median error of any tuner after all simulations, by cell."""
        smallest = {}
        for cell, by_tuner in self.curves.items():
            with np.errstate(invalid="ignore"):
                medians = [float(np.median(c.values[:, -1])) for c in by_tuner.values()]
            smallest[cell] = min((m for m in medians if np.isfinite(m)), default=0.0)
        return smallest

    @cached_property
    def _floors(self) -> dict[str, float]:
        """Error of each cell (problem with one range of targets) below which tuners count as equal.

        For simulated targets it is the `negligible_error` of the experiment. For a recording, whose
        error cannot become zero, it is the smallest median error increased by that share.
        """
        floors = {}
        for row in self.suite.cells.itertuples():
            cell, floor = str(row.cell), float(row.negligible_error)  # type: ignore[arg-type]
            is_measured = row.range == "real"
            floors[cell] = (1.0 + floor) * self._smallest_errors[cell] if is_measured else floor
        return floors

    @cached_property
    def checkpoints(self) -> tuple[int, ...]:
        """Numbers of simulations after which tuners are compared, within the budget."""
        return tuple(k for k in CHECKPOINTS if k <= self.suite.budget)

    @cached_property
    def _target_means(self) -> dict[str, dict[str, pd.DataFrame]]:
        """Mean errors over seeds, by cell and tuner.

        A cell is a problem with one range of targets. Each table has a row per target and a column
        per number of simulations.
        """
        return {
            cell: {
                tuner: pd.DataFrame(curves.values).groupby(curves.keys["target"]).mean()
                for tuner, curves in by_tuner.items()
            }
            for cell, by_tuner in self.curves.items()
        }

    @cached_property
    def _start_errors(self) -> dict[str, pd.Series[float]]:
        """Errors of the starts by target, for each cell: those of tuners without training.

        A cell is a problem with one range of targets. The start is the point at which a tuner
        begins, before any simulation of its own; trained tuners may begin elsewhere.
        """
        start_errors = {}
        for cell, by_tuner in self.curves.items():
            errors = [
                pd.Series(curves.values[:, 0], index=curves.keys["target"])
                for tuner, curves in by_tuner.items()
                if not self._get_training_share(cell, tuner)  # it is 0 without training
            ]
            # Empty if all tuners of the cell are trained.
            errors = errors or [pd.Series(dtype=float)]
            # All runs on a target have the same start; the minimum passes over failed ones (inf).
            start_errors[cell] = pd.concat(errors).groupby(level=0).min()
        return start_errors

    def _get_training_share(self, cell: str, tuner: str) -> float:
        """Return a target's share of the training simulations of a tuner; 0 without training.

        Args:
            cell: name of the cell.
            tuner: label of the tuner.
        """
        return self._fit_simulations.get((cell, tuner), 0.0) / TARGETS_SHARING_TRAINING

    @cached_property
    def _fit_simulations(self) -> dict[tuple[str, str], float]:
        rows = self.suite.training.itertuples()
        return {(str(r.cell), str(r.tuner)): float(r.fit_simulations) for r in rows}  # type: ignore[arg-type]

    def get_trained_tuners(self) -> set[str]:
        """Return the tuners that need training simulations."""
        return {tuner for (_, tuner), cost in self._fit_simulations.items() if cost > 0}

    @cached_property
    def _medians(self) -> dict[tuple[str, int], pd.DataFrame]:
        """Median log errors over targets, by (`FREE` or `COUNTED`, number of simulations)."""
        return {
            (training, k): self._compute_medians(k, training)
            for training in (FREE, COUNTED)
            for k in self.checkpoints
        }

    def _compute_medians(self, k: int, training: str) -> pd.DataFrame:
        """Compute median log errors over targets: a row per cell, a column per tuner.

        A cell is a problem with one range of targets. A tuner that lacks a run on some target of a
        cell has no median (NaN) there.

        Args:
            k: number of simulations.
            training: `FREE` if the cost of training is not counted, `COUNTED` if it is.
        """
        medians = {}
        for cell, by_tuner in self._target_means.items():
            logs = pd.DataFrame(
                {
                    t: self._compute_log_errors(means, cell, t, k, training)
                    for t, means in by_tuner.items()
                }
            )
            # NaN where the tuner has no run on a target. `np.median` keeps it; pandas would not.
            values: Array = logs.to_numpy(dtype=np.float64)
            medians[cell] = pd.Series(np.median(values, axis=0), index=logs.columns)
        frame = pd.DataFrame(medians).T
        return frame[[t for t in self.suite.tuners if t in frame]]

    def _compute_log_errors(
        self, means: pd.DataFrame, cell: str, tuner: str, k: int, training: str
    ) -> pd.Series[float]:
        """Compute the logarithms of the errors of a tuner after k simulations, by target.

        If training is counted, the target's share of the training simulations is a part of the k
        simulations: a trained tuner has only the others for the target. With fewer simulations than
        that share it counts with the error of the start, although a regressor, for example, has an
        estimate of the parameters before any simulation of the target.

        Args:
            means: mean errors over seeds, a row per target, a column per number of simulations.
            cell: name of the cell, a problem with one range of targets.
            tuner: label of the tuner.
            k: number of simulations.
            training: `FREE` if the cost of training is not counted, `COUNTED` if it is.
        """
        share = self._get_training_share(cell, tuner) if training == COUNTED else 0.0
        errors = means[max(int(k - share), 0)]
        if share > k:
            # A target whose start error is unknown keeps the tuner's own error without simulations.
            errors = self._start_errors[cell].reindex(errors.index).fillna(errors)
        logs = compute_log_errors(errors.to_numpy(dtype=np.float64), self._floors[cell])
        return pd.Series(logs, index=errors.index)

    def get_medians(self, k: int, training: str = FREE) -> pd.DataFrame:
        """Return median log errors after k simulations: a row per cell, a column per tuner.

        Args:
            k: number of simulations.
            training: `FREE` or `COUNTED`.
        """
        return self._medians[training, k]

    def get_ranks(self, k: int) -> pd.DataFrame:
        """Rank the tuners in each cell; 1 is best, NaN where a tuner has no such run."""
        return _rank_tuners(self.get_medians(k))

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Median errors and ranks by cell, tuner and number of simulations.

        A cell is a problem with one range of targets. The errors are those of all runs; `failures`
        is the number of runs that failed, which have infinite errors.
        """
        lines = []
        for simulations in self.checkpoints:
            ranks = self.get_ranks(simulations)
            for cell, by_tuner in self.curves.items():
                for tuner, curves in by_tuner.items():
                    with np.errstate(invalid="ignore"):
                        median = float(np.median(curves.values[:, simulations]))
                    counts = curves.keys["target"].nunique(), int(curves.failed.sum())
                    lines.append((cell, tuner, simulations, median, ranks.at[cell, tuner], *counts))
        columns = ["cell", "tuner", "simulations", "median_error", "rank", "targets", "failures"]
        return pd.DataFrame(lines, columns=columns)

    @cached_property
    def complete_tuners(self) -> list[str]:
        """Tuners with results in all cells at all checkpoints; only these are compared overall."""
        has_results = [self.get_medians(k).notna().all(axis=0) for k in self.checkpoints]
        return [t for t in self.suite.tuners if all(column.get(t, False) for column in has_results)]

    @cached_property
    def ranks(self) -> pd.DataFrame:
        """Mean ranks over cells with 95 % bootstrap intervals, best first.

        A cell is a problem with one range of targets. The intervals come from resampled cells: they
        say how far the mean rank depends on the chosen problems. Only tuners with results in every
        cell are ranked. The column `training` says whether the cost of training is counted.
        """
        lines = []
        for (training, simulations), medians in self._medians.items():
            ranks = _rank_tuners(medians[self.complete_tuners])
            # The same cells are drawn for every tuner and for both kinds of training cost.
            rng = make_rng("suite ranks", simulations)
            resamples = rng.integers(len(ranks), size=(_RESAMPLE_COUNT, len(ranks)))
            for tuner, mean in ranks.mean().sort_values(kind="stable").items():
                resampled = ranks[tuner].to_numpy()[resamples].mean(axis=1)
                interval = compute_percentile_interval(resampled)
                lines.append((training, simulations, tuner, mean, *interval, len(ranks)))
        columns = ["training", "simulations", "tuner", "mean_rank", "low", "high", "cells"]
        return pd.DataFrame(lines, columns=columns)

    @cached_property
    def pairs(self) -> pd.DataFrame:
        """Test the best tuner against each other one over all cells.

        A cell is a problem with one range of targets. The test is Wilcoxon's signed-rank test of
        the median log errors, with Holm's correction for the number of tuners. One row per tuner,
        number of simulations, and with or without training cost.
        """
        lines = []
        # The key is `FREE` or `COUNTED` training, and the number of simulations.
        for key, all_medians in self._medians.items():
            medians = all_medians[self.complete_tuners]
            # A single tuner makes no pair.
            if medians.shape[1] < 2:
                continue
            best = str(_rank_tuners(medians).mean().idxmin())
            tests = {
                str(t): compare_pair(medians[best].to_numpy(), medians[t].to_numpy())
                for t in medians
                if t != best
            }
            corrected = correct_holm(np.array([test.p_value for test in tests.values()]))
            for (tuner, test), p_holm in zip(tests.items(), corrected, strict=True):
                values = test.targets, test.a_better, test.ratio, test.p_value, float(p_holm)
                lines.append((*key, best, tuner, *values))
        columns = ["training", "simulations", "best", "tuner", "cells", "best_better"]
        columns += ["error_ratio", "p_value", "p_holm"]
        return pd.DataFrame(lines, columns=columns)

    @cached_property
    def running_times(self) -> pd.DataFrame:
        """Compute expected running times to three error levels, also with the training's cost.

        There is one row per cell (problem with one range of targets), tuner and level. The levels
        of a problem from recorded data are multiples of its smallest error, since its true
        parameters are unknown. The training's cost is the part of it that falls on one target.
        """
        lines = []
        for row in self.suite.cells.itertuples():
            cell = str(row.cell)
            levels: tuple[float, ...] = ERROR_LEVELS
            if row.range == "real":  # recorded data
                levels = tuple(f * self._smallest_errors[cell] for f in MEASURED_LEVELS)
            for tuner, curves in self.curves[cell].items():
                # Beyond the end of a smaller budget nothing is known.
                is_incomplete = np.isnan(curves.values).any()
                budget = int(np.max(curves.used)) if is_incomplete else self.suite.budget
                share = self._get_training_share(cell, tuner)
                for number, threshold in enumerate(levels, 1):
                    effort = compute_effort(curves, threshold, budget)
                    ert, counts = float(effort.compute_ert()), effort.successes
                    resamples = draw_target_resamples(len(counts), "suite")
                    interval = compute_percentile_interval(effort.compute_ert(resamples))
                    values = ert, *interval, ert + share, int(counts.sum()), effort.runs
                    lines.append((cell, tuner, number, threshold, *values))
        columns = ["cell", "tuner", "level", "threshold", "ert", "low", "high"]
        columns += ["ert_with_training", "successes", "runs"]
        return pd.DataFrame(lines, columns=columns)

    @cached_property
    def profile(self) -> pd.DataFrame:
        """Mean ranks by problem property: dimension, noise, range, misspecification and others.

        A row has the property and its value, the number of simulations, the tuner, its mean rank,
        and the number of cells (problems with one range of targets) over which the mean is taken.
        """
        lines = []
        for simulations in self.checkpoints:
            ranks = _rank_tuners(self.get_medians(simulations)[self.complete_tuners])
            for name, value, mask in self._list_properties():
                cells = list(self.suite.cells.loc[mask, "cell"])
                means = ranks.loc[cells].mean().sort_values(kind="stable")
                lines += [
                    (name, value, simulations, tuner, mean, len(cells))
                    for tuner, mean in means.items()
                    if cells
                ]
        columns = ["property", "value", "simulations", "tuner", "mean_rank", "cells"]
        return pd.DataFrame(lines, columns=columns)

    def _list_properties(self) -> Iterator[tuple[str, str, pd.Series[bool]]]:
        """Yield each property of problems with one of its values, and a mask of cells with it.

        A cell is a problem with one range of targets: "in" the training range, "wide", or "real"
        for recorded data. A misspecified simulator is tuned "before" and "after" its extension by
        the missing effect.
        """
        cells = self.suite.cells
        tags = cells["tags"].str.split(";")
        dimension = cells["parameters"].astype(int)
        kind = cells["range"]

        def find_tagged(tag: str) -> pd.Series[bool]:
            return tags.map(lambda words: tag in words).astype(bool)

        # An extended simulator lacks no effect any more.
        misspecified = find_tagged("misspecified") & (kind != "after")
        yield "parameters", "1", dimension == 1
        yield "parameters", "2 or 3", (dimension > 1) & (dimension <= 3)
        yield "parameters", "4 to 10", dimension > 3
        for tag in ("noise-free", "low-noise", "noisy"):
            yield "noise", tag, find_tagged(tag)
        yield "range", "in range", kind.isin(["in", "before", "after"])
        yield "range", "wide", kind == "wide"
        yield "simulator", "complete", ~misspecified & (kind != "real")
        yield "simulator", "an effect is missing", misspecified & (kind != "real")
        yield "data", "measured", kind == "real"
        yield "data", "robot from a model file", find_tagged("robot")

    def find_losses(self, tuner: str, k: int, factor: float) -> pd.DataFrame:
        """Find the cells in which a tuner's median error exceeds the smallest one by a factor.

        A cell is a problem with one range of targets.

        Args:
            tuner: label of the tuner.
            k: number of simulations.
            factor: smallest ratio of the errors.

        Returns:
            Columns cell, winner and ratio; the largest ratio first.
        """
        medians = self.get_medians(k)
        # Differences of logarithms are logarithms of ratios.
        excess = medians[tuner] - medians.min(axis=1)
        # exp(700) is close to the largest finite number.
        ratios = np.exp(excess.clip(upper=700.0))
        columns = {"cell": medians.index, "winner": medians.idxmin(axis=1), "ratio": ratios}
        losses: pd.DataFrame = pd.DataFrame(columns)[excess > np.log(factor)]
        return losses.sort_values("ratio", ascending=False, kind="stable", ignore_index=True)

    @cached_property
    def ranks_over_common_targets(self) -> pd.DataFrame:
        """Mean ranks over the targets that every tuner of their cell ran; empty if these are all.

        A cell is a problem with one range of targets. These ranks compare slow tuners, which ran on
        some of the targets only, with the others.
        """
        runs = self.suite.runs
        tuner_counts = runs.groupby("cell")["tuner"].nunique()
        by_target = runs.groupby(["cell", "target"])["tuner"].transform("nunique")
        is_common = by_target == runs["cell"].map(tuner_counts)
        # No rows, but the columns of a table of ranks.
        if is_common.all():
            return self.ranks.iloc[:0]
        return SuiteTables(self.suite.select(is_common)).ranks

    def build_tables(self) -> dict[str, pd.DataFrame]:
        """Return all tables of the suite by name; the name is that of the CSV file."""
        return {
            "ranks_common_targets": self.ranks_over_common_targets,
            "errors": self.errors,
            "ranks": self.ranks,
            "pairs": self.pairs,
            "ert": self.running_times,
            "profile": self.profile,
            "coverage": self.coverage,
        }

    @cached_property
    def coverage(self) -> pd.DataFrame:
        """Numbers of targets and seeds by method: on how many runs the errors are based.

        Columns: tuner, cells, fewest and most targets of a cell, and the numbers of cells with one,
        two, ... seeds in each target (``seeds_1``, ``seeds_2``, ...). Methods without random
        numbers need one seed.
        """
        runs = self.suite.runs
        # Of the targets of a cell, that with the fewest seeds counts.
        seeds_of_target = runs.groupby(["tuner", "cell", "target"])["seed"].nunique()
        seeds = seeds_of_target.groupby(["tuner", "cell"]).min()
        cells = seeds.groupby("tuner").value_counts().unstack(fill_value=0).sort_index(axis=1)
        targets = runs.groupby(["tuner", "cell"])["target"].nunique().groupby("tuner")
        summary = targets.agg(cells="size", min_targets="min", max_targets="max")
        table: pd.DataFrame = summary.join(cells.add_prefix("seeds_")).reset_index()
        return table


def _rank_tuners(medians: pd.DataFrame) -> pd.DataFrame:
    """Rank the tuners, one a column, in each row; equal errors share a rank."""
    # Rounding gives errors that differ by the last bit the same rank.
    return medians.round(9).rank(axis=1)


GUIDE_COLUMNS = ["property", "value", "cells", "simulations", "best", "best_untrained"]


RANK_TOLERANCE = 0.5
"""Difference from the lowest mean rank up to which the headline keeps a method."""


def choose_segments(means: pd.DataFrame) -> list[tuple[str, int]]:
    """Choose as few methods as possible, each near the lowest mean rank at its checkpoints.

    Args:
        means: mean ranks, a row per tuner, a column per number of simulations.

    Returns:
        Methods, each with the last number of simulations for which it is chosen.
    """
    is_near_best = means <= means.min() + RANK_TOLERANCE
    checkpoints = [int(str(k)) for k in means]
    segments, start = [], 0
    while start < len(checkpoints):
        # Number of checkpoints from `start` on at which each method stays near the best.
        segment_lengths = is_near_best.iloc[:, start:].cumprod(axis=1).sum(axis=1)
        longest = segment_lengths.index[segment_lengths == segment_lengths.max()]
        stop = start + int(segment_lengths.max())
        # Of the methods that stay longest, the one with the lowest mean rank meanwhile.
        tuner = str(means.loc[longest, checkpoints[start:stop]].mean(axis=1).idxmin())
        segments.append((tuner, checkpoints[stop - 1]))
        start = stop
    return segments


def build_guide(tables: SuiteTables) -> pd.DataFrame:
    """Build the decision guide: the best method for each kind of problem and budget.

    Args:
        tables: statistics of the suite, with mean ranks over all problems and by property.

    Returns:
        Columns `GUIDE_COLUMNS`: property of problems and its value, number of cells (problems with
        one range of targets), number of simulations, best of all methods, and best of those that
        need no training.
    """
    trained = tables.get_trained_tuners()
    lines = []
    rows = tables.profile
    overall = tables.ranks[tables.ranks["training"] == FREE]
    overall = overall.assign(property="all problems", value="")
    frame = pd.concat([overall[rows.columns], rows], ignore_index=True)
    for (name, value, k), group in frame.groupby(["property", "value", "simulations"], sort=False):
        group = group.sort_values("mean_rank", kind="stable")
        untrained = group[~group["tuner"].isin(trained)]
        # An equal rank goes to the method that is named first in the ranking.
        lines.append(
            (
                name,
                value,
                int(group["cells"].iloc[0]),
                k,
                group["tuner"].iloc[0],
                untrained["tuner"].iloc[0] if len(untrained) else "",
            )
        )
    return pd.DataFrame(lines, columns=GUIDE_COLUMNS)
