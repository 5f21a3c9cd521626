"""Analytic tuning tasks: functions from parameters to an observation, with known true
parameters.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.benchmark.runner.tuner_loop import Evaluate, RunTrace, drive_tuner
from methods.tuner import Array, Task, Tuner

Observe = Callable[[Array], Array]
TRUE_PARAMETERS = np.array([0.37, 0.62, 0.45, 0.71, 0.28])
START = np.array([0.6, 0.3, 0.7, 0.4, 0.55])


def decays(theta: Array) -> Array:
    """Return decays (30, dim): smooth, nonlinear, coupled; the loss has one global minimum."""
    t = np.linspace(0.0, 1.5, 30)[:, None]
    return np.exp(-(1.0 + 3.0 * theta) * t) + 0.1 * np.sin(2.0 * np.roll(theta, 1) * t)


def logistic(theta: Array) -> Array:
    """Return the logistic map (60, 1) in its chaotic range; only its first samples respond
    smoothly.
    """
    x, out = 0.4, []
    for _ in range(60):
        x = (3.7 + 0.3 * theta[0]) * x * (1.0 - x)
        out.append(x)
    return np.array(out)[:, None]


def problem(
    observe: Observe,
    true_parameters: Array,
    start: Array,
    budget: int,
    observed: Array | None = None,
) -> tuple[Task, Evaluate]:
    """Return a task with target `observe(truth)` or `observed`, and its simulator; arrays are
    read-only.
    """
    target = observe(true_parameters) if observed is None else observed
    dim = len(true_parameters)
    scale, training = np.ones(target.shape[1]), np.stack([np.zeros(dim), np.ones(dim)])
    arrays = [np.array(a, dtype=np.float64) for a in (start, target, scale, training)]
    for array in arrays:
        array.setflags(write=False)
    task = Task(dim, *arrays, budget, (len(target),))

    def evaluate(points: Array) -> tuple[Array, Array]:
        observations = np.stack([observe(point) for point in points])
        return observations, np.sqrt((task.residuals(observations) ** 2).mean(axis=1))

    return task, evaluate


def smooth(dim: int, budget: int) -> tuple[Task, Evaluate]:
    """Return the smooth problem with `dim` parameters."""
    return problem(decays, TRUE_PARAMETERS[:dim], START[:dim], budget)


def errors(
    tuner: Tuner, observe: Observe, true_parameters: Array, start: Array, budget: int, seed: int = 0
) -> Array:
    """Return the largest error of the recommendation after each simulation, (budget + 1,); after an
    early end the last error is repeated.
    """
    task, evaluate = problem(observe, true_parameters, start, budget)
    found = np.abs(run(tuner, task, evaluate, seed).recommendations - true_parameters).max(axis=1)
    return np.append(found, np.full(budget + 1 - len(found), found[-1]))


def run(tuner: Tuner, task: Task, evaluate: Evaluate, seed: int = 0) -> RunTrace:
    """Run the tuner, and assert that the run did not fail."""
    trace = drive_tuner(tuner, task, evaluate, np.random.default_rng(seed))
    assert trace.status in {"done", "converged"}, trace.reason
    return trace
