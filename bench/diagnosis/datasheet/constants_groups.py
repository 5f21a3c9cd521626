"""Group the runs of a data sheet's recording by their constants, such as the load of each run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bench.diagnosis.datasheet.sheet_content import SheetContent
from sims.recording.recording import Run


@dataclass(frozen=True)
class ConstantsGroup:
    """Runs of a recording with equal constants.

    Attributes:
        name: Short name from the constants; empty if there are none.
        numbers: Parameters and constants.
        runs: Runs of the recording.
    """

    name: str
    numbers: Mapping[str, float]
    runs: tuple[Run, ...]


def group_runs_by_constants(sheet: SheetContent) -> list[ConstantsGroup]:
    """Group the runs with equal constants, such as one load, in the order of the recording.

    An MJCF model has fixed numbers, so each group needs its own model.
    """
    by_constants: dict[tuple[tuple[str, float], ...], list[Run]] = {}
    for run in sheet.recording.runs:
        by_constants.setdefault(tuple(sorted(run.constants.items())), []).append(run)
    defaults = {c.name: c.value for c in sheet.subject.kind.constants}
    defaults |= {p.name: p.nominal for p in sheet.subject.kind.parameters}
    fitted_values = {name: number.value for name, number in sheet.extended.parameters.items()}
    numbers = {**defaults, **sheet.recording.constants, **sheet.extended.constants, **fitted_values}
    return [
        ConstantsGroup(
            "_".join(f"{name}{value:g}" for name, value in constants) if by_constants else "",
            {**numbers, **dict(constants)},
            tuple(runs),
        )
        for constants, runs in by_constants.items()
    ]
