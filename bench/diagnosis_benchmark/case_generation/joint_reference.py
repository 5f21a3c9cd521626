"""Reference simulation of pendulum and slider with scipy, with any effect or unmodelled cause.

The model has one coordinate, and events where dry friction stops it. Hidden-state effects add a
driven mass or an internal state that no sensor shows.

Every law is written here again in plain numbers, those of signals in `input_and_sensor_effects`.
Nothing is shared with the effect library, which the benchmark tests.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import copysign, cos, exp, hypot, pi, sin, tanh
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import (
    InputSegment,
    TrueSystem,
    compute_applied_input,
)
from sims.core.simulator import Array, Scenario

SOLVER_TOLERANCES: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}
INTERPOLATION_INTERVAL = 0.011  # seconds: for shorter intervals, order 5 is cheaper than order 8
# Width of a region's soft border as a fraction of its half width; a smooth border preserves the
# order of the solver.
REGION_EDGE_WIDTH = 0.05


ResistanceLaw = Callable[[float, float, float], float]
"""Function from time, position and velocity of a coordinate to a force."""
GravityForce = Callable[[float], float]
SegmentResult = tuple[float, Array, Any]
MAX_FIRST_STEPS = (0.01, 0.02)
"""Longest first step of the solver with and without dry friction, s."""
MAX_STEP = 0.05
"""Longest step of the solver, s."""


STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity in m/s^2 (ISO 80000-3)."""


