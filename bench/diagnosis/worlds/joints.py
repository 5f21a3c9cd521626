"""Reference simulation of pendulum and slider with scipy, with any effect or unmodelled cause.

The model has one coordinate, and events where dry friction stops it. Hidden-state effects add a
driven mass or an internal state that no sensor shows.

Every law is written here again in plain numbers. Nothing is shared with the effect library, which
the benchmark tests.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import copysign, cos, exp, hypot, inf, pi, sin, tanh
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from bench.diagnosis.worlds.base import Effects, World
from sims.base import Array, Scenario

TOLERANCES: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}
SHORT = 0.011  # seconds: for shorter intervals, order 5 is cheaper than order 8
# Width of a region's soft border as a fraction of its half width; a smooth border preserves the
# order of the solver.
EDGE = 0.05
SLEWED = 2e-3  # seconds for which an input with limited rate is held constant
STRAIGHT = 10  # number of parts of an interval in which a linear command is held constant

NOT_LINEAR = ("input.deadband", "input.saturation", "backlash", "input.rate", "input.power")

Law = Callable[[float, float, float], float]
Weight = Callable[[float], float]
Moved = tuple[float, Array, Any]


@dataclass(frozen=True)
class Piece:
    """Time interval in which the applied input approaches `target` from `start`.

    With `lag` zero, the input jumps to `target` at once.
    """

    begin: float
    end: float
    start: float
    target: float
    lag: float

    def at(self, t: float) -> float:
        """Return the applied input at time t."""
        return self.target + (
            (self.start - self.target) * exp((self.begin - t) / self.lag) if self.lag > 0 else 0.0
        )

    def cut(self, begin: float, end: float) -> Piece:
        """Return the part of this interval from `begin` to `end`."""
        return Piece(begin, end, self.at(begin), self.target, self.lag)


def felt(scenario: Scenario, effects: Effects, until: float) -> list[Piece]:
    """Compute the first input as applied to the plant, from time 0 to `until`.

    A lag must follow the nonlinear input effects.

    Args:
        scenario: the run.
        effects: the hidden effects.
        until: end time.

    Raises:
        NotImplementedError: a nonlinear input effect follows a lag.
    """
    if "u" not in scenario.inputs:
        return [Piece(0.0, until, 0.0, effects.get("input.bias", [0.0])[0], 0.0)]
    levels, edges, lag = np.array(scenario.inputs["u"]), scenario.times - scenario.times[0], 0.0
    if "input.hold" in effects:
        levels, edges = _straight(levels, edges, effects["input.hold"][0])
    for name, c in effects.items():
        if name in NOT_LINEAR and lag:
            raise NotImplementedError(f"{name} behind input.lag")
        if name == "input.delay":
            edges = edges + c[0]
        elif name == "input.lag":
            lag = c[0]
        elif name == "input.rate":
            levels, edges = _slewed(levels, edges, c[0])
        elif name in STEPWISE:
            levels = STEPWISE[name](levels, *c)
    changes = np.flatnonzero(np.diff(levels)) + 1
    begins, targets = [0.0, *edges[changes]], [levels[0], *levels[changes]]
    pieces, state = [], levels[0]
    for begin, end, target in zip(begins, [*begins[1:], inf], targets, strict=True):
        if begin < until:
            pieces.append(
                Piece(float(begin), float(min(end, until)), float(state), float(target), lag)
            )
            state = pieces[-1].at(pieces[-1].end)
    return pieces


def _straight(levels: Array, edges: Array, share: float) -> tuple[Array, Array]:
    """Divide each interval into parts, to approximate an input between hold and linear.

    Args:
        levels: input at each sample.
        edges: time of each sample.
        share: 0 for a zero-order hold, 1 for linear interpolation.

    Returns:
        Levels and begins of the parts.
    """
    parts = (np.arange(STRAIGHT) + 0.5) / STRAIGHT
    fine = levels[:-1, None] + share * np.diff(levels)[:, None] * parts
    begins = edges[:-1, None] + np.diff(edges)[:, None] * np.arange(STRAIGHT) / STRAIGHT
    return np.append(fine.ravel(), levels[-1]), np.append(begins.ravel(), edges[-1])


def _slewed(levels: Array, edges: Array, most: float) -> tuple[Array, Array]:
    """Limit the rate of an input to `most` per second, in short parts of constant level.

    Returns:
        Levels and begins of the parts.
    """
    ends = [*edges[1:].tolist(), edges[-1] + 1.0]
    values, begins, state = [], [], float(levels[0])
    for level, begin, end in zip(levels.tolist(), edges.tolist(), ends, strict=True):
        while begin < end and state != level:
            last = min(begin + SLEWED, end)
            away = level - state
            lasting = min(abs(away) / most, last - begin)
            after = level if lasting >= abs(away) / most else state + copysign(most * lasting, away)
            # mean over the part, in which the rise may end
            values.append(0.5 * (state + after) * lasting / (last - begin))
            values[-1] += after * (1 - lasting / (last - begin))
            begins.append(begin)
            state, begin = after, last
        if begin < end:
            values.append(level)
            begins.append(begin)
    return np.array(values), np.array(begins)


def _play(levels: Array, width: float) -> Array:
    result, state = [], levels[0]
    for level in levels:
        if abs(level - state) > width / 2:
            state = level - copysign(width / 2, level - state)
        result.append(state)
    return np.array(result)


STEPWISE: dict[str, Callable[..., Array]] = {
    "input.gain": lambda u, c: u * (1 + c),
    "input.bias": lambda u, c: u + c,
    "input.deadband": lambda u, c: np.sign(u) * np.maximum(np.abs(u) - c, 0.0),
    "input.saturation": lambda u, c: np.minimum(np.maximum(u, -c), c),
    "input.power": lambda u, gain, power: (1 + gain) * np.sign(u) * np.abs(u) ** (1 + power),
    "backlash": _play,
}


class Joint:
    """Equation of motion of one coordinate with effects and unmodelled causes.

    Attributes:
        inertia: generalised inertia of the drive side.
        weight: gravity force as a function of position.
        forces: laws of the acting forces.
        limits: laws of the dry friction limits.
        behind: hidden-state effects: driven loads and hysteresis.
    """

    def __init__(self, world: World, number: int) -> None:
        k, p = world.constants, world.parameters
        self.weight: Weight
        self.sideways: Weight
        self.latched = number % 2 == 0
        if world.system == "pendulum":
            arm = k["mass"] * k["length"]
            self.inertia, gravity = p["inertia"], k["gravity"]
            self.weight = lambda x: -arm * gravity * sin(x)
            self.sideways = lambda x: arm * cos(x)
        else:
            self.inertia, gravity = p["mass"], 9.80665
            self.weight = lambda x: 0.0
            self.sideways = lambda x: self.inertia
        self.gravity = gravity
        acting = {**world.effects, **world.foreign}
        self.forces = [FORCES[name](self, list(c)) for name, c in acting.items() if name in FORCES]
        self.limits = [LIMITS[name](self, list(c)) for name, c in acting.items() if name in LIMITS]
        self.breaks: list[float] = []
        if "gust" in acting:
            push, lasting, *begins = acting["gust"]
            begin = begins[number]
            self.breaks = [begin, begin + lasting]
            self.forces.append(
                lambda t, x, v: push if begin <= self.middle < begin + lasting else 0.0
            )
        self.restless = bool({"force.periodic", "input.lag", "friction.warming"} & set(acting))
        whole, gravity_of_all = self.inertia, self.weight
        self.behind: list[Any] = [
            BEHIND[name](whole, gravity_of_all, *c) for name, c in acting.items() if name in BEHIND
        ]
        self.inertia = whole - sum(part.inertia for part in self.behind)

    def enter(self, piece: Piece) -> None:
        """Set the input interval in which the motion is integrated."""
        self.piece, self.middle = piece, 0.5 * (piece.begin + piece.end)

    def pull(self, t: float, x: float, v: float, *z: float) -> float:
        """Compute the force on the coordinate, without dry friction.

        Args:
            t: time.
            x: position.
            v: velocity.
            *z: states of the hidden-state effects.
        """
        total = self.piece.at(t) + self.weight(x)
        for force in self.forces:
            total += force(t, x, v)
        for part, own in zip(self.behind, batched(z), strict=True):
            total += part.force(x, v, *own)
        return total

    def rates(self, x: float, v: float, *z: float) -> list[float]:
        """Compute the time derivatives of the states of the hidden-state effects.

        Args:
            x: position.
            v: velocity.
            *z: states of the hidden-state effects.
        """
        parts = zip(self.behind, batched(z), strict=True)
        return [rate for part, own in parts for rate in part.rates(x, v, *own)]

    def limit(self, t: float, x: float, v: float) -> float:
        """Compute the dry friction limit.

        Args:
            t: time.
            x: position.
            v: velocity.
        """
        return sum(limit(t, x, v) for limit in self.limits)


def batched(z: Sequence[float]) -> list[tuple[float, float]]:
    """Group values in pairs."""
    return list(zip(z[::2], z[1::2], strict=True))


class Load(ABC):
    """Load behind a transmission: `share` of the inertia and of the weight.

    The sensor shows the motion of the drive side, x and v; the load has the states y and w.
    """

    def __init__(self, inertia: float, weight: Weight, share: float) -> None:
        self.whole, self.inertia, self.weight = inertia, share * inertia, weight
        self.share = share

    @abstractmethod
    def between(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by the drive side.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """

    def force(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the force of the load on the drive side.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """
        return -self.inertia * self.between(x, v, y, w) - self.share * self.weight(x)

    def rates(self, x: float, v: float, y: float, w: float) -> tuple[float, float]:
        """Compute the time derivatives of the load's states.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """
        return w, self.between(x, v, y, w) + self.weight(y) / self.whole


class Sprung(Load):
    """Load on a spring, with `frequency` rad/s when the drive side is fixed."""

    def __init__(
        self, inertia: float, weight: Weight, share: float, frequency: float, ratio: float
    ) -> None:
        super().__init__(inertia, weight, share)
        self.frequency, self.ratio = frequency, ratio

    def begin(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state of the load, with the static deflection of the spring."""
        return x + self.weight(x) / self.whole / self.frequency**2, v

    def between(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by spring and damper; see `Load`."""
        return self.frequency**2 * (x - y) + 2 * self.ratio * self.frequency * (v - w)


class Loose(Load):
    """Load behind backlash, with stiff damped flanks that never pull."""

    def __init__(self, inertia: float, weight: Weight, gap: float, share: float) -> None:
        super().__init__(inertia, weight, share)
        self.gap = gap

    def begin(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state of the load, centred in the gap."""
        return x, v

    def between(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by the flank in contact; see `Load`."""
        over = abs(x - y) - self.gap / 2
        if over <= 0:
            return 0.0
        side = copysign(1.0, x - y)
        damped = 600 * (v - w) * over / (over + self.gap / 100)
        push = side * (1 - self.share) * (22500 * side * over + damped)
        return side * max(push, 0.0)


class Yielding:
    """Dahl friction: the surfaces yield over `deflection`; its state is a fraction of the limit."""

    inertia = 0.0

    def __init__(self, inertia: float, weight: Weight, limit: float, deflection: float) -> None:
        self.most, self.deflection = limit, deflection

    def begin(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state, without strain."""
        return 0.0, 0.0

    def force(self, x: float, v: float, _: float, strain: float) -> float:
        """Compute the friction force on the mass.

        Args:
            x: position.
            v: velocity.
            strain: friction force as a fraction of its limit.
        """
        return -self.most * strain

    def rates(self, x: float, v: float, _: float, strain: float) -> tuple[float, float]:
        """Compute the time derivatives of the two states.

        Args:
            x: position.
            v: velocity.
            strain: friction force as a fraction of its limit.
        """
        speed = min(abs(v) / self.deflection, 400.0)
        return 0.0, speed * (copysign(1.0, v) - strain)


BEHIND: dict[str, Callable[..., Any]] = {
    "joint.flexibility": Sprung,
    "joint.backlash": Loose,
    "friction.hysteresis": Yielding,
}


def _wave(c: Sequence[float], cycles: float) -> float:
    return c[0] * sin(2 * pi * cycles) + c[1] * cos(2 * pi * cycles)


FORCES: dict[str, Callable[[Joint, list[float]], Law]] = {
    "drag.linear": lambda j, c: lambda t, x, v: -c[0] * v,
    "drag.quadratic": lambda j, c: lambda t, x, v: -c[0] * abs(v) * v,
    "friction.direction": lambda j, c: lambda t, x, v: -c[0] * max(v, 0.0) - c[1] * min(v, 0.0),
    "wind": lambda j, c: lambda t, x, v: -c[0] * abs(v - c[1]) * (v - c[1]),
    "gravity.scale": lambda j, c: lambda t, x, v: c[0] * j.weight(x),
    "gravity.tilt": lambda j, c: lambda t, x, v: c[0] * j.gravity * j.sideways(x),
    "supply.sag": lambda j, c: (
        lambda t, x, v: j.piece.at(t) * (1 / (1 + c[0] * abs(j.piece.at(t))) - 1)
    ),
    "supply.braking": lambda j, c: lambda t, x, v: -c[0] * j.piece.at(t) * (j.piece.at(t) * v < 0),
    "spring.linear": lambda j, c: lambda t, x, v: -c[0] * x,
    "spring.cubic": lambda j, c: lambda t, x, v: -c[0] * x**3,
    "force.bias": lambda j, c: lambda t, x, v: c[0],
    "force.ripple": lambda j, c: lambda t, x, v: _wave(c, x / c[2]),
    "force.periodic": lambda j, c: lambda t, x, v: _wave(c, t * c[2]),
    "ageing": lambda j, c: lambda t, x, v: -c[0] * t * v,  # unmodelled: damping grows with time
    "state.limit": lambda j, c: lambda t, x, v: -copysign(1.0, c[0]) * stopped(x, v, *c),
    "latch": lambda j, c: (
        lambda t, x, v: -c[0] * max(x - c[1], 0.0) if j.latched else 0.0
    ),  # unmodelled: a soft end stop in every other run
}
LIMITS: dict[str, Callable[[Joint, list[float]], Law]] = {
    "friction.coulomb": lambda j, c: lambda t, x, v: c[0],
    "friction.stribeck": lambda j, c: lambda t, x, v: c[0] + c[1] * exp(-((v / c[2]) ** 2)),
    "friction.load": lambda j, c: lambda t, x, v: c[0] * abs(j.piece.at(t) - j.weight(x)),
    "friction.load_direction": lambda j, c: (
        lambda t, x, v: abs(c[0] * j.piece.at(t) - c[1] * j.weight(x))
    ),
    "friction.load_quadratic": lambda j, c: (
        lambda t, x, v: (
            c[0] * abs(j.piece.at(t) - j.weight(x))
            + c[1] * through(j.piece.at(t), -j.weight(x)) ** 2
        )
    ),
    "friction.position": lambda j, c: (
        lambda t, x, v: c[0] + hypot(c[1], c[2]) + _wave(c[1:], x / c[3])
    ),
    "friction.warming": lambda j, c: lambda t, x, v: (c[0] + c[1] * abs(v)) * exp(-t / c[2]),
    "patch": lambda j, c: (
        lambda t, x, v: c[0] * inside(x, c[1], c[2])
    ),  # unmodelled: dry friction from c1 - c2 to c1 + c2
}
FOREIGN = ("patch", "gust", "ageing", "latch")


def through(drive: float, against: float) -> float:
    """Return the smaller force that gears transmit; zero if both forces have the same direction."""
    return min(abs(drive), abs(against)) if drive * against > 0 else 0.0


def stopped(x: float, v: float, stiffness: float, place: float, loss: float) -> float:
    """Compute the magnitude of the force of an end stop, by Hertz's contact law.

    Args:
        x: position.
        v: velocity.
        stiffness: force at a depth of 0.01, divided by that depth; its sign is the side of the
            stop.
        place: position of the stop.
        loss: damping, as a factor of the approach velocity.
    """
    side = copysign(1.0, stiffness)
    depth = max(side * (x - place), 0.0)
    push: float = depth**1.5
    return abs(stiffness) * push / 0.1 * max(1.0 + loss * side * v, 0.0)


def inside(x: float, centre: float, half: float) -> float:
    """Return 1 inside a region and 0 outside, with soft borders.

    The integral over x is the width of the region.

    Args:
        x: position.
        centre: centre of the region.
        half: half width of the region.
    """
    return 0.5 * (
        tanh((x - centre + half) / (EDGE * half)) - tanh((x - centre - half) / (EDGE * half))
    )


def move(world: World, scenario: Scenario, number: int, instants: Array) -> Array:
    """Simulate a run.

    Args:
        world: the true system.
        scenario: the run.
        number: index of the run in the recording.
        instants: increasing times >= 0, (T,).

    Returns:
        Positions and velocities, (T, 2).
    """
    joint, until = Joint(world, number), float(instants[-1])
    names = ("q", "qd") if world.system == "pendulum" else ("x", "v")
    state = np.array([scenario.initial[name] for name in names])
    hidden = [value for part in joint.behind for value in part.begin(*state)]
    state = np.concatenate([state, hidden])
    out = np.empty((instants.size, 2))
    out[instants <= 0] = state[:2]
    for piece in felt(scenario, world.effects, until):
        marks = [
            piece.begin,
            *(b for b in sorted(joint.breaks) if piece.begin < b < piece.end),
            piece.end,
        ]
        for begin, end in pairwise(marks):
            joint.enter(piece.cut(begin, end))
            state = _through(joint, state, instants, out)
    return out


def _through(joint: Joint, state: Array, instants: Array, out: Array) -> Array:
    """Integrate to the end of the input interval, from one standstill to the next.

    Args:
        joint: the equation of motion.
        state: state at the begin of the interval.
        instants: times of the samples, (T,).
        out: receives positions and velocities, (T, 2).

    Returns:
        State at the end.
    """
    now, end = joint.piece.begin, joint.piece.end
    for _ in range(10_000):
        if now >= end:
            return state
        reached, after, solution = _glide(joint, now, state)
        first, last = np.searchsorted(instants, [now, reached], side="right")
        if last > first:
            out[first:last] = solution(instants[first:last]).T[:, :2] if solution else state[:2]
        now, state = reached, after
    raise RuntimeError("it never gets through: too many standstills")


def _glide(joint: Joint, now: float, state: Array) -> Moved:
    """Integrate until the next standstill, break-away or end of the input interval.

    Returns:
        End time, state at that time, and the dense solution (None without motion).
    """
    (x, v, *z), end = state, joint.piece.end
    way = copysign(1.0, v) if v else 0.0
    if joint.limits and v == 0.0:
        pull = joint.pull(now, x, 0.0, *z)
        if abs(pull) <= joint.limit(now, x, 0.0):
            return _held(joint, now, state) if z else (_loose(joint, now, x), state, None)
        way = copysign(1.0, pull)

    def rate(t: float, y: Array) -> list[float]:
        rubbing = way * joint.limit(t, *y[:2]) if joint.limits else 0.0
        return [y[1], (joint.pull(t, *y) - rubbing) / joint.inertia, *joint.rates(*y)]

    def turns(t: float, y: Array) -> float:
        return float(way * y[1])

    stops: Any = turns
    stops.terminal, stops.direction = True, -1
    events, first = (stops, min(0.01, end - now)) if joint.limits else (None, min(0.02, end - now))
    settings: dict[str, Any] = {
        "dense_output": True,
        "max_step": 0.05,
        "first_step": first,
        **TOLERANCES,
    }
    method: Any = "RK45" if end - now < SHORT else "DOP853"
    solved = solve_ivp(rate, (now, end), state, method, events=events, **settings)
    if not solved.success:
        raise RuntimeError(solved.message)
    after = solved.y[:, -1].copy()
    if joint.limits and solved.t_events is not None and solved.t_events[0].size:
        after[1] = 0.0
    return float(solved.t[-1]), after, solved.sol


def _held(joint: Joint, now: float, state: Array) -> Moved:
    """Integrate the hidden states while dry friction holds the coordinate, until it breaks away."""
    end = joint.piece.end

    def rate(t: float, y: Array) -> list[float]:
        return [0.0, 0.0, *joint.rates(*y)]

    def excess(t: float, y: Array) -> float:
        return abs(joint.pull(t, *y)) - joint.limit(t, *y[:2]) * (1 + 1e-9)

    stops: Any = excess
    stops.terminal, stops.direction = True, 1
    settings: dict[str, Any] = {"dense_output": True, "max_step": 0.01, **TOLERANCES}
    solved = solve_ivp(rate, (now, end), state, "RK45", events=stops, **settings)
    return float(solved.t[-1]), solved.y[:, -1].copy(), solved.sol


def _loose(joint: Joint, now: float, x: float) -> float:
    """Find the time at which the coordinate breaks away, or the end of the input interval.

    Within an input interval only time-dependent forces and limits change while the coordinate
    rests.
    """
    end = joint.piece.end
    if not joint.restless:
        return end

    def excess(t: float) -> float:
        return abs(joint.pull(t, x, 0.0)) - joint.limit(t, x, 0.0)

    grid: Sequence[float] = np.linspace(now, end, max(3, int(500 * (end - now)))).tolist()
    for before, after in pairwise(grid):
        if excess(after) > 0:
            return min(
                brentq(excess, before, after, xtol=1e-13) + 1e-12 if excess(before) < 0 else after,
                end,
            )
    return end
