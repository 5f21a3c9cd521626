"""What a census of a recording finds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Finding(NamedTuple):
    """One finding.

    Attributes:
        about: clock, drift, quantisation, saturation, stillness or contradiction.
        text: what was found, with its number.
        remedy: what to do about it.
    """

    about: str
    text: str
    remedy: str

    @property
    def line(self) -> str:
        """All of it."""
        return f"{self.about}: {self.text}; {self.remedy}"


def named(names: Iterable[str], most: int = 4) -> str:
    """Some names, each once, in words."""
    each = list(dict.fromkeys(names))
    more = len(each) - most
    return ", ".join(each[:most]) + (f" and {more} more" if more > 0 else "")
