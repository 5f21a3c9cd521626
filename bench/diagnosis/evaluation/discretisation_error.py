"""Discretisation error of a robot's time step: better steps and integrators, and a correction.

A model file specifies a time step and an integrator, and both affect the motion: with a coarse step
the motion is early by about half a step, or a stiff servo becomes unstable. With the motion q(h) at
step size h, a scheme is accepted as the reference if halving its step hardly changes the motion. If
no scheme qualifies, the first-order error of an implicit scheme is extrapolated (L. F. Richardson,
1911, doi:10.1098/rsta.1911.0009):

    q = 2 q(h / 2) - q(h)                                                                      (1)

A smaller error, which no finer step is worth, is corrected: `correct_discretisation`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array
from sims.robot.integrator_settings import IntegratorSettings
from sims.robot.robot_simulator import RobotSimulator

MIN_DISCRETISATION_ERROR = 0.2
"""Minimum RMS discretisation error, in units of the noise, at which finer steps are considered."""
MAX_CORRECTED_ERROR = 0.1
"""Maximum RMS error, in units of the noise, of a setting that corrects the discretisation error."""
MAX_CORRECTED_ERROR_FAR_FIT = 0.7
"""Maximum RMS error of a setting, in units of the noise, if the residual is much larger.

The rest of the error is corrected after the fit (`correct_discretisation`).
"""
MIN_ERROR_REDUCTION = 4.0
"""Minimum factor by which a setting must reduce an error above `MAX_CORRECTED_ERROR`.

The reference is the error of the step of the model file.
"""
MAX_ERROR_TO_RESIDUAL_RATIO = 0.05
"""Maximum error of a setting above `MAX_CORRECTED_ERROR`, as a share of the model's residual."""
CONVERGENCE_TOLERANCE = 0.03
"""Maximum RMS change by halving the step, in units of the noise, of a reference scheme."""
MAX_STEP_DIVISIONS = 10
"""Maximum number of divisions of the step of the model file."""
STIFF_INTEGRATOR = "implicitfast"
"""Integrator that remains stable with stiff servos."""
CHECKED_RUN_COUNT = 2
"""Number of runs that are checked; a step that is too coarse is so in all runs."""
RELATIVE_RK4_COST = 3.3
"""Time of a step of RK4, relative to one of the other integrators."""
MAX_CORRECTABLE_ERROR = 1.0
"""Maximum RMS discretisation error that is corrected, in units of the noise."""


class StepRefinement(NamedTuple):
    """A finer step or better integrator for a robot.

    Attributes:
        kind: its simulator with these settings.
        file_settings: step and integrator of the model file.
        numerics: step and integrator that correct the error.
        error: RMS discretisation error of `file_settings`, in units of the noise.
        corrected_error: RMS discretisation error of `numerics`, in units of the noise.
    """

    kind: type[RobotSimulator]
    file_settings: IntegratorSettings
    numerics: IntegratorSettings
    error: float
    corrected_error: float

    def is_accurate_enough(self, residual_rms: float) -> bool:
        """Return whether the step is fine enough for a model with the given residual.

        Args:
            residual_rms: RMS residual of the model, in units of the noise.
        """
        return self.corrected_error < max(
            MAX_CORRECTED_ERROR, MAX_ERROR_TO_RESIDUAL_RATIO * residual_rms
        )


def find_step_refinements(evaluator: RunEvaluator, noise: NoiseModel) -> Iterator[StepRefinement]:
    """Yield time steps and integrators that reproduce the converged motion, the cheapest first.

    Nothing is generated if the settings of the model file are accurate, or if no motion converges
    as a reference.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        noise: noise of each channel.
    """
    kind = evaluator.kind
    assert issubclass(kind, RobotSimulator)
    # 1. Converged motion.
    motions = _ReferenceMotions(evaluator, noise)
    # Time step and integrator of the model file.
    model_settings = kind.numerics
    reference = motions.find_converged_motion(model_settings)
    if reference is None:
        return
    # 2. Error of the settings of the model file.
    error = motions.compute_rms_difference(motions.get_motion(model_settings), reference)
    if not error > MIN_DISCRETISATION_ERROR:
        return
    # 3. Settings with an error below `MAX_CORRECTED_ERROR`. One that reduces the error clearly, but
    # leaves more of it, is also yielded: the caller accepts it for a model with a large residual
    # (`StepRefinement.is_accurate_enough`).
    clearly_reduced_error = min(MAX_CORRECTED_ERROR_FAR_FIT, error / MIN_ERROR_REDUCTION)
    max_error = max(MAX_CORRECTED_ERROR, clearly_reduced_error)
    for numerics in _iterate_settings(model_settings):
        corrected_error = motions.compute_rms_difference(motions.get_motion(numerics), reference)
        if corrected_error < max_error:
            yield StepRefinement(
                kind=kind.with_integrator_settings(numerics),
                file_settings=model_settings,
                numerics=numerics,
                error=error,
                corrected_error=corrected_error,
            )


