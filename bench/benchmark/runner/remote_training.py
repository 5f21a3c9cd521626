"""Train a tuner that lives in an isolated process; its simulations run here and are counted."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation.message_channel import (
    MAX_STATE_BYTES,
    Message,
    ProtocolError,
    pack_arrays,
    to_printable,
    unpack_arrays,
)
from bench.benchmark.isolation.process_exit import RunEndedError
from bench.benchmark.isolation.rng_transfer import decode_rng_state, encode_rng_state
from bench.benchmark.isolation.tuner_processes import IsolatedProcess
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from methods.tuner import BudgetExceededError, TrainingCallback, TrainingSimulator
from sims.core.simulator import Array

_NO_DEADLINE = float("inf")
"""Deadline of a training, in seconds: none."""


def train_remotely(
    child: IsolatedProcess,
    simulator: CountedTrainingSimulator,
    stream: NDArray[np.uint32],
    watch: TrainingCallback | None,
) -> dict[str, Array]:
    """Train a tuner in its isolated process.

    Args:
        child: process of the tuner.
        simulator: training simulator, which counts the simulations.
        stream: seed of the tuner's random generator.
        watch: training callback; None for none.

    Returns:
        Trained arrays by name.

    Raises:
        RunEndedError: the tuner failed.
        KilledExternallyError: its process was killed externally.
    """
    request = {"stream": stream.astype(np.int64), "budget": np.array(simulator.budget)}
    child.send(b"F", *pack_arrays(request), flags=watch is not None, deadline=_NO_DEADLINE)
    simulators: list[TrainingSimulator] = [simulator]
    while True:
        message = child.receive(MAX_STATE_BYTES, _NO_DEADLINE)
        try:
            if message.kind == b"L":
                return unpack_arrays(message.body)
            _handle_message(child, message, simulators, watch)
        except ProtocolError as error:
            raise RunEndedError(
                "crashed", f"the tuner's process violated the message protocol: {error}"
            ) from None


def _handle_message(
    child: IsolatedProcess,
    message: Message,
    simulators: list[TrainingSimulator],
    callback: TrainingCallback | None,
) -> None:
    """Handle one message of a tuner during its training.

    Raises:
        ProtocolError: the message is not valid here.
    """
    if message.kind == b"W" and callback is not None:
        callback.epoch(*_parse_progress(message.to_document()))
        child.send(b"K", deadline=_NO_DEADLINE)
    elif (
        message.kind == b"P"
        and message.flags < 4
        and (callback is not None or not message.flags & 1)
    ):
        # The second simulator is for evaluation only, and exists only if there is a callback.
        if message.flags & 1 and callback is not None and len(simulators) == 1:
            simulators.append(callback.ground)
        _serve_simulation(child, message, simulators[message.flags & 1])
    else:
        raise ProtocolError("it sent a message of an unexpected kind")


def _parse_progress(document: Any) -> tuple[str, int, int, float, float]:
    """Parse a progress message: stage, epoch, number of epochs, and two losses.

    Raises:
        ProtocolError: the message has another content.
    """
    try:
        stage, epoch, epochs, loss, held_out = document
        return to_printable(str(stage)[:80]), int(epoch), int(epochs), float(loss), float(held_out)
    except (TypeError, ValueError, OverflowError):
        raise ProtocolError("its report of progress is not valid") from None


def _serve_simulation(
    child: IsolatedProcess, message: Message, simulator: TrainingSimulator
) -> None:
    """Send the properties of a simulator, and simulate if the message requests it.

    It serves a learned tuner that trains in an isolated process. A request that is not valid, or
    beyond the budget, is answered by a refusal (message X), and the training can continue.
    """
    result: dict[str, NDArray[Any]] = {}
    if message.flags & 2:
        try:
            result = _simulate_points(message, simulator)
        except (ValueError, BudgetExceededError) as error:
            kind = "budget" if isinstance(error, BudgetExceededError) else "value"
            refusal = json.dumps({"kind": kind, "says": str(error)}).encode()
            child.send(b"X", refusal, deadline=_NO_DEADLINE)
            return
    properties = {
        "training": simulator.training,
        "scale": simulator.scale,
        "lengths": np.array(simulator.lengths, dtype=np.int64),
        "initial": simulator.scene.initial,
        "inputs": simulator.scene.inputs,
        "counts": np.array([simulator.used, simulator.budget], dtype=np.int64),
    }
    child.send(b"O", *pack_arrays({**properties, **result}), deadline=_NO_DEADLINE)


def _simulate_points(message: Message, simulator: TrainingSimulator) -> dict[str, NDArray[Any]]:
    """Simulate the requested points.

    Returns:
        The observations, and the state of the random generator after drawing the scenario.
    """
    request = unpack_arrays(message.body)
    points = request.get("points", np.empty(0))
    if points.dtype != np.float64 or points.ndim != 2 or points.shape[1] != simulator.dim:
        raise ProtocolError("it requested no points")
    generator = np.random.Generator(np.random.PCG64())
    generator.bit_generator.state = decode_rng_state(request.get("rng", np.empty(0)))
    observations = simulator.simulate(generator, points)
    return {"observations": observations, "rng": encode_rng_state(generator.bit_generator.state)}
