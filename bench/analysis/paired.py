"""Tuner against tuner: paired tests over targets with effect sizes, and mean ranks over problems.

Sources: F. Wilcoxon, Biometrics Bulletin 1(6), 1945 (scipy); S. Holm, Scand. J. Statist. 6, 65,
1979; D. S. Kerby, Comprehensive Psychology 3, 2014, for the matched-pairs rank-biserial
correlation; J. Demsar, JMLR 7, 2006, for ranks over problems, Friedman's and Nemenyi's tests
(scikit-posthocs).
"""

from __future__ import annotations

import itertools
import warnings

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


def log_errors(curves: Curves) -> pd.DataFrame:
    """Logarithms of final errors, a row a target, a column a tuner; the mean over seeds first."""
    columns = {}
    for tuner in curves.tuners():
        mine = curves.of(tuner=tuner)
        names, groups = mine.by_target()
        errors = mean_over_seeds(mine.final(), groups)
        # A failure in one seed makes the target's mean infinite: it counts as failed.
        columns[tuner] = pd.Series(logarithms(errors), index=names)
    return pd.DataFrame(columns)


def pairs(curves: Curves) -> pd.DataFrame:
    """Every pair of tuners on the targets of each experiment and range, columns as `PAIR_COLUMNS`.

    `a_better` is the share of targets on which a ends with the smaller error (ties count half);
    `effect` the rank-biserial correlation, 1 where a is better on all targets, -1 where b is;
    `error_ratio` the median of a's error over b's. Holm's correction is over all pairs of an
    experiment and range.
    """
    parts = []
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        logs = log_errors(curves.of(experiment=str(experiment), range=str(kind)))
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


def logarithms(errors: Array) -> Array:
    """(n,) logarithms of errors (n,); of an infinite one, as of a run that failed, what is worse
    than any error.
    """
    logs: Array = np.where(np.isinf(errors), _WORST, np.log(np.maximum(errors, LEAST)))
    return logs


def compared(a: Array, b: Array) -> tuple[int, float, float, float, float]:
    """Targets, share on which a is better, effect, ratio of errors and p-value (Wilcoxon's
    signed-rank test), of logarithms of errors a and b (n,) on the same targets.
    """
    from scipy.stats import rankdata, wilcoxon

    there = ~(np.isnan(a) | np.isnan(b))
    difference = a[there] - b[there]
    wins = (difference < 0) + 0.5 * (difference == 0)
    better = float(wins.mean()) if len(difference) else np.nan
    # Wilcoxon drops ties: they speak for neither.
    unequal = difference[difference != 0]
    if not len(unequal):
        return len(difference), better, 0.0, 1.0, 1.0
    ranks = rankdata(np.abs(unequal))
    # Kerby's simple difference: the share of ranks in favour less the share against.
    effect = float((ranks[unequal < 0].sum() - ranks[unequal > 0].sum()) / ranks.sum())
    with warnings.catch_warnings():
        # Of few pairs or ties it says that it approximates.
        warnings.simplefilter("ignore")
        p = float(wilcoxon(unequal).pvalue)
    # A failure against none makes a ratio beyond what a number holds.
    ratio = float(np.exp(np.clip(np.median(difference), -700, 700)))
    return len(difference), better, effect, ratio, p


def ranks(curves: Curves) -> pd.DataFrame:
    """Rank of each tuner (columns) on each problem (rows): by the median over targets, failures
    last, 1 is best.

    A problem is an experiment and a range; tuners that miss a problem are left out.
    """
    rows = {}
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        logs = log_errors(curves.of(experiment=str(experiment), range=str(kind)))
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
