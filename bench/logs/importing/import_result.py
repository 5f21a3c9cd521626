"""Result of an import, and what a user states about the logs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bench.core.option_dataclasses import option
from bench.logs.importing.column_guessing import LogColumn
from sims.core.argument_checks import Name, Names

POSITION_UNITS = ("rad", "deg", "normalised")
"""Units of positions that a user may state; normalised positions are those of LeRobot."""
MAX_NAMES = 12
"""Maximum number of names in a line."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Information about logs that the user states.

    Attributes:
        held_out: Names of the runs that are held out (default: every third one).
        rate: Rate of the rows in Hz, if the logs have no time stamps.
        position_unit: Unit of positions and their commands for which none is stated: rad, deg, or
            normalised (-100 to 100 of LeRobot) (default: derived from the joints' ranges).
        calibration: Calibration file of LeRobot, by which normalised positions become angles
            (default: the one in the folder of the dataset).
    """

    held_out: Names = ()
    rate: float | None = option(None, "HZ")
    position_unit: Name = option("", "UNIT")
    calibration: str | Path | None = None


@dataclass
class ImportResult:
    """Description of logs, with its guesses and warnings.

    Attributes:
        text: The description in TOML.
        guessed: Guesses, one line each.
        untold: Columns, files and stamps that were left out and why, one line each.
        checks: What the user must check before using the description, one line each.
    """

    text: str
    guessed: list[str] = field(default_factory=list)
    untold: list[str] = field(default_factory=list)
    checks: list[str] = field(default_factory=list)
    _left_out: set[tuple[str, str]] = field(default_factory=set, init=False, repr=False)

    def leave_out(self, column: LogColumn, reason: str) -> None:
        """Report a column that is left out.

        Args:
            column: the column.
            reason: why it is left out, in words.
        """
        self._left_out.add((column.file, column.name))
        self.untold.append(f"{column.file}, column {column.name}: {reason}; left out")

    def is_left_out(self, column: LogColumn) -> bool:
        """Return whether a column has been reported as left out."""
        return (column.file, column.name) in self._left_out
