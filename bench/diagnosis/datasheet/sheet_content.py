"""Content of a data sheet for any output format, and its text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bench.diagnosis.datasheet.drive_diagram import DriveDiagram, compute_drive_diagram
from bench.diagnosis.datasheet.sheet_rows import SheetRow
from bench.diagnosis.datasheet.subject import PLACE_KIND_TITLES, SheetSubject
from bench.diagnosis.report.wording import (
    append_unit,
    format_fitted_value,
    format_number,
    format_p_value,
    format_percent,
    joined,
    sanitise,
)
from bench.diagnosis.verdict import Verdict
from sims.extended_simulator import ExtendedSimulator
from sims.recording.recording import Recording

FORMAT_VERSION = 1
"""Format version of sheet.toml."""

NAMES_IN_TERMINAL = 5
"""Maximum number of effects that the terminal names as not shown by the data."""


@dataclass(frozen=True)
class SheetContent:
    """Content of a data sheet.

    Attributes:
        name: Name on the sheet.
        subject: Joint or system that it describes.
        recording: Logs.
        verdict: Verdict of the diagnosis.
        extended: Extended simulator.
        rows: Numbers of the sheet.
    """

    name: str
    subject: SheetSubject
    recording: Recording
    verdict: Verdict
    extended: ExtendedSimulator
    rows: tuple[SheetRow, ...]

    def document(self) -> dict[str, Any]:
        """Return the content of sheet.toml."""
        rows_by_name = {row.name: row.to_document() for row in self.rows}
        joint = {"joint": self.subject.joint} if self.subject.joint else {}
        return {
            "format": FORMAT_VERSION,
            "name": self.name,
            "system": self.subject.kind.name,
            **joint,
            "recording": self.recording.title or self.recording.path.stem,
            "runs": [run.name for run in self.recording.training()],
            "verdict": self.verdict.verdict,
            "elsewhere": list(self.elsewhere()),
            "quantities": rows_by_name,
            **self._describe_rest(),
        }

    def _describe_rest(self) -> dict[str, Any]:
        """Return the diagram of a drive; without a drive, the dry friction that holds the joint."""
        if self.diagram is not None:
            return {"diagram": self.diagram.to_document()}
        rest_diagram = self.rest
        return {
            "rest": {
                "unit": rest_diagram.unit,
                "laws": list(rest_diagram.laws),
                "breakaway": rest_diagram.breakaway,
            }
        }

    @cached_property
    def is_driven(self) -> bool:
        """Return whether a drive acts here; without one there is no diagram."""
        return self.subject.is_driven(self.recording)

    @property
    def diagram(self) -> DriveDiagram | None:
        """Diagram of where the joint moves, holds and slips; None without a drive."""
        return self.rest if self.is_driven else None

    def explain_missing_diagram(self) -> str:
        """Return why there is no diagram, and what is known of the joint at rest instead."""
        reason = "the log has no input"
        if self.subject.joint:
            reason = (
                f"joint {self.subject.joint} has no actuator in the model, and no force in the log"
            )
        rest_diagram = self.rest
        if rest_diagram.laws and rest_diagram.breakaway > 0:
            force = append_unit(format_number(rest_diagram.breakaway), rest_diagram.unit)
            friction_text = (
                f"At rest, dry friction holds loads up to {force} ({joined(rest_diagram.laws)})"
            )
        else:
            friction_text = "No friction law was found that holds it at rest"
        return (
            f"There is no drive: {reason}. Therefore this sheet has no drive and back-drive "
            "diagram, and "
            "no numbers of a drive; the table shows the other effects on the joint. "
            f"{friction_text}."
        )

    @cached_property
    def rest(self) -> DriveDiagram:
        """Diagram of where the joint moves, holds and slips, also without a drive."""
        force_limits = [row.number.value for row in self.rows if row.strongest and row.number]
        return compute_drive_diagram(self.subject, self.extended, next(iter(force_limits), None))

    def elsewhere(self) -> Iterator[str]:
        """Yield causes of the model that act at other places, or in the world."""
        for name, numbers in self.extended.effects.items():
            if not any(True for _ in self.subject.localise_effect(name, numbers)):
                yield name

    def lines(self) -> list[str]:
        """Format the sheet as text: numbers first, then the effects that are not shown."""
        lines = [f"{sanitise(self.name, 80)}: {self.verdict.verdict}"]
        identified = [row for row in self.rows if row.number is not None]
        lines += [
            f"  {sanitise(r.name, 60)} = {format_fitted_value(r.number)}"
            for r in identified
            if r.number
        ]
        all_absent_names = [row.name for row in self.rows if row.number is None]
        absent_names, unnamed_count = (
            all_absent_names[:NAMES_IN_TERMINAL],
            len(all_absent_names) - NAMES_IN_TERMINAL,
        )
        if unnamed_count > 0:
            absent_names = [
                *absent_names,
                f"{unnamed_count} more (the sheet gives the detection limit of each)",
            ]
        lines.append(
            f"not detected in these data: {sanitise(joined(absent_names), 2000) or 'nothing'}"
        )
        return lines


UNJUDGED_P_VALUE = 0.05
"""P-value above which a cause is on the sheet only because the search ended before it was tested.
"""


def title(row: SheetRow, is_driven: bool) -> str:
    """Return the title of the part of the table that a row belongs to.

    Args:
        row: Row of the sheet.
        is_driven: Whether a drive acts on the joint or system.
    """
    if row.part == "system":
        return "Motor" if is_driven else "System"
    return PLACE_KIND_TITLES[row.part]


def format_prediction_interval(row: SheetRow) -> str:
    """Format half the prediction interval for a run or log that is not yet recorded."""
    return (
        ""
        if row.prediction_half_width is None
        else f"± {format_number(row.prediction_half_width, 2)}"
    )


def format_name(row: SheetRow) -> str:
    """Return the name of the row in words."""
    if row.part == "system":
        return row.name.replace("_", " ")
    # The sheet shows the value itself, not its difference from the model file.
    return row.says if row.stated is None else re.sub("^(wrong|misplaced) ", "", row.says)


def format_short_name(row: SheetRow) -> str:
    """Return the name of the row without the joint or actuator that the whole sheet describes."""
    effect, _, placed_name = row.name.partition("@")
    if not placed_name:
        return row.name
    place, _, coefficient = placed_name.partition(" ")
    channel = place.partition(".")[0] if row.part == "channel" else ""
    return " ".join(part for part in (effect, coefficient, channel) if part)


def format_evidence(row: SheetRow, is_short: bool = False) -> str:
    """Format the evidence for a number on the sheet.

    Args:
        row: Row of the sheet.
        is_short: Whether to use the short form for print.
    """
    if row.state == "derived":
        return "computed from the numbers below"
    if row.state == "fitted":
        return (
            "fitted"
            if row.number and row.number.low is not None
            else "not identified by these data"
        )
    is_judged = row.p_value is None or row.p_value <= UNJUDGED_P_VALUE
    unjudged_text = "not tested" if is_short else "the search ended before it was tested"
    parts = [format_p_value(row.p_value) if is_judged else unjudged_text]
    if row.share is not None:
        closed_share = format_percent(row.share)
        parts.append(
            f"{closed_share} held out"
            if is_short
            else f"alone it closes {closed_share} of the held-out gap"
        )
    if row.alternatives:
        parts.append(f"{joined(row.alternatives, 'or')} explains the data equally well")
    return "; ".join(parts)


def format_detection_limit(row: SheetRow) -> str:
    """Format in words how large an absent effect could be without being detected."""
    detection_limit = row.detection_limit
    if detection_limit is None or detection_limit.size == float("inf"):
        return "none: the data do not depend on it"
    size = format_number(detection_limit.size, 2)
    if detection_limit.is_unbounded:
        return append_unit(f"± {size}", row.unit) + ", larger than any plausible value"
    if detection_limit.limit:
        return append_unit(f"none {detection_limit.limit} {size}", row.unit)
    if detection_limit.is_nonzero_if_fitted:
        return (
            append_unit(
                f"{format_number(detection_limit.estimate_if_fitted, 2)} ± {size}", row.unit
            )
            + ", not diagnosed"
        )
    return append_unit(f"0 ± {size}", row.unit)


def format_confounding(row: SheetRow) -> str:
    """Format confounded parameters, and causes that the effect might replace."""
    parts = list(row.detection_limit.confounded_with) if row.detection_limit else []
    if row.alternatives:
        parts.append(f"possible alternative to {joined(row.alternatives, 'or')}")
    return ", ".join(parts)
