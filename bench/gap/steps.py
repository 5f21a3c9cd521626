"""A time step or an integrator as a cause: what the verdict says of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.gap.causes.rules import VerdictName
from bench.gap.verdict import Cause, Verdict
from sims.extended import Number

if TYPE_CHECKING:
    from bench.gap.model.numerics import Finer

STEP, INTEGRATOR = "numerics.step", "numerics.integrator"
_WITH: dict[VerdictName, VerdictName] = {"adequate": "named", "unknown": "partial"}
"""Verdicts on what is left, and on the whole when the step has been found at fault besides."""


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
