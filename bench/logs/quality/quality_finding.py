"""Result of one quality check of a recording."""

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


def format_names(names: Iterable[str], most: int = 4) -> str:
    """Format a list of names, each once, and the number of names beyond the first few.

    Args:
        names: Names, possibly repeated.
        most: Maximum number of names that are written out.
    """
    distinct_names = list(dict.fromkeys(names))
    unnamed_count = len(distinct_names) - most
    return ", ".join(distinct_names[:most]) + (
        f" and {unnamed_count} more" if unnamed_count > 0 else ""
    )
