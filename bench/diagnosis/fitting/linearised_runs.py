"""Linearised robot runs: responses to effects and initial states, and discretisation correction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt_step import is_finite_response
from sims.core.simulator import Array
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.robot_simulator import RobotSimulator

MAX_CORRECTABLE_ERROR = 1.0
"""Maximum RMS discretisation error that is corrected, in units of the noise."""


def compute_effect_responses(
    evaluator: RunEvaluator, theta: Array, states: Array, added: Sequence[tuple[str, Array]]
) -> Array:
    """Compute how the runs of a robot change to first order if one effect is added, for K effects.

    Linearised dynamics cost much less than a simulation for each effect. Series effects (joints in
    series) cannot be linearised; they are simulated, and the result is cached. The result has
    single precision, because it is by far the largest array of an explanation and only a
    derivative.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        theta: (P,) parameters, without the added effects.
        states: (R, s) initial states.
        added: K effects with their coefficients.

    Returns:
        Changes of the runs (K, R, T, C); NaN where they are not finite.
    """
    runs, length, channels = evaluator.observed.shape
    responses: Array = np.full((len(added), runs, length, channels), np.nan, dtype=np.float32)
    cached_responses = evaluator.cached_responses
    keys = [(name, c.tobytes()) for name, c in added]
    missing_indices = [i for i, key in enumerate(keys) if key not in cached_responses]
    worker_arguments = [
        (run, theta, states[run], [added[i] for i in missing_indices]) for run in range(runs)
    ]
    for run, (values, simulation_count) in evaluator.worker_pool.map_unordered(
        evaluator, _compute_responses, worker_arguments
    ):
        # Values that overflow single precision become infinite here.
        with np.errstate(over="ignore"):
            responses[missing_indices, run, : values.shape[1]] = values
        evaluator.simulation_count += simulation_count
    responses[~is_finite_response(responses)] = np.nan
    for i, key in enumerate(keys):
        if key in cached_responses:
            responses[i] = cached_responses[key]
        elif is_series_effect(evaluator.available_effects[key[0]]):
            # Responses without a linearisation are simulated, and are similar in all models near
            # the data.
            cached_responses[key] = responses[i].copy()
    return responses


def _compute_responses(
    evaluator: RunEvaluator,
    run: int,
    theta: Array,
    states: Array,
    added: Sequence[tuple[str, Array]],
) -> tuple[Array, int]:
    """Compute how one run changes by each of K added effects (K, T, C); runs in a worker.

    Also return the number of simulations that were needed, since not all effects have a
    linearisation.

    Shapes: T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: run evaluator of all runs.
        run: index of the run.
        theta: (P,) parameters of the model without the added effects.
        states: (s,) initial state of the run.
        added: name and coefficients of each added effect.
    """
    linearisation = _get_linearisation(evaluator, run, theta, states)
    return linearisation.compute_effect_responses(
        [(evaluator.available_effects[name], c) for name, c in added]
    )


def compute_state_jacobian(
    evaluator: RunEvaluator, theta: Array, states: Array, is_recomputed: bool = False
) -> Array:
    """Return derivatives (R, T, C, s) of the runs by their initial states.

    They are those about the first requested model, or about this one if `is_recomputed` is set.
    Initial states act similarly in all models near the data, and a fit with derivatives of another
    such model converges to the same result.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs of a robot.
        theta: (P,) parameters.
        states: (R, s) initial states.
        is_recomputed: whether to recompute the derivatives about this model and store them.
    """
    if evaluator.state_derivatives is None or is_recomputed:
        evaluator.state_derivatives = compute_initial_state_derivatives(evaluator, theta, states)
    return evaluator.state_derivatives


def compute_initial_state_derivatives(
    evaluator: RunEvaluator, theta: Array, states: Array
) -> Array:
    """Compute the derivatives (R, T, C, s) of the runs by their initial states about one model.

    Each run is linearised in a worker. Derivatives that are not finite are set to zero.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs of a robot.
        theta: (P,) parameters of the model.
        states: (R, s) initial states of the model.
    """
    runs, length, channels = evaluator.observed.shape
    result = np.zeros((runs, length, channels, len(evaluator.state_names)))
    calls = [(run, theta, states[run]) for run in range(runs)]
    for run, values in evaluator.worker_pool.map_unordered(
        evaluator, _compute_initial_state_derivatives, calls
    ):
        result[run, : values.shape[1]] = np.moveaxis(values, 0, -1)
    result[~is_finite_response(result)] = 0.0
    return result


def _compute_initial_state_derivatives(
    evaluator: RunEvaluator, run: int, theta: Array, states: Array
) -> Array:
    """Compute the derivatives (s, T, C) of one run by its initial states; runs in a worker.

    Shapes: T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        run: index of the run.
        theta: (P,) parameters.
        states: (s,) initial state about which the run is linearised.
    """
    return _get_linearisation(evaluator, run, theta, states).compute_initial_state_responses()


def _get_linearisation(
    evaluator: RunEvaluator, run: int, theta: Array, states: Array
) -> RunLinearisation:
    """Return the dynamics of a robot linearised along one run, at given parameters.

    The latest linearisations are cached, one for each run, because most are used more than once.

    Shapes: P parameters, s states of a run.

    Args:
        evaluator: run evaluator of all runs.
        run: index of the run.
        theta: (P,) parameters.
        states: (s,) initial state: positions first, then velocities.
    """
    key = run, theta.tobytes(), states.tobytes()
    cache = evaluator.cached_linearisations
    linearisation: RunLinearisation | None = cache.pop(key, None)
    if linearisation is None:
        coordinate_count = len(evaluator.state_names) // 2
        scenario = evaluator.prepared_runs[run].scenario
        linearisation = RunLinearisation(
            evaluator.simulator,
            theta,
            scenario,
            states[:coordinate_count],
            states[coordinate_count:],
        )
    cache[key] = linearisation
    # Drop the linearisations that were not used for the longest time.
    for oldest_key in list(cache)[: -len(evaluator.prepared_runs)]:
        del cache[oldest_key]
    return linearisation


def correct_discretisation(
    evaluator: RunEvaluator, noise: NoiseModel, theta: Array, states: Array
) -> None:
    """Correct all later simulations for the discretisation error at a model near the data.

    An error below `MAX_CORRECTABLE_ERROR` is not reported as a cause, but an effect could imitate
    it: for example dry friction that stops within a step and not at its end, or a servo that is
    nearly too fast for the step. With the motion q(h) at step size h, the discretisation error is

        2 q(h / 4) - q(h / 2) - q(h)                                                           (1)

    to first order in h (L. F. Richardson, 1911, doi:10.1098/rsta.1911.0009), and approximately for
    any higher order.

    Shapes: R runs, P parameters.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        noise: noise of each channel.
        theta: (P,) parameters of a model near the data.
        states: (R, s) initial states of the model.
    """
    if not evaluator.has_linearisation:
        return
    assert issubclass(evaluator.kind, RobotSimulator)
    effects = [*evaluator.library, *evaluator.extra_effects]
    run_count = len(evaluator.prepared_runs)
    scenarios = [run_data.scenario for run_data in evaluator.prepared_runs]
    thetas = np.tile(theta, (run_count, 1))
    initial_states = dict(zip(evaluator.state_names, states.T, strict=True))
    half_step_kind = evaluator.kind.with_half_step()
    # Motions with the usual step, half of it and a quarter of it.
    simulated = [evaluator.simulator.simulate_batch(thetas, scenarios, initial_states)]
    for kind in (half_step_kind, half_step_kind.with_half_step()):
        finer = kind(evaluator.recording.constants, evaluator.channels, effects=effects)
        simulated.append(finer.simulate_batch(thetas, scenarios, initial_states))
    # In units of a run with the usual step: 1 + 2 with half of the step + 4 with a quarter.
    evaluator.simulation_count += 7 * run_count
    correction = 2.0 * simulated[2] - simulated[1] - simulated[0]  # (1)
    squared_errors = np.square(correction / noise.sigma)[np.isfinite(evaluator.observed)]
    # A large error cannot be removed by this correction.
    if float(np.sqrt(squared_errors.mean())) < MAX_CORRECTABLE_ERROR:
        evaluator.discretisation_correction = np.nan_to_num(correction)
