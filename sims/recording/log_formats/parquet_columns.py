"""Read the numeric columns of Parquet tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only

MAX_COLUMNS = 10_000
"""Maximum number of columns of a log, and of entries of a list in a cell."""


def read_numeric_columns(table: Any) -> tuple[dict[str, Array], list[str]]:
    """Read the numeric columns of a pyarrow table.

    Returns:
        Numbers by column name, (T,) or (T, k), and the names of the columns without numbers.
    """
    columns: dict[str, Array] = {}
    texts = []
    for name in table.column_names:
        values = _convert_to_numbers(table.column(name))
        if values is None:
            texts.append(name)
        else:
            columns[name] = make_read_only(values)
    return columns, texts


def make_unreadable_error(path: Path, error: Exception) -> InputError:
    """Make the error for a file that pyarrow cannot read."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"{path}: not a Parquet file: {reason[:300]}")


def is_numeric_type(kind: Any) -> bool:
    """Return whether columns of a pyarrow type hold numbers, times or lists of them."""
    import pyarrow

    if _is_list(kind):
        kind = kind.value_type
    types = pyarrow.types
    numeric = types.is_integer, types.is_floating, types.is_timestamp, types.is_boolean
    return any(is_one(kind) for is_one in numeric)


def _is_list(kind: Any) -> bool:
    """Return whether an Arrow type is a list, of any of the three kinds in a Parquet table."""
    import pyarrow

    types = pyarrow.types
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _convert_to_numbers(column: Any) -> Array | None:
    """Return the numbers (T,) or (T, k) of a column; None if it holds none."""
    import pyarrow

    kind = column.type
    if pyarrow.types.is_timestamp(kind):
        column = column.cast(pyarrow.int64())
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    if pyarrow.types.is_boolean(kind):
        column = column.cast(pyarrow.int8())
        kind = column.type
    if pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind):
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    if not _is_list(kind):
        return None
    rows = column.to_pylist()
    lengths = {len(row) if row is not None else -1 for row in rows}
    if len(lengths) != 1 or not 0 < max(lengths) <= MAX_COLUMNS:
        return None
    try:
        return np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        return None
