"""Columns of all tables of a comparison of diagnosers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.table_schemas import Columns, ColumnSpec, EmptyCellRule
from bench.diagnosis_benchmark.case_generation.recording_conditions import CASE_KINDS
from bench.diagnosis_benchmark.result_tables import FAILURE_COLUMNS as FAILED
from bench.diagnosis_benchmark.result_tables import PRIMARY_METRIC


def _declare_text_column(name: str) -> ColumnSpec:
    """Declare a text column whose cells may be empty."""
    return ColumnSpec(name, str, empty=EmptyCellRule.MAY)


def _declare_count_column(name: str) -> ColumnSpec:
    """Declare a column of counts, at least 0."""
    return ColumnSpec(name, int, low=0)


def _declare_size_column(name: str) -> ColumnSpec:
    """Declare a column of numbers of at least 0, whose cells may be empty."""
    return ColumnSpec(name, float, low=0.0, empty=EmptyCellRule.MAY)


def _declare_fraction_column(name: str) -> ColumnSpec:
    """Declare a column of fractions from 0 to 1, whose cells may be empty."""
    return ColumnSpec(name, float, low=0.0, high=1.0, empty=EmptyCellRule.MAY)


_COUNT_COLUMNS = (
    _declare_count_column("count"),
    _declare_count_column("of"),
    *(_declare_fraction_column(name) for name in ("share", "low", "high")),
)
_KIND_COLUMN = ColumnSpec("kind", str, words=CASE_KINDS)
_ITEM_COLUMNS: Columns = (
    *(ColumnSpec(name, str) for name in ("question", "diagnoser")),
    _KIND_COLUMN,
    ColumnSpec("system", str),
    _declare_text_column("hidden"),
    ColumnSpec("noise", str),
    ColumnSpec("stated", bool),
    _declare_count_column("rate"),
    _declare_count_column("runs"),
    ColumnSpec("source", str),
    ColumnSpec("driven", bool),
    *(_declare_size_column(name) for name in ("size", "beyond", "run_seconds")),
    *(_declare_text_column(name) for name in ("channels", "status", "reason", "verdict", "named")),
    ColumnSpec("outcome", str),
    *(_declare_count_column(name) for name in ("set_size", "class_size", "largest_set")),
    *(ColumnSpec(name, bool) for name in ("found", "found_class", "alarm")),
    _declare_fraction_column("p_value"),
    *(_declare_count_column(name) for name in ("intervals", "holding", "simulations")),
    *(_declare_size_column(name) for name in ("seconds", "processor_seconds")),
    ColumnSpec("trusted", bool),
)
_BY_NAME = {column.name: column for column in _ITEM_COLUMNS} | {
    "right_by": ColumnSpec("right_by", str)
}
_QUANTILE_COLUMNS = [
    f"{what}_{part}"
    for what in ("simulations", "processor_seconds", "seconds")
    for part in ("median", "p95")
]

TABLE_COLUMNS: Mapping[str, Columns] = {
    "table": (ColumnSpec("diagnoser", str), ColumnSpec("metric", str), *_COUNT_COLUMNS),
    "failures": tuple(_BY_NAME[name] for name in FAILED),
    "groups": (
        *(ColumnSpec(name, str) for name in ("diagnoser", "metric", "by", "value")),
        *_COUNT_COLUMNS,
    ),
    "power": (
        ColumnSpec("diagnoser", str),
        _declare_size_column("size"),
        ColumnSpec("metric", str),
        *_COUNT_COLUMNS,
    ),
    "confusion": (
        *(ColumnSpec(name, str) for name in ("diagnoser", "hidden", "said")),
        _declare_count_column("count"),
    ),
    "calibration": (
        ColumnSpec("diagnoser", str),
        _declare_fraction_column("level"),
        *_COUNT_COLUMNS,
    ),
    "sets": (ColumnSpec("diagnoser", str), ColumnSpec("largest_set", str), *_COUNT_COLUMNS),
    "costs": (
        ColumnSpec("diagnoser", str),
        _declare_count_column("answers"),
        *(_declare_size_column(name) for name in _QUANTILE_COLUMNS),
        _declare_count_column("training_simulations"),
        _declare_size_column("training_seconds"),
    ),
    "pairs": (
        ColumnSpec("metric", str),
        ColumnSpec("diagnoser", str),
        *(_declare_count_column(name) for name in ("questions", "only_simgap", "only_other")),
        *(_declare_fraction_column(name) for name in ("p_value", "p_holm")),
    ),
    "items": _ITEM_COLUMNS,
}
"""Columns of each table, by the name of its file."""
STATUS_COLUMNS = ("question", "diagnoser", "status", "reason", "simulations", "seconds")
"""Columns of items.csv that describe how an answer was produced."""


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Read a table of a comparison of diagnosers.

    Args:
        folder: result folder of the comparison.
        name: one of `TABLE_COLUMNS`.

    Raises:
        InputError: the file does not exist or is damaged.
    """
    path = folder / f"{name}.csv"
    remedy = f"write it again with simgap plot {folder}"
    table: pd.DataFrame = CsvTable(path, TABLE_COLUMNS[name], remedy).table.to_pandas()
    return table


def build_leaderboard(table: pd.DataFrame) -> pd.DataFrame:
    """Build the leaderboard: one row per diagnoser and one column per metric.

    Args:
        table: the table of all metrics, see `result_tables.METRICS`.

    Returns:
        Fractions; the diagnoser with the highest primary metric comes first.
    """
    shares_by_metric = table.pivot(index="diagnoser", columns="metric", values="share")
    shares_by_metric = shares_by_metric[list(dict.fromkeys(table["metric"]))]
    sorted_shares: pd.DataFrame = shares_by_metric.sort_values(
        PRIMARY_METRIC, ascending=False, kind="stable"
    )
    return sorted_shares.rename_axis(columns=None).reset_index()
