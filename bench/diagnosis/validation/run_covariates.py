"""Run covariates: quantities that differ between runs and may explain a parameter trend.

They are the amplitude, speed, direction and position of the motion, the size of each input, the
order of the runs, and the extra columns of the recording, such as a temperature.

A parameter of a joint is compared with the motion of that joint, any other parameter with the
primary coordinate of the system. The motion is taken from the fitted model because it has no noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.model_set import FittedModel
from sims.core.simulator import Array

CovariateKind = Literal[
    "load", "supply", "amplitude", "speed", "direction", "position", "command", "time", "other"
]

LOAD_UNITS = ("kg", "kg*m^2", "N", "N*m")
"""Units by which a constant is recognised as a load."""
MIN_RELATIVE_VARIATION = 1e-3
"""Minimum variation of a covariate between runs, as a fraction of its largest magnitude."""


class RunCovariate(NamedTuple):
    """Quantity that differs between runs.

    Attributes:
        kind: Category of the quantity.
        name: Quantity in words; for an extra column its name.
        values: (R,) value of each run, in any unit.
    """

    kind: CovariateKind
    name: str
    values: Array


def compute_run_covariates(
    evaluator: RunEvaluator, model: FittedModel, number: str
) -> list[RunCovariate]:
    """List the quantities that differ between the runs and may explain a trend of a parameter.

    Args:
        evaluator: Run evaluator with the runs.
        model: Fitted model whose simulated motion is used.
        number: Name of the parameter, ``parameter`` or ``parameter@joint``.
    """
    covariates = [
        *_list_non_motion_covariates(evaluator),
        *_compute_motion_covariates(evaluator, model, number),
    ]
    return [covariate for covariate in covariates if _varies_between_runs(covariate.values)]


def classify_constant(evaluator: RunEvaluator, name: str) -> CovariateKind:
    """Return the category of a constant that differs between runs, from its unit.

    Args:
        evaluator: Run evaluator; its simulator declares the constants.
        name: Name of the constant.
    """
    units = {constant.name: constant.unit for constant in evaluator.kind.constants}
    unit = units.get(name, "")
    if unit in LOAD_UNITS:
        return "load"
    return "supply" if unit == "V" else "other"


def _list_non_motion_covariates(evaluator: RunEvaluator) -> Iterator[RunCovariate]:
    """Yield the covariates of each run that do not depend on its motion.

    They are the order of the runs, the root mean square of each command, and the mean of each
    recorded signal that the simulator does not use, such as a temperature.
    """
    yield RunCovariate(
        "time", "the order of runs", np.arange(len(evaluator.runs), dtype=np.float64)
    )
    for name in evaluator.runs[0].inputs:
        sizes = [float(np.sqrt(np.mean(np.square(run.inputs[name])))) for run in evaluator.runs]
        yield RunCovariate("command", f"the size of {name}", np.array(sizes))
    for name in evaluator.runs[0].extra:
        columns = [run.extra.get(name, np.empty(0)) for run in evaluator.runs]
        means = [float(np.nanmean(v)) if np.isfinite(v).any() else np.nan for v in columns]
        yield RunCovariate("other", name, np.array(means))


def _compute_motion_covariates(
    evaluator: RunEvaluator, model: FittedModel, number: str
) -> Iterator[RunCovariate]:
    """Yield covariates of the simulated motion of each run, at the joint of a parameter.

    They are the amplitude (standard deviation), the RMS speed, the direction of motion (-1 to 1),
    and the mean position.
    """
    system = evaluator.simulator.system
    if not system.coordinates:
        return
    joint = f"q.{number.partition('@')[2]}"
    name = joint if joint in system.coordinates else system.coordinates[system.primary]
    if name not in evaluator.channels:
        return
    column = evaluator.channels.index(name)
    rows = []
    for track, simulated in zip(evaluator.prepared_runs, model.fit.simulated, strict=True):
        times = track.scenario.times
        place = simulated[: times.size, column]
        rate = np.gradient(place, times)
        mean_direction = float(rate.sum() / max(np.abs(rate).sum(), 1e-300))
        rows.append(
            (float(place.std()), float(np.sqrt(np.mean(rate**2))), mean_direction, place.mean())
        )
    amplitude, speed, direction, position = np.array(rows).T
    yield RunCovariate("amplitude", "the amplitude", amplitude)
    yield RunCovariate("speed", "the speed", speed)
    yield RunCovariate("direction", "the direction of motion", direction)
    yield RunCovariate("position", "the position", position)


def _varies_between_runs(values: Array) -> bool:
    return bool(
        np.isfinite(values).all() and np.ptp(values) > MIN_RELATIVE_VARIATION * np.abs(values).max()
    )
