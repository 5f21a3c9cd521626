"""Linearised robot runs: their responses to effects and to initial states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt_step import is_finite_response
from sims.core.simulator import Array
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.dynamics.series_joints import is_series_effect


def compute_effect_responses(
    evaluator: RunEvaluator, theta: Array, states: Array, added: Sequence[tuple[str, Array]]
) -> Array:
    """Compute how the runs of a robot change to first order if one effect is added, for K effects.

    Linearised dynamics cost much less than a simulation for each effect. Series effects (a further
    joint in series with a joint, such as backlash) cannot be linearised; they are simulated, and
    the result is cached. The result has single precision, because it is by far the largest array of
    an explanation and only a derivative.

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
    keys = [(name, coefficients.tobytes()) for name, coefficients in added]
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
    for i, (name, _) in enumerate(added):
        key = keys[i]
        if key in cached_responses:
            responses[i] = cached_responses[key]
        elif is_series_effect(evaluator.available_effects[name]):
            # Simulated responses cost more, and are similar in all models near the data.
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

    The most recently used linearisations are cached, as many as there are runs, because most are
    used more than once.

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
    # The cache is ordered by the last use. Drop the linearisations unused for the longest time.
    for oldest_key in list(cache)[: -len(evaluator.prepared_runs)]:
        del cache[oldest_key]
    return linearisation