def _iterate_settings(model_settings: IntegratorSettings) -> Iterator[IntegratorSettings]:
    """Yield finer time steps and other integrators than the robot's own, the cheapest first.

    The cost of a setting is the number of steps times the relative cost of the integrator
    (`RELATIVE_RK4_COST`).

    Args:
        model_settings: time step, integrator and options of the model file.
    """
    step, integrator, *_ = model_settings
    relative_costs = {"RK4": RELATIVE_RK4_COST}
    # `dict.fromkeys` removes a repeated name and keeps the order.
    integrators = dict.fromkeys((integrator, STIFF_INTEGRATOR, "RK4"))
    # Cost, divisor of the step, and integrator.
    settings_with_cost = []
    for divisor in (1, 2, 5, MAX_STEP_DIVISIONS):
        for name in integrators:
            # The settings of the model file themselves are left out.
            if (divisor, name) != (1, integrator):
                settings_with_cost.append((divisor * relative_costs.get(name, 1.0), divisor, name))
    settings_with_cost.sort(key=lambda entry: entry[0])
    for _, divisor, name in settings_with_cost:
        yield model_settings._replace(timestep=step / divisor, integrator=name)


def simulate_with_settings(
    evaluator: RunEvaluator, numerics: IntegratorSettings, theta: Array, initial_states: Array
) -> Array:
    """Simulate the first runs of a robot with other integrator or solver settings, without effects.

    Shapes: R simulated runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        numerics: settings of the integrator and the solver.
        theta: (P,) parameters; the coefficients of effects among them are not used.
        initial_states: (R, s) initial states of the first R runs; other runs are not simulated.

    Returns:
        Simulated readings (R, T, C), NaN after the end of a run.
    """
    kind = evaluator.kind
    assert issubclass(kind, RobotSimulator)
    run_count = len(initial_states)
    # The parameters of the system come first in theta, and the same values hold in every run.
    parameters = np.tile(theta[: evaluator.system_parameter_count], (run_count, 1))
    states = dict(zip(evaluator.state_names, initial_states.T, strict=True))
    scenarios = [run.scenario for run in evaluator.prepared_runs[:run_count]]
    evaluator.simulation_count += run_count
    other_kind = kind.with_integrator_settings(numerics)
    with closing(other_kind(evaluator.recording.constants, evaluator.channels)) as simulator:
        return simulator.simulate_batch(parameters, scenarios, states)


