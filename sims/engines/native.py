"""Integrate a ball with an engine's native integrator and contact model, without corrections.

The result is of first order in the step.

Effects act through their force at the beginning of each step. Their contact parameters are set when
the next step may bring the ball to the ground. The smooth acceleration in flight, which no engine
reports, is

    a = g + f - k v (1 + |v|)                                              (1)

with f the effects' force per unit mass and k the engine's air damping (`sims.ball.bullet_world`).
There is no vertical acceleration where the ball rests.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from sims.base import Array
from sims.engines.external import Lane, Path, legs
from sims.engines.flight import Mover
from sims.engines.point import Impact, Pull, Vector, gravity, path_of

_SLOW = 0.2
"""Speed in m/s below which Bullet treats a ball on the ground as resting."""


class NativeBall(Mover, Protocol):
    """Ball over level ground in an engine."""

    damping: float
    """Coefficient of the engine's air damping: -damping v (1 + |v|), in m/s^2."""

    def touch(self, restitution: float, friction: float) -> None:
        """Set restitution and friction coefficient of the following impacts."""
        ...

    def near(self, gap: float) -> bool:
        """Return whether contact may act with the ball's lowest point `gap` m above the ground."""
        ...


def rollout(ball: NativeBall, lane: Lane) -> Path:
    """Integrate one batch element.

    Args:
        ball: ball in an engine.
        lane: batch element to integrate.

    Returns:
        Positions, velocities and accelerations (N, 3); NaN if the integration failed.
    """
    # Unlike in `flight`, velocity and contact of the engine are used without correction.
    contact = Impact(lane)
    felt = Pull(lane)
    floor = float(lane.system.floor(lane.constants)[0, 0])
    ball.start(lane.numbers)
    x: Vector = lane.x.tolist()
    w: Vector = lane.v.tolist()
    ball.touch(*contact.at(max(-w[2], 0.0)))
    ball.place(x, w)
    kept = set(lane.kept.tolist())
    steps = lane.steps.tolist()
    t = 0.0
    step = math.nan
    rows = [(*x, *w, *felt.at(t, x, w))]
    for begin, counts in legs(lane):
        if steps[begin] != step:
            step = steps[begin]
            ball.pace(step)
        if felt.any or contact.changes:
            states = []
            for count in counts:
                for _ in range(count):
                    # Contact can act only if the predicted end of the next step is near the ground.
                    if contact.changes and w[2] < 0.0 and ball.near(x[2] + step * w[2] - floor):
                        ball.touch(*contact.at(-w[2]))
                    x, w = ball.advance(felt.at(t, x, w))
                    t += step
                states.append((*x, *w, *felt.at(t, x, w)))
        else:
            # No force must be evaluated: the engine runs from sample to sample.
            states = [(*x, *w, 0.0, 0.0, 0.0) for x, w in ball.glide(counts)]
        rows.extend(states if begin + sum(counts) in kept else states[:-1])
        if not math.isfinite(sum(rows[-1])):
            break
    at, v, pulled = path_of(lane, rows)
    speed = np.sqrt((v * v).sum(axis=1, keepdims=True))
    a: Array = gravity(lane) + pulled - ball.damping * v * (1.0 + speed)  # (1)
    for i in np.flatnonzero(np.abs(v[:, 2]) < _SLOW):
        if ball.near(at[i, 2] - floor):
            a[i, 2] = 0.0
    return at, v, a
