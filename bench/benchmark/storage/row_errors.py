"""Errors in rows of a result folder; the first bad row is reported in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from bench.benchmark.storage.cell_validation import Mask
from sims.core.simulator import InputError
from sims.core.toml_validation import format_value

if TYPE_CHECKING:
    import pandas as pd

RowErrorFactory = Callable[[int, str], InputError]
"""Makes the error for a row of a file, counted from 0."""
TableErrorFactory = Callable[[int | None, str], InputError]
"""Makes the error for a row of a file, counted from 0, or for the whole file (None)."""


def raise_for_first_bad_row(
    bad: pd.Series | Mask, make_error: RowErrorFactory, describe_row: Callable[[int], str]
) -> None:
    """Raise an error for the first bad row.

    Args:
        bad: Mask of bad rows.
        make_error: Makes the error.
        describe_row: Describes what is wrong in a row.

    Raises:
        InputError: There is a bad row.
    """
    mask = np.asarray(bad, dtype=bool)
    if mask.any():
        row = int(mask.argmax())
        raise make_error(row, describe_row(row))


def check_known(
    values: pd.Series, known_values: Iterable[str], column: str, make_error: RowErrorFactory
) -> None:
    """Reject values that the experiment does not define.

    Args:
        values: Values to check.
        known_values: Values that the experiment defines.
        column: Name of the quantity.
        make_error: Makes the error.

    Raises:
        InputError: There is an unknown value.
    """
    raise_for_first_bad_row(
        ~values.isin(list(known_values)),
        make_error,
        lambda row: (
            f"{column}: expected one of experiment.toml, found {format_value(values.iloc[row])}"
        ),
    )


def check_equal(
    found: pd.Series, expected: pd.Series, name: str, why: str, make_error: RowErrorFactory
) -> None:
    """Reject values that differ from the expected ones; two missing values are equal.

    Args:
        found: Values to check.
        expected: Expected values.
        name: Name of the column.
        why: Reason for the expected values.
        make_error: Makes the error.

    Raises:
        InputError: A value differs.
    """
    is_different = found.to_numpy() != expected.to_numpy()
    raise_for_first_bad_row(
        is_different & ~(found.isna() & expected.isna()).to_numpy(),
        make_error,
        lambda i: f"{name}: expected {expected[i]} {why}, found {found[i]}",
    )
