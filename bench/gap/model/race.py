"""Racing of fits: share the best cost between rounds and stop fits that fall far behind."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bench.gap.model.problem import Problem

RACED = 4
"""Minimum number of iterations before a fit can be eliminated."""
LEG = 3
"""Number of iterations per racing round; the best cost is shared between rounds."""
BEATEN = 100.0
"""Margin of the sum of squares, in units of the noise variance, beyond which a fit is eliminated.

It compares the optimistic final cost of the fit (see `HOPE`) with the best cost.
"""
HOPE = 10.0
"""Decrease of the cost that a fit may still reach, as a multiple of its next predicted decrease."""


class Leg(NamedTuple):
    """Iterations `first` to `last` (exclusive) of a fit with `all` iterations in total."""

    first: int
    last: int
    all: int


def legs(iterations: int, race: bool) -> Iterator[Leg]:
    """Yield the rounds of a fit.

    Args:
        iterations: total number of iterations; with 0, one empty round is generated.
        race: whether the fits race, and so exchange their best cost after each short round.
            Otherwise there is only one round.
    """
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
    """Mark fits as done if several more steps would not bring them close to the best cost.

    Args:
        problems: states of the fits; `done` is set in place.
        reached: lowest cost of other fits.
    """
    best = min(reached, *(p.point.cost for p in problems))
    for p in problems:
        p.done |= p.point.cost - HOPE * p.promised > best + BEATEN
