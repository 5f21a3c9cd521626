"""What is odd about a recording, before anything is fitted to it."""

from __future__ import annotations

from typing import NamedTuple


class Oddity(NamedTuple):
    """Something odd.

    Attributes:
        text: one line, without the file's name.
        certain: whether nothing sound could look like this.
    """

    text: str
    certain: bool
