"""Scores a run against the truth, in the parent process, and lays it out as rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.problem.identifiability import Spectrum
from bench.problem.problem import Problem
from bench.problem.targets import Target
from bench.runs.drive import Trace
from bench.runs.worker import Order, Outcome
from bench.store.status import Status


def unfinished(problem: Problem, target: Target, status: str, reason: str) -> Outcome:
    """The outcome of a run of which nothing but its end is known: it stands where it started, with
    no simulation.
    """
    nothing, start = np.empty(0), target.sealed.start[None]
    trace = Trace(status, reason, start[:0], nothing, start, nothing, nothing)
    return Outcome(trace, np.full((1, len(problem.channels)), np.nan), None, 0.0)


def status_of(problem: Problem, order: Order, outcome: Outcome) -> Status:
    """The status row of a run."""
    trace = outcome.trace
    return Status(
        run=order.run,
        tuner=order.entry.label,
        simulator=problem.experiment.simulator,
        target=order.target.name,
        seed=order.seed,
        status=trace.status,
        reason=trace.reason,
        simulations=len(trace.losses),
        seconds=outcome.seconds,
        trusted=problem.experiment.trusted,
    )


def rows(
    problem: Problem,
    order: Order,
    target: Target,
    outcome: Outcome,
    spectrum: Spectrum | None = None,
) -> dict[str, Any]:
    """Columns of runs.parquet for one run, one entry for each k = 0..simulations.

    With a spectrum the parameters' error is there along stiff and along sloppy directions too.
    """
    trace = outcome.trace
    k = len(trace.losses)
    columns: dict[str, Any] = {
        "run": [order.run] * (k + 1),
        "experiment": [problem.experiment.name] * (k + 1),
        "tuner": [order.entry.label] * (k + 1),
        "simulator": [problem.experiment.simulator] * (k + 1),
        "target": [target.sealed.name] * (k + 1),
        "seed": [order.seed] * (k + 1),
        "range": [target.sealed.range] * (k + 1),
        "trusted": [problem.experiment.trusted] * (k + 1),
        "k": np.arange(k + 1),
        "loss": _after_start(trace.losses),
    }
    columns |= _parameter_columns(problem, target, outcome)
    if spectrum is not None and target.truth is not None:
        # Directions mix parameters, so these must have one unit: training widths.
        away = problem.cube.physical(trace.recommendations) - target.truth
        widths = away / problem.cube.training_widths()
        columns["stiff_error"], columns["sloppy_error"] = spectrum.errors(widths)
    columns["obs_error"] = outcome.obs_rmse[:, problem.error_channel]
    # Every run of a comparison has the same columns, so that its rows fit into one table.
    nothing = np.full((k + 1, len(problem.channels)), np.nan)
    heldout = nothing if outcome.heldout_rmse is None else outcome.heldout_rmse
    columns["heldout_error"] = heldout[:, problem.error_channel]
    for i, channel in enumerate(problem.channels):
        columns[f"obs_error_{channel.name}"] = outcome.obs_rmse[:, i]
        # Without noise there is no such unit.
        noise = problem.noise[i] if problem.noise[i] > 0 else np.nan
        columns[f"obs_error_{channel.name}_in_noise"] = outcome.obs_rmse[:, i] / noise
        columns[f"heldout_error_{channel.name}"] = heldout[:, i]
    columns["tuner_seconds"] = _after_start(trace.tuner_seconds)
    columns["simulator_seconds"] = _after_start(trace.simulator_seconds)
    return columns


def _parameter_columns(problem: Problem, target: Target, outcome: Outcome) -> dict[str, Any]:
    """Parameter errors, proposals, recommendations and the truth, one column a parameter."""
    cube = problem.cube
    recommended = cube.physical(outcome.trace.recommendations)
    proposed = cube.physical(outcome.trace.proposals)
    # A recording has no known truth: its errors of parameters are NaN throughout.
    truth = np.full(cube.dim, np.nan) if target.truth is None else target.truth
    errors = np.abs(recommended - truth)
    columns: dict[str, Any] = {"param_error": (errors / cube.training_widths()).mean(axis=1)}
    if cube.dim == 1:
        columns["param_abs_error"] = errors[:, 0]
    columns["outside"] = np.full(
        len(errors), np.nan if target.truth is None else problem.outside(target.truth)
    )
    for i, parameter in enumerate(cube.parameters):
        columns[f"proposal_{parameter.name}"] = _after_start(proposed[:, i])
        columns[f"recommendation_{parameter.name}"] = recommended[:, i]
        columns[f"true_{parameter.name}"] = np.full(len(errors), truth[i])
    return columns


def _after_start(values: Any) -> Any:
    """`values` of simulations 1..k behind a NaN for k = 0, before any simulation."""
    return np.concatenate([[np.nan], values])
