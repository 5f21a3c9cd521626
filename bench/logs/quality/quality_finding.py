"""Result of one quality check of a recording, and its anomalies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class QualityFinding(NamedTuple):
    """One finding of a quality check.

    Attributes:
        about: clock, drift, quantisation, saturation, stillness, contradiction, overlap or drive.
        text: Description of the finding, with its number.
        remedy: Recommended action.
    """

    about: str
    text: str
    remedy: str

    @property
    def text_line(self) -> str:
        """The complete finding in one line."""
        return f"{self.about}: {self.text}; {self.remedy}"


_MAX_NAMES = 4
"""Maximum number of names that are written out."""


def format_names(names: Iterable[str]) -> str:
    """Format a list of names, each once, and the number of names beyond the first few.

    Args:
        names: Names, possibly repeated.
    """
    distinct_names = list(dict.fromkeys(names))
    unnamed_count = len(distinct_names) - _MAX_NAMES
    return ", ".join(distinct_names[:_MAX_NAMES]) + (
        f" and {unnamed_count} more" if unnamed_count > 0 else ""
    )


class Anomaly(NamedTuple):
    """An implausible property of a recording.

    Attributes:
        text: One line, without the file's name.
        certain: Whether no correct recording can have this property.
    """

    text: str
    certain: bool
