"""Sentences about the best tuners after 1, 3, 10 and all simulations, for terminal and page."""

from __future__ import annotations

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


def rank_at_checkpoints(statistics: ComparisonStatistics, kind: str) -> list[TunerRanking]:
    """List the verdicts after 1, 3, 10 and all simulations in one range.

    Args:
        statistics: Statistics of the comparison.
        kind: Range of the targets.
    """
    ranking = _select_range(statistics, kind)
    return [
        _sort_by_verdict(statistics, k, ranking[ranking["simulations"] == k])
        for k in sorted(set(ranking["simulations"].astype(int)))
    ]


def _select_range(statistics: ComparisonStatistics, kind: str) -> pd.DataFrame:
    return statistics.ranking[statistics.ranking["range"] == kind]


def _sort_by_verdict(statistics: ComparisonStatistics, k: int, part: pd.DataFrame) -> TunerRanking:
    """Sort the tuners of one range by their verdict after `k` simulations.

    One tuner has the verdict `BEST`, the lowest median error; others may be `EQUAL` to it. The
    error in the sentence is that of the best one.

    Args:
        statistics: statistics of the comparison.
        k: number of simulations.
        part: rows of the ranking for this range and this number of simulations.
    """

    def select_verdicts(*verdicts: str) -> pd.DataFrame:
        return part[part["verdict"].isin(verdicts)]

    # Equal tuners are in the order of legends, so that a page has one order.
    best = sorted(select_verdicts(BEST, EQUAL)["tuner"], key=statistics.order.index)
    first = select_verdicts(BEST)
    return TunerRanking(
        k,
        [str(name) for name in best],
        _format_best_error(statistics, float(first["median"].iloc[0])) if len(first) else "",
        [_format_worse_tuner(row) for row in select_verdicts(WORSE).to_dict("records")],
        [str(name) for name in select_verdicts(UNDECIDED)["tuner"]],
        [str(name) for name in select_verdicts(FAILED)["tuner"]],
    )


def _format_best_error(statistics: ComparisonStatistics, median: float) -> str:
    """Format the median error of the best tuner in the unit of the statistics.

    An error at or below the negligible error (`floor`) is given as an upper limit, because smaller
    differences have no meaning. A median that is not finite means that half of the targets failed.
    """
    if not np.isfinite(median):
        return "it failed on half of the targets"
    text = f"{median * statistics.unit:.2g}"
    return f"at most {text}" if median <= statistics.floor * (1 + 1e-9) else text


def _format_worse_tuner(row: dict[Any, Any]) -> str:
    """Format a worse tuner, e.g. ``cma_es 5.8x (8/10)``."""
    ratio = float(row["error_ratio"])
    factor = f" {format_number(ratio, _DIGITS)}x" if ratio > 1.0 else ""
    # A failed run has an infinite error.
    factor = factor if np.isfinite(ratio) else " failed"
    return f"{row['tuner']}{factor} ({row['targets_worse']}/{row['targets']})"


def format_target_count(statistics: ComparisonStatistics, kind: str) -> str:
    """Format the number of targets of a range: ``10 targets``, or how many of them decide.

    A target decides between tuners if its data determine at least one direction of the parameters.
    """
    count = statistics.target_counts[kind]
    deciding_counts = _select_range(statistics, kind)["targets"]
    deciding_count = int(deciding_counts.max()) if len(deciding_counts) else 0
    unit = ("starting point" if kind == "real" else "target") + ("" if count == 1 else "s")
    if deciding_count == count:
        return f"{count} {unit}"
    return f"{deciding_count} of {count} {unit} decide"


def format_error_floor(statistics: ComparisonStatistics) -> str:
    """State which errors count as equal."""
    return f"errors below {statistics.floor * statistics.unit:.2g} count as equal"


def explain_ranking(statistics: ComparisonStatistics, kind: str) -> str:
    """Explain the test of the ranking and the notation; empty if no tuners were compared.

    Args:
        statistics: Statistics of the comparison.
        kind: Range of the targets.
    """
    comparison_count = _count_tested_tuners(statistics, kind)
    if not comparison_count:
        return ""
    return (
        f"Nx (k/n): median error N times the best one's, larger on k of n targets. Worse: "
        f"p < {SIGNIFICANCE:g} in Wilcoxon's signed-rank test against the best, Holm-corrected for "
        f"{comparison_count} comparison{'s' if comparison_count > 1 else ''}."
    )


def _count_tested_tuners(statistics: ComparisonStatistics, kind: str) -> int:
    """Return the number of tuners that the best one is tested against.

    Args:
        statistics: statistics of the comparison.
        kind: range of the targets, such as ``in``.
    """
    part = _select_range(statistics, kind)
    return max(part.loc[part["verdict"] != FAILED, "tuner"].nunique() - 1, 0)


def warn_about_target_count(statistics: ComparisonStatistics, kind: str) -> str:
    """Warn if there are too few targets for any significant difference; empty otherwise.

    With few targets even a tuner that wins on all of them may do so under the null hypothesis.

    Args:
        statistics: Statistics of the comparison.
        kind: Range of the targets.
    """
    comparison_count = _count_tested_tuners(statistics, kind)
    if not comparison_count:
        return ""
    targets = int(_select_range(statistics, kind)["targets"].max())
    required_targets = compute_min_targets(comparison_count)
    if targets >= required_targets:
        return ""
    return (
        f"{targets} target{'s' if targets != 1 else ''} cannot decide between "
        f"{comparison_count + 1} tuners: at least {required_targets} are needed "
        f"(--targets {required_targets})."
    )


def list_failed_runs(statistics: ComparisonStatistics, kind: str) -> str:
    """List the tuners with failed runs in a range and their numbers; empty for none.

    Args:
        statistics: Statistics of the comparison.
        kind: Range of the targets.
    """
    part = _select_range(statistics, kind).drop_duplicates("tuner")
    texts = [
        f"{row['tuner']} {row['failures']} of {row['runs']}"
        for row in part.to_dict("records")
        if row["failures"]
    ]
    return f"failed runs, which count as infinite errors: {', '.join(texts)}" if texts else ""
