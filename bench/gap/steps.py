"""A time step or an integrator as a cause: what the verdict says of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from bench.gap.causes.rules import VerdictName, helps, is_alike
from bench.gap.verdict import Cause, Verdict
from sims.extended import Number

if TYPE_CHECKING:
    from bench.gap.model.numerics import Finer

Item = TypeVar("Item")

SURE = 20.0
"""Twice the log likelihood by which a finer step must explain the data better than the file's own:
odds of 22,000 to 1.
"""
PART = 0.5
"""Share of the base model's gap that a finer step must close alone to be used in the search. With a
smaller share another missing effect decides which step looks better.
"""
STEP, INTEGRATOR = "numerics.step", "numerics.integrator"
_WITH: dict[VerdictName, VerdictName] = {"adequate": "named", "unknown": "partial"}
"""Verdicts on what is left, and on the whole when the step has been found at fault besides."""


class Reusable(Generic[Item]):
    """An iterable that computes each item once, when it is first needed."""

    def __init__(self, items: Iterator[Item]) -> None:
        self._rest, self._known = items, list[Item]()

    def __iter__(self) -> Iterator[Item]:
        """All items from the first."""
        number = 0
        while True:
            if number == len(self._known):
                try:
                    self._known.append(next(self._rest))
                except StopIteration:
                    return
            yield self._known[number]
            number += 1


def is_finer_step_better(gain: float, gap: float, left: float) -> bool:
    """Whether a finer step explains the data better beyond doubt, and closes a large part of the
    gap without any other change.

    Args:
        gain: twice the log likelihood that it gains for the base model.
        gap: RMS that the base model leaves with the file's own step over the noise, in its units.
        left: the same with the finer step.
    """
    return gain >= SURE and gap - max(left, 0.0) >= PART * gap


def is_finer_model_better(file: tuple[float, float], finer: tuple[float, float]) -> bool:
    """Whether a model with a finer step is better beyond doubt than one with the file's own.

    Args:
        file: merit (Schwarz's criterion, twice the log likelihood less log n for each number) of
            the model with the file's step, and what it leaves over the noise, RMS in its units.
        finer: the same with the finer step. Far from the noise the likelihood is misled by
            autocorrelated residuals, so the residual must be smaller, too.
    """
    merits, excesses = zip(file, finer, strict=True)
    return not is_alike(merits[1] - merits[0]) and helps(merits, excesses)


class Coarse(NamedTuple):
    """The file's own step was at fault.

    Attributes:
        fine: what mends it.
        gain: twice the log likelihood that it gains.
    """

    fine: Finer
    gain: float


def with_numerics(verdict: Verdict, coarse: Coarse) -> Verdict:
    """The verdict with the step or integrator as its first cause."""
    causes = (*_causes(coarse), *verdict.causes)
    return replace(verdict, verdict=_WITH.get(verdict.verdict, verdict.verdict), causes=causes)


def _causes(coarse: Coarse) -> list[Cause]:
    from sims.robot.numerics import INTEGRATORS

    own, numerics = coarse.fine.own, coarse.fine.numerics
    # Two numbers are fitted at most, so the gain is one of chance with this probability (Wilks).
    chance = float(np.exp(-0.5 * min(coarse.gain, 1400.0)))
    error = f"the file's own misses its fine motion by {coarse.fine.error:.2g} times the noise"
    causes = []
    if numerics.integrator != own.integrator:
        says = f"integrator = {numerics.integrator} follows the robot's motion; {error}"
        number = Number(float(INTEGRATORS[numerics.integrator]), "1", None, None)
        causes.append(Cause(INTEGRATOR, (), says, {"coefficient": number}, chance))
    if numerics.timestep != own.timestep:
        says = f"a time step of {numerics.timestep:g} s follows the robot's motion; {error}"
        number = Number(numerics.timestep, "s", None, None)
        causes.append(Cause(STEP, (), says, {"coefficient": number}, chance))
    return causes
