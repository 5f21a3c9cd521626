"""Build the result rows of a run in the parent process: errors by simulation, and its status."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.benchmark.problem.fisher_information import InformationSpectrum
from bench.benchmark.problem.targets import Target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_in_worker import RunOutcome, RunRequest
from bench.benchmark.storage.run_status import RunStatus


def make_status(problem: TuningProblem, request: RunRequest, outcome: RunOutcome) -> RunStatus:
    """Make the status row of a run.

    Args:
        problem: tuning problem.
        request: tuner, target and seed of the run.
        outcome: how the run ended.
    """
    trace = outcome.trace
    return RunStatus(
        run=request.run,
        tuner=request.entry.label,
        simulator=problem.experiment.simulator,
        target=request.target.name,
        seed=request.seed,
        status=trace.status,
        reason=trace.reason,
        simulations=len(trace.losses),
        seconds=outcome.seconds,
        trusted=problem.experiment.trusted,
    )


def build_rows(
    problem: TuningProblem,
    request: RunRequest,
    target: Target,
    outcome: RunOutcome,
    spectrum: InformationSpectrum | None = None,
) -> dict[str, Any]:
    """Build the columns of runs.parquet for one run, with a row for each k = 0..simulations.

    Row k describes the run after k simulations: its loss, the errors of the point that the tuner
    then recommends, and the seconds in tuner and simulator. The errors are those of the parameters,
    against the true ones, and RMS errors of the channels on fitting and held-out runs. What does
    not exist, such as the loss in row 0, is NaN.

    Args:
        problem: tuning problem.
        request: request of the run.
        target: target with its true parameters.
        outcome: outcome of the run.
        spectrum: Fisher-information spectrum of the target; if given, parameter errors along stiff
            and along sloppy directions are added. These are the directions of the parameter space
            that the data determine well and badly.

    Returns:
        Values by column name, each column with one value per row.
    """
    trace = outcome.trace
    simulations = len(trace.losses)
    columns: dict[str, Any] = {
        "run": [request.run] * (simulations + 1),
        "experiment": [problem.experiment.name] * (simulations + 1),
        "tuner": [request.entry.label] * (simulations + 1),
        "simulator": [problem.experiment.simulator] * (simulations + 1),
        "target": [target.blinded.name] * (simulations + 1),
        "seed": [request.seed] * (simulations + 1),
        "range": [target.blinded.range] * (simulations + 1),
        "trusted": [problem.experiment.trusted] * (simulations + 1),
        "k": np.arange(simulations + 1),
        "loss": _prepend_nan(trace.losses),
    }
    columns |= _build_parameter_columns(problem, target, outcome)
    if spectrum is not None and target.truth is not None:
        # Directions combine parameters, which therefore need a common unit: training widths.
        parameter_errors = problem.cube.to_physical(trace.recommendations) - target.truth
        errors_in_widths = parameter_errors / problem.cube.compute_training_widths()
        columns["stiff_error"], columns["sloppy_error"] = spectrum.compute_directional_errors(
            errors_in_widths
        )
    # The main error is that of one channel, which the experiment selects.
    columns["obs_error"] = outcome.obs_rmse[:, problem.error_channel]
    # All runs of a comparison have the same columns, so that their rows form one table.
    unknown_errors = np.full((simulations + 1, len(problem.channels)), np.nan)
    heldout = unknown_errors if outcome.heldout_rmse is None else outcome.heldout_rmse
    columns["heldout_error"] = heldout[:, problem.error_channel]
    for channel_index, channel in enumerate(problem.channels):
        columns[f"obs_error_{channel.name}"] = outcome.obs_rmse[:, channel_index]
        # Without noise the error cannot be measured in units of the noise.
        noise = problem.noise[channel_index] if problem.noise[channel_index] > 0 else np.nan
        columns[f"obs_error_{channel.name}_in_noise"] = outcome.obs_rmse[:, channel_index] / noise
        columns[f"heldout_error_{channel.name}"] = heldout[:, channel_index]
    columns["tuner_seconds"] = _prepend_nan(trace.tuner_seconds)
    columns["simulator_seconds"] = _prepend_nan(trace.simulator_seconds)
    return columns


def _build_parameter_columns(
    problem: TuningProblem, target: Target, outcome: RunOutcome
) -> dict[str, Any]:
    """Build columns of parameter errors, proposals, recommendations and true parameters.

    `param_error` is the mean error of the parameters in units of their training widths; with one
    parameter, `param_abs_error` is its error in its own unit. `outside` is the distance of the true
    parameters from the training range.

    Args:
        problem: tuning problem of the experiment.
        target: target with its true parameters.
        outcome: outcome of the run with k simulations.

    Returns:
        Columns of k + 1 values by name; row 0 is the start, which has no proposal.
    """
    cube = problem.cube
    recommended = cube.to_physical(outcome.trace.recommendations)
    proposed = cube.to_physical(outcome.trace.proposals)
    # A recording has no known true parameters, so its parameter errors are NaN.
    truth = np.full(cube.dim, np.nan) if target.truth is None else target.truth
    errors = np.abs(recommended - truth)
    columns: dict[str, Any] = {
        "param_error": (errors / cube.compute_training_widths()).mean(axis=1)
    }
    if cube.dim == 1:
        columns["param_abs_error"] = errors[:, 0]
    columns["outside"] = np.full(
        len(errors),
        np.nan if target.truth is None else cube.compute_distance_from_training(target.truth),
    )
    for parameter_index, parameter in enumerate(cube.parameters):
        columns[f"proposal_{parameter.name}"] = _prepend_nan(proposed[:, parameter_index])
        columns[f"recommendation_{parameter.name}"] = recommended[:, parameter_index]
        columns[f"true_{parameter.name}"] = np.full(len(errors), truth[parameter_index])
    return columns


def _prepend_nan(values: Any) -> Any:
    """Prepend NaN, for k = 0 before any simulation, to the values of simulations 1..k."""
    return np.concatenate([[np.nan], values])
