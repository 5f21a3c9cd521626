"""A ball stepped by an engine, read at second order in the step, its impacts solved by the engine
where they happen.

In flight the engine's velocity w is the one half a step before the position (see
`sims.engines.external`): with acceleration a, a step of length h is

    w' = v + h/2 a                                                         (1)
    x' = x + h w'                                                          (2)
    v' = w' + h/2 a'                                                       (3)

where the engine adds gravity g by itself and is given, beside it, what takes its velocity to (1):

    f = (v + h/2 a - w) / h - g                                            (4)

Under gravity alone that is the exact parabola. A step that would pass the ground is cut where it
meets it: from height H above it, with upward speed u and upward acceleration l,

    s = (u + r) / -l = 2 H / (r - u),    r = sqrt(u^2 - 2 l H)             (5)

seconds away. There the engine solves the contact in a step of its own, of which only the change of
velocity counts, and the rest of the step follows. The error of an impact is thus that of the
flight, of second order in h, and none under gravity alone.

When bouncing is over is agreed with the batch engine (`sims.engines.ground`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from sims.engines.external import Lane, Path, legs
from sims.engines.point import Impact, Pull, State, Vector, gravity, path_of

_NO_TIME = 1e-12
"""Seconds that are not worth a step."""
INSIDE = 1e-9
"""Metres inside the ground at which a ball is placed where contact must act beyond rounding."""


class Mover(Protocol):
    """A ball in an engine. Vectors are x, y, z; forces per unit mass."""

    def start(self, constants: dict[str, float]) -> None:
        """Make the world ready for a rollout, without a trace of the one before."""
        ...

    def pace(self, step: float) -> None:
        """Set the step in seconds."""
        ...

    def place(self, x: Vector, w: Vector) -> None:
        """Set the position and the engine's velocity."""
        ...

    def advance(self, force: Vector) -> State:
        """Take one step with this force (m/s^2) beside gravity."""
        ...

    def glide(self, counts: Sequence[int]) -> list[State]:
        """Take so many steps under gravity alone, and so many again, and so on; what is reached
        each time.
        """
        ...


