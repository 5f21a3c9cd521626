"""Fast reading of large faultless tables; what it hesitates over is left to the reader that looks
at every cell.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from sims.base import Array

WORTHWHILE = 1 << 20
"""Bytes from which on importing the fast parser pays."""


def read_fast(
    path: Path, header: Sequence[str], wanted: Sequence[str], gaps: Collection[str]
) -> tuple[list[str], dict[str, Array]] | None:
    """Run names row by row, and the columns `wanted` as numbers; None where anything is out of the
    ordinary.

    Args:
        path: a table whose first line is its header.
        header: its columns, checked; one of them is ``run``.
        wanted: columns of numbers.
        gaps: those among them whose cells may be empty (NaN).
    """
    import pyarrow as arrow
    from pyarrow import csv

    types = {"run": arrow.string()}
    types |= {name: arrow.float64() for name in wanted}
    try:
        table = csv.read_csv(
            path,
            # one thread: workers run beside each other, one a core
            csv.ReadOptions(column_names=list(header), skip_rows=1, use_threads=False),
            # quotes may hide commas and line ends; they are left to the other reader
            csv.ParseOptions(quote_char=False),
            csv.ConvertOptions(
                column_types=types,
                null_values=[""],
                strings_can_be_null=False,
            ),
        )
    except (arrow.ArrowException, OSError):
        return None
    columns: dict[str, Array] = {}
    for name in wanted:
        cells = table[name]
        values = cells.to_numpy()
        # an empty cell is NaN and allowed in a gap; a NaN or inf that is written is not
        allowed = cells.null_count if name in gaps else 0
        if np.count_nonzero(~np.isfinite(values)) != allowed:
            return None
        columns[name] = values
    runs = table["run"].combine_chunks().dictionary_encode()
    names = [str(name).strip() for name in runs.dictionary.to_pylist()]
    if any('"' in name for name in names):
        return None
    return [names[code] for code in runs.indices.to_numpy().tolist()], columns
