"""The tuner's contract: a run is a generator that yields proposals and receives evaluations.

A tuner works in the unit cube and never sees units, the simulator or the truth. The harness
(`bench`) owns the loop: it simulates, counts, times and logs; the method reads like its paper.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Evaluation(NamedTuple):
    """What the simulator showed for the proposals of one `yield`.

    Attributes:
        proposals: what was simulated (n, dim): the proposals, moved into the unit cube where they
            lay outside it.
        observations: (n, T, C), SI units.
        losses: (n,), each `Task.loss` of its observation; not finite where the simulation failed.
    """

    proposals: Array
    observations: Array
    losses: Array


class Ask(NamedTuple):
    """Proposals together with what the tuner would deliver now.

    Yield a bare array to have the harness recommend the proposal of the lowest loss seen; yield an
    `Ask` to recommend something else. The recommendation holds until the next `yield`.

    Attributes:
        points: (n, dim) or (dim,) proposals, unit cube.
        recommend: (dim,), unit cube, made from the evaluations received so far; None for the lowest
            loss seen.
    """

    points: Array
    recommend: Array | None = None


Steps = Generator["Array | Ask", Evaluation, "str | None"]
"""A tuner's run. Its return value, if any, is the reason for which it stopped by itself."""


class Scene(NamedTuple):
    """What the experimenter knows of a target's scenario beside its observation.

    Attributes:
        initial: (K,) initial values that no channel begins with, and constants of the run, run by
            run in the order of their names, SI units.
        inputs: (T, U) input signals in the order of their names, SI units; the runs follow one
            another along T.
    """

    initial: Array
    inputs: Array


NOTHING = Scene(np.empty(0), np.empty((0, 0)))
"""Nothing is known, or nothing worth telling."""


@dataclass(frozen=True)
class Task:
    """Everything a tuner gets of one target; nothing here leads to its true parameters.

    Attributes:
        dim: number of parameters.
        start: (dim,) where every tuner starts on this target, unit cube.
        observed: (T, C) the target's observation, SI units; NaN where a sample is missing. The runs
            of a recording with several runs follow one another along T.
        scale: (C,) what a residual is divided by: the channel's noise where known, else its typical
            magnitude.
        training: (2, dim) lower and upper corner of the training range, unit cube.
        budget: number of simulations the tuner may use.
        lengths: number of samples of each run; they add up to T.
        scene: what is known of the scenario beside the observation.
    """

    dim: int
    start: Array
    observed: Array
    scale: Array
    training: Array
    budget: int
    lengths: tuple[int, ...]
    scene: Scene = NOTHING

    def residuals(self, observations: Array) -> Array:
        """Scaled differences simulated - observed, (n, T * C); zero where the target's sample is
        missing.
        """
        difference = (observations - self.observed) / self.scale
        return np.where(np.isnan(self.observed), 0.0, difference).reshape(len(observations), -1)


class Practice(Protocol):
    """The simulator as a learned tuner meets it in `fit`: counted, and fenced to the training
    range.

    Attributes:
        dim: number of parameters.
        training: (2, dim) corners of the training range, unit cube.
        scale: (C,) as in `Task`.
        lengths: as in `Task`.
        scene: as in `Task`, of the scenario in which `simulate` was last called; of any before
            that.
        used: simulations made so far.
        budget: simulations allowed.
    """

    dim: int
    training: Array
    scale: Array
    lengths: tuple[int, ...]
    scene: Scene
    used: int
    budget: int

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """(n, dim) parameters drawn uniformly from the training range, unit cube."""
        ...

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Observations (n, T, C) of `points` (n, dim), all in one scenario drawn by `rng` as
        targets' are.

        Raises:
            ValueError: a point outside the training range.
            BudgetExceededError: more simulations than the training budget.
        """
        ...


class Watch(Protocol):
    """Looks on while a learned tuner trains; what is learned is the same without it."""

    @property
    def ground(self) -> Practice:
        """More simulations of the training range, which only measure; the training budget does not
        count them.
        """
        ...

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Told of each pass over the data of one stage of the training: its number from 1, and the
        losses.
        """
        ...


class BudgetExceededError(RuntimeError):
    """A learned tuner asked for more training simulations than it was given."""


