"""Tables over many logs: one row per log, and one row per number of each cause."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from io import StringIO
from math import nan
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from bench.diagnosis.batch.log_rows import LogResult, format_cause, format_log_table
from bench.diagnosis.report.wording import format_label

REPORT_FILE = "report.html"
"""File name of a log's report in its folder, and of the summary page of all logs."""
LONGEST_NAME = 80
"""Maximum number of characters of a number's name that are shown."""
_TEXTS = ("log", "verdict", "causes", "error", "report")
_MEASURED = ("gap_closed", "low", "high", "before", "after", "seconds")
"""Numeric columns of the table of logs."""


def build_log_table(rows: Sequence[LogResult], folders: Mapping[str, Path]) -> pd.DataFrame:
    """Build a table with one row per log: its causes, its report and the share of the gap closed.

    Args:
        rows: Result of each log.
        folders: Folder of each log's explanation, by log.
    """
    lines = []
    for log_number, row in enumerate(rows, start=1):
        folder = folders[row.log]
        error = _read_held_out_errors(folder) if not row.error else {}
        report = "" if row.error else quote(f"{folder.name}/{REPORT_FILE}")
        lines.append({
            "number": log_number, "log": row.log, "verdict": row.verdict or "not explained",
            "causes": "; ".join(format_cause(cause) for cause in row.causes),
            "gap_closed": row.gap_closed,
            "low": error.get("low"), "high": error.get("high"),
            "before": _convert_to_noise_floors(error, "rmse_base"),
            "after": _convert_to_noise_floors(error, "rmse_extended"),
            "seconds": row.seconds, "error": row.error, "report": report,
        })  # fmt: skip
    frame = pd.DataFrame(lines, columns=["number", *_TEXTS, *_MEASURED])
    return frame.astype(dict.fromkeys(_MEASURED, float))


def read_log_table(rows: Sequence[LogResult]) -> pd.DataFrame:
    """Read the text of logs.csv as a table; names that look like numbers stay text."""
    head, *lines = csv.reader(StringIO(format_log_table(rows)))
    frame = pd.DataFrame(lines, columns=head)
    for name in ("value", "low", "high", "gap_closed", "seconds"):
        frame[name] = frame[name].map(lambda text: float(text) if text else nan).astype(float)
    return frame


def _read_held_out_errors(folder: Path) -> dict[str, float]:
    """Read the held-out errors from a log's verdict.json; empty if it cannot be read."""
    try:
        held_out = json.loads((folder / "verdict.json").read_text(encoding="utf-8"))["heldout"]
        return {key: value for key, value in held_out.items() if isinstance(value, (int, float))}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _convert_to_noise_floors(error: Mapping[str, float], key: str) -> float | None:
    """Convert a held-out error to noise floors."""
    value, floor = error.get(key), error.get("noise_floor")
    return value / floor if value is not None and floor else None


def place_of(name: str) -> str:
    """Format the place of a coefficient: ``at elbow`` for ``coefficient@elbow``."""
    coefficient, separator, place = name.partition("@")
    return f"at {place}" if separator and coefficient == "coefficient" else name


def build_number_table(rows: Sequence[LogResult]) -> pd.DataFrame:
    """Build a table with one row per number of each cause, those of the commonest cause first."""
    lines = []
    for log_number, row in enumerate(rows, start=1):
        for cause in row.causes:
            for name, number in cause["coefficients"].items():
                label = format_label(place_of(name), number["unit"], LONGEST_NAME)
                label_with_cause = f"{format_cause(cause)}: {label}"
                cells = {
                    "cause": format_cause(cause),
                    "name": name,
                    "what": label_with_cause,
                    **number,
                }
                lines.append({"number": log_number, "log": row.log, **cells})
    columns = ["number", "log", "cause", "name", "what", "value", "low", "high", "unit"]
    frame = pd.DataFrame(lines, columns=columns)
    frame = frame.astype(dict.fromkeys(["value", "low", "high"], float))
    frequency = frame["what"].map(frame["what"].value_counts())
    order = frequency.sort_values(ascending=False, kind="stable").index
    return frame.loc[order].reset_index(drop=True)
