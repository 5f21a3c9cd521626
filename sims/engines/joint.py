"""Systems of one coordinate, stepped by an engine and read at second order in the step.

The engine's velocity w is the one half a step before the position. With force f(t, x, v, u) beside
the gravity G(x), each step of length h from (x, v) is

    start:  w  = v + h/2 (G(x) + f(t, x, v, u)) / M                        (1)
    engine: x' = x + h w                                                   (2)
    end:    v' = w + h/2 (G(x') + f(t', x', v', u)) / M                    (3)

where (1) is put in as one force over the step,

    F = (w - w_before) M / h - G(x)                                        (4)

and (3) is solved for v' by one Newton step, so that damping, however strong, is stable (the two
halves together are the trapezoidal rule in v), and dry friction is exact in each half
(`external.kick`).

Where nothing acts but inputs and viscous damping c, the engine's own joint damping carries it,
explicit in w, and the engine need not be interrupted. With J = M + h c / 2 in place of M,

    w' = w + h (T - c w) / J,  which is  w' - w = h (T - c (w + w') / 2) / M    (5)

has its damping at the midpoint, so that v = (w + w') / 2 is the velocity at x. From the engine's
velocity half a step before x, and back to it,

    v = (w + h/2 (G + u) / M) / (1 + h/2 c / M)                            (6)
    w = (1 + h/2 c / M) v - h/2 (G + u) / M                                (7)

and where the input goes from u to u', the step has half a kick of each: w' - w = h (G + (u + u') /
2 - c v) / M with v of (6) is (5) with T = G plus

    u' + (1/2 - h c / (4 M)) (u - u')                                      (8)
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from sims.base import Array
from sims.engines.external import Forces, Lane, Path, kick, legs, rate
from sims.engines.scalar import Resistance, is_library, resistance

_NUDGE = 1e-3
"""Change of velocity (m/s or rad/s) over which the slope of the force is taken."""


class Joint(Protocol):
    """A body on one hinge or guide in an engine."""

    open_loop: bool
    """Whether the system's drive depends on its inputs alone."""

    def start(self, constants: dict[str, float]) -> None:
        """Make the world ready for a rollout."""
        ...

    def pace(self, step: float, inertia: float, damping: float) -> bool:
        """Set step, generalised inertia and damping; False if the engine cannot represent the
        inertia.
        """
        ...

    def place(self, x: float, w: float) -> None:
        """Set position and the engine's velocity."""
        ...

    def gravity(self, x: float) -> float:
        """The generalised force that the engine itself applies at position x."""
        ...

    def advance(self, force: float) -> tuple[float, float]:
        """Take one step with this generalised force beside gravity; position and the engine's
        velocity after it.
        """
        ...

    def glide(self, force: float, counts: Sequence[int]) -> list[tuple[float, float]]:
        """As `advance`, for so many steps, and so many again, and so on; the states reached."""
        ...


def rollout(joint: Joint, lane: Lane) -> Path:
    """Integrate one lane; NaN where the engine cannot represent it."""
    joint.start(lane.numbers)
    inertia = float(lane.system.mass(lane.theta, lane.constants)[0, 0])
    # Three ways, the quickest that carries all that acts: asking the effects for their force takes
    # longer than the engine's own step.
    opposing = resistance(lane) if joint.open_loop else None
    if opposing is None:
        return _driven(joint, lane, inertia, _Asked(joint, lane, inertia))
    damping = _carried(lane)
    if damping is None:
        return _driven(joint, lane, inertia, _Known(joint, lane, inertia, opposing))
    return _open(joint, lane, inertia, damping)


def _carried(lane: Lane) -> float | None:
    """The damping that stands for all effects of the lane; None if it cannot."""
    if not lane.effects:
        return 0.0
    (effect, c), *others = lane.effects
    damping = float(c[0, 0, 0])
    alone = is_library(effect, "drag.linear") and not others
    return damping if alone and damping > 0.0 else None


