"""Expected running time and runtime distributions over error thresholds, as in COCO.

Source: N. Hansen, A. Auger, D. Brockhoff, T. Tusar, Anytime performance assessment in blackbox
optimization benchmarking, IEEE TEVC 26(6), 2022, sections III and IV; N. Hansen, A. Auger, R. Ros,
S. Finck, P. Posik, Comparing results of 31 algorithms from BBOB-2009, GECCO 2010, for ERT. Two
things differ on purpose. A run has reached a
threshold after the simulation from which on what it would deliver *stays* within it: the first
touch is known to nobody who has no truth. And a failed run has reached nothing and counts with its
whole budget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.analysis.curves import Curves
from bench.analysis.table import checkpoints
from bench.problem.seeds import rng_for
from sims.base import Array

THRESHOLDS: Array = np.logspace(0, -8, 51)
"""Of the runtime distribution, in training widths; as many as COCO's."""
LEVELS = (0.1, 0.01, 1e-3, 1e-4, 1e-6)
"""Of the ERT table, in training widths."""


def thresholds(curves: Curves, simulated: bool) -> tuple[Array, tuple[float, ...]]:
    """Thresholds of the distribution and levels of the table.

    On a recording they lie between the median error of the starts and the least that anyone ended
    with.
    """
    if simulated:
        return THRESHOLDS, LEVELS
    start = float(np.nanmedian(curves.values[:, 0]))
    # At least half the way: where nobody improved, thresholds must differ all the same.
    best = min(float(np.nanmin(curves.final())), 0.5 * start)
    # A little above the best, so that rounding does not keep the best from reaching it.
    spread = np.geomspace(start, 1.001 * best, 21)
    return spread, tuple(float(x) for x in spread[[5, 10, 15, 18, 20]])


def reached(curves: Curves, threshold: float) -> Array:
    """(R,) simulations after which the error stays at or below `threshold`; infinite where it never
    does.
    """
    # Negated, so that a NaN is beyond.
    beyond = ~(curves.values <= threshold)
    steps = beyond.shape[1]
    # One behind the last that is beyond: from there on the error stays.
    last = steps - np.argmax(beyond[:, ::-1], axis=1)
    last = np.where(beyond.any(axis=1), last, 0)
    return np.where((last >= steps) | curves.failed, np.inf, last.astype(np.float64))


@dataclass(frozen=True)
class Effort:
    """What reaching a threshold took, by target.

    Attributes:
        simulations: (targets,) spent in all runs of a target, until the threshold or the end.
        seconds: (targets,) of the tuner, likewise.
        successes: (targets,) runs that reached it.
        runs: all runs.
    """

    simulations: Array
    seconds: Array
    successes: NDArray[np.int64]
    runs: int

    def ert(self, picked: NDArray[np.int64] | None = None) -> Array:
        """Simulations spent for each success, over the targets `picked` (..., n); infinite without
        a success.
        """
        return _per_success(self.simulations, self.successes, picked)

    def tuner_seconds(self) -> float:
        """Seconds in the tuner for each success."""
        return float(_per_success(self.seconds, self.successes, None))


def _per_success(
    spent: Array, successes: NDArray[np.int64], picked: NDArray[np.int64] | None
) -> Array:
    if picked is not None:
        spent, successes = spent[picked], successes[picked]
    total, count = spent.sum(axis=-1), successes.sum(axis=-1)
    result: Array = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return result


def effort(
    curves: Curves, threshold: float, budget: int, tuner_seconds: Array | None = None
) -> Effort:
    """What it took the runs of one tuner to reach `threshold`.

    Args:
        curves: of one tuner and range.
        threshold: of the metric.
        budget: what a failed run counts with.
        tuner_seconds: (R, K + 1) spent in the tuner so far.
    """
    times = reached(curves, threshold)
    success = np.isfinite(times)
    unsuccessful = np.where(curves.failed, budget, curves.used)
    spent = np.where(success, times, unsuccessful)
    seconds = np.zeros(len(spent))
    if tuner_seconds is not None:
        # A run that went beyond the budget of interest counts with its seconds there.
        column = np.minimum(spent, tuner_seconds.shape[1] - 1).astype(np.int64)
        seconds = tuner_seconds[np.arange(len(spent)), column]
    _, groups = curves.by_target()
    return Effort(
        np.array([spent[rows].sum() for rows in groups]),
        np.array([seconds[rows].sum() for rows in groups]),
        np.array([success[rows].sum() for rows in groups]),
        len(spent),
    )


def resampled(targets: int, *names: str, resamples: int = 1000) -> NDArray[np.int64]:
    """(resamples, targets) places of targets drawn with replacement; the same for tuners that share
    the targets.
    """
    return rng_for("resample", *names).integers(targets, size=(resamples, targets))


def percentile_interval(values: Array) -> tuple[float, float]:
    """95 % percentile interval of resampled values, which may be infinite."""
    # Order statistics, no interpolation: between a number and infinity lies nothing.
    ordered = np.sort(values)
    n = len(ordered)
    return float(ordered[int(0.025 * (n - 1))]), float(ordered[int(np.ceil(0.975 * (n - 1)))])


ERT_COLUMNS = [
    "experiment",
    "range",
    "tuner",
    "threshold",
    "ert",
    "low",
    "high",
    "successes",
    "runs",
    "failures",
]


def ert_table(curves: Curves, levels: tuple[float, ...], budget: int) -> pd.DataFrame:
    """ERT with its 95 % bootstrap interval over targets, columns as `ERT_COLUMNS`."""
    lines = []
    for (experiment, kind), _ in curves.keys.groupby(["experiment", "range"], sort=False):
        part = curves.of(experiment=str(experiment), range=str(kind))
        for tuner in part.tuners():
            mine = part.of(tuner=tuner)
            for level in levels:
                spent = effort(mine, level, budget)
                # The same draws for every tuner: what they share does not blur a comparison.
                picked = resampled(len(spent.successes), str(experiment), str(kind))
                low, high = percentile_interval(spent.ert(picked))
                counts = int(spent.successes.sum()), spent.runs, int(mine.failed.sum())
                lines.append(
                    (experiment, kind, tuner, level, float(spent.ert()), low, high, *counts)
                )
    return pd.DataFrame(lines, columns=ERT_COLUMNS)


SHARE_COLUMNS = ["range", "tuner", "simulations", "share"]
_POINTS = 60
"""Numbers of simulations of a runtime distribution, on a logarithmic scale."""


def solved(curves: Curves, spread: Array, points: NDArray[np.int64]) -> Array:
    """(P,) share of pairs of run and threshold reached after each of `points` simulations."""
    times = np.concatenate([reached(curves, float(t)) for t in spread])
    return np.array([(times <= k).mean() for k in points])


def share_table(curves: Curves, spread: Array) -> pd.DataFrame:
    """Runtime distributions, `SHARE_COLUMNS`: the share of (run, threshold) pairs reached for good,
    at numbers of simulations on a logarithmic scale and at those that tables name.

    Args:
        curves: of the deciding metric, all ranges.
        spread: thresholds of that metric.
    """
    budget = curves.values.shape[1] - 1
    between = np.geomspace(1, budget, _POINTS).astype(int)
    points = np.unique(np.concatenate([[0], between, checkpoints(budget)]))
    parts = []
    for kind in dict.fromkeys(curves.keys["range"]):
        part = curves.of(range=str(kind))
        for tuner in part.tuners():
            share = solved(part.of(tuner=tuner), spread, points)
            columns = (str(kind), tuner, points, share)
            parts.append(pd.DataFrame(dict(zip(SHARE_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True)
