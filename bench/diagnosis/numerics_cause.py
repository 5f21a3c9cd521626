"""Report wrong numerical settings of a model file as the first causes of a verdict.

They are a too coarse time step or integrator, and options of MuJoCo's solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.diagnosis.search.verdict_rules import VerdictName
from bench.diagnosis.verdict import Cause, Verdict
from sims.extended_simulator import FittedValue
from sims.robot.fitted_causes import make_option_value

if TYPE_CHECKING:
    from bench.diagnosis.evaluation.discretisation_error import StepRefinement
    from sims.robot.robot_simulator import RobotSimulator

STEP, INTEGRATOR = "numerics.step", "numerics.integrator"
_VERDICT_WITH_NUMERICS: dict[VerdictName, VerdictName] = {
    "adequate": "named",
    "unknown": "partial",
}
"""Verdict on the whole if numerical settings are wrong, by the verdict on the remaining causes."""
MAX_P_VALUE_GAIN = 1400.0
"""Largest gain for which a p-value is computed.

Beyond it, exp(-gain / 2) becomes zero by underflow.
"""


class CoarseStepFinding(NamedTuple):
    """Finding that the model file's own step is too coarse.

    Attributes:
        refinement: Finer step that corrects the error.
        gain: Gain in twice the log-likelihood.
    """

    refinement: StepRefinement
    gain: float


class OptionFinding(NamedTuple):
    """Finding that options of the model file's solver differ from those of the recording.

    Attributes:
        kind: Simulator with the options that explain the recording.
        gain: Gain in twice the log-likelihood.
    """

    kind: type[RobotSimulator]
    gain: float


def add_numerics_causes(verdict: Verdict, causes: Sequence[Cause]) -> Verdict:
    """Add wrong numerical settings to a verdict as its first causes.

    Args:
        verdict: Verdict on the remaining causes.
        causes: The numerical settings; the verdict stays as it is without any.
    """
    if not causes:
        return verdict
    return replace(
        verdict,
        verdict=_VERDICT_WITH_NUMERICS.get(verdict.verdict, verdict.verdict),
        causes=(*causes, *verdict.causes),
    )


def _compute_p_value(gain: float) -> float:
    """Return the p-value of a gain in twice the log-likelihood by at most two chosen numbers.

    It is exp(-gain / 2) by Wilks' theorem; the gain is limited to `MAX_P_VALUE_GAIN`.
    """
    return float(np.exp(-0.5 * min(gain, MAX_P_VALUE_GAIN)))


def list_option_causes(finding: OptionFinding) -> list[Cause]:
    """Return the options of the solver that differ from the model file as causes.

    The coefficient of an option is its value in the simulation that explains the recording; an
    option that is a word, such as a solver, has its number in MuJoCo.

    Args:
        finding: simulator class of the robot with the other options, and their gain.
    """
    from sims.robot.integrator_settings import OPTION_EFFECTS, format_option, list_changed_options

    kind, p_value = finding.kind, _compute_p_value(finding.gain)
    causes = []
    for effect, (stated, number) in list_changed_options(kind.robot, kind.numerics).items():
        option = OPTION_EFFECTS[effect]
        # Some options are words, such as a solver; others are numbers.
        options = format_option(option, stated), format_option(option, number)
        before, after = (value if isinstance(value, str) else f"{value:g}" for value in options)
        description = f"{option} = {after} explains the recording, the model file has {before}"
        coefficients = {"coefficient": make_option_value(effect, stated, number)}
        causes.append(Cause(effect, (), description, coefficients, p_value))
    return causes


def list_step_causes(coarse: CoarseStepFinding) -> list[Cause]:
    """Return the integrator and the time step as causes if they differ from the model file.

    The coefficient of the integrator is its number in MuJoCo, that of the time step its value in s.
    Both are chosen and not estimated, so they have no interval.

    Args:
        coarse: Finding that the file's step is too coarse.
    """
    from sims.robot.integrator_settings import INTEGRATOR_IDS

    file_settings, numerics = coarse.refinement.file_settings, coarse.refinement.numerics
    p_value = _compute_p_value(coarse.gain)
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
