"""The loop around one tuner on one target: exact budget, statuses, recommendations.

Nothing in here knows the truth. The loop gets a sealed task and a function that simulates; scoring
against the truth happens later, in another process (`bench.runs.runner`).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from methods.base import Ask, Evaluation, Task, Tuner
from sims.base import Array

Evaluate = Callable[[Array], "tuple[Array, Array]"]
"""Unit-cube points (n, dim) -> observations (n, T, C), losses (n,)."""


@dataclass(frozen=True)
class Trace:
    """What one run did.

    Attributes:
        status: done, converged, timeout, crashed or diverged.
        reason: why, in words; the traceback for a crash; empty for done.
        proposals: (k, dim) what was simulated, unit cube.
        losses: (k,).
        recommendations: (k + 1, dim) what the tuner would deliver after 0, 1, ... k simulations.
        tuner_seconds: (k,) time in the tuner before each simulation, shared out evenly over a
            batch.
        simulator_seconds: (k,) time in the simulator.
    """

    status: str
    reason: str
    proposals: Array
    losses: Array
    recommendations: Array
    tuner_seconds: Array
    simulator_seconds: Array


class _DivergenceError(Exception):
    """A tuner proposed or recommended something that is not a finite number."""


def _points(asked: object, dim: int, what: str) -> Array:
    """The proposals as a fresh (n, dim) array inside the unit cube."""
    points = np.array(asked, dtype=np.float64, ndmin=2)
    if points.ndim != 2 or points.shape[1] != dim or not len(points):
        raise ValueError(
            f"the tuner gave {what} of shape {points.shape}; expected (n, {dim}) with n >= 1"
        )
    if not _inside(points):
        if not np.isfinite(points).all():
            first = points[~np.isfinite(points).all(axis=1)][0]
            raise _DivergenceError(f"the tuner gave {what} that are not finite: {first}")
        points.clip(0.0, 1.0, out=points)
    return points


def _inside(points: Array) -> bool:
    """Whether all lies in 0..1; for the few numbers of one point a plain loop is three times
    quicker than numpy.
    """
    if points.size <= 32:
        return all(0.0 <= x <= 1.0 for x in points.ravel().tolist())
    return bool((points >= 0.0).all() and (points <= 1.0).all())


def drive(
    tuner: Tuner,
    task: Task,
    evaluate: Evaluate,
    rng: np.random.Generator,
    seconds: float = float("inf"),
) -> Trace:
    """Run `tuner` on `task` until its budget is used, it stops, or it fails.

    Proposals outside the unit cube are moved to its border; a batch that would overshoot the budget
    is cut. The `recommendations` follow `methods.base.Ask`; k = 0 is the start unless the tuner
    recommends something else before its first simulation.

    Args:
        tuner: fitted where it needs to be.
        task: the sealed target.
        evaluate: the simulator and loss.
        rng: the run's own generator.
        seconds: time limit, checked between evaluations.

    Returns:
        The trace; failures are a status there, never an exception.
    """
    dim, budget = task.dim, task.budget
    proposals: list[Array] = []
    losses: list[Array] = []
    recommended: list[Array] = [task.start]
    tuner_time: list[tuple[int, float]] = []
    simulator_time: list[tuple[int, float]] = []
    best_loss, best = np.inf, task.start
    used = 0
    status, reason = "done", ""
    started = perf_counter()
    steps = None
    try:
        steps = tuner.tune(task, rng)
        before = perf_counter()
        asked = next(steps)
        while True:
            recommendation = None
            if type(asked) is Ask:
                asked, recommendation = asked
                if recommendation is not None:
                    recommended[-1] = _points(recommendation, dim, "recommendations")[0]
            points = _points(asked, dim, "proposals")
            if used >= budget:
                break
            cut = len(points) > budget - used
            if cut:
                points = points[: budget - used]
            n = len(points)
            now = perf_counter()
            observations, loss = evaluate(points)
            after = perf_counter()
            used += n
            tuner_time.append((n, now - before))
            simulator_time.append((n, after - now))
            points.setflags(
                write=False
            )  # the tuner gets these very arrays: sorting them would spoil the record
            loss.setflags(write=False)
            proposals.append(points)
            losses.append(loss)
            for i, value in enumerate(loss.tolist()):
                if value < best_loss:
                    best_loss, best = value, points[i]
                recommended.append(best if recommendation is None else recommended[-1])
            if after - started > seconds:
                status, reason = (
                    "timeout",
                    f"stopped after {after - started:.1f} s, limit {seconds:g} s",
                )
                break
            if cut:
                break
            before = perf_counter()
            asked = steps.send(Evaluation(points, observations, loss))
    except StopIteration as stop:
        status, reason = "converged", str(stop.value or "the tuner stopped")
    except _DivergenceError as error:
        status, reason = "diverged", str(error)
    except Exception:
        status, reason = "crashed", traceback.format_exc()
    finally:
        if steps is not None and hasattr(steps, "close"):
            try:
                steps.close()
            except Exception:
                status, reason = "crashed", traceback.format_exc()
    return Trace(
        status,
        reason,
        np.concatenate(proposals) if proposals else np.empty((0, dim)),
        np.concatenate(losses) if losses else np.empty(0),
        np.stack(recommended),
        _shared_out(tuner_time),
        _shared_out(simulator_time),
    )


def _shared_out(batches: list[tuple[int, float]]) -> Array:
    """Seconds of each simulation from (size, seconds) of each batch."""
    sizes = np.array([n for n, _ in batches], dtype=np.int64)
    seconds = np.array([s for _, s in batches], dtype=np.float64)
    return np.repeat(seconds / np.maximum(sizes, 1), sizes)