class JointDynamics:
    """Equation of motion of one coordinate with effects and unmodelled causes.

    Attributes:
        inertia: generalised inertia of the drive side.
        weight: gravity force as a function of position.
        forces: laws of the acting forces.
        limits: laws of the dry friction limits.
        hidden_state_effects: hidden-state effects: driven loads and hysteresis.
    """

    def __init__(self, true_system: TrueSystem, number: int) -> None:
        """Collect the laws of the system and of its hidden causes, for one run.

        * `weight`: generalised force of gravity, by position,
        * `forces`, `limits`: laws of forces and of dry friction limits, as functions of time,
          position and velocity,
        * `inertia`: inertia of the drive side, without the loads of hidden-state effects,
        * `sideways`: generalised force of a unit horizontal acceleration, by position,
        * `latched`: whether the cause `latch` acts in this run (every other run),
        * `breaks`: times at which a gust begins and ends, s,
        * `restless`: whether forces change with time while the coordinate rests.

        Args:
            true_system: true system of a case: constants, parameters and hidden effects.
            number: index of the run in the recording.
        """
        constants, parameters = true_system.constants, true_system.parameters
        self.weight: GravityForce
        self.sideways: GravityForce
        self.latched = number % 2 == 0
        if true_system.system == "pendulum":
            arm = constants["mass"] * constants["length"]
            self.inertia, gravity = parameters["inertia"], constants["gravity"]
            self.weight = lambda x: -arm * gravity * sin(x)
            self.sideways = lambda x: arm * cos(x)
        else:
            self.inertia, gravity = parameters["mass"], STANDARD_GRAVITY
            self.weight = lambda x: 0.0
            self.sideways = lambda x: self.inertia
        self.gravity = gravity
        self.forces = [
            FORCE_EFFECTS[name](self, list(coefficients))
            for name, coefficients in true_system.effects.items()
            if name in FORCE_EFFECTS
        ]
        self.limits = [
            DRY_FRICTION_EFFECTS[name](self, list(coefficients))
            for name, coefficients in true_system.effects.items()
            if name in DRY_FRICTION_EFFECTS
        ]
        self.breaks: list[float] = []
        if "gust" in true_system.effects:
            push, duration, *start_times = true_system.effects["gust"]
            push_start = start_times[number]
            self.breaks = [push_start, push_start + duration]
            # The middle of the integrated interval decides, so that the force does not jump in it.
            self.forces.append(
                lambda t, x, v: push if push_start <= self.middle < push_start + duration else 0.0
            )
        self.restless = bool(
            {"force.periodic", "input.lag", "friction.warming"} & set(true_system.effects)
        )
        total_inertia, gravity_of_all = self.inertia, self.weight
        self.hidden_state_effects: list[Any] = [
            HIDDEN_STATE_EFFECTS[name](total_inertia, gravity_of_all, *coefficients)
            for name, coefficients in true_system.effects.items()
            if name in HIDDEN_STATE_EFFECTS
        ]
        # Loads behind a transmission are parts of the total inertia.
        self.inertia = total_inertia - sum(part.inertia for part in self.hidden_state_effects)

    def set_input_segment(self, segment: InputSegment) -> None:
        """Set the input interval in which the motion is integrated, before the integration starts.

        A gust acts in the whole interval or not at all, which the time in its middle decides.

        Args:
            segment: part of an input interval that contains no begin or end of a gust.
        """
        self.segment, self.middle = segment, 0.5 * (segment.begin + segment.end)

    def drive(self, t: float) -> float:
        """Return the force of the drive, the applied input, at a time."""
        return self.segment.evaluate(t)

    def compute_force(self, t: float, x: float, v: float, *z: float) -> float:
        """Compute the force on the coordinate, without dry friction, in N or N·m.

        It is the sum of the applied input, gravity, the laws of the effects, and the reactions of
        driven loads and hysteresis.

        Args:
            t: time.
            x: position.
            v: velocity.
            *z: states of the hidden-state effects (driven loads, hysteresis), two for each.
        """
        total = self.drive(t) + self.weight(x)
        for force in self.forces:
            total += force(t, x, v)
        for part, part_states in zip(self.hidden_state_effects, pair_up(z), strict=True):
            total += part.force(x, v, *part_states)
        return total

    def compute_hidden_rates(self, x: float, v: float, *z: float) -> list[float]:
        """Compute the time derivatives of the states of the hidden-state effects.

        Args:
            x: position.
            v: velocity.
            *z: states of the hidden-state effects (driven loads, hysteresis), two for each.

        Returns:
            Derivatives in the order of `z`.
        """
        parts = zip(self.hidden_state_effects, pair_up(z), strict=True)
        return [rate for part, part_states in parts for rate in part.rates(x, v, *part_states)]

    def compute_friction_limit(self, t: float, x: float, v: float) -> float:
        """Compute the dry friction limit: the sum of all laws that act.

        It is the friction force of a moving coordinate, and the force that a resting one resists.

        Args:
            t: time.
            x: position.
            v: velocity.
        """
        return sum(limit(t, x, v) for limit in self.limits)


def pair_up(z: Sequence[float]) -> list[tuple[float, float]]:
    """Group values in pairs, because each hidden-state effect has two states."""
    return list(zip(z[::2], z[1::2], strict=True))


