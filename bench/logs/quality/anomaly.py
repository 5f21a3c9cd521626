"""Anomaly of a recording, found before any model is fitted."""

from __future__ import annotations

from typing import NamedTuple


class Anomaly(NamedTuple):
    """An implausible property of a recording.

    Attributes:
        text: One line, without the file's name.
        certain: Whether no correct recording can have this property.
    """

    text: str
    certain: bool
