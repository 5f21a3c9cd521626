"""Result rows, tables and a summary of the causes of many logs."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from math import nan
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from bench.diagnosis.report.wording import append_unit, format_label
from bench.pages.text_format import format_csv

LOGS_TABLE_FILE = "logs.csv"
"""File name of the table, which has one row for each number of each cause of each log."""
LOG_COLUMNS = (
    "log", "verdict", "cause", "alternatives", "coefficient", "value", "low", "high", "unit",
    "gap_closed", "seconds", "error",
)  # fmt: skip


@dataclass(frozen=True)
class LogResult:
    """Result of one log.

    Attributes:
        log: Name of the log.
        digest: Digest of the log's files and settings, see `Log`.
        verdict: Verdict in one word; empty if the log could not be explained.
        causes: Causes as in verdict.json.
        gap_closed: Share of the held-out gap that is closed; None without held-out runs.
        seconds: Duration of the diagnosis in seconds.
        error: Reason why the log could not be explained, in one line.
    """

    log: str
    digest: str
    verdict: str = ""
    causes: tuple[Mapping[str, Any], ...] = ()
    gap_closed: float | None = None
    seconds: float | None = None
    error: str = ""


def format_cause(cause: Mapping[str, Any]) -> str:
    """Format a cause with its alternatives: ``friction.coulomb or joint.backlash``."""
    return " or ".join([cause["effect"], *cause["alternatives"]])


def format_log_table(rows: Sequence[LogResult]) -> str:
    """Format the table of all logs as CSV, with one row for each number of each cause."""
    lines: list[tuple[object, ...]] = []
    for row in rows:
        cells: list[tuple[object, ...]] = []
        for cause in row.causes:
            for name, number in cause["coefficients"].items():
                cause_cells = cause["effect"], " or ".join(cause["alternatives"]), name
                cells.append(
                    (*cause_cells, *(number[key] for key in ("value", "low", "high", "unit")))
                )
        common_cells = row.gap_closed, row.seconds, row.error
        lines += [(row.log, row.verdict, *cell, *common_cells) for cell in cells or [("",) * 7]]
    return format_csv(LOG_COLUMNS, lines)


def summarise_causes(rows: Sequence[LogResult]) -> list[str]:
    """Summarise how often each cause was found, and the range of its numbers.

    The most frequent cause comes first.
    """
    by_cause: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        for cause in row.causes:
            by_cause.setdefault(format_cause(cause), []).append(cause["coefficients"])
    lines = []
    for effects, coefficients in sorted(
        by_cause.items(), key=lambda entry: (-len(entry[1]), entry[0])
    ):
        numbers = []
        for name, first in coefficients[0].items():
            values = [c[name]["value"] for c in coefficients if name in c]
            label = "" if name == "coefficient" else f"{name} "
            low, high = min(values), max(values)
            span = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
            numbers.append(f"{label}{append_unit(span, first['unit'])}")
        lines.append(f"{effects}: in {len(coefficients)} of {len(rows)} logs, {', '.join(numbers)}")
    return lines


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
