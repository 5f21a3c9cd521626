"""Ranks of tuners over several problems, with tests of Friedman and Nemenyi.

Source: J. Demsar, JMLR 7, 2006 (scikit-posthocs).
"""

from __future__ import annotations

import pandas as pd

from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.paired_tests import MIN_ERROR, build_log_error_table

MIN_PROBLEMS_FOR_RANKS = 5
"""Minimum number of problems for mean ranks."""


def compute_problem_ranks(curves: RunCurves, floor: float = MIN_ERROR) -> pd.DataFrame:
    """Rank tuners on each problem by their median error over targets.

    A problem is an experiment and a range. The best tuner has rank 1 and failures are last. Tuners
    that miss a problem are left out.

    Args:
        curves: error of every run.
        floor: errors below this value count as equal to it.

    Returns:
        Ranks with one row per problem and one column per tuner.
    """
    rows = {}
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        logs = build_log_error_table(
            curves.select(experiment=str(experiment), range=str(kind)), floor=floor
        )
        rows[f"{experiment} {kind}"] = logs.median(axis=0)
    medians = pd.DataFrame(rows).T.dropna(axis="columns")
    # Rounding gives errors that differ by the last bit the same rank.
    return medians.round(9).rank(axis=1)


def compute_nemenyi_p_values(ranked: pd.DataFrame) -> tuple[float, pd.DataFrame]:
    """Test ranks (problems, tuners) with Friedman's test and Nemenyi's post-hoc test.

    Returns:
        Friedman's p-value, and Nemenyi's p-value for each pair of tuners.

    Raises:
        ValueError: there are fewer than `MIN_PROBLEMS_FOR_RANKS` problems or fewer than three
            tuners.
    """
    if len(ranked) < MIN_PROBLEMS_FOR_RANKS or ranked.shape[1] < 3:
        raise ValueError(
            f"mean ranks need {MIN_PROBLEMS_FOR_RANKS} problems and 3 tuners, found {ranked.shape}"
        )
    from scikit_posthocs import posthoc_nemenyi_friedman
    from scipy.stats import friedmanchisquare

    table = posthoc_nemenyi_friedman(ranked.to_numpy())
    table.index = table.columns = ranked.columns
    return float(friedmanchisquare(*ranked.to_numpy().T).pvalue), table
