"""Fits that race: who falls far behind is given up, and all hear of the best now and then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bench.gap.model.problem import Problem

RACED = 4
"""Steps after which a model can be so far behind that it is given up."""
LEG = 3
"""Steps after which those who race hear of each other."""
BEATEN = 100.0
"""A model is given up whose sum of squares, less what may be hoped for, is so much above the best
one's.
"""
HOPE = 10.0
"""What may be hoped for, in multiples of what the next step promises."""


class Leg(NamedTuple):
    """Steps from the first until the last, which is not made any more, of so many in all."""

    first: int
    last: int
    all: int


def legs(iterations: int, race: bool) -> Iterator[Leg]:
    """The way of a fit: in legs where models race, who hear of each other between them."""
    first = 0
    while first < iterations or not first:
        last = iterations
        if race:
            last = min(iterations, first + LEG if first else RACED)
        yield Leg(first, last, max(iterations, 1))
        if not iterations:
            return
        first = last


def give_up(problems: Sequence[Problem], reached: float) -> None:
    """Leave models unfinished that several steps like the last would not bring near the best."""
    best = min(reached, *(p.point.cost for p in problems))
    for p in problems:
        p.done |= p.point.cost - HOPE * p.promised > best + BEATEN
