"""Many logs as tables: a row a log, and a row for each number of each cause."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from io import StringIO
from math import nan
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from bench.gap.each.rows import Row, named, table
from bench.gap.report.words import labelled

REPORT = "report.html"
"""The page of a log in its folder, and that of all logs above."""
LONGEST_NAME = 80
"""Characters of the name of a number that are shown."""
_TEXTS = ("log", "verdict", "causes", "error", "report")
_MEASURED = ("gap_closed", "low", "high", "before", "after", "seconds")
"""Columns of the table of logs."""


def logs(rows: Sequence[Row], folders: Mapping[str, Path]) -> pd.DataFrame:
    """A row a log: what it says, where its report is, what is closed of its gap."""
    lines = []
    for place, row in enumerate(rows, start=1):
        folder = folders[row.log]
        error = _held_out_of(folder) if not row.error else {}
        report = "" if row.error else quote(f"{folder.name}/{REPORT}")
        lines.append({
            "number": place, "log": row.log, "verdict": row.verdict or "not explained",
            "causes": "; ".join(named(cause) for cause in row.causes),
            "gap_closed": row.gap_closed,
            "low": error.get("low"), "high": error.get("high"),
            "before": _floors(error, "rmse_base"), "after": _floors(error, "rmse_extended"),
            "seconds": row.seconds, "error": row.error, "report": report,
        })  # fmt: skip
    frame = pd.DataFrame(lines, columns=["number", *_TEXTS, *_MEASURED])
    return frame.astype(dict.fromkeys(_MEASURED, float))


def written(rows: Sequence[Row]) -> pd.DataFrame:
    """The table beside the page, as its text has it: names that look like numbers stay names."""
    head, *lines = csv.reader(StringIO(table(rows)))
    frame = pd.DataFrame(lines, columns=head)
    for name in ("value", "low", "high", "gap_closed", "seconds"):
        frame[name] = frame[name].map(lambda text: float(text) if text else nan).astype(float)
    return frame


def _held_out_of(folder: Path) -> dict[str, float]:
    """The numbers of a log's held-out runs in its verdict; none where it cannot be read."""
    try:
        said = json.loads((folder / "verdict.json").read_text(encoding="utf-8"))["heldout"]
        return {key: value for key, value in said.items() if isinstance(value, (int, float))}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _floors(error: Mapping[str, float], key: str) -> float | None:
    """A held-out error in noise floors."""
    value, floor = error.get(key), error.get("noise_floor")
    return value / floor if value is not None and floor else None


def place_of(name: str) -> str:
    """Name a number of a cause: ``at elbow`` for ``coefficient@elbow``."""
    coefficient, at, place = name.partition("@")
    return f"at {place}" if at and coefficient == "coefficient" else name


def numbers(rows: Sequence[Row]) -> pd.DataFrame:
    """A row for each number of each cause of a log, those of the commonest cause first."""
    lines = []
    for place, row in enumerate(rows, start=1):
        for cause in row.causes:
            for name, known in cause["coefficients"].items():
                label = labelled(place_of(name), known["unit"], LONGEST_NAME)
                what = f"{named(cause)}: {label}"
                about = {"cause": named(cause), "name": name, "what": what, **known}
                lines.append({"number": place, "log": row.log, **about})
    columns = ["number", "log", "cause", "name", "what", "value", "low", "high", "unit"]
    frame = pd.DataFrame(lines, columns=columns)
    frame = frame.astype(dict.fromkeys(["value", "low", "high"], float))
    often = frame["what"].map(frame["what"].value_counts())
    order = often.sort_values(ascending=False, kind="stable").index
    return frame.loc[order].reset_index(drop=True)
