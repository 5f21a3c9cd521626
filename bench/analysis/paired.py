"""Tuner against tuner: paired tests over targets with effect sizes, and mean ranks over problems.

Sources: F. Wilcoxon, Biometrics Bulletin 1(6), 1945 (scipy); S. Holm, Scand. J. Statist. 6, 65,
1979; D. S. Kerby, Comprehensive Psychology 3, 2014, for the matched-pairs rank-biserial
correlation; J. Demsar, JMLR 7, 2006, for ranks over problems, Friedman's and Nemenyi's tests
(scikit-posthocs).
"""

from __future__ import annotations

import itertools
import warnings
from typing import NamedTuple

import numpy as np
import pandas as pd

from bench.analysis.curves import Curves, mean_over_seeds
from sims.base import Array

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
LEAST = 1e-12
"""Errors below this count as equal: rounding."""
_WORST = 1e3
"""Logarithm that stands for a target on which a run failed: worse than any error, and as bad as
another failure.
"""
PROBLEMS = 5
"""Problems that mean ranks need at least."""


def log_errors(curves: Curves, k: int = -1, floor: float = LEAST) -> pd.DataFrame:
    """Logarithms of errors after k simulations, a row a target, a column a tuner.

    The mean over seeds is taken first. A failure in one seed makes it infinite: the tuner then
    counts as failed on this target.

    Args:
        curves: the error of every run.
        k: number of simulations; -1 for all.
        floor: errors below this count as equal to it.
    """
    columns = {}
    for tuner in curves.tuners():
        mine = curves.of(tuner=tuner)
        names, groups = mine.by_target()
        errors = mean_over_seeds(mine.after(k), groups)
        columns[tuner] = pd.Series(logarithms(errors, floor), index=names)
    return pd.DataFrame(columns)


def pairs(curves: Curves, floor: float = LEAST) -> pd.DataFrame:
    """Compare every pair of tuners on the targets of each experiment and range.

    Columns are `PAIR_COLUMNS`. `a_better` is the share of targets on which a ends with the smaller
    error (ties count half); `effect` the rank-biserial correlation, 1 where a is better on all
    targets, -1 where b is; `error_ratio` the median of a's error over b's. Holm's correction is
    over all pairs of an experiment and range.

    Args:
        curves: the error of every run.
        floor: errors below this count as equal to it.
    """
    parts = []
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        logs = log_errors(curves.of(experiment=str(experiment), range=str(kind)), floor=floor)
        lines = [
            (experiment, kind, a, b, *compared(logs[a].to_numpy(), logs[b].to_numpy()))
            for a, b in itertools.combinations(logs.columns, 2)
        ]
        # A single tuner makes no pair.
        if lines:
            part = pd.DataFrame(lines, columns=PAIR_COLUMNS[:-1])
            part["p_holm"] = holm(part["p_value"].to_numpy())
            parts.append(part)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=PAIR_COLUMNS)


def holm(p: Array) -> Array:
    """(n,) p-values p (n,) of one family, each corrected so that the chance of any false alarm
    among them stays at the level: the k-th smallest times n + 1 - k, none below one before it.
    """
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(steps, 1.0)
    return corrected


def logarithms(errors: Array, floor: float = LEAST) -> Array:
    """Return logarithms of errors (n,), of which those below `floor` count as equal to it.

    An infinite error, as of a run that failed, becomes a number that is worse than any error.
    """
    logs: Array = np.where(np.isinf(errors), _WORST, np.log(np.maximum(errors, floor)))
    return logs


class PairedTest(NamedTuple):
    """How tuner a does against tuner b on the same targets.

    Attributes:
        targets: number of targets that both have.
        a_better: share of them on which a has the smaller error; ties count half.
        effect: matched-pairs rank-biserial correlation, 1 where a is better on all targets.
        ratio: median over targets of a's error over b's.
        p_value: of Wilcoxon's signed-rank test, two-sided.
    """

    targets: int
    a_better: float
    effect: float
    ratio: float
    p_value: float


def compared(a: Array, b: Array) -> PairedTest:
    """Compare the logarithms of errors a and b (n,) on the same targets."""
    from scipy.stats import rankdata, wilcoxon

    there = ~(np.isnan(a) | np.isnan(b))
    difference = a[there] - b[there]
    wins = (difference < 0) + 0.5 * (difference == 0)
    better = float(wins.mean()) if len(difference) else np.nan
    # Wilcoxon drops ties: they speak for neither.
    unequal = difference[difference != 0]
    if not len(unequal):
        return PairedTest(len(difference), better, 0.0, 1.0, 1.0)
    ranks = rankdata(np.abs(unequal))
    # Kerby's simple difference: the share of ranks in favour less the share against.
    effect = float((ranks[unequal < 0].sum() - ranks[unequal > 0].sum()) / ranks.sum())
    with warnings.catch_warnings():
        # Of few pairs or ties it says that it approximates.
        warnings.simplefilter("ignore")
        p = float(wilcoxon(unequal).pvalue)
    # A failure against none makes a ratio beyond what a number holds.
    ratio = float(np.exp(np.clip(np.median(difference), -700, 700)))
    return PairedTest(len(difference), better, effect, ratio, p)


def ranks(curves: Curves, floor: float = LEAST) -> pd.DataFrame:
    """Rank each tuner (columns) on each problem (rows): by the median over targets, failures last,
    1 is best. Errors below `floor` count as equal to it.

    A problem is an experiment and a range; tuners that miss a problem are left out.
    """
    rows = {}
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        logs = log_errors(curves.of(experiment=str(experiment), range=str(kind)), floor=floor)
        rows[f"{experiment} {kind}"] = logs.median(axis=0)
    medians = pd.DataFrame(rows).T.dropna(axis="columns")
    # Rounded, so that errors that differ by the last bit share a rank.
    return medians.round(9).rank(axis=1)


def nemenyi(ranked: pd.DataFrame) -> tuple[float, pd.DataFrame]:
    """Friedman's p-value, and Nemenyi's for each pair of tuners, of ranks (problems, tuners).

    Raises:
        ValueError: fewer than `PROBLEMS` problems or three tuners, of which mean ranks say nothing.
    """
    if len(ranked) < PROBLEMS or ranked.shape[1] < 3:
        raise ValueError(f"mean ranks need {PROBLEMS} problems and 3 tuners, found {ranked.shape}")
    from scikit_posthocs import posthoc_nemenyi_friedman
    from scipy.stats import friedmanchisquare

    table = posthoc_nemenyi_friedman(ranked.to_numpy())
    table.index = table.columns = ranked.columns
    return float(friedmanchisquare(*ranked.to_numpy().T).pvalue), table
