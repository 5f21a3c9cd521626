"""Report a too coarse time step or integrator as the first cause of a verdict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from bench.diagnosis.search.verdict_rules import (
    VerdictName,
    improves_held_out,
    is_indistinguishable,
)
from bench.diagnosis.verdict import Cause, Verdict
from sims.extended_simulator import FittedValue

if TYPE_CHECKING:
    from bench.diagnosis.evaluation.integrator_check import StepRefinement

Item = TypeVar("Item")

MIN_FINER_STEP_GAIN = 20.0
"""Minimum gain in twice the log-likelihood of a finer step over the file's own step; it means odds
of 22,000 to 1.
"""
MIN_CLOSED_SHARE = 0.5
"""Minimum share of the base model's gap that a finer step must close alone to be used in the
search. With a smaller share, another missing effect decides which step looks better.
"""
STEP, INTEGRATOR = "numerics.step", "numerics.integrator"
_VERDICT_WITH_COARSE_STEP: dict[VerdictName, VerdictName] = {
    "adequate": "named",
    "unknown": "partial",
}
"""Verdict on the whole if the step was too coarse, by the verdict on the remaining causes."""


class Reusable(Generic[Item]):
    """Iterable that computes each item once, when it is first needed."""

    def __init__(self, items: Iterator[Item]) -> None:
        self._remaining_items, self._computed_items = items, list[Item]()

    def __iter__(self) -> Iterator[Item]:
        """Yield all items from the first; none is computed a second time."""
        number = 0
        while True:
            if number == len(self._computed_items):
                try:
                    self._computed_items.append(next(self._remaining_items))
                except StopIteration:
                    return
            yield self._computed_items[number]
            number += 1


def is_finer_step_better(gain: float, gap: float, remaining_gap: float) -> bool:
    """Return whether a finer step is significantly better and alone closes a large part of the gap.

    Args:
        gain: Gain in twice the log-likelihood of the base model.
        gap: Excess RMS residual of the base model with the file's own step, in units of the noise.
        remaining_gap: Excess RMS residual of the base model with the finer step, in units of the
            noise.
    """
    return gain >= MIN_FINER_STEP_GAIN and gap - max(remaining_gap, 0.0) >= MIN_CLOSED_SHARE * gap


def is_finer_model_better(file: tuple[float, float], finer: tuple[float, float]) -> bool:
    """Return whether a model with a finer step is significantly better than one with the file's.

    Args:
        file: Penalised log-likelihood (twice the log-likelihood less log n for each parameter;
            Schwarz's criterion) and excess RMS residual in units of the noise, with the file's
            step.
        finer: The two values with the finer step. Far from the noise floor, autocorrelated
            residuals bias the likelihood, so the residual must be smaller too.
    """
    merits, excesses = zip(file, finer, strict=True)
    return not is_indistinguishable(merits[1] - merits[0]) and improves_held_out(merits, excesses)


class CoarseStepFinding(NamedTuple):
    """Finding that the model file's own step is too coarse.

    Attributes:
        refinement: Finer step that corrects the error.
        gain: Gain in twice the log-likelihood.
    """

    refinement: StepRefinement
    gain: float


def add_numerics_cause(verdict: Verdict, coarse: CoarseStepFinding) -> Verdict:
    """Add the step or integrator to a verdict as its first cause.

    Args:
        verdict: Verdict on the remaining causes.
        coarse: Finding that the file's step is too coarse.
    """
    causes = (*_list_numerics_causes(coarse), *verdict.causes)
    return replace(
        verdict,
        verdict=_VERDICT_WITH_COARSE_STEP.get(verdict.verdict, verdict.verdict),
        causes=causes,
    )


def _list_numerics_causes(coarse: CoarseStepFinding) -> list[Cause]:
    """Return the integrator and the time step as causes if they differ from the model file.

    Their p-value is that of the gain in twice the log-likelihood by Wilks' theorem, exp(-gain / 2)
    for two parameters; the gain is limited to 1400 so that the p-value does not become zero by
    underflow.
    """
    from sims.robot.integrator_settings import INTEGRATOR_IDS

    file_settings, numerics = coarse.refinement.file_settings, coarse.refinement.numerics
    # At most two numbers are chosen, so Wilks' theorem gives this p-value of the gain.
    p_value = float(np.exp(-0.5 * min(coarse.gain, 1400.0)))
    error = (
        f"the file's own misses its fine motion by {coarse.refinement.error:.2g} times the noise"
    )
    causes = []
    if numerics.integrator != file_settings.integrator:
        description = f"integrator = {numerics.integrator} follows the robot's motion; {error}"
        number = FittedValue(float(INTEGRATOR_IDS[numerics.integrator]), "1", None, None)
        causes.append(Cause(INTEGRATOR, (), description, {"coefficient": number}, p_value))
    if numerics.timestep != file_settings.timestep:
        description = f"a time step of {numerics.timestep:g} s follows the robot's motion; {error}"
        number = FittedValue(numerics.timestep, "s", None, None)
        causes.append(Cause(STEP, (), description, {"coefficient": number}, p_value))
    return causes
