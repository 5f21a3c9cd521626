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
    bad: pd.Series | Mask, fault: RowErrorFactory, says: Callable[[int], str]
) -> None:
    """Raise an error for the first bad row.

    Args:
        bad: Mask of bad rows.
        fault: Makes the error.
        says: Describes what is wrong in a row.

    Raises:
        InputError: There is a bad row.
    """
    mask = np.asarray(bad, dtype=bool)
    if mask.any():
        row = int(mask.argmax())
        raise fault(row, says(row))


def check_known(values: pd.Series, known: Iterable[str], what: str, fault: RowErrorFactory) -> None:
    """Reject values that the experiment does not define.

    Args:
        values: Values to check.
        known: Values that the experiment defines.
        what: Name of the quantity.
        fault: Makes the error.

    Raises:
        InputError: There is an unknown value.
    """
    raise_for_first_bad_row(
        ~values.isin(list(known)),
        fault,
        lambda row: (
            f"{what}: expected one of experiment.toml, found {format_value(values.iloc[row])}"
        ),
    )


def check_equal(
    found: pd.Series, wanted: pd.Series, name: str, why: str, fault: RowErrorFactory
) -> None:
    """Reject values that differ from the expected ones; two missing values are equal.

    Args:
        found: Values to check.
        wanted: Expected values.
        name: Name of the column.
        why: Reason for the expected values.
        fault: Makes the error.

    Raises:
        InputError: A value differs.
    """
    is_different = found.to_numpy() != wanted.to_numpy()
    raise_for_first_bad_row(
        is_different & ~(found.isna() & wanted.isna()).to_numpy(),
        fault,
        lambda i: f"{name}: expected {wanted[i]} {why}, found {found[i]}",
    )
