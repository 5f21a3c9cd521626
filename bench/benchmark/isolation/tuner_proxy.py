"""Proxy of a tuner in an isolated process: the tuner and its runs, as the harness uses them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation.message_channel import (
    MAX_PROPOSAL_BYTES,
    MAX_TEXT_BYTES,
    ProtocolError,
    pack_arrays,
)
from bench.benchmark.isolation.process_limits import AffinityController
from bench.benchmark.isolation.tuner_processes import START_TIMEOUT_SECONDS, IsolatedProcess
from methods.tuner import Array, Evaluation, Proposal, Task

_CLOSE_TIMEOUT_SECONDS = 10.0
"""Maximum timeout in seconds for the tuner to close its resources at the end of a run."""


@dataclass(frozen=True)
class TunerSpec:
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


def relocate(tuned: TunerSpec, places: Mapping[Path, Path]) -> TunerSpec:
    """Return a specification with another path of its file.

    Args:
        tuned: specification of a tuner.
        places: new path of each file by its present path.
    """
    return replace(tuned, file=str(places[Path(tuned.file)])) if tuned.file else tuned


class IsolatedTuner:
    """Tuner that has been built in an isolated process.

    Args:
        child: process of the tuner.
        tuned: specification of the tuner.
        state: trained weights of a learned tuner.

    Attributes:
        import_seconds: seconds to build the tuner, nearly all for imports of its file.

    Raises:
        RunEndedError: the tuner cannot be built; the caller ends the process if it still runs.
    """

    def __init__(
        self,
        child: IsolatedProcess,
        tuned: TunerSpec,
        state: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        """Send the specification of the tuner to its process, then the weights if there are any.

        The tuner has been built when the process has answered. Message kinds: B builds, L loads
        weights.
        """
        self.child = child
        child.wait_until_ready()
        started = perf_counter()
        deadline = started + START_TIMEOUT_SECONDS
        description = {
            "name": tuned.name,
            "module": tuned.module,
            "file": tuned.file,
            "options": dict(tuned.options),
        }
        child.send(b"B", json.dumps(description).encode(), deadline=deadline)
        child.receive(deadline=deadline)
        self.import_seconds = perf_counter() - started
        if state is not None:
            child.send(b"L", *pack_arrays(state), deadline=deadline)
            child.receive(deadline=deadline)


@dataclass(frozen=True)
class IsolatedRun:
    """Isolated tuner for one run, with the method `tune` of a tuner.

    Attributes:
        tuner: isolated tuner.
        stream: seed of the run's random generator.
        seconds: time limit of the run.
    """

    tuner: IsolatedTuner
    stream: NDArray[np.uint32]
    seconds: float

    def tune(self, task: Task, _: np.random.Generator) -> IsolatedSteps:
        """Start the run; its random numbers are drawn in the isolated process.

        Args:
            task: task of the target.
            _: not used.
        """
        return IsolatedSteps(self.tuner.child, task, self.stream, self.seconds)


class IsolatedSteps:
    """Run of an isolated tuner, with the methods of the generator `tuner.TunerGenerator`."""

    def __init__(
        self, child: IsolatedProcess, task: Task, stream: NDArray[np.uint32], seconds: float
    ) -> None:
        """Prepare the run; the process gets the task with the first `next`.

        `_deadline` is the end of the whole run, `_farewell` the seconds allowed for closing the
        tuner. `_waits` is True while the process waits for an evaluation. `_limit` is the maximum
        size of a proposal message in bytes: 8 per float64, for all points of the budget and a
        recommendation.
        """
        self._child, self._task, self._stream = child, task, stream
        self._deadline = perf_counter() + seconds
        self._farewell = min(seconds, _CLOSE_TIMEOUT_SECONDS)
        self._affinity_controller = AffinityController()
        self._waits = False
        self._limit = min(MAX_PROPOSAL_BYTES, 8 * task.dim * (task.budget + 2))

    def __next__(self) -> Array | Proposal:
        """Send the task to the process, which starts the tuner, and return the first proposal.

        The budget is limited to 2^62, so that it fits into an int64.
        """
        task = self._task
        packed_arrays = pack_arrays(
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
        self._child.send(b"T", *packed_arrays, deadline=self._deadline)
        return self._receive_answer()

    def send(self, evaluation: Evaluation) -> Array | Proposal:
        """Send an evaluation to the tuner, and return its next proposal.

        It has the losses and observations of the last proposal. The flags tell the process on which
        processor to run, see `AffinityController`.
        """
        flags = self._affinity_controller.record_exchange()
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
        return self._receive_answer()

    def _receive_answer(self) -> Array | Proposal:
        """Receive the tuner's answer: points to simulate (A), or the end of its run (S).

        A message has n points (n, dim), after one recommended point (dim,) if its flags are 1.
        Anything else ends the process, because code of a tuner may send any bytes.

        Raises:
            StopIteration: the tuner has stopped; the value is its reason.
            RunEndedError: the message is not valid, the process failed, or the time limit was
                reached.
        """
        message = self._child.receive(max(self._limit, MAX_TEXT_BYTES), self._deadline)
        if message.kind == b"S":
            raise StopIteration(message.to_text())
        dim, point_count = self._task.dim, message.size
        try:
            coordinates = message.to_array()
        except ProtocolError as error:
            raise self._child.fail_with_protocol_error(str(error)) from None
        recommends = message.flags == 1
        if (
            message.kind != b"A"
            or not point_count
            or coordinates.size != (point_count + recommends) * dim
        ):
            raise self._child.fail_with_protocol_error("it requested no points")
        self._waits = True
        if recommends:
            return Proposal(coordinates[dim:].reshape(point_count, dim), coordinates[:dim])
        return coordinates.reshape(point_count, dim)

    def close(self) -> None:
        """End the run; the process may serve another one.

        Raises:
            RunEndedError: the tuner failed while it was closed.
        """
        self._affinity_controller.release_affinity()
        if self._waits:
            self._waits = False
            deadline = perf_counter() + self._farewell
            self._child.send(b"C", deadline=deadline)
            self._child.receive(deadline=deadline)
