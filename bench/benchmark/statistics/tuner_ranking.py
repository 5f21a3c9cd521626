"""Rank tuners after k simulations and over several problems; agreement of rankings.

This is the only ranking rule of a comparison: headline, tables, legends and terminal use it.

* A tuner's error on a target is the mean over its seeds. An error below the experiment's
  `negligible_error` counts as equal to it. A run that failed has an infinite error.
* Tuners are ranked by the median of that error over targets; equal medians share a rank. Among
  equals the smaller geometric mean over targets comes first, then the better rank after fewer
  simulations.
* The first tuner is tested against each other one: Wilcoxon's signed-rank test on the paired
  logarithms of errors, two-sided, with Holm's correction over the k - 1 comparisons.

The best tuner is chosen by the same data that it is tested with. J. C. Hsu (Constrained
simultaneous confidence intervals for multiple comparisons with the best, Annals of Statistics
12(3), 1136-1144, 1984, doi:10.1214/aos/1176346732) shows why k - 1 comparisons suffice: the truly
best tuner is called worse only if one of the k - 1 others beats it in a test. With a level of
alpha / (k - 1) for each test this happens with a probability of at most alpha, whichever of the
others was selected. Two-sided p-values make each test twice as strict as the one-sided tests of
Hsu, which leaves room for Holm's larger levels after the first rejections; a test simulates equal
tuners and checks the error rate. What is controlled is the exclusion of the best tuner, not every
statement about pairs: these are in pairs.csv, corrected over all pairs.

Tests over several problems (Friedman, Nemenyi): J. Demsar, JMLR 7, 2006 (scikit-posthocs).

Agreement of rankings: M. G. Kendall, Biometrika 30, 81, 1938, doi:10.1093/biomet/30.1-2.81 (tau-b
of scipy); the percentile bootstrap of B. Efron, R. Tibshirani, An Introduction to the Bootstrap,
1993, ch. 13; the permutation test for paired conditions of P. Good, Permutation, Parametric, and
Bootstrap Tests of Hypotheses, 2005, ch. 3.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.statistics.bootstrap import INTERVAL_QUANTILES
from bench.benchmark.statistics.error_curves import MIN_ERROR, RunCurves, build_log_error_table
from bench.benchmark.statistics.paired_tests import compare_pair, correct_holm
from bench.core.random_streams import make_rng
from sims.core.simulator import Array

RANKING_COLUMNS = [
    "experiment",
    "range",
    "simulations",
    "rank",
    "tuner",
    "verdict",
    "median",
    "error_ratio",
    "targets_worse",
    "targets",
    "p_value",
    "p_holm",
    "runs",
    "failures",
]
SIGNIFICANCE = 0.05
"""Holm-corrected p-value below which a tuner is called worse than the best one."""
_RANKED_AFTER = (1, 3, 10)
"""Numbers of simulations after which tuners are ranked, in addition to the whole budget."""
_MAX_LOG_ERROR = 100.0
"""Upper limit of the logarithm of a real error; larger values represent a failed run."""
BEST, EQUAL, UNDECIDED, WORSE, FAILED = "best", "equal", "not decided", "worse", "failed"
"""Verdicts on a tuner.

