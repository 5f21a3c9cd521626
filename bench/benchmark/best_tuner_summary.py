"""Sentences about the best tuners after 1, 3, 10 and all simulations, for terminal and page."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.tuner_ranking import (
    BEST,
    EQUAL,
    FAILED,
    SIGNIFICANCE,
    UNDECIDED,
    WORSE,
    compute_min_targets,
)
from bench.pages.text_format import format_number

_DIGITS = 2
"""Number of significant digits of factors."""


RANGE_PHRASES = {
    "in": "targets in the training range",
    "wide": "targets anywhere in the bounds",
    "real": "the recording",
}
"""Wording for the ranges of targets."""


class TunerRanking(NamedTuple):
    """Verdicts on the tuners of one range after some number of simulations.

    Attributes:
        simulations: Number of simulations.
        best: Tuners that share the smallest error.
        error: Median error of the best tuners, as text.
        worse: Tuners that are significantly worse, each with factor and number of targets.
        undecided: Tuners with a larger median error whose difference is not significant.
        failed: Tuners all of whose runs failed.
    """

    simulations: int
    best: list[str]
    error: str
    worse: list[str]
    undecided: list[str]
    failed: list[str]


@dataclass(frozen=True)
class RangeResult:
    """Verdicts on the tuners in one range of targets, and sentences about them.

    Attributes:
        statistics: statistics of the comparison.
        kind: range of the targets, such as ``in``.
    """

    statistics: ComparisonStatistics
    kind: str

    @cached_property
    def _ranking(self) -> pd.DataFrame:
        """Rows of the ranking for this range."""
        ranking = self.statistics.ranking
        return ranking[ranking["range"] == self.kind]

    @property
    def where(self) -> str:
        """The range in words, for the middle of a sentence."""
        return RANGE_PHRASES[self.kind]

    @property
    def title(self) -> str:
        """The range with its number of targets, for the beginning of a sentence."""
        return f"{self.where[0].upper()}{self.where[1:]} ({self.targets})"

    @property
    def targets(self) -> str:
        """Number of targets of the range: ``10 targets``, or how many of them decide.

        A target decides between tuners if its data determine at least one direction of the
        parameters. Targets of a recording (``real``) differ in their starting points only.
        """
        count = self.statistics.target_counts[self.kind]
        unit = ("starting point" if self.kind == "real" else "target") + ("" if count == 1 else "s")
        if self._deciding_count == count:
            return f"{count} {unit}"
        return f"{self._deciding_count} of {count} {unit} decide"

    @property
    def _deciding_count(self) -> int:
        return int(self._ranking["targets"].max()) if len(self._ranking) else 0

    @cached_property
    def rankings(self) -> list[TunerRanking]:
        """Verdicts after 1, 3, 10 and all simulations."""
        groups = self._ranking.groupby("simulations")
        return [_sort_by_verdict(self.statistics, int(str(k)), part) for k, part in groups]

    @property
    def running_times(self) -> list[dict[Hashable, Any]]:
        """Rows of expected running times (ERT) of the best tuners, in their order.

        The ERT is the expected number of simulations until the error stays below the reference
        threshold (`reference_level`); tuners that never reach it are left out.
        """
        statistics, ranking = self.statistics, self._ranking
        final_rows = ranking[ranking["simulations"] == ranking["simulations"].max()]
        best = list(final_rows.loc[final_rows["verdict"].isin((BEST, EQUAL)), "tuner"])
        table = statistics.running_times
        rows = table[
            (table["range"] == self.kind)
            & (table["threshold"] == statistics.reference_level)
            & (table["successes"] > 0)
            & table["tuner"].isin(best)
        ]
        return sorted(rows.to_dict("records"), key=lambda row: statistics.order.index(row["tuner"]))

    @property
    def failed_runs(self) -> str:
        """Sentence on the tuners with failed runs and their numbers; empty for none."""
        texts = [
            f"{row['tuner']} {row['failures']} of {row['runs']}"
            for row in self._ranking.drop_duplicates("tuner").to_dict("records")
            if row["failures"]
        ]
        return f"failed runs, which count as infinite errors: {', '.join(texts)}" if texts else ""

    @property
    def _comparison_count(self) -> int:
        """Number of tuners that the best one is tested against."""
        part = self._ranking
        return max(part.loc[part["verdict"] != FAILED, "tuner"].nunique() - 1, 0)

    @property
    def explanation(self) -> str:
        """Sentence on the test of the ranking and the notation; empty if none was made."""
        count = self._comparison_count
        if not count:
            return ""
        return (
            f"Nx (k/n): median error N times the best one's, larger on k of n targets. Worse: "
            f"p < {SIGNIFICANCE:g} in Wilcoxon's signed-rank test against the best, Holm-corrected "
            f"for {count} comparison{'s' if count > 1 else ''}."
        )

    @property
    def warning(self) -> str:
        """Sentence on too few targets for any significant difference; empty otherwise.

        With few targets even a tuner that wins on all of them may do so under the null hypothesis.
        """
        count, targets = self._comparison_count, self._deciding_count
        required_targets = compute_min_targets(count) if count else 0
        if targets >= required_targets:
            return ""
        return (
            f"{targets} target{'s' if targets != 1 else ''} cannot decide between "
            f"{count + 1} tuners: at least {required_targets} are needed "
            f"(--targets {required_targets})."
        )


def _sort_by_verdict(statistics: ComparisonStatistics, k: int, part: pd.DataFrame) -> TunerRanking:
    """Sort the tuners of one range by their verdict after `k` simulations.

    One tuner has the verdict `BEST`, the lowest median error, unless all of them failed; others may
    be `EQUAL` to it. The stated error is that of the best one.

    Args:
        statistics: statistics of the comparison.
        k: number of simulations.
        part: rows of the ranking for this range and this number of simulations.
    """

    def select_verdicts(*verdicts: str) -> pd.DataFrame:
        return part[part["verdict"].isin(verdicts)]

    # Equal tuners are in the order of legends, so that a page has one order.
    best = sorted(select_verdicts(BEST, EQUAL)["tuner"], key=statistics.order.index)
    error_text = ""
    if len(best_row := select_verdicts(BEST)):
        error_text = _format_best_error(statistics, float(best_row["median"].iloc[0]))
    return TunerRanking(
        simulations=k,
        best=[str(name) for name in best],
        error=error_text,
        worse=[_format_worse_tuner(row) for row in select_verdicts(WORSE).to_dict("records")],
        undecided=[str(name) for name in select_verdicts(UNDECIDED)["tuner"]],
        failed=[str(name) for name in select_verdicts(FAILED)["tuner"]],
    )


def _format_best_error(statistics: ComparisonStatistics, median: float) -> str:
    """Format the median error of the best tuner, such as ``0.012`` or ``at most 0.001``.

    An error at or below the negligible error (`statistics.floor`) is given as an upper limit,
    because smaller differences have no meaning. A median that is not finite means that half of the
    targets failed.

    Args:
        statistics: statistics of the comparison.
        median: median error over targets, in training widths if true parameters are known.
    """
    if not np.isfinite(median):
        return "it failed on half of the targets"
    # `unit` converts training widths to the unit of the parameter if there is only one.
    text = f"{median * statistics.unit:.2g}"
    # 1e-9 is a tolerance for rounding.
    return f"at most {text}" if median <= statistics.floor * (1 + 1e-9) else text


def _format_worse_tuner(row: dict[Any, Any]) -> str:
    """Format a tuner that is significantly worse than the best one, e.g. ``cma_es 5.8x (8/10)``.

    Its median error is 5.8 times that of the best tuner, and larger on 8 of 10 targets.

    Args:
        row: row of the ranking table.
    """
    ratio = float(row["error_ratio"])
    factor = ""
    if not np.isfinite(ratio):  # a failed run has an infinite error
        factor = " failed"
    elif ratio > 1.0:
        factor = f" {format_number(ratio, _DIGITS)}x"
    return f"{row['tuner']}{factor} ({row['targets_worse']}/{row['targets']})"


def explain_first(worse: Sequence[str]) -> list[str]:
    """Write out the first of several worse tuners, which explains the format of the others.

    ``cma_es 5.8x (8/10)`` becomes ``cma_es 5.8x the error (larger on 8 of 10 targets)``.

    Args:
        worse: texts of tuners that are significantly worse than the best one.

    Returns:
        The texts; only the first one is changed.
    """
    # A text without a factor does not match, and stays as it is.
    first = [
        re.sub(r" (\d\S*x) \((\d+)/(\d+)\)$", r" \1 the error (larger on \2 of \3 targets)", text)
        for text in worse[:1]
    ]
    return [*first, *worse[1:]]


def format_error_floor(statistics: ComparisonStatistics) -> str:
    """State which errors count as equal."""
    return f"errors below {statistics.floor * statistics.unit:.2g} count as equal"
