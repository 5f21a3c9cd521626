"""Client for a tuner in an isolated process: the tuner and its runs, as the harness uses them."""

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
"""Maximum timeout in seconds for the tuner to close its resources at the end of a run."""


@dataclass(frozen=True)
class Tuned:
    """Specification of a tuner to be built in an isolated process.

    Attributes:
        name: registered name.
        module: module of an installed tuner.
        file: plugin file of the tuner; empty if it is installed.
        options: options of its entry.
        modules: packages that it needs, to be preloaded.
    """

    name: str
    module: str
    file: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()


def moved(tuned: Tuned, places: Mapping[Path, Path]) -> Tuned:
    """Return a specification with another path of its file.

    Args:
        tuned: specification of a tuner.
        places: new path of each file by its present path.
    """
    return replace(tuned, file=str(places[Path(tuned.file)])) if tuned.file else tuned


class SealedTuner:
    """Tuner that has been built in an isolated process.

    Args:
        child: process of the tuner.
        tuned: specification of the tuner.
        state: trained weights of a learned tuner.

    Attributes:
        import_seconds: seconds to build the tuner, nearly all for imports of its file.

    Raises:
        EndedError: the tuner cannot be built; the caller has to end the process if it still runs.
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
    """Isolated tuner for one run, with the method `tune` of a tuner.

    Attributes:
        tuner: isolated tuner.
        stream: seed of the run's random generator.
        seconds: time limit of the run.
    """

    tuner: SealedTuner
    stream: NDArray[np.uint32]
    seconds: float

    def tune(self, task: Task, _: np.random.Generator) -> SealedSteps:
        """Start the run; its random numbers are drawn in the isolated process.

        Args:
            task: task of the target.
            _: not used.
        """
        return SealedSteps(self.tuner.child, task, self.stream, self.seconds)


class SealedSteps:
    """Run of an isolated tuner, with the methods of the generator `methods.base.Steps`."""

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
        """Send an evaluation, and return the next proposal."""
        flags = self._pace.step()
        # False until the next proposal: if this fails, the process has been ended.
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
        """End the run; the process may serve another one.

        Raises:
            EndedError: the tuner failed while it was closed.
        """
        self._pace.release()
        if self._waits:
            self._waits = False
            deadline = perf_counter() + self._farewell
            self._child.send(b"C", deadline=deadline)
            self._child.receive(deadline=deadline)
