"""How far a study is: what making ended with, and what its folder holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

MISSING = "missing"
"""The status of what has not been made yet."""
FINE = ("done", "converged", "made")
"""Statuses of which there is nothing more to say."""


class Made(NamedTuple):
    """How far a study came when it was made.

    Attributes:
        finished: how many runs or shots there are.
        planned: how many there are to be.
        interrupted: a person stopped it.
        stopped: what else did, in words.
        skipped: why it cannot be made on this machine at all.
    """

    finished: int
    planned: int
    interrupted: bool = False
    stopped: str = ""
    skipped: str = ""

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self.finished == self.planned


class End(NamedTuple):
    """How one run or shot ended.

    Attributes:
        name: its id.
        group: what it is counted with: its tuner, or its kind of ball.
        status: as in status.csv; `MISSING` where there is none.
        reason: in words, a traceback of a crash.
    """

    name: str
    group: str
    status: str
    reason: str = ""


class Standing(NamedTuple):
    """What a study's folder holds, while somebody may be at work there.

    Attributes:
        name: of the experiment.
        what: what is counted, e.g. ``runs finished``.
        hashes: of what must not change until it is complete, by what a person would call it.
        ends: of everything that is planned, in the order of the plan.
        under_way: whether results remain to be written, though everything may have ended.
    """

    name: str
    what: str
    hashes: Mapping[str, str]
    ends: tuple[End, ...]
    under_way: bool = False

    @property
    def finished(self) -> int:
        """How many have ended."""
        return sum(end.status != MISSING for end in self.ends)

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return not self.under_way and self.finished == len(self.ends)
