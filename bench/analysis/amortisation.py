"""When training pays: simulations of learned and of search tuners over many targets, and who wins
at which cost.

A learned tuner costs its training once and little on each target. `break_even` says from how many
targets on the sum is below a search tuner's; `winners` who needs the least time when a simulation
takes c seconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.analysis.curves import Curves
from bench.analysis.runtimes import Effort, effort, percentile_interval, resampled
from sims.base import Array

EVEN_COLUMNS = [
    "experiment",
    "range",
    "threshold",
    "learned",
    "search",
    "fit_simulations",
    "fit_seconds",
    "ert_learned",
    "ert_search",
    "targets",
    "low",
    "high",
]
COSTS: Array = np.logspace(-6, 3, 181)
"""Seconds that a simulation may take."""
AT_ONCE, NEVER = 10**-0.5, 10**4.5
"""Places on a logarithmic axis of a training that pays from the first target on, because the search
never reaches the error, and of one that does not pay within 10^4 targets.
"""
SECONDS_COLUMNS = ["range", "tuner", "simulation_seconds", "seconds"]
SHARED = 100
"""Targets that share one training where it is asked who wins at which cost."""


@dataclass(frozen=True)
class Price:
    """What one tuner costs for one threshold.

    Attributes:
        effort: on each target.
        fit_simulations: of one training.
        fit_seconds: of one training, simulations included.
        simulation_seconds: of one simulation as it was made here.
    """

    effort: Effort
    fit_simulations: float = 0.0
    fit_seconds: float = 0.0
    simulation_seconds: float = 0.0

    def seconds(self, cost: Array, targets: float) -> Array:
        """Seconds a target at `cost` seconds a simulation, where the training is shared by so many
        targets.
        """
        # Of its training, what the simulations took here is replaced by what they cost there.
        learning = max(self.fit_seconds - self.fit_simulations * self.simulation_seconds, 0.0)
        marginal = self.effort.ert() * cost + self.effort.tuner_seconds()
        result: Array = marginal + (self.fit_simulations * cost + learning) / targets
        return result


def prices(
    curves: Curves,
    threshold: float,
    budget: int,
    tuner_seconds: Array,
    simulator_seconds: Array,
    fits: Mapping[str, tuple[float, float]],
) -> dict[str, Price]:
    """The price of every tuner in one experiment and range.

    Args:
        curves: of all its tuners.
        threshold: of the metric.
        budget: simulations on one target.
        tuner_seconds: (R, K + 1) spent in the tuner so far.
        simulator_seconds: likewise in the simulator.
        fits: (simulations, seconds) of one training, by tuner.
    """
    result = {}
    for tuner in curves.tuners():
        mask = (curves.keys["tuner"] == tuner).to_numpy(dtype=bool)
        spent = effort(curves.where(mask), threshold, budget, tuner_seconds[mask])
        each = float(simulator_seconds[mask][:, -1].sum() / max(curves.used[mask].sum(), 1))
        result[tuner] = Price(spent, *fits.get(tuner, (0.0, 0.0)), each)
    return result


def break_even(learned: Price, search: Price, picked: NDArray[np.int64] | None = None) -> Array:
    """Targets n at which fit + n ert_learned = n ert_search: from there on training pays.

    0 where the search never reaches the threshold, infinite where training never pays.
    """
    # Solved for n: fit / (ert_search - ert_learned).
    hopeless = np.isinf(learned.effort.ert(picked))
    # Where neither gets there, or they need the same, there is no number.
    with np.errstate(invalid="ignore", divide="ignore"):
        saved = search.effort.ert(picked) - learned.effort.ert(picked)
        result: Array = np.where(hopeless | ~(saved > 0), np.inf, learned.fit_simulations / saved)
    return result


def break_even_table(
    experiment: str, kind: str, threshold: float, held: Mapping[str, Price]
) -> pd.DataFrame:
    """Every learned tuner against every search tuner, with 95 % bootstrap intervals over targets,
    `EVEN_COLUMNS`.
    """
    lines = []
    for name, learned in held.items():
        for other, search in held.items():
            # Only one that was trained can have paid for it, and only against one that was not.
            if not learned.fit_simulations or search.fit_simulations:
                continue
            picked = resampled(len(learned.effort.successes), experiment, kind)
            low, high = percentile_interval(break_even(learned, search, picked))
            costs = learned.fit_simulations, learned.fit_seconds
            erts = float(learned.effort.ert()), float(search.effort.ert())
            even = float(break_even(learned, search))
            lines.append((experiment, kind, threshold, name, other, *costs, *erts, even, low, high))
    return pd.DataFrame(lines, columns=EVEN_COLUMNS)


def winners(held: Mapping[str, Price], targets: float) -> list[tuple[float, float, str]]:
    """(from, to, tuner): ranges of the cost of a simulation in seconds, and who needs the least
    time there.
    """
    names = [name for name, price in held.items() if np.isfinite(price.effort.ert())]
    if not names:
        return []
    best = np.argmin([held[name].seconds(COSTS, targets) for name in names], axis=0)
    changes = np.flatnonzero(np.diff(best)) + 1
    edges = [0, *changes.tolist(), len(COSTS)]
    return [
        (float(COSTS[begin]), float(COSTS[end - 1]), names[best[begin]])
        for begin, end in itertools.pairwise(edges)
    ]


def seconds_table(prices: Mapping[str, Mapping[str, Price]]) -> pd.DataFrame:
    """Seconds for a target by the cost of a simulation, `SECONDS_COLUMNS`; nothing of who never
    reaches the error.

    Args:
        prices: of reaching one error, by range, by tuner.
    """
    parts = []
    for kind, by_tuner in prices.items():
        for tuner, price in by_tuner.items():
            seconds = price.seconds(COSTS, SHARED)
            # A logarithmic axis has no place for who is there from the start.
            if np.isfinite(price.effort.ert()) and seconds[0] > 0:
                columns = (kind, tuner, COSTS, seconds)
                parts.append(pd.DataFrame(dict(zip(SECONDS_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=SECONDS_COLUMNS)


def placed_even(table: pd.DataFrame) -> pd.DataFrame:
    """Put the numbers of targets of `break_even_table` on a logarithmic axis from `AT_ONCE` to
    `NEVER`.
    """
    placed = table.copy()
    for column in ("targets", "low", "high"):
        values = table[column].to_numpy(dtype=np.float64)
        # Fewer than one target is the first; what is beyond the axis stands at its end.
        within = np.where(values < 1e4, np.maximum(values, 1.0), NEVER)
        placed[column] = np.where(values == 0, AT_ONCE, within)
    return placed
