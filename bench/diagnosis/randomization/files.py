"""Files of `simgap explain --ranges`: ranges.toml, ranges.csv and code for two frameworks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.diagnosis.randomization.isaac_lab import render_isaac_lab_code
from bench.diagnosis.randomization.mujoco_playground import render_mujoco_playground_code
from bench.diagnosis.randomization.ranges import RandomizationRanges
from bench.pages.csv_text import format_csv
from sims.extended_simulator import ExtendedSimulator

FORMAT_VERSION = 1
"""Format version of ranges.toml."""
COLUMNS = (
    "cause", "coefficient", "source", "kind", "name", "field", "address", "sign", "unit",
    "nominal", "value", "low", "high", "operation", "minimum", "maximum",
)  # fmt: skip
"""Columns of ranges.csv: the keys of a range in ranges.toml."""


def build_range_files(
    ranges: RandomizationRanges, extended: ExtendedSimulator, folder: Path | None = None
) -> Mapping[str, str]:
    """Return the content of each file by its name.

    Without ranges there are no files, and without model fields for the numbers there is no code.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        folder: Folder of the files; the path of the model file is relative to it.
    """
    if not ranges.ranges:
        return {}
    import tomli_w

    rows = [entry.document() for entry in ranges.ranges]
    assert extended.robot is not None
    document: dict[str, Any] = {
        "format": FORMAT_VERSION,
        "model": extended.robot.to_document(folder)["model"],
        "recording": extended.title,
        "left_out": list(ranges.left_out),
        "ranges": rows,
    }
    table = [[_format_cell(row.get(column)) for column in COLUMNS] for row in rows]
    tables = {"ranges.toml": tomli_w.dumps(document), "ranges.csv": format_csv(COLUMNS, table)}
    if not any(entry.fields for entry in ranges.ranges):
        return tables
    robot = getattr(extended.kind, "robot", None)
    return {
        **tables,
        "ranges_isaac_lab.py": render_isaac_lab_code(ranges, extended, robot),
        "ranges_mujoco_playground.py": render_mujoco_playground_code(ranges, extended, robot),
    }


def _format_cell(value: Any) -> object:
    """Format a value as a cell: an address as numbers with spaces, a missing value as empty."""
    if isinstance(value, list):
        return " ".join(str(number) for number in value)
    return "" if value is None else value
