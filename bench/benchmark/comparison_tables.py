"""Tables of a comparison: errors, running times, rankings, pairs, break-even and fastest tuners."""

from __future__ import annotations

import pandas as pd

from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_table import build_error_table
from bench.benchmark.statistics.expected_running_time import build_ert_table
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.provenance_columns import add_salt_column, add_trust_column
from bench.benchmark.statistics.training_amortisation import (
    BREAK_EVEN_COLUMNS,
    TARGETS_PER_TRAINING,
    build_break_even_table,
    find_cheapest_tuners,
)
from bench.benchmark.storage.result_folder import StoredComparison

WINNER_COLUMNS = ["experiment", "range", "threshold", "from_seconds", "to_seconds", "tuner"]


def build_tables(
    stored: StoredComparison, statistics: ComparisonStatistics | None = None
) -> dict[str, pd.DataFrame]:
    """Build the tables of a comparison: table, ert, ranking, pairs, break_even and who_wins.

    Args:
        stored: stored comparison, from `bench.benchmark.storage.result_folder.read_comparison`.
        statistics: statistics of the comparison; None to compute them.

    Returns:
        Tables by name; empty without a run.
    """
    if stored.runs.empty:
        return {}
    experiment = stored.experiment
    statistics = statistics or ComparisonStatistics(stored)
    lines = build_error_table(stored.runs, stored.statuses, experiment.budget, stored.costs)
    frames = {
        "table": statistics.sort_rows(add_salt_column(lines, experiment)),
        "ert": statistics.sort_rows(
            build_ert_table(statistics.curves, statistics.levels, experiment.budget)
        ),
        "ranking": statistics.ranking,
        "pairs": compare_all_pairs(statistics.curves, statistics.floor),
        "break_even": _build_break_even_rows(experiment.name, statistics),
        "who_wins": _build_fastest_tuner_table(experiment.name, statistics),
    }
    return {name: add_trust_column(frame, experiment) for name, frame in frames.items()}


def _build_break_even_rows(experiment: str, statistics: ComparisonStatistics) -> pd.DataFrame:
    """Build the table of break-even targets for all priced thresholds and ranges.

    It says from how many targets on the training of a learned tuner costs less than a search.
    """
    parts = [
        build_break_even_table(experiment, kind, level, by_tuner)
        for level, ranges in statistics.tuning_costs.items()
        for kind, by_tuner in ranges.items()
    ]
    # Concatenation with an empty part would change numeric columns to object columns.
    parts = [part for part in parts if len(part)]
    return pd.concat(parts) if parts else pd.DataFrame(columns=BREAK_EVEN_COLUMNS)


def _build_fastest_tuner_table(experiment: str, statistics: ComparisonStatistics) -> pd.DataFrame:
    """Build the table of the fastest tuner by duration of one simulation, per threshold and range.

    A training is shared by `TARGETS_PER_TRAINING` targets. Each row has the bounds of the duration
    in seconds, and the tuner that needs the least time between them.
    """
    lines = [
        (experiment, kind, level, *line)
        for level, ranges in statistics.tuning_costs.items()
        for kind, by_tuner in ranges.items()
        for line in find_cheapest_tuners(by_tuner, TARGETS_PER_TRAINING)
    ]
    return pd.DataFrame(lines, columns=WINNER_COLUMNS)
