"""Racing of fits: share the best cost between rounds and stop fits that fall far behind."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bench.diagnosis.fitting.fit_state import FitState

MIN_ITERATIONS_BEFORE_ELIMINATION = 4
"""Minimum number of iterations before a fit can be eliminated."""
ITERATIONS_PER_ROUND = 3
"""Number of iterations per racing round; the best cost is shared between rounds."""
ELIMINATION_MARGIN = 100.0
"""Margin of the sum of squares, in units of the noise variance, beyond which a fit is eliminated.

It compares the optimistic final cost of the fit (see `PREDICTED_DECREASE_FACTOR`) with the best
cost.
"""
PREDICTED_DECREASE_FACTOR = 10.0
"""Decrease of the cost that a fit may still reach, as a multiple of its next predicted decrease."""


class RacingRound(NamedTuple):
    """Iterations `first` to `last` (exclusive) of a fit with `all` iterations in total."""

    first: int
    last: int
    all: int


def iterate_rounds(iterations: int, race: bool) -> Iterator[RacingRound]:
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
            last = min(
                iterations,
                first + ITERATIONS_PER_ROUND if first else MIN_ITERATIONS_BEFORE_ELIMINATION,
            )
        yield RacingRound(first, last, max(iterations, 1))
        if not iterations:
            return
        first = last


def eliminate_losing_fits(problems: Sequence[FitState], reached: float) -> None:
    """Mark fits as done if several more steps would not bring them close to the best cost.

    Args:
        problems: states of the fits; `done` is set in place.
        reached: lowest cost of other fits.
    """
    best = min(reached, *(p.point.cost for p in problems))
    for p in problems:
        p.is_finished |= (
            p.point.cost - PREDICTED_DECREASE_FACTOR * p.predicted_decrease
            > best + ELIMINATION_MARGIN
        )
