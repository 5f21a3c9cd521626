"""Compare the training cost of learned tuners with the cost of search tuners.

A learned tuner has a training cost, which is paid once, and a small cost for each target.
`compute_break_even_targets` computes the number of targets from which its total number of
simulations is below the one of a search tuner. `find_cheapest_tuners` finds the tuner that needs
the least time when a simulation takes c seconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.statistics.bootstrap import compute_percentile_interval, draw_target_resamples
from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.expected_running_time import ThresholdEffort, compute_effort
from sims.core.simulator import Array

BREAK_EVEN_COLUMNS = [
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
WINNER_COLUMNS = ["experiment", "range", "threshold", "from_seconds", "to_seconds", "tuner"]
SIMULATION_COST_GRID: Array = np.logspace(-6, 3, 181)
"""Durations of one simulation for which tuners are compared, in seconds."""
AT_ONCE, NEVER = 10**-0.5, 10**4.5
"""Positions on a logarithmic axis for two results without a finite number of targets.

`AT_ONCE`: training pays from the first target, because the search tuner never reaches the error.
`NEVER`: training does not pay within 10^4 targets.
"""
TIME_PER_TARGET_COLUMNS = ["range", "tuner", "simulation_seconds", "seconds"]
TARGETS_PER_TRAINING = 100
"""Number of targets that share one training when tuners are compared by time."""


@dataclass(frozen=True)
class TuningCost:
    """Cost of one tuner to reach one threshold.

    Attributes:
        effort: simulations and seconds spent on each target.
        fit_simulations: number of simulations of one training.
        fit_seconds: duration of one training including its simulations, in seconds.
        simulation_seconds: duration of one simulation as measured in these runs, in seconds.
    """

    effort: ThresholdEffort
    fit_simulations: float = 0.0
    fit_seconds: float = 0.0
    simulation_seconds: float = 0.0

    def compute_seconds_per_target(self, cost: Array, targets: float) -> Array:
        """Compute the seconds per target for a given duration of one simulation.

        They are the time of a target itself, simulations and tuner, and its share of a training.
        The simulations of a target are its expected running time (ERT), those per success.

        Args:
            cost: duration of one simulation in seconds, any shape.
            targets: number of targets that share the cost of one training.

        Returns:
            Seconds per target, in the shape of `cost`.
        """
        # The measured time of the training simulations is replaced by their time at the given cost.
        learning_seconds = max(
            self.fit_seconds - self.fit_simulations * self.simulation_seconds, 0.0
        )
        tuning_seconds = self.effort.compute_ert() * cost + self.effort.compute_tuner_seconds()
        training_seconds = self.fit_simulations * cost + learning_seconds
        result: Array = tuning_seconds + training_seconds / targets
        return result


TuningCosts: TypeAlias = Mapping[float, Mapping[str, Mapping[str, TuningCost]]]
"""Costs by error threshold, by range of targets, and by tuner."""


def compute_tuning_costs(
    curves: RunCurves,
    threshold: float,
    budget: int,
    tuner_seconds: Array,
    simulator_seconds: Array,
    fits: Mapping[str, tuple[float, float]],
) -> dict[str, TuningCost]:
    """Compute the cost of every tuner in one experiment and range.

    Args:
        curves: error curves of all tuners.
        threshold: error threshold of the metric.
        budget: number of simulations on one target.
        tuner_seconds: (R, K + 1) cumulative seconds spent in the tuner after k simulations.
        simulator_seconds: (R, K + 1) cumulative seconds spent in the simulator after k simulations.
        fits: (simulations, seconds) of one training, by tuner.

    Returns:
        Cost by tuner.
    """
    result = {}
    for tuner in curves.list_tuners():
        mask = (curves.keys["tuner"] == tuner).to_numpy(dtype=bool)
        effort = compute_effort(curves.select_mask(mask), threshold, budget, tuner_seconds[mask])
        # The last column has the total of each run.
        seconds_per_simulation = float(
            simulator_seconds[mask][:, -1].sum() / max(curves.used[mask].sum(), 1)
        )
        result[tuner] = TuningCost(effort, *fits.get(tuner, (0.0, 0.0)), seconds_per_simulation)
    return result


def split_by_training(
    costs_by_range: Mapping[str, Mapping[str, TuningCost]], order: Sequence[str]
) -> tuple[list[str], list[str]]:
    """List the untrained tuners, and the trained ones that reach an error in some range.

    Args:
        costs_by_range: cost of every tuner to reach the error, by range, by tuner.
        order: tuners in the order of the ranking.

    Returns:
        Untrained tuners and trained tuners, each list in the order of the ranking.
    """
    untrained, trained = [], []
    for tuner in order:
        costs = [by_tuner[tuner] for by_tuner in costs_by_range.values() if tuner in by_tuner]
        # A tuner without a run has no costs, and is in neither list.
        if not costs:
            continue
        # Only a training uses simulations before the first target (`fit_simulations`).
        if not any(cost.fit_simulations for cost in costs):
            untrained.append(tuner)
        # The expected running time (ERT) is infinite if no run reaches the error.
        elif any(cost.effort.compute_ert() < float("inf") for cost in costs):
            trained.append(tuner)
    return untrained, trained


def compute_break_even_targets(
    learned: TuningCost, search: TuningCost, picked: NDArray[np.int64] | None = None
) -> Array:
    """Compute the number of targets from which training a learned tuner pays.

    Training costs `fit` simulations once; then the learned tuner needs fewer simulations for each
    target than the search tuner. The break-even number n of targets solves
    fit + n ert_learned = n ert_search, with the expected running times (ERT) of both tuners.

    Args:
        learned: cost of the learned tuner.
        search: cost of the search tuner.
        picked: (..., n) indices of the targets whose effort gives the ERT, such as bootstrap
            resamples; None for all targets.

    Returns:
        (...) numbers of targets; 0 where the search tuner never reaches the threshold, infinite
        where training never pays.
    """
    learned_never_succeeds = np.isinf(learned.effort.compute_ert(picked))
    # Solved for n: fit / (ert_search - ert_learned). If the search tuner never reaches the
    # threshold, its ERT is infinite, and n is 0.
    # Training never pays if the saving is not positive, or NaN because both tuners fail.
    with np.errstate(invalid="ignore", divide="ignore"):
        saving = search.effort.compute_ert(picked) - learned.effort.compute_ert(picked)
        result: Array = np.where(
            learned_never_succeeds | ~(saving > 0), np.inf, learned.fit_simulations / saving
        )
    return result


def build_break_even_table(
    experiment: str, kind: str, threshold: float, costs_by_tuner: Mapping[str, TuningCost]
) -> pd.DataFrame:
    """Compare every learned tuner with every search tuner by break-even targets.

    They are the number of targets after which training has paid off. Both tuners are also compared
    by their expected running time (ERT), the simulations per success.

    Args:
        experiment: name of the experiment.
        kind: range of the targets.
        threshold: error threshold of the metric.
        costs_by_tuner: cost by tuner.

    Returns:
        One row per pair with 95 % bootstrap intervals over targets, columns `BREAK_EVEN_COLUMNS`.
    """
    lines = []
    for learned_name, learned_cost in costs_by_tuner.items():
        for search_name, search_cost in costs_by_tuner.items():
            # Only a trained tuner has a training cost, and it is compared with untrained tuners
            # alone.
            if not learned_cost.fit_simulations or search_cost.fit_simulations:
                continue
            # `successes` has one number for each target.
            target_count = len(learned_cost.effort.successes)
            resamples = draw_target_resamples(target_count, experiment, kind)
            low, high = compute_percentile_interval(
                compute_break_even_targets(learned_cost, search_cost, resamples)
            )
            training_cost = learned_cost.fit_simulations, learned_cost.fit_seconds
            learned_ert = float(learned_cost.effort.compute_ert())
            search_ert = float(search_cost.effort.compute_ert())
            break_even = float(compute_break_even_targets(learned_cost, search_cost))
            lines.append(
                (
                    experiment,
                    kind,
                    threshold,
                    learned_name,
                    search_name,
                    *training_cost,
                    learned_ert,
                    search_ert,
                    break_even,
                    low,
                    high,
                )
            )
    return pd.DataFrame(lines, columns=BREAK_EVEN_COLUMNS)


def build_break_even_tables(experiment: str, tuning_costs: TuningCosts) -> pd.DataFrame:
    """Build the table of break-even targets for all thresholds and ranges.

    It says from how many targets on the training of a learned tuner costs less than a search.

    Args:
        experiment: name of the experiment.
        tuning_costs: cost of every tuner.

    Returns:
        Table with the columns `BREAK_EVEN_COLUMNS`.
    """
    parts = [
        build_break_even_table(experiment, kind, level, by_tuner)
        for level, ranges in tuning_costs.items()
        for kind, by_tuner in ranges.items()
    ]
    # Concatenation with an empty part would change numeric columns to object columns.
    parts = [part for part in parts if len(part)]
    return pd.concat(parts) if parts else pd.DataFrame(columns=BREAK_EVEN_COLUMNS)


def find_cheapest_tuners(
    costs_by_tuner: Mapping[str, TuningCost], targets: float
) -> list[tuple[float, float, str]]:
    """Find the fastest tuner for each duration of one simulation.

    The durations are those of `SIMULATION_COST_GRID`. Slow simulations favour tuners that need few
    of them, fast simulations favour tuners whose own computations are fast.

    Args:
        costs_by_tuner: cost by tuner.
        targets: number of targets that share the cost of one training.

    Returns:
        List of (from, to, tuner): bounds of the duration of one simulation in seconds, and the
        tuner that needs the least time between them. Empty if no tuner reaches the threshold.
    """
    # The expected running time (ERT) is infinite for a tuner that never reaches the threshold.
    successful_costs = {
        name: cost
        for name, cost in costs_by_tuner.items()
        if np.isfinite(cost.effort.compute_ert())
    }
    if not successful_costs:
        return []
    names = list(successful_costs)
    seconds = [
        cost.compute_seconds_per_target(SIMULATION_COST_GRID, targets)
        for cost in successful_costs.values()
    ]
    # Position in `names` of the fastest tuner at each duration of the grid.
    cheapest = np.argmin(seconds, axis=0)
    # Positions in the grid from which on another tuner is the fastest.
    changes = np.flatnonzero(np.diff(cheapest)) + 1
    edges = [0, *changes.tolist(), len(SIMULATION_COST_GRID)]
    return [
        (
            float(SIMULATION_COST_GRID[first]),
            float(SIMULATION_COST_GRID[last - 1]),
            names[cheapest[first]],
        )
        for first, last in itertools.pairwise(edges)
    ]


def build_fastest_tuner_table(experiment: str, tuning_costs: TuningCosts) -> pd.DataFrame:
    """Build the table of the fastest tuner by duration of one simulation, per threshold and range.

    A training is shared by `TARGETS_PER_TRAINING` targets. Each row has the bounds of the duration
    in seconds, and the tuner that needs the least time between them.

    Args:
        experiment: name of the experiment.
        tuning_costs: cost of every tuner.

    Returns:
        Table with the columns `WINNER_COLUMNS`.
    """
    lines = [
        (experiment, kind, level, *line)
        for level, ranges in tuning_costs.items()
        for kind, by_tuner in ranges.items()
        for line in find_cheapest_tuners(by_tuner, TARGETS_PER_TRAINING)
    ]
    return pd.DataFrame(lines, columns=WINNER_COLUMNS)


def build_time_per_target_table(prices: Mapping[str, Mapping[str, TuningCost]]) -> pd.DataFrame:
    """Build a table of seconds per target against the duration of one simulation.

    Tuners that never reach the error have no rows.

    Args:
        prices: cost to reach one error, by range, by tuner.

    Returns:
        Table with the columns `TIME_PER_TARGET_COLUMNS`.
    """
    tables = []
    for kind, by_tuner in prices.items():
        for tuner, price in by_tuner.items():
            seconds = price.compute_seconds_per_target(SIMULATION_COST_GRID, TARGETS_PER_TRAINING)
            # The expected running time (ERT) is infinite if a tuner never reaches the error. A
            # logarithmic axis cannot show a tuner that needs 0 seconds.
            if np.isfinite(price.effort.compute_ert()) and seconds[0] > 0:
                columns = (kind, tuner, SIMULATION_COST_GRID, seconds)
                tables.append(
                    pd.DataFrame(dict(zip(TIME_PER_TARGET_COLUMNS, columns, strict=True)))
                )
    if tables:
        return pd.concat(tables, ignore_index=True)
    return pd.DataFrame(columns=TIME_PER_TARGET_COLUMNS)


def map_break_even_counts(table: pd.DataFrame) -> pd.DataFrame:
    """Map counts of `build_break_even_table` to a logarithmic axis from `AT_ONCE` to `NEVER`.

    A count of 0 (training pays at once) becomes `AT_ONCE`, a count of 10^4 or more `NEVER`. Counts
    between 0 and 1 become 1.

    Args:
        table: Counts of targets after which a training has paid, with intervals.

    Returns:
        The table with the mapped columns `targets`, `low` and `high`.
    """
    mapped_table = table.copy()
    for column in ("targets", "low", "high"):
        values = table[column].to_numpy(dtype=np.float64)
        clipped_values = np.where(values < 1e4, np.maximum(values, 1.0), NEVER)
        mapped_table[column] = np.where(values == 0, AT_ONCE, clipped_values)
    return mapped_table
