"""Result of one quality check of a recording, and its anomalies."""

from __future__ import annotations

from typing import NamedTuple

SIGNIFICANCE_SIGMAS = 4.0
"""Detection threshold of the checks in standard deviations."""


class QualityFinding(NamedTuple):
    """One finding of a quality check.

    Attributes:
        about: clock, drift, quantisation, saturation, stillness, contradiction, overlap,
            contact or drive.
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


class Anomaly(NamedTuple):
    """An implausible property of a recording.

    Attributes:
        text: One line, without the file's name.
        certain: Whether no correct recording can have this property.
    """

    text: str
    certain: bool
