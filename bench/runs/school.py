"""Train a tuner that lives in an isolated process; its simulations run here and are counted."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.problem.practice import Practice
from bench.sealing.children import Child
from bench.sealing.ended import EndedError
from bench.sealing.streams import state_of, stream_of
from bench.sealing.wire import (
    ASKED_LIMIT,
    STATE_LIMIT,
    FoulError,
    Message,
    packed,
    printable,
    unpacked,
)
from methods.base import BudgetExceededError, Watch
from methods.base import Practice as Ground
from sims.base import Array

_STREAM_BYTES = 48
"""Size in bytes of the random generator's state before the requested points."""
_FOREVER = float("inf")
"""Deadline of a training, in seconds: none."""


def school(
    child: Child, practice: Practice, stream: NDArray[np.uint32], watch: Watch | None
) -> dict[str, Array]:
    """Train a tuner in its isolated process.

    Args:
        child: process of the tuner.
        practice: training simulator, which counts the simulations.
        stream: seed of the tuner's random generator.
        watch: training callback; None for none.

    Returns:
        Trained arrays by name.

    Raises:
        EndedError: the tuner failed.
        KilledError: its process was killed externally.
    """
    given = {"stream": stream.astype(np.int64), "budget": np.array(practice.budget)}
    child.send(b"F", *packed(given), flags=watch is not None, deadline=_FOREVER)
    grounds: list[Ground] = [practice]
    while True:
        message = child.receive(STATE_LIMIT, _FOREVER)
        try:
            if message.kind == b"L":
                return unpacked(message.body)
            _serve(child, message, grounds, watch)
        except FoulError as error:
            raise EndedError("crashed", f"the tuner's process broke the pipe: {error}") from None


def _serve(child: Child, message: Message, grounds: list[Ground], watch: Watch | None) -> None:
    """Handle one message of a tuner during its training.

    Raises:
        FoulError: the message is not valid here.
    """
    if message.kind == b"W" and watch is not None:
        watch.epoch(*_told(message.document()))
        child.send(b"K", deadline=_FOREVER)
    elif (
        message.kind == b"P" and message.flags < 4 and (watch is not None or not message.flags & 1)
    ):
        # The second simulator is for evaluation only, and exists only if there is a callback.
        if message.flags & 1 and watch is not None and len(grounds) == 1:
            grounds.append(watch.ground)
        _practise(child, message, grounds[message.flags & 1])
    else:
        raise FoulError("it sent what nobody asked for")


def _told(said: Any) -> tuple[str, int, int, float, float]:
    """Parse a progress message: stage, epoch, number of epochs, and two losses.

    Raises:
        FoulError: the message has another content.
    """
    try:
        stage, epoch, epochs, loss, held_out = said
        return printable(str(stage)[:80]), int(epoch), int(epochs), float(loss), float(held_out)
    except (TypeError, ValueError, OverflowError):
        raise FoulError("it told of no epoch") from None


def _practise(child: Child, message: Message, ground: Ground) -> None:
    """Send the properties of a simulator, and simulate if the message requests it."""
    result: dict[str, NDArray[Any]] = {}
    if message.flags & 2:
        try:
            result = _simulated(message, ground)
        except (ValueError, BudgetExceededError) as error:
            kind = "budget" if isinstance(error, BudgetExceededError) else "value"
            refusal = json.dumps({"kind": kind, "says": str(error)}).encode()
            child.send(b"X", refusal, deadline=_FOREVER)
            return
    told = {
        "training": ground.training,
        "scale": ground.scale,
        "lengths": np.array(ground.lengths, dtype=np.int64),
        "initial": ground.scene.initial,
        "inputs": ground.scene.inputs,
        "counts": np.array([ground.used, ground.budget], dtype=np.int64),
    }
    child.send(b"O", *packed({**told, **result}), deadline=_FOREVER)


def _simulated(message: Message, ground: Ground) -> dict[str, NDArray[Any]]:
    """Simulate the requested points.

    Returns:
        The observations, and the state of the random generator after drawing the scenario.
    """
    body = bytes(message.body)
    if len(body) > ASKED_LIMIT or len(body) != _STREAM_BYTES + 8 * message.size * ground.dim:
        raise FoulError("it asked for no points")
    bits = np.random.PCG64()
    state: Any = state_of(np.frombuffer(body[:_STREAM_BYTES], dtype="<i8"))
    bits.state = state
    points = np.frombuffer(body[_STREAM_BYTES:], dtype="<f8").reshape(message.size, ground.dim)
    observations = ground.simulate(np.random.Generator(bits), points.astype(np.float64))
    return {"observations": observations, "stream": stream_of(bits.state)}
