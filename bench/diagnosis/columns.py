"""Columns of all tables of a comparison of diagnosers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from bench.diagnosis.failures import COLUMNS as FAILED
from bench.diagnosis.tables import NAMED
from bench.diagnosis.worlds.item import KINDS
from bench.store.csvs import Csv
from bench.store.schema import Column, Columns, Empty


def _text(name: str) -> Column:
    return Column(name, str, empty=Empty.MAY)


def _count(name: str) -> Column:
    return Column(name, int, low=0)


def _size(name: str) -> Column:
    return Column(name, float, low=0.0, empty=Empty.MAY)


def _share(name: str) -> Column:
    return Column(name, float, low=0.0, high=1.0, empty=Empty.MAY)


_COUNTED = (_count("count"), _count("of"), *(_share(name) for name in ("share", "low", "high")))
_KIND = Column("kind", str, words=KINDS)
_ITEM: Columns = (
    *(Column(name, str) for name in ("question", "diagnoser")),
    _KIND,
    Column("system", str),
    _text("hidden"),
    Column("noise", str),
    Column("stated", bool),
    _count("rate"),
    _count("runs"),
    Column("source", str),
    Column("driven", bool),
    *(_size(name) for name in ("size", "beyond", "run_seconds")),
    *(_text(name) for name in ("channels", "status", "reason", "verdict", "named")),
    Column("outcome", str),
    *(_count(name) for name in ("set_size", "class_size", "largest_set")),
    *(Column(name, bool) for name in ("found", "found_class", "alarm")),
    _share("p_value"),
    *(_count(name) for name in ("intervals", "holding", "simulations")),
    *(_size(name) for name in ("seconds", "processor_seconds")),
    Column("trusted", bool),
)
_BY_NAME = {column.name: column for column in _ITEM} | {"right_by": Column("right_by", str)}
_QUANTILES = [
    f"{what}_{part}"
    for what in ("simulations", "processor_seconds", "seconds")
    for part in ("median", "p95")
]

TABLES: Mapping[str, Columns] = {
    "table": (Column("diagnoser", str), Column("metric", str), *_COUNTED),
    "failures": tuple(_BY_NAME[name] for name in FAILED),
    "groups": (
        *(Column(name, str) for name in ("diagnoser", "metric", "by", "value")),
        *_COUNTED,
    ),
    "power": (Column("diagnoser", str), _size("size"), Column("metric", str), *_COUNTED),
    "confusion": (
        *(Column(name, str) for name in ("diagnoser", "hidden", "said")),
        _count("count"),
    ),
    "calibration": (Column("diagnoser", str), _share("level"), *_COUNTED),
    "sets": (Column("diagnoser", str), Column("largest_set", str), *_COUNTED),
    "costs": (
        Column("diagnoser", str),
        _count("answers"),
        *(_size(name) for name in _QUANTILES),
        _count("training_simulations"),
        _size("training_seconds"),
    ),
    "pairs": (
        Column("metric", str),
        Column("diagnoser", str),
        *(_count(name) for name in ("questions", "only_simgap", "only_other")),
        *(_share(name) for name in ("p_value", "p_holm")),
    ),
    "items": _ITEM,
}
"""Columns of each table, by the name of its file."""
STATUS = ("question", "diagnoser", "status", "reason", "simulations", "seconds")
"""Columns of items.csv that describe how an answer was produced."""


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Read a table of a comparison of diagnosers.

    Args:
        folder: result folder of the comparison.
        name: one of `TABLES`.

    Raises:
        InputError: the file does not exist or is damaged.
    """
    path = folder / f"{name}.csv"
    remedy = f"simgap plot {folder} writes it again"
    table: pd.DataFrame = Csv(path, TABLES[name], remedy).table.to_pandas()
    return table


def board(table: pd.DataFrame) -> pd.DataFrame:
    """Build the leaderboard: one row per diagnoser and one column per metric.

    Args:
        table: the table of all metrics, see `bench.diagnosis.tables.table`.

    Returns:
        Fractions; the diagnoser with the highest primary metric comes first.
    """
    wide = table.pivot(index="diagnoser", columns="metric", values="share")
    wide = wide[list(dict.fromkeys(table["metric"]))]
    named: pd.DataFrame = wide.sort_values(NAMED, ascending=False, kind="stable")
    return named.rename_axis(columns=None).reset_index()
