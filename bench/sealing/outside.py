"""The harness's side of the pipe: a tuner that lives beyond it, and its runs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.sealing.children import PATIENCE, Child
from bench.sealing.pace import Pace
from bench.sealing.wire import ASKED_LIMIT, TEXT_LIMIT, FoulError, packed
from methods.base import Array, Ask, Evaluation, Task

_FAREWELL = 10.0
"""Seconds in which a tuner must have closed what it holds; no more than its run may take."""


@dataclass(frozen=True)
class Tuned:
    """Which tuner is to be built.

    Attributes:
        name: registered.
        module: that it is in, where it is installed.
        file: the plugin file that it is in; empty where it is installed.
        options: of its entry.
        modules: packages that it needs, to be loaded ahead.
    """

    name: str
    module: str
    file: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()


def moved(tuned: Tuned, places: Mapping[Path, Path]) -> Tuned:
    """The tuner where its file has another place."""
    return replace(tuned, file=str(places[Path(tuned.file)])) if tuned.file else tuned


class SealedTuner:
    """A tuner that has been built in its process.

    Args:
        child: started for it.
        tuned: which one.
        state: what it learned, where it learns.

    Attributes:
        import_seconds: that building it took, almost all of it for imports of its file.

    Raises:
        EndedError: it cannot be built; the process has been ended, or is to be.
    """

    def __init__(
        self,
        child: Child,
        tuned: Tuned,
        state: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        self.child = child
        child.ready()
        started = perf_counter()
        deadline = started + PATIENCE
        wanted = {
            "name": tuned.name,
            "module": tuned.module,
            "file": tuned.file,
            "options": dict(tuned.options),
        }
        child.send(b"B", json.dumps(wanted).encode(), deadline=deadline)
        child.receive(deadline=deadline)
        self.import_seconds = perf_counter() - started
        if state is not None:
            child.send(b"L", *packed(state), deadline=deadline)
            child.receive(deadline=deadline)


@dataclass(frozen=True)
class Sealed:
    """A sealed tuner about to make one run; `tune` as of a tuner here.

    Attributes:
        tuner: in its process.
        stream: the seed of the run's random stream.
        seconds: after which it is ended.
    """

    tuner: SealedTuner
    stream: NDArray[np.uint32]
    seconds: float

    def tune(self, task: Task, _: np.random.Generator) -> SealedSteps:
        """Begin the run; its random numbers are drawn on the other side."""
        return SealedSteps(self.tuner.child, task, self.stream, self.seconds)


class SealedSteps:
    """A tuner's run beyond the pipe: `next`, `send` and `close` as of a generator of
    `methods.base.Steps`.
    """

    def __init__(
        self, child: Child, task: Task, stream: NDArray[np.uint32], seconds: float
    ) -> None:
        self._child, self._task, self._stream = child, task, stream
        self._deadline = perf_counter() + seconds
        self._farewell = min(seconds, _FAREWELL)
        self._pace = Pace()
        self._waits = False
        self._limit = min(ASKED_LIMIT, 8 * task.dim * (task.budget + 2))

    def __next__(self) -> Array | Ask:
        task = self._task
        parts = packed(
            {
                "start": task.start,
                "observed": task.observed,
                "scale": task.scale,
                "training": task.training,
                "budget": np.array(min(task.budget, 1 << 62)),
                "lengths": np.array(task.lengths, dtype=np.int64),
                "initial": task.scene.initial,
                "inputs": task.scene.inputs,
                "stream": self._stream.astype(np.int64),
            }
        )
        self._child.send(b"T", *parts, deadline=self._deadline)
        return self._asked()

    def send(self, evaluation: Evaluation) -> Array | Ask:
        """Hand an evaluation over; what is asked for next."""
        flags = self._pace.step()
        # Until it asks again: where this fails, its process has been ended.
        self._waits = False
        self._child.send(
            b"E",
            evaluation.proposals.tobytes(),
            evaluation.losses.tobytes(),
            evaluation.observations.tobytes(),
            flags=flags,
            size=len(evaluation.losses),
            deadline=self._deadline,
        )
        return self._asked()

    def _asked(self) -> Array | Ask:
        message = self._child.receive(max(self._limit, TEXT_LIMIT), self._deadline)
        if message.kind == b"S":
            raise StopIteration(message.text())
        dim, n = self._task.dim, message.size
        try:
            numbers = message.numbers()
        except FoulError as error:
            raise self._child.foul(str(error)) from None
        recommends = message.flags == 1
        if message.kind != b"A" or not n or numbers.size != (n + recommends) * dim:
            raise self._child.foul("it asked for nothing")
        self._waits = True
        if recommends:
            return Ask(numbers[dim:].reshape(n, dim), numbers[:dim])
        return numbers.reshape(n, dim)

    def close(self) -> None:
        """End the run; the process may serve another.

        Raises:
            EndedError: the tuner failed while it was closed.
        """
        self._pace.release()
        if self._waits:
            self._waits = False
            deadline = perf_counter() + self._farewell
            self._child.send(b"C", deadline=deadline)
            self._child.receive(deadline=deadline)
