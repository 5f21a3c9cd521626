"""Paired tests of tuners over targets with effect sizes, and of diagnosers over cases.

Sources: F. Wilcoxon, Biometrics Bulletin 1(6), 1945 (scipy); S. Holm, Scand. J. Statist. 6, 65,
1979; D. S. Kerby, Comprehensive Psychology 3, 2014, for the matched-pairs rank-biserial
correlation; Q. McNemar, Psychometrika 12, 153, 1947, for the answers of two diagnosers.
"""

from __future__ import annotations

import itertools
import warnings
from typing import NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.statistics.error_curves import MIN_ERROR, RunCurves, build_log_error_table
from sims.core.simulator import Array

PAIR_COLUMNS = [
    "experiment",
    "range",
    "a",
    "b",
    "targets",
    "a_better",
    "effect",
    "error_ratio",
    "p_value",
    "p_holm",
]


def compare_all_pairs(curves: RunCurves, floor: float = MIN_ERROR) -> pd.DataFrame:
    """Compare every pair of tuners by a paired test on the targets of each experiment and range.

    Args:
        curves: error of every run.
        floor: errors below this value count as equal to it.

    Returns:
        Table with the columns `PAIR_COLUMNS`. `a_better` is the share of targets on which a ends
        with the smaller error (ties count half). `effect` is the rank-biserial correlation, 1 if a
        is better on all targets, -1 if b is. `error_ratio` is the median of a's error over b's.
        Holm's correction is over all pairs of an experiment and range.
    """
    tables = []
    for experiment, kind, problem_curves in curves.split_problems():
        logs = build_log_error_table(problem_curves, floor=floor)
        lines = [
            (experiment, kind, a, b, *compare_pair(logs[a].to_numpy(), logs[b].to_numpy()))
            for a, b in itertools.combinations(logs.columns, 2)
        ]
        # A single tuner makes no pair.
        if lines:
            part = pd.DataFrame(lines, columns=PAIR_COLUMNS[:-1])
            part["p_holm"] = correct_holm(part["p_value"].to_numpy())
            tables.append(part)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=PAIR_COLUMNS)


class PairedTest(NamedTuple):
    """Comparison of tuner a with tuner b on the same targets.

    Attributes:
        targets: number of targets that both tuners have.
        a_better: share of targets on which a has the smaller error; ties count half.
        effect: matched-pairs rank-biserial correlation, 1 if a is better on all targets.
        ratio: median over targets of a's error over b's.
        p_value: two-sided p-value of Wilcoxon's signed-rank test.
    """

    targets: int
    a_better: float
    effect: float
    ratio: float
    p_value: float


def compare_pair(a: Array, b: Array) -> PairedTest:
    """Compare two tuners on the same targets by Wilcoxon's signed-rank test.

    The differences of their log errors are ranked by size. The p-value tells how likely such
    differences are if neither tuner is better; the effect size is the share of ranks in favour of a
    minus that in favour of b. Without differences, the effect is 0 and the p-value 1.

    Args:
        a: (n,) logarithms of the errors of tuner a; NaN where it has none.
        b: (n,) logarithms of the errors of tuner b on the same targets.

    Returns:
        Counts, effect, ratio and p-value of a compared with b; the share of targets on which a is
        better is NaN without a common target.
    """
    from scipy.stats import rankdata, wilcoxon

    is_paired = ~(np.isnan(a) | np.isnan(b))
    difference = a[is_paired] - b[is_paired]
    wins = (difference < 0) + 0.5 * (difference == 0)
    win_share = float(wins.mean()) if len(difference) else np.nan
    # Wilcoxon's test drops ties.
    unequal = difference[difference != 0]
    if not len(unequal):
        return PairedTest(len(difference), win_share, 0.0, 1.0, 1.0)
    ranks = rankdata(np.abs(unequal))
    # Kerby's simple difference: the share of ranks in favour minus the share against.
    effect = float((ranks[unequal < 0].sum() - ranks[unequal > 0].sum()) / ranks.sum())
    with warnings.catch_warnings():
        # scipy warns that it approximates if there are few pairs or ties.
        warnings.simplefilter("ignore")
        p = float(wilcoxon(unequal).pvalue)
    # The ratio of a failed run and a successful one would overflow.
    ratio = float(np.exp(np.clip(np.median(difference), -700, 700)))
    return PairedTest(len(difference), win_share, effect, ratio, p)


def compute_mcnemar_p_value(first_only: int, second_only: int) -> float:
    """Compute the p-value of McNemar's exact test, two-sided: are two methods equally good?

    If they are, each case that only one of them answered correctly is as likely to be the first
    one's as the second one's. Without such cases the p-value is 1.

    Args:
        first_only: number of cases that only the first method answered correctly.
        second_only: number of cases that only the second method answered correctly.
    """
    from scipy.stats import binomtest

    if first_only + second_only:
        return float(binomtest(first_only, first_only + second_only).pvalue)
    return 1.0


def correct_holm(p: Array) -> Array:
    """Apply the Holm correction to the p-values (n,) of one family of tests.

    It bounds the probability of any false rejection in the family. The k-th smallest p-value is
    multiplied by n + 1 - k; a corrected value is at least as large as the one before it. NaN, for
    a test that was not possible, stays NaN and does not count.
    """
    # statsmodels' `multipletests` takes a second to import and collects all garbage in each call.
    order = np.argsort(p)[: np.count_nonzero(~np.isnan(p))]
    corrected: Array = np.full(len(p), np.nan)
    multiplied = np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1))
    corrected[order] = np.minimum(multiplied, 1.0)
    return corrected
