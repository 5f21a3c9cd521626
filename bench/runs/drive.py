"""The loop around one tuner on one target: exact budget, statuses, recommendations.

Nothing in here knows the truth. The loop gets a sealed task and a function that simulates; scoring
against the truth happens later, in another process (`bench.runs.runner`).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np

from bench.sealing.asked import as_points
from bench.sealing.ended import EndedError, KilledError
from methods.base import Array, Ask, Evaluation, Task

Evaluate = Callable[[Array], "tuple[Array, Array]"]
"""Unit-cube points (n, dim) -> observations (n, T, C), losses (n,)."""


class Steps(Protocol):
    """A tuner's run as `methods.base.Steps`, here or in another process."""

    def __next__(self) -> Array | Ask: ...

    def send(self, evaluation: Evaluation, /) -> Array | Ask:
        """Hand an evaluation over; what the tuner asks for next."""
        ...

    def close(self) -> None:
        """End the run."""
        ...


class Tunes(Protocol):
    """What begins a run: a `methods.base.Tuner`, or one in another process."""

    def tune(self, task: Task, rng: np.random.Generator, /) -> Steps:
        """A run on this target."""
        ...


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
            batch; of the last one also what came after it.
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
    points = as_points(asked, dim, what)
    # Almost always inside, so what is dear is asked only otherwise.
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


class _Record:
    """What a run has done so far."""

    def __init__(self, task: Task) -> None:
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
        """Whether something was simulated and nothing of it has a finite loss."""
        return self.used > 0 and self._best_loss == np.inf

    def recommend(self, recommendation: Array) -> None:
        """Take what the tuner would deliver now, after all that it has seen."""
        self._recommended[-1] = _points(recommendation, self._dim, "recommendations")[0]

    def add(self, points: Array, losses: Array, stays: bool) -> None:
        """Add simulated points (n, dim) and their losses (n,).

        Args:
            points: as the tuner gets them back.
            losses: likewise.
            stays: whether the tuner's last recommendation holds until it gives another; else the
                best point so far is recommended.
        """
        # The tuner gets these very arrays: sorting them would spoil the record.
        points.setflags(write=False)
        losses.setflags(write=False)
        self.used += len(points)
        self._proposals.append(points)
        self._losses.append(losses)
        for i, loss in enumerate(losses.tolist()):
            if loss < self._best_loss:
                self._best_loss, self._best = loss, points[i]
            self._recommended.append(self._recommended[-1] if stays else self._best)

    def time(self, points: int, tuner: float, simulator: float) -> None:
        """Add the seconds that so many points took."""
        self._tuner_seconds.append((points, tuner))
        self._simulator_seconds.append((points, simulator))

    def late(self, tuner: float) -> None:
        """Add the seconds that came after the last simulation to those of its batch."""
        if self._tuner_seconds:
            points, seconds = self._tuner_seconds[-1]
            self._tuner_seconds[-1] = points, seconds + tuner

    def trace(self, status: str, reason: str) -> Trace:
        """The whole run, now that it has ended."""
        return Trace(
            status,
            reason,
            np.concatenate(self._proposals) if self._proposals else np.empty((0, self._dim)),
            np.concatenate(self._losses) if self._losses else np.empty(0),
            np.stack(self._recommended),
            _shared_out(self._tuner_seconds),
            _shared_out(self._simulator_seconds),
        )


def drive(
    tuner: Tunes,
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
        The trace; failures are a status there.

    Raises:
        KilledError: the tuner's process was killed from outside, which is no failure of its own.
    """
    record = _Record(task)
    started = perf_counter()
    steps = None
    try:
        steps = tuner.tune(task, rng)
        status, reason = _exchange(steps, task, evaluate, record, started + seconds)
    except StopIteration as stop:
        status, reason = "converged", str(stop.value or "the tuner stopped")
    except _DivergenceError as error:
        status, reason = "diverged", str(error)
    except EndedError as ended:
        status, reason = ended.status, ended.reason
    except KilledError:
        # Nothing that the run did: it is made again.
        raise
    except Exception:
        status, reason = "crashed", traceback.format_exc()
    finally:
        # Also where a person interrupts: what the tuner holds open is its own to close.
        fault = _closed(steps)
    if status == "timeout":
        reason = f"stopped after {perf_counter() - started:.1f} s, limit {seconds:g} s"
    elif fault:
        status, reason = "crashed", fault
    elif status in ("done", "converged") and record.diverged:
        says = f"none of {record.used} simulations has a finite loss"
        status, reason = "diverged", f"{says} ({reason or 'budget used'})"
    return record.trace(status, reason)


def _exchange(
    steps: Steps, task: Task, evaluate: Evaluate, record: _Record, deadline: float
) -> tuple[str, str]:
    """Simulate what the tuner asks for, until the budget or the time is used: status and reason.

    Raises:
        StopIteration: the tuner stopped; its value says why.
        _DivergenceError: it gave something that is not finite.
        Exception: it failed, or the simulator did.
    """
    before = perf_counter()
    asked = next(steps)
    while True:
        recommendation = None
        if type(asked) is Ask:
            asked, recommendation = asked
            if recommendation is not None:
                record.recommend(recommendation)
        points = _points(asked, task.dim, "proposals")
        # Only now: what the tuner recommends after its last simulation counts.
        left = task.budget - record.used
        if left <= 0:
            # And so does the time that it took to.
            record.late(perf_counter() - before)
            return "done", ""
        cut = len(points) > left
        if cut:
            points = points[:left]
        now = perf_counter()
        observations, losses = evaluate(points)
        after = perf_counter()
        record.time(len(points), now - before, after - now)
        record.add(points, losses, stays=recommendation is not None)
        if after > deadline:
            return "timeout", ""
        # A batch is handed back whole or not at all.
        if cut:
            return "done", ""
        before = perf_counter()
        asked = steps.send(Evaluation(points, observations, losses))


def _closed(steps: Steps | None) -> str:
    """Close a tuner's generator; returns the traceback of what that raised, or nothing."""
    # What is no generator has failed already, with a message of its own.
    if steps is None or not hasattr(steps, "close"):
        return ""
    try:
        steps.close()
    except EndedError as ended:
        return ended.reason or "the tuner did not close what it holds"
    except KilledError:
        raise
    except Exception:
        return traceback.format_exc()
    return ""


def _shared_out(batches: list[tuple[int, float]]) -> Array:
    """Seconds of each simulation from (size, seconds) of each batch."""
    sizes = np.array([n for n, _ in batches], dtype=np.int64)
    seconds = np.array([s for _, s in batches], dtype=np.float64)
    return np.repeat(seconds / np.maximum(sizes, 1), sizes)
