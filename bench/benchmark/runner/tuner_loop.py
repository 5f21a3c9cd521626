"""Run one tuner on one target: exact budget, evaluation of proposals, statuses, recommendations.

This module has no access to the true parameters. The loop gets a task and a function that
simulates. Scoring against the true parameters happens later, in another process
(`bench.benchmark.runner.experiment_runner`).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from bench.benchmark.isolation.message_channel import to_points
from bench.benchmark.isolation.process_errors import KilledExternallyError, RunEndedError
from methods.tuner import Array, Evaluation, Proposal, Task, Tuner, TunerGenerator

if TYPE_CHECKING:
    from bench.benchmark.isolation.tuner_processes import IsolatedRun


Evaluate = Callable[[Array], "tuple[Array, Array]"]
"""Function that simulates points (n, dim) of the unit cube.

It returns observations (n, T, C) and losses (n,).
"""


@dataclass(frozen=True)
class RunTrace:
    """Trace of one run.

    Attributes:
        status: done, converged, timeout, crashed or diverged.
        reason: reason of the status; the traceback for a crash; empty for done.
        proposals: (k, dim) simulated points of the unit cube.
        losses: (k,) losses of the simulated points.
        recommendations: (k + 1, dim) points that the tuner recommends after 0, 1, ... k
            simulations.
        tuner_seconds: (k,) time in the tuner before each simulation, distributed evenly over a
            batch; the last one includes the time after the last simulation.
        simulator_seconds: (k,) time in the simulator.
    """

    status: str
    reason: str
    proposals: Array
    losses: Array
    recommendations: Array
    tuner_seconds: Array
    simulator_seconds: Array

    @classmethod
    def make_unfinished(cls, status: str, reason: str, start: Array) -> RunTrace:
        """Make the trace of a run without simulations; its only recommendation is the start.

        Args:
            status: status of the run.
            reason: reason of the status.
            start: (dim,) start of the run.
        """
        no_values = np.empty(0)
        points = start[None]
        return cls(
            status=status,
            reason=reason,
            proposals=points[:0],  # no points, but with the shape (0, dim)
            losses=no_values,
            recommendations=points,
            tuner_seconds=no_values,
            simulator_seconds=no_values,
        )


class _DivergenceError(Exception):
    """A tuner proposed or recommended a point that is not finite."""


def _check_proposals(proposed: object, dim: int, label: str) -> Array:
    """Return proposals as a new (n, dim) array, clipped to the unit cube.

    Args:
        proposed: Object that the tuner yielded.
        dim: Number of parameters.
        label: What the points are, for messages: "proposals" or "recommendations".

    Raises:
        _DivergenceError: a point is not finite.
    """
    points = to_points(proposed, dim, label)
    # Nearly all points are inside, so the expensive check is done only if some are not. A point
    # with NaN counts as outside, because comparisons with NaN are false.
    if not _is_in_unit_cube(points):
        if not np.isfinite(points).all():
            first = points[~np.isfinite(points).all(axis=1)][0]
            raise _DivergenceError(f"the tuner gave {label} that are not finite: {first}")
        points.clip(0.0, 1.0, out=points)
    return points


def _is_in_unit_cube(points: Array) -> bool:
    """Return whether all points are inside the unit cube.

    For the few numbers of one point a plain loop is three times faster than NumPy.
    """
    if points.size <= 32:
        return all(0.0 <= x <= 1.0 for x in points.ravel().tolist())
    return bool((points >= 0.0).all() and (points <= 1.0).all())


class _RunRecord:
    """Record of a run while it is running."""

    def __init__(self, task: Task) -> None:
        """Begin with no simulation; the start of the task is the recommendation for k = 0.

        `_recommended` has one point (dim,) for each number of simulations k = 0, 1, .... `_best` is
        the point with the lowest loss so far. `_tuner_seconds` and `_simulator_seconds` have one
        pair (number of points, seconds) for each batch of points.
        """
        self.used = 0
        self._dim = task.dim
        self._proposals: list[Array] = []
        self._losses: list[Array] = []
        self._recommended: list[Array] = [task.start]
        self._tuner_seconds: list[tuple[int, float]] = []
        self._simulator_seconds: list[tuple[int, float]] = []
        self._best_loss, self._best = np.inf, task.start

    @property
    def diverged(self) -> bool:
        """True if points were simulated and none of them has a finite loss."""
        return self.used > 0 and self._best_loss == np.inf

    def recommend(self, recommendation: Array) -> None:
        """Record what the tuner recommends after all evaluations so far."""
        # This replaces the default recommendation, which `add` has stored.
        self._recommended[-1] = _check_proposals(recommendation, self._dim, "recommendations")[0]

    def add(self, points: Array, losses: Array, stays: bool) -> None:
        """Add simulated points and their losses.

        Args:
            points: (n, dim) points as the tuner gets them.
            losses: (n,) losses as the tuner gets them.
            stays: True if the tuner's last recommendation stays valid until the next one; otherwise
                the best point so far is recommended.
        """
        # The tuner gets the same arrays; writing to them would change the record.
        points.setflags(write=False)
        losses.setflags(write=False)
        self.used += len(points)
        self._proposals.append(points)
        self._losses.append(losses)
        for i, loss in enumerate(losses.tolist()):
            if loss < self._best_loss:
                self._best_loss, self._best = loss, points[i]
            self._recommended.append(self._recommended[-1] if stays else self._best)

    def add_seconds(self, points: int, tuner: float, simulator: float) -> None:
        """Add the seconds spent on a batch of points.

        Args:
            points: number of points.
            tuner: seconds in the tuner.
            simulator: seconds in the simulator.
        """
        self._tuner_seconds.append((points, tuner))
        self._simulator_seconds.append((points, simulator))

    def add_late_seconds(self, tuner: float) -> None:
        """Add the seconds in the tuner after the last simulation to those of the last batch."""
        if self._tuner_seconds:
            points, seconds = self._tuner_seconds[-1]
            self._tuner_seconds[-1] = points, seconds + tuner

    def make_trace(self, status: str, reason: str) -> RunTrace:
        """Return the trace of the ended run."""
        # Empty arrays come first, because a run without simulations has no batches.
        return RunTrace(
            status=status,
            reason=reason,
            proposals=np.concatenate([np.empty((0, self._dim)), *self._proposals]),
            losses=np.concatenate([np.empty(0), *self._losses]),
            recommendations=np.stack(self._recommended),
            tuner_seconds=_distribute_batch_seconds(self._tuner_seconds),
            simulator_seconds=_distribute_batch_seconds(self._simulator_seconds),
        )


def drive_tuner(
    tuner: Tuner | IsolatedRun,
    task: Task,
    evaluate: Evaluate,
    rng: np.random.Generator,
    seconds: float = float("inf"),
) -> RunTrace:
    """Run a tuner on a task until its budget is used, it stops, or it fails.

    A tuner is a generator that yields proposals and receives their evaluations. Proposals outside
    the unit cube are moved to its boundary. A batch that would exceed the budget is shortened.
    After k simulations the tuner recommends the point that it has stated, or else the simulated
    point with the lowest loss; for k = 0 this is the start. The way in which the loop ends becomes
    the status of the run.

    Args:
        tuner: tuner, trained if it needs training, in this process or in another one.
        task: task of the target, without its true parameters.
        evaluate: function that simulates points and computes their losses.
        rng: random generator of the run.
        seconds: time limit, checked between evaluations.

    Returns:
        The trace; a failure is a status of it.

    Raises:
        KilledExternallyError: the tuner's process was killed externally; the tuner did not fail.
    """
    record = _RunRecord(task)
    started = perf_counter()
    steps = None
    try:
        steps = tuner.tune(task, rng)
        status, reason = _run_ask_tell_loop(steps, task, evaluate, record, started + seconds)
    except StopIteration as stop:
        status, reason = "converged", str(stop.value or "the tuner stopped")
    except _DivergenceError as error:
        status, reason = "diverged", str(error)
    except RunEndedError as ended:
        status, reason = ended.status, ended.reason
    except KilledExternallyError:
        # The run is not the cause, so it is repeated.
        raise
    except Exception:
        status, reason = "crashed", traceback.format_exc()
    finally:
        # After an interrupt, too, the tuner must close its resources.
        close_error = _close_generator(steps)
    if status == "timeout":
        reason = f"stopped after {perf_counter() - started:.1f} s, limit {seconds:g} s"
    elif close_error:
        status, reason = "crashed", close_error
    elif status in ("done", "converged") and record.diverged:
        explanation = f"none of {record.used} simulations has a finite loss"
        status, reason = "diverged", f"{explanation} ({reason or 'budget used'})"
    return record.make_trace(status, reason)


def _run_ask_tell_loop(
    steps: TunerGenerator, task: Task, evaluate: Evaluate, record: _RunRecord, deadline: float
) -> tuple[str, str]:
    """Simulate the tuner's proposals until the budget or the time limit is reached.

    Args:
        steps: the running tuner, which yields points and receives their evaluations.
        task: number of parameters and budget of the run.
        evaluate: simulates points of the unit cube, and returns observations and losses.
        record: record of the run, extended in place.
        deadline: time limit on the clock `perf_counter`, in seconds.

    Returns:
        Status and reason.

    Raises:
        StopIteration: the tuner stopped; the exception's value is its reason.
        _DivergenceError: the tuner proposed or recommended a point that is not finite.
        Exception: the tuner or the simulator failed.
    """
    requested_at = perf_counter()
    proposed = next(steps)
    while True:
        recommendation = None
        if type(proposed) is Proposal:
            proposed, recommendation = proposed
            if recommendation is not None:
                record.recommend(recommendation)
        points = _check_proposals(proposed, task.dim, "proposals")
        # The check comes here, so that the recommendation after the last simulation is recorded.
        remaining = task.budget - record.used
        if remaining <= 0:
            # The time that the tuner needed for this recommendation is recorded, too.
            record.add_late_seconds(perf_counter() - requested_at)
            return "done", ""
        is_cut = len(points) > remaining
        # A batch beyond the budget is cut; the tuner does not get its evaluations.
        if is_cut:
            points = points[:remaining]
        answered_at = perf_counter()
        observations, losses = evaluate(points)
        simulated_at = perf_counter()
        record.add_seconds(len(points), answered_at - requested_at, simulated_at - answered_at)
        record.add(points, losses, stays=recommendation is not None)
        if simulated_at > deadline:
            return "timeout", ""
        if is_cut:
            return "done", ""
        requested_at = perf_counter()
        proposed = steps.send(Evaluation(points, observations, losses))


def _close_generator(steps: TunerGenerator | None) -> str:
    """Close a tuner's generator, and return the traceback of an error in it, or an empty text.

    Args:
        steps: Generator of the tuner's run; None if it never started.
    """
    # An object without `close` is not a generator, and has already failed with its own message.
    if steps is None or not hasattr(steps, "close"):
        return ""
    try:
        steps.close()
    except RunEndedError as ended:
        return ended.reason or "the tuner did not release its resources"
    except KilledExternallyError:
        raise
    except Exception:
        return traceback.format_exc()
    return ""


def _distribute_batch_seconds(batches: list[tuple[int, float]]) -> Array:
    """Distribute (size, seconds) of batches evenly to their simulations."""
    sizes = np.array([n for n, _ in batches], dtype=np.int64)
    seconds = np.array([s for _, s in batches], dtype=np.float64)
    return np.repeat(seconds / np.maximum(sizes, 1), sizes)