class _ReferenceMotions:
    """Motions of the first runs with any step and integrator, each simulated once."""

    def __init__(self, evaluator: RunEvaluator, noise: NoiseModel) -> None:
        self._evaluator, self._noise = evaluator, noise
        self._checked_runs = evaluator.prepared_runs[:CHECKED_RUN_COUNT]
        self._motions: dict[IntegratorSettings, Array] = {}

    def get_motion(self, numerics: IntegratorSettings) -> Array:
        """Return the motion (R, T, C) with a step and integrator, NaN after the end of a run.

        It is simulated at the nominal parameters without effects, and cached.

        Shapes: R checked runs, T samples, C channels.

        Args:
            numerics: time step, integrator and solver options.
        """
        if numerics not in self._motions:
            evaluator = self._evaluator
            states = evaluator.initial_state_guesses[: len(self._checked_runs)]
            self._motions[numerics] = simulate_with_settings(
                evaluator, numerics, evaluator.get_nominal_theta(), states
            )
        return self._motions[numerics]

    def find_converged_motion(self, model_settings: IntegratorSettings) -> Array | None:
        """Return the converged motion of the robot (R, T, C); None if no integrator converges.

        A motion has converged if halving the time step hardly changes it.

        1. Try RK4 with smaller and smaller steps.
        2. For stiff motions, extrapolate the step of an implicit integrator to zero (Richardson):
           with step sizes h and h / 2, q = 2 q(h / 2) - q(h), eq. (1).

        Shapes: R runs, T samples, C channels.

        Args:
            model_settings: time step, integrator and options of the model file.
        """

        def simulate(integrator: str, divisor: int) -> Array:
            """Simulate with another integrator and a part of the time step of the file."""
            timestep = model_settings.timestep / divisor
            settings = model_settings._replace(timestep=timestep, integrator=integrator)
            return self.get_motion(settings)

        def extrapolate(divisor: int) -> Array:
            """Extrapolate to the step zero from a part of the time step and half of it, eq. (1)."""
            coarse = simulate(STIFF_INTEGRATOR, divisor)
            refined = simulate(STIFF_INTEGRATOR, 2 * divisor)
            return 2.0 * refined - coarse

        # Divisors of the time step to try. The motion of each is compared with that of half the
        # step, which is returned if they agree.
        for divisors, compute_motion in (
            ((1, 2, 5), partial(simulate, "RK4")),
            ((2, 5), extrapolate),
        ):
            for divisor in divisors:
                refined = compute_motion(2 * divisor)
                change = self.compute_rms_difference(compute_motion(divisor), refined)
                if change < CONVERGENCE_TOLERANCE:
                    return refined
        return None

    def compute_rms_difference(self, first: Array, second: Array) -> float:
        """Return the RMS difference in units of the noise; infinite if a simulation fails.

        Only available samples of the recording are compared.

        Shapes: R runs, T samples, C channels.

        Args:
            first: (R, T, C) simulated channels of the checked runs.
            second: (R, T, C) the same channels, simulated with other settings.
        """
        squares = []
        for run, run_data in enumerate(self._checked_runs):
            observed_mask = np.isfinite(run_data.observed)
            # Runs are padded to equal length.
            samples = slice(len(observed_mask))
            difference = (first[run, samples] - second[run, samples]) / self._noise.sigma
            squares.append(np.square(difference[observed_mask]))
        rms = float(np.sqrt(np.concatenate(squares).mean()))
        return rms if np.isfinite(rms) else float("inf")


def correct_discretisation(
    evaluator: RunEvaluator, noise: NoiseModel, theta: Array, states: Array
) -> None:
    """Correct all later simulations for the discretisation error at a model near the data.

    The correction is stored in the evaluator, which adds it to its simulations. An error below
    `MAX_CORRECTABLE_ERROR` is not reported as a cause, but an effect could imitate it: for example
    dry friction that stops within a step and not at its end, or a servo that is nearly too fast for
    the step. A larger error is not corrected.

    With the motion q(h) at step size h, the converged motion is 2 q(h / 4) - q(h / 2) to first
    order in h (L. F. Richardson, 1911, doi:10.1098/rsta.1911.0009), and approximately for any
    higher order. The correction is its difference from the simulated motion,

        2 q(h / 4) - q(h / 2) - q(h).                                                          (2)

    Shapes: R runs, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot; its `discretisation_correction` is
            set.
        noise: noise of each channel.
        theta: (P,) parameters of a model near the data.
        states: (R, s) initial states of the model.
    """
    # Robots without contact are those that have a linearisation. Other systems are not simulated at
    # a fixed step, and an impact is not smooth in the step size.
    if not evaluator.has_linearisation:
        return
    assert issubclass(evaluator.kind, RobotSimulator)
    # The finer simulators have the same effects, because theta has their coefficients.
    effects = [*evaluator.library, *evaluator.extra_effects]
    run_count = len(evaluator.prepared_runs)
    scenarios = [run_data.scenario for run_data in evaluator.prepared_runs]
    thetas = np.tile(theta, (run_count, 1))
    initial_states = dict(zip(evaluator.state_names, states.T, strict=True))
    half_step_kind = evaluator.kind.with_half_step()
    # Motions with the usual step, half of it and a quarter of it.
    motions = [evaluator.simulator.simulate_batch(thetas, scenarios, initial_states)]
    for kind in (half_step_kind, half_step_kind.with_half_step()):
        constants = evaluator.recording.constants
        with closing(kind(constants, evaluator.channels, effects=effects)) as finer:
            motions.append(finer.simulate_batch(thetas, scenarios, initial_states))
    usual_step, half_step, quarter_step = motions
    # Cost in units of a run with the usual step: 1, 2 with half of the step, and 4 with a quarter.
    evaluator.simulation_count += 7 * run_count
    correction = 2.0 * quarter_step - half_step - usual_step  # (2)
    squared_errors = np.square(correction / noise.sigma)[np.isfinite(evaluator.observed)]
    rms_error = float(np.sqrt(squared_errors.mean()))
    # After the end of a shorter run, the correction is NaN and must not change anything.
    if rms_error < MAX_CORRECTABLE_ERROR:
        evaluator.discretisation_correction = np.nan_to_num(correction)