`BEST`: first of the ranking. `EQUAL`: same rank as the first and not worse. `UNDECIDED`: lower
rank, but the test does not decide. `WORSE`: the test decides. `FAILED`: all runs failed.
"""
MIN_PROBLEMS_FOR_RANKS = 5
"""Minimum number of problems for mean ranks."""
BOOTSTRAP_RESAMPLES = 500
"""Number of bootstrap resamples of the targets for an interval."""
PERMUTATION_COUNT = 9999
"""Number of random permutations of the conditions for a p-value."""
HALF_SPLIT_COUNT = 200
"""Number of random splits of the targets into halves, for the agreement of one condition."""


def list_ranking_points(budget: int) -> list[int]:
    """Return the numbers of simulations after which tuners are ranked: 1, 3, 10 and the budget."""
    return [k for k in _RANKED_AFTER if k < budget] + [budget]


def compute_min_targets(comparison_count: int) -> int:
    """Return the minimum number of targets that can decide all comparisons with the best tuner.

    The smallest two-sided p-value of Wilcoxon's signed-rank test on n pairs is 2 / 2^n = 2^(1-n);
    Holm's first step multiplies it by the number of comparisons.

    Args:
        comparison_count: number of tuners that are compared with the best one.
    """
    return next(n for n in itertools.count(1) if 2.0 ** (1 - n) * comparison_count < SIGNIFICANCE)


def rank_tuners(curves: RunCurves, budget: int, floor: float) -> pd.DataFrame:
    """Rank the tuners of each experiment and range after 1, 3, 10 and all simulations.

    Args:
        curves: deciding error of every run.
        budget: largest number of simulations.
        floor: errors below this value count as equal to it.

    Returns:
        One row per tuner, in the order of the ranking, columns `RANKING_COLUMNS`. `error_ratio` is
        the tuner's median over the best one's, `targets_worse` the number of targets on which its
        error is larger.
    """
    parts = []
    for experiment, kind, part in curves.split_problems():
        for k, ranking in _compute_rankings(part, budget, floor).items():
            parts.append(_build_verdict_rows(ranking, part, (experiment, kind, k)))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=RANKING_COLUMNS)


def rank_after_budget(curves: RunCurves, budget: int, floor: float) -> list[str]:
    """Rank tuners after the whole budget, over all targets of all ranges; best first.

    Tuners come last if all their runs failed.

    Args:
        curves: deciding error of every run.
        budget: largest number of simulations.
        floor: errors below this value count as equal to it.
    """
    return list(_compute_rankings(curves, budget, floor)[budget].order)


class _Ranking(NamedTuple):
    """Ranking of the tuners after a number of simulations.

    Attributes:
        logs: logarithms of errors, one row per target, one column per tuner.
        ranks: rank of each tuner, 1 is best.
        order: tuners, the best first.
    """

    logs: pd.DataFrame
    ranks: pd.Series[float]
    order: Sequence[str]


def _compute_rankings(curves: RunCurves, budget: int, floor: float) -> dict[int, _Ranking]:
    """Compute the ranking of the tuners after each number of simulations of `list_ranking_points`.

    A rank follows from the median log error over targets. Within equal ranks, tuners are ordered by
    the mean, then by the ranks after fewer simulations. Those whose runs all failed come last.

    Args:
        curves: errors of all runs.
        budget: largest number of simulations.
        floor: error at or below which errors count as equal.

    Returns:
        Rankings by number of simulations.
    """
    # True for a tuner whose runs all failed; it comes last.
    has_failed = {t: bool(curves.select(tuner=t).failed.all()) for t in curves.list_tuners()}
    rankings: dict[int, _Ranking] = {}
    earlier_ranks: list[pd.Series[float]] = []
    for simulations in list_ranking_points(budget):
        logs = build_log_error_table(curves, simulations, floor)
        # Rounding gives errors that differ by the last bits the same rank.
        medians, mean_logs = logs.median().round(9), logs.mean().round(9)
        ranks = medians.rank(method="min")
        # Each key has a number for every tuner; a later key decides among tuners that are equal by
        # all earlier ones.
        keys = [pd.Series(has_failed), medians, mean_logs, *reversed(earlier_ranks)]
        order = sorted(logs.columns, key=lambda t: [float(key[t]) for key in keys])
        rankings[simulations] = _Ranking(logs, ranks, order)
        earlier_ranks.append(ranks)
    return rankings


def _build_verdict_rows(
    ranking: _Ranking, curves: RunCurves, key: tuple[str, str, int]
) -> pd.DataFrame:
    """Build the rows of one ranking, with each tuner tested against the best.

    The first tuner that has a successful run is BEST. Each other one is tested against it, by
    Wilcoxon's signed-rank test over targets with Holm's correction for several tests. It is WORSE
    if its errors are significantly larger, otherwise EQUAL if it has the same rank as the best, and
    else UNDECIDED. A tuner whose runs all failed is FAILED and is not tested.

    Args:
        ranking: order of the tuners, their ranks, and the logarithms of their errors by target.
        curves: errors of each run over the number of simulations; gives the counts of runs and
            failures.
        key: first columns of each row: experiment, range and number of simulations.

    Returns:
        One row per tuner, in the order of the ranking, columns `RANKING_COLUMNS`.
    """
    logs, ranks, order = ranking
    # A mask of each tuner's runs, True for a failed run.
    is_failed = {t: curves.select(tuner=t).failed for t in order}
    successful_tuners = [t for t in order if not is_failed[t].all()]
    best = successful_tuners[0] if successful_tuners else order[0]
    tests = {t: compare_pair(logs[t].to_numpy(), logs[best].to_numpy()) for t in order}
    other_tuners = [t for t in successful_tuners if t != best]
    corrected = dict(
        zip(
            other_tuners,
            correct_holm(np.array([tests[t].p_value for t in other_tuners])),
            strict=True,
        )
    )
    lines = []
    for tuner in order:
        # The best tuner and those without a successful run are not tested; their p-values are NaN.
        test, p_holm = tests[tuner], corrected.get(tuner, np.nan)
        if tuner not in successful_tuners:
            verdict = FAILED
        elif tuner == best:
            verdict = BEST
        # A negative effect means larger errors than those of the best tuner.
        elif p_holm < SIGNIFICANCE and test.effect < 0:
            verdict = WORSE
        else:
            verdict = EQUAL if ranks[tuner] == ranks[best] else UNDECIDED
        worse_count = int((logs[tuner] > logs[best]).sum())
        median, best_median = _compute_median_error(logs[tuner]), _compute_median_error(logs[best])
        p_value = test.p_value if tuner in other_tuners else np.nan
        test_cells = (
            median,
            median / best_median if np.isfinite(best_median) else np.nan,
            worse_count,
            test.targets,
            p_value,
            p_holm,
        )
        counts = len(is_failed[tuner]), int(is_failed[tuner].sum())
        lines.append((*key, int(ranks[tuner]), tuner, verdict, *test_cells, *counts))
    return pd.DataFrame(lines, columns=RANKING_COLUMNS)


def _compute_median_error(logs: pd.Series[float]) -> float:
    """Return the median error over targets; infinite if half of the targets failed.

    Args:
        logs: logarithms of the errors, one for each target; a target on which the tuner failed has
            a large number instead. A median above `_MAX_LOG_ERROR` comes from such numbers.
    """
    median_log = float(logs.median())
    return float(np.exp(median_log)) if median_log < _MAX_LOG_ERROR else np.inf


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
    for experiment, kind, problem_curves in curves.split_problems():
        logs = build_log_error_table(problem_curves, floor=floor)
        rows[f"{experiment} {kind}"] = logs.median(axis=0)
    medians = pd.DataFrame(rows).T.dropna(axis="columns")
    # Rounding gives errors that differ by the last bit the same rank.
    return medians.round(9).rank(axis=1)


def compute_nemenyi_p_values(ranked: pd.DataFrame) -> tuple[float, pd.DataFrame]:
    """Test ranks (problems, tuners) with Friedman's test and Nemenyi's post-hoc test.

    Args:
        ranked: (problems, tuners) ranks, 1 is best.

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


