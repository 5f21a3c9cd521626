"""Content of a data sheet, for any output format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bench.diagnosis.datasheet.drive_diagram import DriveDiagram, compute_drive_diagram
from bench.diagnosis.datasheet.sheet_rows import SheetRow
from bench.diagnosis.datasheet.subject import SheetSubject
from bench.diagnosis.report.wording import (
    append_unit,
    format_fitted_value,
    format_number,
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