class FlyingBall(Mover, Protocol):
    """A ball over level ground."""

    def strike(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """The velocity after the engine's contact with the ground at x, all else standing still;
        `place` follows.
        """
        ...

    def hold(self) -> None:
        """Let contact do no more from now on than hold the ball up; `place` follows."""
        ...


def rollout(ball: FlyingBall, lane: Lane) -> Path:
    """Integrate one lane."""
    ball.start(lane.numbers)
    flight = Flight(ball, lane)
    kept = set(lane.kept.tolist())
    steps = lane.steps.tolist()
    rows = [flight.state]
    for begin, counts in legs(lane):
        states = flight.leg(steps[begin], counts)
        # A leg may end between two samples, where nothing is kept.
        rows.extend(states if begin + sum(counts) in kept else states[:-1])
        if not math.isfinite(sum(flight.state)):
            break
    return path_of(lane, rows)


class Flight:
    """One rollout.

    Attributes:
        x: position.
        v: velocity.
        a: acceleration.
        lift: the vertical one if there were no ground.
        w: the engine's velocity; None when it must be placed anew.
        step: the engine's, seconds; NaN when it must be set anew.
        rests: whether it lies on the ground.
        time: seconds since the start.
    """

    def __init__(self, ball: FlyingBall, lane: Lane) -> None:
        self._ball = ball
        self._contact = Impact(lane)
        self._pull = Pull(lane)
        self._gravity = gravity(lane)
        self._floor = float(lane.system.floor(lane.constants)[0, 0])
        x, y, z = lane.x.tolist()
        self.x: Vector = x, y, max(z, self._floor)  # what begins inside the ground begins on it
        self.v: Vector = lane.v.tolist()
        self.a = self._gravity
        self.lift = self._gravity[2]
        self.w: Vector | None = None
        self.step = math.nan
        self.rests = False
        self.time = 0.0
        self._look()
        if self._time_to_ground() == 0.0 and self.v[2] == 0.0:
            self._rest()
            self._look()

    @property
    def state(self) -> tuple[float, ...]:
        """Position, velocity, acceleration."""
        return (*self.x, *self.v, *self.a)

    def leg(self, step: float, counts: Sequence[int]) -> list[tuple[float, ...]]:
        """So many steps, and so many again, and so on; the state reached each time."""
        if self._pull.any:
            return [self._stepwise(step, count) for count in counts]
        states: list[tuple[float, ...]] = []
        left = list(counts)
        while left:
            # Steps until the impact: as many whole samples as fit go to the engine in one call.
            room = math.inf if self.rests else self._time_to_ground() / step
            whole = 0
            for count in left:
                if room < count:
                    break
                room -= count
                whole += 1
            if whole:
                states.extend(self._glide(step, left[:whole]))
                left = left[whole:]
                continue
            # Then the whole steps before the impact, and the one that it cuts.
            if room >= 1.0:
                self._glide(step, (int(room),))
            self.meet(step)
            left[0] -= int(room) + 1
            if not left[0]:
                states.append(self.state)
                left = left[1:]
        return states

    def _stepwise(self, step: float, count: int) -> tuple[float, ...]:
        """Steps that ask for the forces; the state they reach."""
        for _ in range(count):
            # What lies on the ground and is pulled upward flies again.
            if self.rests and self.lift > 0.0:
                self.rests = False
                self.w = None
                self._look()
            if self.rests or self._time_to_ground() >= step:
                self._forced(step)
            else:
                self.meet(step)
        return self.state

    def meet(self, left: float) -> None:
        """A step with impacts."""
        while left > _NO_TIME:
            until = math.inf if self.rests else self._time_to_ground()
            if until > _NO_TIME:
                part = min(until, left)
                if self._pull.any:
                    self._forced(part)
                else:
                    self._glide(part, (1,))
            if until >= left:
                return
            left -= until
            self._strike()

    def _ready(self, step: float) -> Vector:
        """Make the engine step so, placed if it must be; its velocity."""
        # The velocity half a step before is another one for another step.
        if step != self.step:
            self._ball.pace(step)
            self.step = step
            self.w = None
        if self.w is None:
            # (1) backwards, from the step before.
            half = 0.5 * step
            x, y, z = self.v
            ax, ay, az = self.a
            self.w = x - half * ax, y - half * ay, z - half * az
            self._ball.place(self.x, self.w)
        return self.w

    def _glide(self, step: float, counts: Sequence[int]) -> list[tuple[float, ...]]:
        """Steps under gravity alone, or at rest; the states they reach."""
        self._ready(step)
        ax, ay, az = self.a
        x = 0.5 * step * ax
        y = 0.5 * step * ay
        z = 0.5 * step * az
        reached = self._ball.glide(counts)
        self.x, self.w = reached[-1]
        states = []
        for at, w in reached:
            v = w[0] + x, w[1] + y, w[2] + z  # (3)
            states.append((*at, *v, ax, ay, az))
        self.v = states[-1][3:6]
        return states

    def _forced(self, step: float) -> None:
        """One step, in flight or at rest, under all that acts."""
        half = 0.5 * step
        wx, wy, wz = self._ready(step)
        x, y, z = self.v
        ax, ay, az = self.a
        gx, gy, gz = self._gravity
        # (4); at rest the engine's contact bears whatever presses the ball on the ground.
        lift = self.lift - gz if self.rests else (z + half * az - wz) / step - gz
        along = (x + half * ax - wx) / step - gx
        across = (y + half * ay - wy) / step - gy
        self.x, self.w = self._ball.advance((along, across, lift))
        self.time += step
        wx, wy, wz = self.w
        # The acceleration at the end is asked for at the velocity that (3) gives with that at the
        # beginning, and (3) is taken with what comes back.
        self.v = 2.0 * wx - x, 2.0 * wy - y, 0.0 if self.rests else 2.0 * wz - z
        self._look()
        ax, ay, az = self.a
        self.v = wx + half * ax, wy + half * ay, 0.0 if self.rests else wz + half * az

    def _look(self) -> None:
        """Acceleration here and now; at rest the ground takes the vertical one."""
        x, y, z = self._gravity
        if self._pull.any:
            felt = self._pull.at(self.time, self.x, self.v)
            x = x + felt[0]
            y = y + felt[1]
            z = z + felt[2]
        self.lift = z
        self.a = x, y, 0.0 if self.rests else z

    def _time_to_ground(self) -> float:
        """Seconds until a flight with the present acceleration meets the ground; 0 on it, inf if
        never.
        """
        gap = max(self.x[2] - self._floor, 0.0)
        rate = self.v[2]
        lift = self.a[2]
        inside = rate * rate - 2.0 * lift * gap
        # (5): of its two forms the one in which no digits are lost.
        if rate > 0.0 or (rate == 0.0 and lift < 0.0):
            return (rate + math.sqrt(inside)) / -lift if lift < 0.0 else math.inf
        if inside < 0.0 or (rate == 0.0 and lift >= 0.0):
            return math.inf
        return 2.0 * gap / (math.sqrt(inside) - rate)

    def _strike(self) -> None:
        speed = -self.v[2]
        self.w = None  # whatever contact makes of the velocity, the engine must be told
        restitution, friction, over = self._contact.law(max(speed, 0.0), -self.a[2])
        if speed > 0.0:
            self.v = self._ball.strike(self.x, self.v, restitution, friction)
            self.step = math.nan  # the engine's own step was that of the contact
        if over:
            self._rest()
        self._look()

    def _rest(self) -> None:
        self.rests = True
        # A little inside, so that the engine's contact acts from the first step on.
        x, y, z = self.x
        self.x = x, y, min(z, self._floor - INSIDE)
        self.v = self.v[0], self.v[1], 0.0
        self._ball.hold()
