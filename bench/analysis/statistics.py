"""The numbers behind the tables and figures of one comparison, each computed once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import pandas as pd

from bench.analysis.amortisation import Price, prices
from bench.analysis.curves import Rows, primary
from bench.analysis.runtimes import thresholds
from bench.problem.experiment import Experiment

PRICED = 3
"""Levels, the loosest first, that have prices: tighter ones hardly a tuner reaches."""


class Statistics:
    """What decides a comparison, and what reaching it took.

    Args:
        experiment: what was compared.
        runs: rows of runs.parquet.
        statuses: rows of status.csv.
        costs: (simulations, seconds) of one training, by tuner.

    Attributes:
        metric: that decides, see `primary`.
        runs: those that have it.
        curves: the metric of every run.
        spread: thresholds of the runtime distribution.
        levels: thresholds of the tables.
    """

    def __init__(
        self,
        experiment: Experiment,
        runs: pd.DataFrame,
        statuses: pd.DataFrame,
        costs: Mapping[str, tuple[float, float]],
    ) -> None:
        self.metric, self.runs, in_widths = primary(runs)
        self._rows = Rows(self.runs, statuses, experiment.budget)
        self.curves = self._rows.curves(self.metric)
        self.spread, self.levels = thresholds(self.curves, in_widths)
        self._budget, self._costs = experiment.budget, costs

    @cached_property
    def prices(self) -> dict[float, dict[str, dict[str, Price]]]:
        """What every tuner costs: by level (the first `PRICED`), by range, by tuner."""
        return {level: self._prices(level) for level in self.levels[:PRICED]}

    def _prices(self, level: float) -> dict[str, dict[str, Price]]:
        in_tuner = self._rows.spent("tuner_seconds")
        in_simulator = self._rows.spent("simulator_seconds")
        ranges = self.curves.keys["range"]
        result = {}
        for kind in dict.fromkeys(ranges):
            mask = (ranges == kind).to_numpy(dtype=bool)
            result[str(kind)] = prices(
                self.curves.where(mask),
                level,
                self._budget,
                in_tuner[mask],
                in_simulator[mask],
                self._costs,
            )
        return result

    @cached_property
    def level(self) -> float:
        """The tightest level that at least half of the tuners reach in some run, in every range;
        else the loosest.
        """
        for level in sorted(self.prices):
            if all(_half(by_tuner) for by_tuner in self.prices[level].values()):
                return level
        return max(self.prices)


def _half(by_tuner: Mapping[str, Price]) -> bool:
    reaching = sum(np.isfinite(price.effort.ert()) for price in by_tuner.values())
    return bool(2 * reaching >= len(by_tuner))
