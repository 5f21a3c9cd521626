"""Read large faultless CSV tables fast.

Tables with anything unusual are left to the slower reader, which inspects each cell.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from sims.core.simulator import Array

MIN_FAST_PARSE_BYTES = 1 << 20
"""Minimum size in bytes of a table for which importing the fast parser is worthwhile."""


def read_csv_fast(
    path: Path, header: Sequence[str], column_names: Sequence[str], gaps: Collection[str]
) -> tuple[list[str], dict[str, Array]] | None:
    """Read the run names and the numeric columns of a CSV table with pyarrow.

    Args:
        path: Table whose first line is its header.
        header: Checked names of its columns, including ``run``.
        column_names: Names of the numeric columns to read.
        gaps: Those among them whose cells may be empty (NaN).

    Returns:
        Name of the run of each row, and the numeric columns (T,) by name; None if anything in the
        table is unusual.
    """
    import pyarrow as arrow
    from pyarrow import csv

    types = {"run": arrow.string()}
    types |= {name: arrow.float64() for name in column_names}
    try:
        table = csv.read_csv(
            path,
            # Use one thread, because there is already one worker process per core.
            csv.ReadOptions(column_names=list(header), skip_rows=1, use_threads=False),
            # Quotes may hide commas and line ends; such tables are left to the other reader.
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
    for name in column_names:
        cells = table[name]
        values = cells.to_numpy()
        # An empty cell is NaN and allowed in a gap; NaN or inf written as text is not.
        allowed_gaps = cells.null_count if name in gaps else 0
        if np.count_nonzero(~np.isfinite(values)) != allowed_gaps:
            return None
        columns[name] = values
    runs = table["run"].combine_chunks().dictionary_encode()
    names = [str(name).strip() for name in runs.dictionary.to_pylist()]
    if any('"' in name for name in names):
        return None
    return [names[code] for code in runs.indices.to_numpy().tolist()], columns