def compute_friedman_p_value(errors: Array) -> float:
    """Compute the p-value of Friedman's test that all tuners perform equally, over targets.

    A tuner that failed on a target has the worst rank there. Errors are compared as rounded
    logarithms, so that rounding errors do not break ties.

    Args:
        errors: errors, (targets, tuners); NaN for a failed run.

    Returns:
        The p-value; NaN with too few targets or fewer than three tuners.
    """
    from scipy.stats import friedmanchisquare

    targets, tuners = errors.shape
    if targets < MIN_PROBLEMS_FOR_RANKS or tuners < 3:
        return float("nan")
    # An infinite error has the worst rank.
    ranked_errors = np.where(np.isfinite(errors), errors, np.inf)
    log_errors = np.log(np.maximum(ranked_errors, MIN_ERROR)).round(9)
    return float(friedmanchisquare(*log_errors.T).pvalue)


@dataclass(frozen=True)
class RankAgreement:
    """Agreement of two rankings.

    Attributes:
        tau: Kendall's tau-b between the mean ranks; 1 is the same order, -1 the reverse.
        low: lower bound of its 95 % bootstrap interval over targets, extended to contain
            `compute_kendall_tau`.
        high: upper bound of this interval.
        halves: mean tau between halves of the targets in the first condition; the value that is
            reached by two rankings which differ in their targets only.
        p_value: p-value of the permutation test that exchanges the conditions of each target at
            random; the null hypothesis is that no tuner's mean rank changes.
    """

    tau: float
    low: float
    high: float
    halves: float
    p_value: float


def compute_mean_ranks(errors: Array) -> Array:
    """Compute each tuner's mean rank (tuners,) over targets from errors (targets, tuners).

    Rank 1 is best. A tuner whose error is NaN or infinite has the last rank on that target.
    """
    mean_ranks: Array = _rank_within_targets(errors).mean(axis=0)
    return mean_ranks


def _rank_within_targets(errors: Array) -> Array:
    """Compute each tuner's rank within each target from errors (targets, tuners).

    Returns:
        (targets, tuners) ranks, 1 for the smallest error. Equal errors share their mean rank; a NaN
        or infinite error has the last rank.
    """
    from scipy.stats import rankdata

    # Rounded logarithms give errors that differ by the last bit the same rank.
    logs = np.log(np.maximum(np.where(np.isfinite(errors), errors, np.inf), 1e-12))
    ranks: Array = rankdata(np.round(logs, 9), axis=1)
    return ranks