def _open(joint: Joint, lane: Lane, inertia: float, damping: float) -> Path:
    """No feedback from the motion but viscous damping: the engine runs on its own while the input
    is constant.
    """
    drive = _drive(lane)
    forces = drive.tolist()
    steps = lane.steps.tolist()
    kept = set(lane.kept.tolist())
    x = float(lane.x[0])
    w = math.nan
    v = float(lane.v[0])
    step = math.nan
    felt = forces[0]
    rows = [(x, w, step, felt)]
    for begin, counts in legs(lane, drive):
        h = steps[begin]
        u = forces[begin]
        end = begin + sum(counts)
        if h != step:
            # The velocity half a step before is another one for another step.
            if begin:
                v = _whole(w, joint.gravity(x) + felt, inertia, damping, step)
            if not joint.pace(h, inertia + 0.5 * h * damping, damping):  # (5)
                break
            half = 0.5 * h / inertia
            joint.place(x, (1.0 + half * damping) * v - half * (joint.gravity(x) + u))  # (7)
        elif u != felt:
            joint.advance(u + (0.5 - 0.25 * h * damping / inertia) * (felt - u))  # (8)
            counts[0] -= 1
        states = joint.glide(u, counts)
        x, w = states[-1]
        if not math.isfinite(x + w):
            break
        step = h
        felt = u
        # A leg may end between two samples, where the input changes and nothing is kept.
        if end not in kept:
            states.pop()
        rows.extend((*state, h, u) for state in states)
    if len(rows) < lane.kept.size:
        return _failed(lane)
    # Velocities are read off at the end, all at once: the engine ran without interruption.
    positions, w_at, step_at, felt_at = np.array(rows).T
    force = _weights(lane, positions) + felt_at
    rates = _whole(w_at, force, inertia, damping, step_at)
    rates[0] = lane.v[0]
    accelerations = (force - damping * rates) / inertia
    return positions[:, None], rates[:, None], accelerations[:, None]


def _whole(w: Any, force: Any, inertia: float, damping: float, step: Any) -> Any:
    """The velocity at the time of the position, from the engine's half a step before and the force
    on the position.
    """
    half = 0.5 * step / inertia
    return (w + half * force) / (1.0 + half * damping)  # (6)


def _driven(joint: Joint, lane: Lane, inertia: float, forces: _Forces) -> Path:
    """Whatever acts, asked for at each step."""
    x = float(lane.x[0])
    v = float(lane.v[0])
    t = 0.0
    step = math.nan
    w = v
    inverse = 1.0 / inertia
    forces.feel(0)
    forces.look(t, x, v)
    kept = set(lane.kept.tolist())
    rows = [(x, v, forces.acceleration(v))]
    for i, h in enumerate(lane.steps.tolist()):
        if forces.feel(i):
            forces.look(t, x, v)
        start = kick(v, forces.force(v), forces.limit, inverse, 0.5 * h)  # (1)
        if h != step:
            if not joint.pace(h, inertia, 0.0):
                break
            w = 2.0 * v - start  # so that the force put in is the force there is
            joint.place(x, w)
            step = h
        x, w = joint.advance((start - w) * inertia / h - forces.weight)  # (4), (2)
        if not math.isfinite(x + w):
            break
        t += h
        # Forces are asked for where the velocity would be without a change of force: w lies in the
        # middle between v and that.
        forces.look(t, x, 2.0 * w - v)
        v = forces.end(w, h)  # (3)
        if i + 1 in kept:
            rows.append((x, v, forces.acceleration(v)))
    if len(rows) < lane.kept.size:
        return _failed(lane)
    x_at, v_at, a_at = np.array(rows).T[:, :, None]
    return x_at, v_at, a_at


