"""Faults in rows of a result folder: the first is said, in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from bench.store.cells import Mask
from sims.base import InputError
from sims.user_toml import shown

if TYPE_CHECKING:
    import pandas as pd

Fault = Callable[[int, str], InputError]
"""The error for a row, counted from 0, of a file."""
MaybeFault = Callable[[int | None, str], InputError]
"""The same, and the error for the whole file."""


def refuse(bad: pd.Series | Mask, fault: Fault, says: Callable[[int], str]) -> None:
    """Raise for the first row that is bad."""
    mask = np.asarray(bad, dtype=bool)
    if mask.any():
        row = int(mask.argmax())
        raise fault(row, says(row))


def check_known(values: pd.Series, known: Iterable[str], what: str, fault: Fault) -> None:
    """Refuse values that the experiment does not know."""
    refuse(
        ~values.isin(list(known)),
        fault,
        lambda row: f"{what}: expected one of experiment.toml, found {shown(values.iloc[row])}",
    )


def check_equal(found: pd.Series, wanted: pd.Series, name: str, why: str, fault: Fault) -> None:
    """Refuse values that are not the wanted ones; nothing is the same as nothing."""
    differ = found.to_numpy() != wanted.to_numpy()
    refuse(
        differ & ~(found.isna() & wanted.isna()).to_numpy(),
        fault,
        lambda i: f"{name}: expected {wanted[i]} {why}, found {found[i]}",
    )
