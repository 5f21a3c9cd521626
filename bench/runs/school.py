"""Lets a tuner train that lives in a process of its own: it simulates here, counted and fenced."""

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
"""Of a random stream's state, in front of the points that are asked for."""
_FOREVER = float("inf")
"""Training takes its time."""


def school(
    child: Child, practice: Practice, stream: NDArray[np.uint32], watch: Watch | None
) -> dict[str, Array]:
    """Have a tuner learn; returns what it learned.

    Args:
        child: the tuner's process.
        practice: where it trains; counts what is simulated.
        stream: the seed of its random stream.
        watch: looks on.

    Raises:
        EndedError: the tuner failed.
        KilledError: its process was killed from outside.
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
    """Answer what a tuner at school asks.

    Raises:
        FoulError: that is no question.
    """
    if message.kind == b"W" and watch is not None:
        watch.epoch(*_told(message.document()))
        child.send(b"K", deadline=_FOREVER)
    elif (
        message.kind == b"P" and message.flags < 4 and (watch is not None or not message.flags & 1)
    ):
        # The second ground only measures, and is there for who looks on.
        if message.flags & 1 and watch is not None and len(grounds) == 1:
            grounds.append(watch.ground)
        _practise(child, message, grounds[message.flags & 1])
    else:
        raise FoulError("it sent what nobody asked for")


def _told(said: Any) -> tuple[str, int, int, float, float]:
    """Stage, epoch, epochs, and two losses.

    Raises:
        FoulError: it is something else.
    """
    try:
        stage, epoch, epochs, loss, held_out = said
        return printable(str(stage)[:80]), int(epoch), int(epochs), float(loss), float(held_out)
    except (TypeError, ValueError, OverflowError):
        raise FoulError("it told of no epoch") from None


def _practise(child: Child, message: Message, ground: Ground) -> None:
    """Tell of the ground, and simulate there where that is asked for."""
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
    """Observations of the points that are asked for, and the random stream behind the scenario's
    draw.
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
