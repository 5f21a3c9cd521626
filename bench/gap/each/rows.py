"""What came of each of many logs: a row each, the table of all, and what all say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.pages.csv_text import csv_text

TABLE = "logs.csv"
"""The table: a row for each number of each cause of each log."""
HEAD = (
    "log", "verdict", "cause", "alternatives", "coefficient", "value", "low", "high", "unit",
    "gap_closed", "seconds", "error",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What came of a log.

    Attributes:
        log: its name.
        digest: that of `Log`.
        verdict: the word; empty where it could not be explained.
        causes: as verdict.json has them.
        gap_closed: share of the held-out gap that is closed; None where nothing is held out.
        seconds: that it took.
        error: why it could not be explained, in one line.
    """

    log: str
    digest: str
    verdict: str = ""
    causes: tuple[Mapping[str, Any], ...] = ()
    gap_closed: float | None = None
    seconds: float | None = None
    error: str = ""


def named(cause: Mapping[str, Any]) -> str:
    """A cause with what cannot be told from it: ``friction.coulomb or joint.backlash``."""
    return " or ".join([cause["effect"], *cause["alternatives"]])


def table(rows: Sequence[Row]) -> str:
    """The table of all logs as CSV, a row for each number of each cause."""
    lines: list[tuple[object, ...]] = []
    for row in rows:
        cells: list[tuple[object, ...]] = []
        for cause in row.causes:
            for name, number in cause["coefficients"].items():
                what = cause["effect"], " or ".join(cause["alternatives"]), name
                cells.append((*what, *(number[key] for key in ("value", "low", "high", "unit"))))
        last = row.gap_closed, row.seconds, row.error
        lines += [(row.log, row.verdict, *cell, *last) for cell in cells or [("",) * 7]]
    return csv_text(HEAD, lines)


def told(rows: Sequence[Row]) -> list[str]:
    """How often each cause was named, and its numbers' range over the logs; most frequent first."""
    places: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        for cause in row.causes:
            places.setdefault(named(cause), []).append(cause["coefficients"])
    lines = []
    for effects, found in sorted(places.items(), key=lambda entry: (-len(entry[1]), entry[0])):
        numbers = []
        for name, first in found[0].items():
            values = [c[name]["value"] for c in found if name in c]
            label = "" if name == "coefficient" else f"{name} "
            unit = "" if first["unit"] == "1" else f" {first['unit']}"
            low, high = min(values), max(values)
            span = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
            numbers.append(f"{label}{span}{unit}")
        lines.append(f"{effects}: in {len(found)} of {len(rows)} logs, {', '.join(numbers)}")
    return lines