class Tuner:
    """Base of all tuners. Subclasses implement `tune`; learned ones also `fit`, `state` and
    `restore`.

    Options are keyword arguments with defaults (a dataclass does well). An instance is used for one
    run after another and must not keep anything from one to the next, except what `fit` learned.

    Attributes:
        name: how the tuner is called in tables; derived from the class name where not given
            (RandomSearch -> random_search).
        requires: importable packages without which this tuner is listed as skipped.
        stochastic: whether `tune` uses its generator; where not, one seed tells all.
        learned: whether `fit` must have been called before `tune`.
        trains_as: another tuner that trains in the same way; its random stream is used, so that a
            comparison of the two compares what they do with the same network.
        known_failures: conformance checks (by function name) that it fails on purpose, with the
            reason.
        watch: looks on during `fit`, where the tuner tells it of its progress.
    """

    name: ClassVar[str] = ""
    requires: ClassVar[tuple[str, ...]] = ()
    stochastic: ClassVar[bool] = True
    learned: ClassVar[bool] = False
    trains_as: ClassVar[str] = ""
    known_failures: ClassVar[Mapping[str, str]] = {}
    watch: Watch | None = None

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # of its own: a subclass of a named tuner is another tuner
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:
        """Yield proposals (n, dim) in the unit cube, receive their `Evaluation`; return a reason to
        stop early.
        """
        raise NotImplementedError(f"{type(self).__name__} does not implement tune")

    def fit(self, simulator: Practice, rng: np.random.Generator, budget: int) -> None:
        """Learn from at most `budget` simulations of the training range."""

    def state(self) -> dict[str, Array]:
        """What `fit` learned, as plain arrays by name."""
        return {}

    def restore(self, state: dict[str, Array]) -> None:
        """Take back what `state` gave.

        Raises:
            ValueError: arrays of other names or shapes than this tuner's.
        """


_PATIENCE = 5.0
"""Seconds in which an optimiser must let go of its thread."""


class _Stopped(BaseException):
    """Raised inside a callback optimiser's thread when the harness ends its run."""


def from_callback(minimise: Callable[[Callable[[Array], float]], str | None]) -> Steps:
    """Turn an optimiser that only takes an objective function into a tuner's generator.

    The optimiser runs in a thread of its own and is never at work at the same time as the harness:
    each call of the objective hands one point over and waits for its loss.

    Args:
        minimise: called with the objective (dim,) -> loss; returns the reason for which it stopped,
            or None. It must let exceptions of the objective through.

    Returns:
        The generator; its return value is the reason.
    """
    to_harness: list[Array] = []
    to_optimiser: list[float] = []
    outcome: list[str | None] = []
    failure: list[BaseException] = []
    # each side waits for the other's semaphore, so that one of the two is at work at any time
    asked = threading.Semaphore(0)
    answered = threading.Semaphore(0)
    closing = False

    def objective(point: Array) -> float:
        if closing:
            raise _Stopped
        to_harness.append(np.array(point, dtype=np.float64))
        asked.release()
        answered.acquire()
        if closing:
            raise _Stopped
        return to_optimiser.pop()

    def work() -> None:
        try:
            answered.acquire()
            if not closing:
                outcome.append(minimise(objective))
        except _Stopped:
            pass
        except BaseException as error:
            # an exception that ends this thread would be lost; the harness files it
            failure.append(error)
        finally:
            # nothing was handed over: that is how the harness learns that it is done
            asked.release()

    # a daemon, since an optimiser that never returns must not keep the process alive
    worker = threading.Thread(target=work, daemon=True, name="callback-optimiser")
    worker.start()
    try:
        answered.release()
        while True:
            asked.acquire()
            if failure:
                raise failure[0]
            if not to_harness:
                return outcome[0] if outcome else None
            evaluation = yield to_harness.pop()[None, :]
            to_optimiser.append(float(evaluation.losses[0]))
            answered.release()
    finally:
        # the optimiser waits for a loss; it gets an exception in its place
        closing = True
        answered.release()
        worker.join(timeout=_PATIENCE)
        if worker.is_alive():
            raise RuntimeError(
                "the optimiser swallowed the exception that ends its run; "
                "its thread cannot be stopped"
            )
