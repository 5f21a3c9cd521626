"""Result rows of many logs, the table of all logs and a summary of their causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.diagnosis.report.wording import append_unit
from bench.pages.csv_text import format_csv

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
