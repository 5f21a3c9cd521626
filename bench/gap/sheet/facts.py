"""What stands on a data sheet, whatever it is written as."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bench.gap.report.words import clean, estimated, joined
from bench.gap.sheet.diagram import Diagram, diagram
from bench.gap.sheet.quantity import Quantity
from bench.gap.sheet.subject import Subject
from bench.gap.verdict import Verdict
from sims.extended import Extended
from sims.recording.recording import Recording

FORMAT = 1
"""Of sheet.toml."""


@dataclass(frozen=True)
class Facts:
    """What stands on a data sheet.

    Attributes:
        name: of what it is.
        subject: the joint, or the system.
        recording: the logs.
        verdict: of the explanation.
        extended: the model that was found.
        rows: its numbers.
    """

    name: str
    subject: Subject
    recording: Recording
    verdict: Verdict
    extended: Extended
    rows: tuple[Quantity, ...]

    def document(self) -> dict[str, Any]:
        """The content of sheet.toml."""
        named = {row.name: row.document() for row in self.rows}
        joint = {"joint": self.subject.joint} if self.subject.joint else {}
        return {
            "format": FORMAT,
            "name": self.name,
            "system": self.subject.kind.name,
            **joint,
            "recording": self.recording.title or self.recording.path.stem,
            "runs": [run.name for run in self.recording.training()],
            "verdict": self.verdict.verdict,
            "elsewhere": list(self.elsewhere()),
            "quantities": named,
            "diagram": self.diagram.document(),
        }

    @cached_property
    def diagram(self) -> Diagram:
        """Where the joint moves, holds and slips."""
        strongest = [row.number.value for row in self.rows if row.strongest and row.number]
        return diagram(self.subject, self.extended, next(iter(strongest), None))

    def elsewhere(self) -> Iterator[str]:
        """Causes that the model has at other places, or in the world."""
        for name, numbers in self.extended.effects.items():
            if not any(True for _ in self.subject.own(name, numbers)):
                yield name

    def lines(self) -> list[str]:
        """What the sheet says, in words: numbers first, then how many are not shown."""
        lines = [f"{clean(self.name, 80)}: {self.verdict.verdict}"]
        shown = [row for row in self.rows if row.number is not None]
        lines += [f"  {clean(r.name, 60)} = {estimated(r.number)}" for r in shown if r.number]
        rest = [row.name for row in self.rows if row.number is None]
        lines.append(f"not shown by these data: {clean(joined(rest), 2000) or 'nothing'}")
        return lines
