"""Reference simulation of the ball with scipy, with any effect, from impact to impact."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, hypot, pi, sin, sqrt, tanh
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import TrueSystem
from bench.diagnosis_benchmark.case_generation.joint_reference import (
    SOLVER_TOLERANCES,
    compute_region_indicator,
)
from sims.core.simulator import Array, Scenario

REST_SPEED = 1e-5  # m/s: after slower rebounds the ball rests
UNMODELLED_CAUSES = ("updraft", "gust", "wear", "layer")
Acceleration = tuple[float, float, float]
STATES = ("x", "y", "z", "vx", "vy", "vz")
LAYER_BLUR = 0.02
"""Height over which the drag of a layer fades in, m."""
MAX_FIRST_STEP = 0.02
"""Longest first step of the solver, s."""


class Gust(NamedTuple):
    """Temporary acceleration along x and upward, m/s^2, from `begin` to `end`, s."""

    x: float
    z: float
    begin: float
    end: float


class FlightDynamics:
    """Accelerations of a ball in flight."""

    def __init__(self, true_system: TrueSystem, number: int) -> None:
        """Collect the laws of the hidden causes, and the times between which a gust blows.

        `gust` is None without a gust in this run. `breaks` are the times at which the acceleration
        jumps: the solver must not step over them.

        Args:
            true_system: true system of a case: constants, parameters and hidden effects.
            number: index of the run in the recording.
        """
        self.g = true_system.constants["gravity"]
        self.acting = true_system.effects
        # Pairs of a law of acceleration and its coefficients. The other causes act at impacts, on
        # the sensors, or for a time.
        self.laws = [
            (ACCELERATION_LAWS[name], c)
            for name, c in self.acting.items()
            if name in ACCELERATION_LAWS
        ]
        self.gust: Gust | None = None
        self.breaks: list[float] = []
        if "gust" in self.acting:
            gust_x, gust_z, duration, *start_times = self.acting["gust"]
            self.breaks = [start_times[number], start_times[number] + duration]
            self.gust = Gust(gust_x, gust_z, *self.breaks)

    def compute_acceleration(self, t: float, y: Any, middle: float) -> Acceleration:
        """Compute the acceleration (x, y, z) of a ball with hidden causes, m/s^2.

        Args:
            t: time, s.
            y: position and velocity, (6,).
            middle: a time within the integrated interval, which decides whether a gust acts: it
                begins and ends at ends of intervals.
        """
        ax, ay, az = 0.0, 0.0, -self.g
        for law, c in self.laws:
            bx, by, bz = law(c, self.g, t, *y)
            ax, ay, az = ax + bx, ay + by, az + bz
        if self.gust and self.gust.begin <= middle < self.gust.end:
            ax, az = ax + self.gust.x, az + self.gust.z
        return ax, ay, az


def _compute_quadratic_drag(c: float, u: float, v: float, w: float) -> Acceleration:
    factor = -c * sqrt(u * u + v * v + w * w)
    return factor * u, factor * v, factor * w


def _compute_wind_drag(
    c: Sequence[float],
    g: float,
    t: float,
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    w: float,
) -> Acceleration:
    """Compute the acceleration by quadratic drag in air that moves horizontally, m/s^2.

    Args:
        c: drag coefficient in 1/m, and air velocity along x and along y in m/s.
        g: gravitational acceleration, m/s^2; unused, as are time and position: all laws of
            acceleration have the same arguments.
        t: time, s.
        x: position, m.
        y: position, m.
        z: height, m.
        u: velocity along x, m/s.
        v: velocity along y, m/s.
        w: upward velocity, m/s.
    """
    u, v = u - c[1], v - c[2]
    return _compute_quadratic_drag(c[0], u, v, w)


def _compute_periodic_acceleration(
    c: Sequence[float], g: float, t: float, *state: float
) -> Acceleration:
    return 0.0, 0.0, c[0] * sin(2 * pi * c[2] * t) + c[1] * cos(2 * pi * c[2] * t)


def _compute_layer_drag(
    c: Sequence[float],
    g: float,
    t: float,
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    w: float,
) -> Acceleration:
    """Compute the acceleration by quadratic drag that acts only above a height, m/s^2.

    This is the unmodelled cause `layer`. The drag fades in over about 0.02 m (`fade_in` rises from
    0 to 1), because a jump would reduce the order of the solver.

    Args:
        c: drag coefficient in 1/m, and height in m.
        g: gravitational acceleration, m/s^2; unused, as are time and horizontal position: all laws
            of acceleration have the same arguments.
        t: time, s.
        x: position, m.
        y: position, m.
        z: height, m.
        u: velocity along x, m/s.
        v: velocity along y, m/s.
        w: upward velocity, m/s.
    """
    fade_in = 0.5 * (1 + tanh((z - c[1]) / LAYER_BLUR))
    return _compute_quadratic_drag(c[0] * fade_in, u, v, w)


ACCELERATION_LAWS: dict[str, Callable[..., Acceleration]] = {
    "drag.linear": lambda c, g, t, x, y, z, u, v, w: (-c[0] * u, -c[0] * v, -c[0] * w),
    "drag.quadratic": lambda c, g, t, x, y, z, u, v, w: _compute_quadratic_drag(c[0], u, v, w),
    "wind": _compute_wind_drag,
    "gravity.scale": lambda c, g, *s: (0.0, 0.0, -c[0] * g),
    "gravity.tilt": lambda c, g, *s: (c[0] * g, c[1] * g, 0.0),
    "force.bias": lambda c, g, *s: (0.0, 0.0, c[0]),
    "force.periodic": _compute_periodic_acceleration,
    "lift.magnus": lambda c, g, t, x, y, z, u, v, w: (-c[0] * w - c[1] * v, c[1] * u, c[0] * u),
    "updraft": lambda c, g, t, x, *s: (
        0.0,
        0.0,
        c[0] * compute_region_indicator(x, c[1], c[2]),
    ),  # unmodelled: rising air within a region of x
    "layer": _compute_layer_drag,  # unmodelled: quadratic drag above a height
}


def simulate_ball(
    true_system: TrueSystem, scenario: Scenario, number: int, instants: Array
) -> Array:
    """Simulate a run: flights between impacts, until the last sample.

    Each flight is integrated until the ball meets the ground. The first part of the rise after an
    impact is integrated without looking for the ground, because the ball starts there.

    Args:
        true_system: true system of a case: constants, parameters and hidden effects.
        scenario: scenario of the run: times, initial state, inputs and constants.
        number: index of the run in the recording.
        instants: increasing times >= 0, (T,).

    Returns:
        Positions and velocities, (T, 6).
    """
    dynamics, end_time = FlightDynamics(true_system, number), float(instants[-1])
    state = np.array([scenario.initial[name] for name in STATES])
    states = np.empty((instants.size, 6))
    states[instants <= 0] = state
    radius = true_system.constants["radius"]
    time, rise_duration, resting = 0.0, 0.0, False
    while time < end_time:
        end = min([end_time, *(instant for instant in dynamics.breaks if instant > time)])
        has_impact_event = not (rise_duration or resting)
        if rise_duration:  # the ground, where the rise after a bounce begins, is no event
            end = min(end, time + rise_duration)
        solved = _integrate_flight(
            dynamics,
            time,
            end,
            state,
            radius if has_impact_event else None,
            resting,
        )
        time_reached, state = float(solved.t[-1]), solved.y[:, -1].copy()
        # The samples after the beginning of this part, up to its end.
        first, last = np.searchsorted(instants, [time, time_reached], side="right")
        if last > first:
            states[first:last] = solved.sol(instants[first:last]).T
        time, rise_duration = time_reached, 0.0
        if has_impact_event and solved.t_events[0].size:
            state, resting = _compute_bounce(true_system, time, state)
            state[2] = radius  # the height, without the error of the event
            if not resting:
                # Seconds of the rise, 0.4 of the time to its top, in which no impact is possible.
                # An acceleration that is not downward is replaced by a small one.
                _, _, az = dynamics.compute_acceleration(time, state, time)
                rise_duration = 0.4 * state[5] / max(-az, 1e-3)
    return states


def _integrate_flight(
    air: FlightDynamics, start: float, end: float, state: Array, floor: float | None, resting: bool
) -> Any:
    """Integrate a part of a flight by the Runge-Kutta method DOP853, up to an impact or a time.

    Args:
        air: accelerations of the ball.
        start: begin, s.
        end: latest end, s.
        state: position and velocity at the begin, (6,).
        floor: height of the centre at which the ball meets the ground, m; None to look for no
            impact.
        resting: whether the ball lies on the ground, which then cancels downward accelerations.

    Returns:
        Result of `scipy.integrate.solve_ivp` with a continuous solution.

    Raises:
        RuntimeError: the solver failed.
    """
    middle = 0.5 * (start + end)  # decides whether a gust acts: an interval contains no end of one

    def rate(t: float, y: Array) -> tuple[float, ...]:
        """Return the time derivatives of position and velocity; a resting ball does not sink.

        `air` has the laws of the hidden causes, `middle` a time that tells which of them act, and
        `resting` whether the ball lies on the ground.

        Args:
            t: time, s.
            y: position (m) and velocity (m/s).
        """
        ax, ay, az = air.compute_acceleration(t, y.tolist(), middle)
        return (y[3], y[4], y[5], ax, ay, max(az, 0.0) if resting else az)

    def meets(t: float, y: Array) -> float:
        return float(y[2] - floor)

    impact_event: Any = meets
    impact_event.terminal, impact_event.direction = True, -1
    events = None if floor is None else impact_event
    settings: dict[str, Any] = {
        "dense_output": True,
        "first_step": min(MAX_FIRST_STEP, end - start),
        **SOLVER_TOLERANCES,
    }
    solved = solve_ivp(rate, (start, end), state, "DOP853", events=events, **settings)
    if not solved.success:
        raise RuntimeError(solved.message)
    return solved


def _compute_bounce(true_system: TrueSystem, t: float, state: Array) -> tuple[Array, bool]:
    """Compute the state after an impact on the ground, for which the ball needs no time.

    Restitution reverses the vertical velocity, and contact friction slows the horizontal one by at
    most the friction coefficient times the vertical impulse, (1 + e) times the impact speed.

    Args:
        true_system: true system of a case: constants, parameters and hidden effects.
        t: time of the impact, s.
        state: position and velocity before the impact, (6,).

    Returns:
        The state after it (6,), and whether the ball stays at rest because the rebound is slower
        than `REST_SPEED`.
    """
    *_, vx, vy, vz = state.tolist()
    speed, e = -vz, true_system.parameters["restitution"]
    if "restitution.speed" in true_system.effects:
        e = min(e * speed ** true_system.effects["restitution.speed"][0], 1.0)
    if "wear" in true_system.effects:  # unmodelled: restitution that decreases with time
        e = min(max(e * (1.0 - true_system.effects["wear"][0] * t), 0.0), 1.0)
    tangential_speed = hypot(vx, vy)
    speed_loss = true_system.effects.get("contact.friction", [0.0])[0] * (1 + e) * speed
    rebound_state = state.copy()
    if tangential_speed > 0:
        rebound_state[3:5] *= max(1.0 - speed_loss / tangential_speed, 0.0)
    rebound_speed = e * speed if e * speed > REST_SPEED else 0.0
    rebound_state[5] = rebound_speed
    return rebound_state, rebound_speed == 0.0
