"""Alternative options of MuJoCo's solver, ranked by how well they explain the recording.

Two simulators of one model file can differ in options that change the motion where geoms touch: the
friction cone, the ratio of the friction's impedance to that of the normal force (`impratio`), the
iterations that prevent slip, the constraint solver and its iterations, and the integrator.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.discretisation_error import simulate_with_settings
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array
from sims.robot.integrator_settings import (
    CONE_IDS,
    INTEGRATOR_IDS,
    SOLVER_IDS,
    IntegratorSettings,
    list_changed_options,
    read_option,
)
from sims.robot.robot_simulator import RobotSimulator

IMPEDANCE_RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Values of `impratio` that are tried; model files state numbers between 1 and 100."""
NOSLIP_ITERATIONS = (0, 5)
"""Numbers of iterations without slip that are tried: without, and with as many as usual."""
SOLVER_ITERATIONS = (1, 3, 10, 30, 100)
"""Numbers of iterations of the solver that are tried."""
MIN_DISTINCT_CHANGE = 0.05
"""Minimum RMS difference of two alternatives, in units of the noise, of which both are tried."""
MIN_SQUARES_DECREASE = 20.0
"""Minimum decrease of the sum of squares by an alternative, in units of the noise."""
MAX_EXCESS_RATIO = 0.4
"""Maximum excess of the sum of squares over that of noise by another option, relative to without.

The initial states belong to the options in use. An option is accepted only if it leaves at most a
quarter of this excess with initial states of its own.
"""
MIN_CLEAR_MEAN_SQUARE = 9.0
"""Minimum mean square of the residual, in units of the noise, at which that ratio counts.

Nearer to the noise, the residual also depends on the initial states.
"""


class OptionAlternative(NamedTuple):
    """Settings with other options than those in use.

    Attributes:
        numerics: the settings.
        squares: sum of squares of the residual with them, in units of the noise.
    """

    numerics: IntegratorSettings
    squares: float


def rank_option_alternatives(
    evaluator: RunEvaluator, noise: NoiseModel, theta: Array, initial_states: Array
) -> list[OptionAlternative]:
    """Simulate the runs with alternative solver options, and rank those that explain them better.

    1. Compute the sum of squares that an alternative must not exceed. It is lower if the
       alternative changes a further option than if it only has another value of an option that
       already differs from the model file, because each changed option must clearly help.
    2. Simulate all alternatives.
    3. Leave out those that make the same motion as a better one.

    Shapes: R runs, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        noise: noise of each channel.
        theta: (P,) parameters of the fitted model.
        initial_states: (R, s) initial states.

    Returns:
        The alternatives, the smallest sum of squares first.
    """
    kind = evaluator.kind
    assert issubclass(kind, RobotSimulator)
    is_recorded = np.isfinite(evaluator.observed)

    def simulate(numerics: IntegratorSettings) -> Array:
        """Return the simulated readings in units of the noise, zero where none is recorded."""
        motion = simulate_with_settings(evaluator, numerics, theta, initial_states)
        return np.where(is_recorded, motion, 0.0) / noise.sigma

    observed = np.where(is_recorded, evaluator.observed, 0.0) / noise.sigma
    samples = max(int(is_recorded.sum()), 1)
    # 1. Limits.
    present_squares = float(np.square(simulate(kind.numerics) - observed).sum())
    limit = present_squares - MIN_SQUARES_DECREASE
    limit_of_further_option = limit
    if present_squares > MIN_CLEAR_MEAN_SQUARE * samples:
        # Noise alone has a sum of squares of one per sample; the rest is the excess.
        limit_of_further_option = samples + MAX_EXCESS_RATIO * (present_squares - samples)
    # Options that differ from the model file.
    changed_options = list_changed_options(kind.robot, kind.numerics).keys()
    # 2. Simulations.
    ranked: list[tuple[OptionAlternative, Array]] = []
    for numerics in _iterate_alternatives(kind):
        evaluator.search_control.check_not_stopped()
        motion = simulate(numerics)
        squares = float(np.square(motion - observed).sum())
        options = list_changed_options(kind.robot, numerics).keys()
        if squares < (limit if options == changed_options else limit_of_further_option):
            ranked.append((OptionAlternative(numerics, squares), motion))
    # 3. Distinct motions, the best one first.
    ranked.sort(key=lambda pair: pair[0].squares)
    distinct: list[tuple[OptionAlternative, Array]] = []
    for alternative, motion in ranked:
        mean_square_differences = [
            float(np.square(motion - known).sum()) / samples for _, known in distinct
        ]
        if all(difference >= MIN_DISTINCT_CHANGE**2 for difference in mean_square_differences):
            distinct.append((alternative, motion))
    return [alternative for alternative, _ in distinct]


def _iterate_alternatives(kind: type[RobotSimulator]) -> Iterator[IntegratorSettings]:
    """Yield solver settings that differ from the present ones in one option.

    The solver and its number of iterations count as one option; many iterations, which are more
    common, come first.

    Args:
        kind: simulator class of the robot.
    """
    settings = kind.numerics
    # Present value of each option: changed already, or that of the model file. The integrator is
    # always among the settings.
    present = settings.to_model_options()
    for name in ("cone", "impratio", "noslip_iterations", "solver", "iterations"):
        present.setdefault(name, read_option(kind.robot, name))
    values_by_option = {
        "cone": list(CONE_IDS.values()),
        "impratio": IMPEDANCE_RATIOS,
        "noslip_iterations": NOSLIP_ITERATIONS,
        "integrator": list(INTEGRATOR_IDS.values()),
    }
    for name, option_values in values_by_option.items():
        for number in option_values:
            if number != present[name]:
                yield settings.replace_options({name: number})
    for solver in (present["solver"], *SOLVER_IDS.values()):
        for iterations in (present["iterations"], *SOLVER_ITERATIONS[::-1]):
            pair = {"solver": solver, "iterations": iterations}
            changed = {name: number for name, number in pair.items() if number != present[name]}
            if changed:
                yield settings.replace_options(changed)
