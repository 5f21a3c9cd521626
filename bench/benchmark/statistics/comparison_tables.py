"""Tables of a comparison: errors, running times, rankings, pairs, break-even, identifiability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.fisher_information import InformationSpectrum
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_curves import build_error_table
from bench.benchmark.statistics.expected_running_time import build_ert_table
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.training_amortisation import (
    BREAK_EVEN_COLUMNS,
    TARGETS_PER_TRAINING,
    build_break_even_table,
    find_cheapest_tuners,
)
from bench.benchmark.storage.result_folder import StoredComparison
from sims.core.simulator import Parameter


def add_trust_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `trusted`, True if the tuners ran without isolation.

    Args:
        frame: any table of the comparison.
        experiment: configuration of the experiment.
    """
    return frame.assign(trusted=experiment.trusted)


def add_salt_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `salt`: ``secret`` if the salt is committed by a hash, else ``public``.

    Args:
        frame: any table of the comparison.
        experiment: configuration of the experiment.
    """
    return frame.assign(salt="secret" if experiment.salt_sha256 else "public")


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

    Args:
        experiment: name of the experiment.
        statistics: statistics of the comparison, with the costs of the tuners.
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

    Args:
        experiment: name of the experiment.
        statistics: statistics of the comparison, with the costs of the tuners.
    """
    lines = [
        (experiment, kind, level, *line)
        for level, ranges in statistics.tuning_costs.items()
        for kind, by_tuner in ranges.items()
        for line in find_cheapest_tuners(by_tuner, TARGETS_PER_TRAINING)
    ]
    return pd.DataFrame(lines, columns=WINNER_COLUMNS)


IDENTIFIABILITY_COLUMNS = [
    "experiment",
    "target",
    "range",
    "direction",
    "eigenvalue",
    "sigma",
    "stiff",
]


def build_identifiability_table(
    experiment: Experiment,
    spectra: Mapping[str, InformationSpectrum],
    parameters: Sequence[Parameter],
) -> pd.DataFrame:
    """Build a table with one row per target and direction, the stiffest direction first.

    Args:
        experiment: experiment of the targets.
        spectra: identifiability spectrum by target.
        parameters: tuned parameters.

    Returns:
        Table of eigenvalues, standard deviations and the components of each parameter.
    """
    lines = [
        [
            experiment.name,
            target,
            target.split("-")[0],
            i + 1,
            spectrum.values[i],
            spectrum.sigmas[i],
            spectrum.is_stiff[i],
            *spectrum.vectors[:, i],
        ]
        for target, spectrum in spectra.items()
        for i in range(len(spectrum.values))
    ]
    return pd.DataFrame(lines, columns=[*IDENTIFIABILITY_COLUMNS, *(p.name for p in parameters)])