class _Forces(ABC):
    """The forces on one coordinate, linear in the velocity about the last look.

    Attributes:
        weight: the engine's own, where last looked.
        limit: of dry friction.
    """

    def __init__(self, joint: Joint, inertia: float) -> None:
        self._gravity = joint.gravity
        self._inertia = inertia
        self.weight = self.limit = self._at = self._force = self._slope = 0.0

    @abstractmethod
    def feel(self, i: int) -> bool:
        """Set the inputs of step i; whether any differs from the step before."""

    @abstractmethod
    def look(self, t: float, x: float, v: float) -> None:
        """Ask for all forces at this instant."""

    def force(self, v: float) -> float:
        """Gravity and all but friction, at a velocity near the one looked at."""
        return self._force + self._slope * (v - self._at)

    def end(self, w: float, step: float) -> float:
        """The velocity half a step after `w`, the force being the one at its end; a growing force
        is taken as is.
        """
        # (3) with f linear in v about the last look: its slope goes over to the inertia's side,
        # which a growing force would make smaller, down to nothing.
        slope = min(self._slope, 0.0)
        force = self._force + slope * (w - self._at)
        return kick(w, force, self.limit, 1.0 / (self._inertia - 0.5 * step * slope), 0.5 * step)

    def acceleration(self, v: float) -> float:
        """Of the smooth motion; zero where friction holds."""
        return rate(v, self.force(v), self.limit) / self._inertia


class _Asked(_Forces):
    """Whatever the system and the effects say, at two velocities for the slope between them."""

    def __init__(self, joint: Joint, lane: Lane, inertia: float) -> None:
        super().__init__(joint, inertia)
        self._ask = Forces(lane, 2)
        self._signals = {name: values.tolist() for name, values in lane.inputs.items()}

    def feel(self, i: int) -> bool:
        """See `_Forces`."""
        # The first step has none before it, not even an equal one.
        changed = i == 0 or any(values[i] != values[i - 1] for values in self._signals.values())
        if changed:
            self._ask.feel({name: values[i] for name, values in self._signals.items()})
        return changed

    def look(self, t: float, x: float, v: float) -> None:
        """See `_Forces`."""
        moment = self._ask.moment
        moment.t.fill(t)
        moment.x.fill(x)
        moment.v[0, 0] = v
        moment.v[1, 0] = v + _NUDGE
        force, nudged = self._ask.force()[:, 0].tolist()
        self.weight = self._gravity(x)
        self.limit = self._ask.limit()
        self._at = v
        self._force = self.weight + force
        self._slope = (nudged - force) / _NUDGE


class _Known(_Forces):
    """An input that acts as it is, and what opposes motion in plain numbers."""

    def __init__(self, joint: Joint, lane: Lane, inertia: float, opposing: Resistance) -> None:
        super().__init__(joint, inertia)
        self._drive: list[float] = _drive(lane).tolist()
        self._felt = self._drive[0]
        self._resistance = opposing.at
        self.limit = opposing.limit

    def feel(self, i: int) -> bool:
        """See `_Forces`."""
        before = self._felt
        self._felt = self._drive[i]
        return bool(self._felt != before)

    def look(self, t: float, x: float, v: float) -> None:  # noqa: ARG002
        """See `_Forces`."""
        opposed, slope = self._resistance(abs(v))
        self.weight = self._gravity(x)
        self._at = v
        self._force = self.weight + self._felt - opposed * v
        self._slope = -slope


def _drive(lane: Lane) -> Array:
    """(S,) generalised force of the inputs over each step, at least one value."""
    if not lane.inputs:
        return np.zeros(max(lane.steps.size, 1))
    signals = {name: values[:, None] for name, values in lane.inputs.items()}
    size = len(next(iter(signals.values())))
    nothing = np.zeros((size, 1))
    moment = lane.moment(nothing, nothing, nothing, signals)
    drive: Array = lane.system.drive(moment)[:, 0]
    return drive


def _weights(lane: Lane, x: Array) -> Array:
    """(n,) gravity's force at positions (n,)."""
    nothing = np.zeros((x.size, 1))
    moment = lane.moment(nothing, x[:, None], nothing, {})
    weights: Array = lane.system.weight(moment)[:, 0]
    return weights


def _failed(lane: Lane) -> Path:
    nothing = np.full((lane.kept.size, 1), np.nan)
    return nothing, nothing, nothing