def compute_kendall_tau(first: Array, second: Array) -> float:
    """Compute Kendall's tau-b of two lists of numbers; NaN if one of them is constant.

    With C and D the numbers of pairs in the same and in opposite order, T1 and T2 the numbers of
    pairs that are tied in the first or in the second list only,

        tau = (C - D) / sqrt((C + D + T1) (C + D + T2))                        (1)

    Args:
        first: (n,) numbers.
        second: (n,) numbers in the same order.
    """
    from scipy.stats import kendalltau

    # Rounding makes numbers equal that differ in their last digits only.
    return float(kendalltau(np.round(first, 9), np.round(second, 9)).statistic)


def compute_rank_agreement(first: Array, second: Array, *names: str) -> RankAgreement:
    """Compare the rankings of the same tuners on the same targets under two conditions.

    Tuners are ranked on each target, and ordered by their mean rank. Kendall's tau of the two
    orders is 1 if they are equal; its interval is a bootstrap over targets, and its p-value tests
    that no tuner's mean rank changes.

    Args:
        first: (targets, tuners) errors in the first condition.
        second: (targets, tuners) errors in the second condition.
        names: names of the comparison, which determine the random stream.

    Returns:
        Tau with its 95 % interval and p-value, and the mean tau between two halves of the targets
        in the first condition: the agreement that can be expected from a change of targets alone.
        The interval is NaN with a single target.
    """
    rng = make_rng("agreement", *names)
    # The shape is (2, targets, tuners).
    ranks = np.stack([_rank_within_targets(first), _rank_within_targets(second)])
    count = ranks.shape[1]
    # Tau of the mean ranks (tuners,) in both conditions.
    observed = compute_kendall_tau(*ranks.mean(axis=1))
    resamples = rng.integers(count, size=(BOOTSTRAP_RESAMPLES, count))
    resampled_taus = [compute_kendall_tau(*ranks[:, rows].mean(axis=1)) for rows in resamples]
    low, high = (np.nan, np.nan)
    if count > 1:
        # Tau is NaN for a resample in which all tuners have the same mean rank in one condition.
        low, high = np.nanquantile(resampled_taus, INTERVAL_QUANTILES)
    # Targets that are drawn twice make ranks noisier, and noise moves tau towards 0. The interval
    # is extended to the observed tau.
    low, high = min(low, observed), max(high, observed)
    p_value = _compute_permutation_p_value(ranks[1] - ranks[0], rng)
    halves = _compute_mean_split_half_tau(ranks[0], rng)
    return RankAgreement(observed, float(low), float(high), halves, p_value)


def _compute_permutation_p_value(changes: Array, rng: np.random.Generator) -> float:
    """Compute the p-value of changes of rank between two conditions, by a permutation test.

    The null hypothesis is that no tuner's mean rank changes. Under it, the two conditions of each
    target can be exchanged, which changes the signs of its rank changes. The p-value is the share
    of such random exchanges whose statistic, the sum over tuners of the squared mean change, is at
    least the observed one. Tau itself is not a suitable statistic: mean ranks that are all reversed
    stay reversed, only less so, under any exchange.

    Args:
        changes: (targets, tuners) change of each rank.
        rng: source of the permutations.
    """
    signs = rng.choice([-1.0, 1.0], size=(PERMUTATION_COUNT, len(changes)))
    # Sums over targets take the place of means, which differ by a constant factor only.
    permuted = ((signs @ changes) ** 2).sum(axis=1)
    observed = (changes.sum(axis=0) ** 2).sum()
    # An equal statistic may differ by rounding.
    extreme_count = (permuted >= observed * (1 - 1e-12)).sum()
    # The observed statistic is one of the permutations, so p is at least 1 / (n + 1).
    return float((1 + extreme_count) / (1 + PERMUTATION_COUNT))


def _compute_mean_split_half_tau(ranks: Array, rng: np.random.Generator) -> float:
    """Compute the mean Kendall tau between the rankings on two random halves of the targets.

    It says how well a ranking of tuners repeats on other targets: 1 is the same order, 0 a random
    one. NaN with fewer than two targets.

    Args:
        ranks: (targets, tuners) ranks on each target.
        rng: source of the random halves.
    """
    half_count = len(ranks) // 2
    if not half_count:
        return float("nan")
    taus = []
    for _ in range(HALF_SPLIT_COUNT):
        order = rng.permutation(len(ranks))
        taus.append(
            compute_kendall_tau(
                ranks[order[:half_count]].mean(axis=0), ranks[order[half_count:]].mean(axis=0)
            )
        )
    return float(np.nanmean(taus))
