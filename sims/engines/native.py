"""A ball stepped by an engine as it comes: its own integrator and contact, first order in the step,
nothing corrected.

Effects act by their force at the beginning of each step. What they make of an impact is set once
the next step may bring the ball to the ground. In flight the smooth acceleration, which no engine
reports, is

    a = g + pull - k v (1 + |v|)                                           (1)

with k what the engine takes for air (`sims.ball.bullet_world`), and there is no vertical one where
the ball rests.
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
"""m/s below which Bullet takes a ball on the ground for resting."""


class NativeBall(Mover, Protocol):
    """A ball over level ground in an engine."""

    damping: float
    """What the engine takes for air: -damping v (1 + |v|), m/s^2."""

    def touch(self, restitution: float, friction: float) -> None:
        """Set restitution and friction of the impacts to come."""
        ...

    def near(self, gap: float) -> bool:
        """Whether contact may act where the ball's lower side is `gap` above the ground."""
        ...


def rollout(ball: NativeBall, lane: Lane) -> Path:
    """Integrate one lane."""
    # Unlike in `flight`, the engine's velocity is read as it comes, and so is its contact.
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
                    # Where the next step may end: contact acts in it or not at all.
                    if contact.changes and w[2] < 0.0 and ball.near(x[2] + step * w[2] - floor):
                        ball.touch(*contact.at(-w[2]))
                    x, w = ball.advance(felt.at(t, x, w))
                    t += step
                states.append((*x, *w, *felt.at(t, x, w)))
        else:
            # Nothing to ask for: the engine runs from sample to sample.
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
