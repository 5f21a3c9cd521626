"""Validate table cells against their declared columns; report the first bad row."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.storage.table_schemas import Columns, ColumnSpec, EmptyCellRule
from sims.core.files import get_first_line
from sims.core.simulator import InputError
from sims.core.toml_validation import format_value

if TYPE_CHECKING:
    import pyarrow as pa


Mask = NDArray[np.bool_]

_VALUE_PATTERNS: Mapping[type, str] = {
    bool: "True|False",
    int: r"-?\d{1,18}",
    float: r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?|-?inf|nan|",
}
"""Patterns of values in a CSV file, by type."""


class CellError(Exception):
    """A cell or a whole column that violates its declaration.

    Attributes:
        row: First such row, counted from 0; None if the error is in the column.
        says: Column, expected and found value.
    """

    def __init__(self, row: int | None, column: str, expected: str, found: str) -> None:
        self.row = row
        self.says = f"{column}: expected {expected}, found {found}"
        super().__init__(self.says)


def make_table_error(path: Path, place: str | None, problem: str, remedy: str) -> InputError:
    """Make the one-line error for a damaged table file.

    Args:
        path: The file.
        place: Where it is damaged, in the words of its format, such as ``line 3``; None for the
            whole file.
        problem: What is wrong.
        remedy: Advice for a damaged file.
    """
    subject = str(path) if place is None else f"{path}, {place}"
    return InputError(f"{subject}: {problem}; {remedy}")


def select_declared_columns(
    names: Sequence[str], columns: Columns, row: int | None = None
) -> list[ColumnSpec]:
    """Select the declared columns that a table or a row of a JSON file has.

    Args:
        names: Names of its columns.
        columns: Declared columns.
        row: Row for the error message; None for a table.

    Returns:
        Declarations of these columns, in the order of `columns`; undeclared columns are ignored.

    Raises:
        CellError: A required column is missing, or a column occurs twice.
    """
    for name in names:
        if names.count(name) > 1:
            times = f"it {names.count(name)} times"
            raise CellError(None, f"column {format_value(name)}", "it once", times)
    for column in columns:
        if column.required and column.name not in names:
            column_list = format_value(", ".join(names))
            raise CellError(row, "columns", f"one named {column.name}", column_list)
    return [column for column in columns if column.name in names]


def parse_parquet_column(column: ColumnSpec, values: pa.ChunkedArray) -> pa.Array:
    """Convert a column of a Parquet file to text, int64, float64 or bool.

    Integers are accepted where floats are declared, and empty cells of a float column become NaN.

    Args:
        column: Declaration of the column: type, range, allowed words, and empty cells.
        values: Its values.

    Raises:
        CellError: It has another type, or a cell is empty that must not be.
    """
    import pyarrow as pa
    from pyarrow import compute

    try:
        # After damage, the bytes of a text may be invalid UTF-8.
        for chunk in values.chunks:
            chunk.validate(full=True)
    except pa.ArrowInvalid as error:
        raise CellError(None, column.name, column.expected_text, get_first_line(error)) from None
    kind = values.type
    # A dictionary-encoded column stores each different value once; it is expanded.
    if pa.types.is_dictionary(kind):
        values = values.cast(kind.value_type)
        kind = values.type
    is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
    is_convertible: Mapping[type, bool] = {
        str: is_text,
        int: pa.types.is_integer(kind),
        float: pa.types.is_floating(kind) or pa.types.is_integer(kind),
        bool: pa.types.is_boolean(kind),
    }
    if not is_convertible[column.kind]:
        raise CellError(None, column.name, column.expected_text, f"a column of type {kind}")
    if values.null_count:
        if column.kind is not float:
            row = compute.index(compute.is_null(values), True).as_py()
            raise CellError(row, column.name, column.expected_text, "nothing")
        values = compute.fill_null(values, np.nan)
    try:
        return values.cast(_get_arrow_type(column)).combine_chunks()
    except pa.ArrowInvalid:  # A number that is too large for the type.
        raise CellError(
            None, column.name, column.expected_text, f"numbers beyond it ({kind})"
        ) from None


def parse_csv_column(column: ColumnSpec, values: pa.Array) -> pa.Array:
    """Convert a column of a CSV file to text, int64, float64 or bool, as it is declared.

    Args:
        column: Declaration of the column: type, range, allowed words, and empty cells.
        values: Its cells as text.

    Raises:
        CellError: A cell cannot be converted.
    """
    from pyarrow import compute

    if column.kind is str:
        return values
    is_valid = compute.match_substring_regex(values, f"^({_VALUE_PATTERNS[column.kind]})$")
    _raise_for_bad_row(
        column,
        to_numpy_mask(compute.invert(is_valid)),
        lambda row: format_value(values[row].as_py()),
    )
    if column.kind is float:
        # An empty cell means NaN.
        values = compute.if_else(compute.equal(values, ""), "nan", values)
    return values.cast(_get_arrow_type(column))


def parse_json_column(column: ColumnSpec, values: Sequence[Any]) -> pa.Array:
    """Convert values of a JSON file to text, int64, float64 or bool.

    Args:
        column: Declaration of the values.
        values: Values from the JSON file.

    Raises:
        CellError: A value has another type or is too large.
    """
    import pyarrow as pa

    kinds = (int, float) if column.kind is float else (column.kind,)
    for row, value in enumerate(values):
        is_null = value is None and column.kind is float  # JSON has no NaN.
        # For Python, True and False are whole numbers too.
        is_wrong_bool = isinstance(value, bool) and column.kind is not bool
        if not is_null and (is_wrong_bool or not isinstance(value, kinds) or _exceeds_int64(value)):
            raise CellError(row, column.name, column.expected_text, format_value(value))
    numbers = [np.nan if v is None else v for v in values]
    return pa.array(numbers, type=_get_arrow_type(column))


def _exceeds_int64(value: Any) -> bool:
    """Return whether an integer is too large for int64; integers in JSON are unlimited."""
    return isinstance(value, int) and abs(value) >= 2**63


def _get_arrow_type(column: ColumnSpec) -> pa.DataType:
    """Return the Arrow type in which the cells of a column are stored."""
    import pyarrow as pa

    types = {str: pa.large_string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    return types[column.kind]


def check_cells(
    column: ColumnSpec,
    values: pa.Array,
    at_start: Mask | None = None,
    is_recording: Mask | None = None,
) -> None:
    """Check that every cell fits the declaration of its column: words, range, and empty cells.

    A column may have to be empty in some rows, and only there: before the first simulation (k = 0),
    or for a recording, which has no true parameters. This is not checked if it is not known which
    rows these are.

    Args:
        column: Declaration of the column: type, range, allowed words, and empty cells.
        values: Result of `parse_parquet_column`, `parse_csv_column` or `parse_json_column`.
        at_start: Mask of rows with k = 0; None if unknown.
        is_recording: Mask of rows of a recording; None if unknown.

    Raises:
        CellError: The first cell that does not.
    """
    if column.kind is bool:
        return
    if column.kind is str:
        _check_texts(column, values)
        return
    numbers = values.to_numpy(zero_copy_only=False)
    empty = np.isnan(numbers) if column.kind is float else np.zeros(len(numbers), dtype=bool)

    def format_cell(row: int) -> str:
        return "nothing" if empty[row] else f"{numbers[row]}"

    exceeds_limits = ~empty & ~((numbers >= column.low) & (numbers <= column.high))
    if not column.infinite:
        exceeds_limits |= np.isinf(numbers)
    _raise_for_bad_row(column, exceeds_limits, format_cell)
    # Mask of the rows whose cell must be empty, by the rule of the column. The two checks below
    # compare it with the cells that are empty.
    must_be_empty = {
        EmptyCellRule.NEVER: np.zeros(len(numbers), dtype=bool),
        EmptyCellRule.MAY: empty,  # Whatever is empty may be so.
        EmptyCellRule.AT_START: at_start,
        EmptyCellRule.RECORDING_ONLY: is_recording,
    }[column.empty]
    if must_be_empty is None:
        return
    _raise_for_bad_row(column, empty & ~must_be_empty, format_cell)
    _raise_for_bad_row(column, must_be_empty & ~empty, format_cell, f"nothing {column.empty.value}")


def _check_texts(column: ColumnSpec, values: pa.Array) -> None:
    """Raise an error for the first text cell that is not one of the column's words, or is empty.

    Empty cells are only refused in columns that must always have a value.
    """
    import pyarrow as pa
    from pyarrow import compute

    if column.words:
        is_allowed = compute.is_in(values, value_set=pa.array(column.words, type=values.type))
        is_bad = compute.invert(is_allowed)
    elif column.empty is EmptyCellRule.NEVER:
        is_bad = compute.equal(values, "")
    else:
        return
    _raise_for_bad_row(column, to_numpy_mask(is_bad), lambda row: format_value(values[row].as_py()))


def to_numpy_mask(values: pa.Array) -> Mask:
    """Convert an Arrow array of bool to NumPy."""
    mask: Mask = values.to_numpy(zero_copy_only=False).astype(bool)
    return mask


def _raise_for_bad_row(
    column: ColumnSpec, is_bad: Mask, describe_row: Callable[[int], str], expected: str = ""
) -> None:
    """Raise an error for the first bad row.

    Args:
        column: declaration of the column.
        is_bad: whether the cell of each row violates it.
        describe_row: returns the cell of a row as text.
        expected: expected value in words; empty for that of the declaration.

    Raises:
        CellError: a cell violates the declaration.
    """
    if is_bad.any():
        row = int(is_bad.argmax())
        raise CellError(row, column.name, expected or column.expected_text, describe_row(row))