class ReferenceLoad(ABC):
    """Load behind a transmission: `share` of the inertia and of the weight.

    The sensor shows the motion of the drive side, x and v; the load has the states y and w.
    """

    def __init__(self, inertia: float, weight: GravityForce, share: float) -> None:
        """Store the total inertia and weight, and compute the inertia of the load.

        Args:
            inertia: inertia of drive side and load together.
            weight: gravity force of both together, as a function of position.
            share: fraction of both that belongs to the load.
        """
        self.total_inertia, self.inertia, self.weight = inertia, share * inertia, weight
        self.share = share

    @abstractmethod
    def compute_load_acceleration(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by the drive side.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """

    def force(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the force of the load on the drive side.

        It is the reaction to the force that accelerates the load. The part of the weight that
        belongs to the load is subtracted, since `JointDynamics` adds all the weight to the drive
        side.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """
        return -self.inertia * self.compute_load_acceleration(
            x, v, y, w
        ) - self.share * self.weight(x)

    def rates(self, x: float, v: float, y: float, w: float) -> tuple[float, float]:
        """Compute the time derivatives of the load's states: its velocity and its acceleration.

        The acceleration by the drive side does not include gravity. Gravity accelerates drive side
        and load alike, by the weight of both over the inertia of both.

        Args:
            x: position of the drive side.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.

        Returns:
            y' and w'.
        """
        return w, self.compute_load_acceleration(x, v, y, w) + self.weight(y) / self.total_inertia


class FlexibleReferenceLoad(ReferenceLoad):
    """Load on a spring, with `frequency` rad/s when the drive side is fixed."""

    def __init__(
        self, inertia: float, weight: GravityForce, share: float, frequency: float, ratio: float
    ) -> None:
        """Store frequency and damping ratio of the load on its spring.

        Args:
            inertia: inertia of drive side and load together.
            weight: gravity force of both together, as a function of position.
            share: fraction of both that belongs to the load.
            frequency: natural frequency of the load with a fixed drive side, rad/s.
            ratio: damping ratio of that oscillation.
        """
        super().__init__(inertia, weight, share)
        self.frequency, self.ratio = frequency, ratio

    def get_initial_state(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state of the load, with the static deflection of the spring.

        Args:
            x: initial position of the drive side, rad or m.
            v: its initial velocity.
        """
        return x + self.weight(x) / self.total_inertia / self.frequency**2, v

    def compute_load_acceleration(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by spring and damper; see `ReferenceLoad`.

        With the natural frequency f and the damping ratio d, it is f^2 (x - y) + 2 d f (v - w).

        Args:
            x: position of the drive side, rad or m.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """
        return self.frequency**2 * (x - y) + 2 * self.ratio * self.frequency * (v - w)


class BacklashReferenceLoad(ReferenceLoad):
    """Load behind backlash, with stiff damped flanks that never pull."""

    def __init__(self, inertia: float, weight: GravityForce, gap: float, share: float) -> None:
        """Store the gap and the share of the load.

        Args:
            inertia: inertia of drive side and load together.
            weight: gravity force of both together, as a function of position.
            gap: whole width of the gap, m or rad.
            share: fraction of inertia and weight that belongs to the load.
        """
        super().__init__(inertia, weight, share)
        self.gap = gap

    def get_initial_state(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state of the load, centred in the gap.

        Args:
            x: initial position of the drive side, rad or m.
            v: its initial velocity.
        """
        return x, v

    def compute_load_acceleration(self, x: float, v: float, y: float, w: float) -> float:
        """Compute the acceleration of the load by the flank in contact; see `ReferenceLoad`.

        The flank is a spring with a damper. With the excess d over half of the gap, the relative
        velocity w in the direction of contact and k = 150 rad/s, the acceleration is

            (1 - share) (k^2 d + 4 k w d / (d + gap / 100)), but never a pull.

        Args:
            x: position of the drive side, rad or m.
            v: velocity of the drive side.
            y: position of the load.
            w: velocity of the load.
        """
        excess = abs(x - y) - self.gap / 2
        if excess <= 0:
            return 0.0
        # 22500 = k^2 and 600 = 4 k; at the depth gap / 100, half of the damping acts.
        side = copysign(1.0, x - y)
        damping_term = 600 * (v - w) * excess / (excess + self.gap / 100)
        contact_acceleration = side * (1 - self.share) * (22500 * side * excess + damping_term)
        return side * max(contact_acceleration, 0.0)


class DahlReferenceFriction:
    """Dahl friction: the surfaces yield over `deflection`; its state is a fraction of the limit."""

    inertia = 0.0

    def __init__(
        self, inertia: float, weight: GravityForce, limit: float, deflection: float
    ) -> None:
        """Store the friction limit, and the deflection over which friction builds up.

        Args:
            inertia: unused; the parameter exists for all hidden-state effects.
            weight: unused.
            limit: largest friction force.
            deflection: distance, m or rad.
        """
        self.limit, self.deflection = limit, deflection

    def get_initial_state(self, x: float, v: float) -> tuple[float, float]:
        """Return the initial state, without strain.

        Args:
            x: unused.
            v: unused.
        """
        return 0.0, 0.0

    def force(self, x: float, v: float, _: float, strain: float) -> float:
        """Compute the friction force on the mass.

        All hidden-state effects have the same arguments; of these, only `strain` is used.

        Args:
            x: position.
            v: velocity.
            _: first hidden state.
            strain: second hidden state, the friction force as a fraction of its limit.
        """
        return -self.limit * strain

    def rates(self, x: float, v: float, _: float, strain: float) -> tuple[float, float]:
        """Compute the time derivatives of the two states by Dahl's law.

        The law is strain' = (sign v - strain) |v| / deflection. The first state is unused, because
        every hidden-state effect has two.

        Args:
            x: position.
            v: velocity.
            strain: friction force as a fraction of its limit.

        Returns:
            0 for the unused state, and strain'.
        """
        # At most 400 1/s, as in the library: far above visible rates, but it can be integrated.
        speed = min(abs(v) / self.deflection, 400.0)
        return 0.0, speed * (copysign(1.0, v) - strain)


HIDDEN_STATE_EFFECTS: dict[str, Callable[..., Any]] = {
    "joint.flexibility": FlexibleReferenceLoad,
    "joint.backlash": BacklashReferenceLoad,
    "friction.hysteresis": DahlReferenceFriction,
}


def _compute_wave(c: Sequence[float], cycles: float) -> float:
    return c[0] * sin(2 * pi * cycles) + c[1] * cos(2 * pi * cycles)


FORCE_EFFECTS: dict[str, Callable[[Any, Sequence[float]], ResistanceLaw]] = {
    "drag.linear": lambda j, c: lambda t, x, v: -c[0] * v,
    "drag.quadratic": lambda j, c: lambda t, x, v: -c[0] * abs(v) * v,
    "friction.direction": lambda j, c: lambda t, x, v: -c[0] * max(v, 0.0) - c[1] * min(v, 0.0),
    "wind": lambda j, c: lambda t, x, v: -c[0] * abs(v - c[1]) * (v - c[1]),
    "gravity.scale": lambda j, c: lambda t, x, v: c[0] * j.weight(x),
    "gravity.tilt": lambda j, c: lambda t, x, v: c[0] * j.gravity * j.sideways(x),
    "supply.sag": lambda j, c: lambda t, x, v: j.drive(t) * (1 / (1 + c[0] * abs(j.drive(t))) - 1),
    "supply.braking": lambda j, c: lambda t, x, v: -c[0] * j.drive(t) * (j.drive(t) * v < 0),
    "spring.linear": lambda j, c: lambda t, x, v: -c[0] * x,
    "spring.cubic": lambda j, c: lambda t, x, v: -c[0] * x**3,
    "force.bias": lambda j, c: lambda t, x, v: c[0],
    "force.ripple": lambda j, c: lambda t, x, v: _compute_wave(c, x / c[2]),
    "force.periodic": lambda j, c: lambda t, x, v: _compute_wave(c, t * c[2]),
    "ageing": lambda j, c: lambda t, x, v: -c[0] * t * v,  # unmodelled: damping grows with time
    "state.limit": lambda j, c: (
        lambda t, x, v: -copysign(1.0, c[0]) * compute_end_stop_force(x, v, *c)
    ),
    "latch": lambda j, c: (
        lambda t, x, v: -c[0] * max(x - c[1], 0.0) if j.latched else 0.0
    ),  # unmodelled: a soft end stop in every other run
}
DRY_FRICTION_EFFECTS: dict[str, Callable[[Any, Sequence[float]], ResistanceLaw]] = {
    "friction.coulomb": lambda j, c: lambda t, x, v: c[0],
    "friction.stribeck": lambda j, c: lambda t, x, v: c[0] + c[1] * exp(-((v / c[2]) ** 2)),
    "friction.load": lambda j, c: lambda t, x, v: c[0] * abs(j.drive(t) - j.weight(x)),
    "friction.load_direction": lambda j, c: (
        lambda t, x, v: abs(c[0] * j.drive(t) - c[1] * j.weight(x))
    ),
    "friction.load_quadratic": lambda j, c: (
        lambda t, x, v: (
            c[0] * abs(j.drive(t) - j.weight(x))
            + c[1] * compute_transmitted_force(j.drive(t), -j.weight(x)) ** 2
        )
    ),
    "friction.position": lambda j, c: (
        lambda t, x, v: c[0] + hypot(c[1], c[2]) + _compute_wave(c[1:], x / c[3])
    ),
    "friction.warming": lambda j, c: lambda t, x, v: (c[0] + c[1] * abs(v)) * exp(-t / c[2]),
    "patch": lambda j, c: (
        lambda t, x, v: c[0] * compute_region_indicator(x, c[1], c[2])
    ),  # unmodelled: dry friction from c1 - c2 to c1 + c2
}
UNMODELLED_CAUSES = ("patch", "gust", "ageing", "latch")


def compute_transmitted_force(drive: float, against: float) -> float:
    """Compute the magnitude of the force that gears transmit from the drive to the load.

    It is the smaller one of both forces if they oppose each other, otherwise zero.

    Args:
        drive: force of the drive, N or N·m.
        against: force of the load, N or N·m, counted in the opposite direction: with equal signs
            both forces oppose each other.
    """
    return min(abs(drive), abs(against)) if drive * against > 0 else 0.0


def compute_end_stop_force(
    x: float, v: float, stiffness: float, position: float, loss: float
) -> float:
    """Compute the magnitude of the force of an end stop, by Hertz's contact law.

    Args:
        x: position.
        v: velocity.
        stiffness: force at a depth of 0.01 (m or rad), divided by that depth; its sign is the side
            of the stop.
        position: position of the stop.
        loss: damping, as a factor of the approach velocity, s/m or s/rad.

    Returns:
        |stiffness| depth^1.5 / 0.1 (1 + loss approach velocity), in N or N·m; never a pull.
    """
    # 0.1 is the root of the depth 0.01, so that the force there is stiffness times depth.
    side = copysign(1.0, stiffness)
    depth = max(side * (x - position), 0.0)
    depth_power: float = depth**1.5
    return abs(stiffness) * depth_power / 0.1 * max(1.0 + loss * side * v, 0.0)


def compute_region_indicator(x: float, centre: float, half: float) -> float:
    """Return 1 inside a region and 0 outside, with soft borders.

    The integral over x is the width of the region.

    Args:
        x: position.
        centre: centre of the region.
        half: half width of the region.
    """
    return 0.5 * (
        tanh((x - centre + half) / (REGION_EDGE_WIDTH * half))
        - tanh((x - centre - half) / (REGION_EDGE_WIDTH * half))
    )


def simulate_joint(
    true_system: TrueSystem, scenario: Scenario, number: int, instants: Array
) -> Array:
    """Simulate one run of a joint with a hidden cause.

    The input is constant or smooth within each of its intervals, which are divided further where a
    gust begins or ends: the solver would lose its accuracy at a jump.

    Args:
        true_system: true system of a case: constants, parameters and hidden effects.
        scenario: scenario of the run: times, initial state, inputs and constants.
        number: index of the run in the recording.
        instants: increasing times >= 0, (T,).

    Returns:
        Positions and velocities, (T, 2).
    """
    joint, end_time = JointDynamics(true_system, number), float(instants[-1])
    names = ("q", "qd") if true_system.system == "pendulum" else ("x", "v")
    state = np.array([scenario.initial[name] for name in names])
    hidden_states = [
        value for effect in joint.hidden_state_effects for value in effect.get_initial_state(*state)
    ]
    state = np.concatenate([state, hidden_states])
    states = np.empty((instants.size, 2))
    states[instants <= 0] = state[:2]
    for segment in compute_applied_input(scenario, true_system.effects, end_time):
        boundaries = [
            segment.begin,
            *(time for time in sorted(joint.breaks) if segment.begin < time < segment.end),
            segment.end,
        ]
        for start, end in pairwise(boundaries):
            joint.set_input_segment(segment.slice(start, end))
            state = _integrate_segment(joint, state, instants, states)
    return states


def _integrate_segment(joint: JointDynamics, state: Array, instants: Array, states: Array) -> Array:
    """Integrate to the end of the input interval, from one standstill to the next.

    Args:
        joint: the equation of motion, with its input interval.
        state: position, velocity and hidden states at the beginning of the interval.
        instants: times of the samples, (T,).
        states: receives positions and velocities at the samples within the interval, (T, 2).

    Returns:
        State at the end.

    Raises:
        RuntimeError: the joint stops more than 10,000 times in the interval.
    """
    time, end = joint.segment.begin, joint.segment.end
    for _ in range(10_000):
        if time >= end:
            return state
        time_reached, end_state, solution = _integrate_until_stop(joint, time, state)
        first, last = np.searchsorted(instants, [time, time_reached], side="right")
        if last > first:
            # Without a solution the coordinate rests; hidden states are not returned.
            states[first:last] = solution(instants[first:last]).T[:, :2] if solution else state[:2]
        time, state = time_reached, end_state
    raise RuntimeError("no solution: the joint stops too often")


def _integrate_until_stop(joint: JointDynamics, start: float, state: Array) -> SegmentResult:
    """Integrate until the next standstill, break-away or end of the input interval.

    A resting coordinate that dry friction can hold is not moved: only its hidden states are
    integrated, or the time of break-away (at which it begins to slide) is searched. Otherwise it
    moves, from rest in the direction of the force.

    Args:
        joint: the equation of motion, with its input interval.
        start: begin, s.
        state: position, velocity and hidden states.

    Returns:
        End time, state at that time, and the dense solution (None without motion).
    """
    x, v, *z = state
    direction = copysign(1.0, v) if v else 0.0
    if joint.limits and v == 0.0:  # dry friction, and the coordinate rests
        force = joint.compute_force(start, x, 0.0, *z)
        if abs(force) <= joint.compute_friction_limit(start, x, 0.0):
            if z:
                return _integrate_stuck(joint, start, state)
            # Without hidden states nothing moves, so there is nothing to integrate.
            return _find_break_away(joint, start, x), state, None
        direction = copysign(1.0, force)
    return _integrate_motion(joint, start, state, direction)


def _integrate_motion(
    joint: JointDynamics, start: float, state: Array, direction: float
) -> SegmentResult:
    """Integrate a moving coordinate until its next standstill or the end of the input interval.

    Dry friction opposes the direction of motion, and an event stops the integration when the
    velocity changes its sign. Without dry friction, there is no such event.

    Args:
        joint: the equation of motion, with its input interval.
        start: begin, s.
        state: position, velocity and hidden states.
        direction: direction of motion, +1 or -1; 0 at rest without dry friction.

    Returns:
        End time, state at that time, and the dense solution.

    Raises:
        RuntimeError: the solver failed.
    """
    end = joint.segment.end

    def compute_derivatives(t: float, y: Array) -> list[float]:
        """Return the time derivatives of position, velocity and hidden states.

        Dry friction is `dry_friction`, with the fixed sign `direction` of the motion, so that the
        right-hand side is smooth.

        Args:
            t: time, s.
            y: position, velocity and hidden states.
        """
        dry_friction = direction * joint.compute_friction_limit(t, *y[:2]) if joint.limits else 0.0
        return [
            y[1],
            (joint.compute_force(t, *y) - dry_friction) / joint.inertia,
            *joint.compute_hidden_rates(*y),
        ]

    def compute_directed_velocity(t: float, y: Array) -> float:
        return float(direction * y[1])

    stop_event: Any = compute_directed_velocity
    stop_event.terminal, stop_event.direction = True, -1  # positive before the stop
    events = stop_event if joint.limits else None
    with_friction, without_friction = MAX_FIRST_STEPS
    max_first_step = with_friction if joint.limits else without_friction
    settings: dict[str, Any] = {
        "dense_output": True,
        "max_step": MAX_STEP,
        "first_step": min(max_first_step, end - start),
        **SOLVER_TOLERANCES,
    }
    # In a short interval, the method of order 5 costs less than the one of order 8.
    method: Any = "RK45" if end - start < INTERPOLATION_INTERVAL else "DOP853"
    solved = solve_ivp(compute_derivatives, (start, end), state, method, events=events, **settings)
    if not solved.success:
        raise RuntimeError(solved.message)
    end_state = solved.y[:, -1].copy()
    # At a standstill the velocity is exactly zero, by which the next call recognises it.
    if joint.limits and solved.t_events is not None and solved.t_events[0].size:
        end_state[1] = 0.0
    return float(solved.t[-1]), end_state, solved.sol


def _integrate_stuck(joint: JointDynamics, start: float, state: Array) -> SegmentResult:
    """Integrate the hidden states while dry friction holds the coordinate, until it breaks away.

    Args:
        joint: the equation of motion, with its input interval.
        start: begin, s.
        state: position, velocity (zero) and hidden states.

    Returns:
        End time, state at that time, and the dense solution.
    """
    end = joint.segment.end

    def rate(t: float, y: Array) -> list[float]:
        return [0.0, 0.0, *joint.compute_hidden_rates(*y)]

    def excess(t: float, y: Array) -> float:
        """Return by how much the force exceeds the friction limit; zero is the break-away event.

        Args:
            t: time, s.
            y: position, velocity and hidden states.
        """
        x, v, *_ = y
        # Slightly above the limit: at the limit, the coordinate would still count as held.
        return abs(joint.compute_force(t, *y)) - joint.compute_friction_limit(t, x, v) * (1 + 1e-9)

    break_away_event: Any = excess
    break_away_event.terminal, break_away_event.direction = True, 1
    # Short steps, s, because the solver looks for events only between them.
    settings: dict[str, Any] = {"dense_output": True, "max_step": 0.01, **SOLVER_TOLERANCES}
    solved = solve_ivp(rate, (start, end), state, "RK45", events=break_away_event, **settings)
    return float(solved.t[-1]), solved.y[:, -1].copy(), solved.sol


def _find_break_away(joint: JointDynamics, start: float, x: float) -> float:
    """Find the time at which the coordinate breaks away, or the end of the input interval.

    It breaks away when the force exceeds the friction limit. A grid of times brackets that instant,
    and Brent's method finds it. Within an input interval only time-dependent forces and limits
    change while the coordinate rests.

    Args:
        joint: equation of motion in the present input interval.
        start: time from which the coordinate rests, s.
        x: position at which it rests, rad or m.
    """
    end = joint.segment.end
    if not joint.restless:
        return end

    def excess(t: float) -> float:
        return abs(joint.compute_force(t, x, 0.0)) - joint.compute_friction_limit(t, x, 0.0)

    # About 500 grid points per second.
    grid: Sequence[float] = np.linspace(start, end, max(3, int(500 * (end - start)))).tolist()
    for left_time, right_time in pairwise(grid):
        if excess(right_time) > 0:
            if excess(left_time) >= 0:  # no change of sign, which Brent's method needs
                return right_time
            # Slightly after the root: at the root, the coordinate would still count as held.
            return min(brentq(excess, left_time, right_time, xtol=1e-13) + 1e-12, end)
    return end
