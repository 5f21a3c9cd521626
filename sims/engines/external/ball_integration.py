"""Integrate a ball with an engine: impacts at their exact time, or the engine's own contact model.

`integrate_ball` has impacts at their exact time, which the engine's contact solver computes.

In flight the engine's velocity w belongs to the time half a step before the position (see
`sims.engines.external.external_engine`): with acceleration a, a step of length h is

    w' = v + h/2 a                                                         (1)
    x' = x + h w'                                                          (2)
    v' = w' + h/2 a'                                                       (3)

where the engine adds gravity g itself and receives the additional force per unit mass that leads to
(1):

    f = (v + h/2 a - w) / h - g                                            (4)

Under gravity alone this is the exact parabola. A step that would pass the ground is cut at the
impact: from height H above the ground, with upward speed u and upward acceleration l, the impact is

    s = (u + r) / -l = 2 H / (r - u),    r = sqrt(u^2 - 2 l H)             (5)

seconds away. There the engine solves the contact in a separate step, of which only the change of
velocity is used, and the rest of the step follows. The error of an impact is therefore that of the
flight: of second order in h, and zero under gravity alone.

The condition for the end of bouncing is that of the batch engine
(`sims.engines.compiled.ground_impacts`).

`integrate_native_ball` uses the engine's own contact model. The result is of first order in the
step. Effects act through their force at the beginning of each step. Their contact parameters are
set when the next step may bring the ball to the ground. The smooth acceleration in flight, which no
engine reports, is

    a = g + f - k v (1 + |v|)                                              (6)

with f the effects' force per unit mass and k the engine's air damping
(`systems.ball_bullet_world`). There is no vertical acceleration where the ball rests.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from sims.core.effect import Contact
from sims.core.simulator import Array
from sims.core.system import StateSnapshot
from sims.engines.compiled.ground_impacts import (
    MAX_SHORT_FLIGHTS,
    MIN_FLIGHT_SECONDS,
    SHORT_FLIGHT_SECONDS,
)
from sims.engines.external.element_forces import ElementForces, Vector
from sims.engines.external.external_engine import ElementWork, Trajectory

BallState = tuple[Vector, Vector]
"""Position and the engine's velocity."""


def get_gravity(element: ElementWork) -> Vector:
    """Return the acceleration of gravity (x, y, z) of a system of kind ``point``, m/s^2.

    It is constant, so that it is evaluated at the origin, at rest and without inputs.
    """
    start = np.zeros((1, 1))
    zeros = np.zeros((1, 3))
    moment = StateSnapshot(
        element.system, element.theta, element.constants, start, zeros, zeros, {}
    )
    weight: list[float] = element.system.weight(moment)[0].tolist()
    return weight


def make_trajectory(element: ElementWork, rows: list[tuple[float, ...]]) -> Trajectory:
    """Split recorded states into positions, velocities and accelerations.

    If a state is missing, because the integration failed, all numbers are NaN.

    Args:
        element: integrated batch element.
        rows: position, velocity and acceleration, nine numbers for each recorded state.

    Returns:
        Positions, velocities and accelerations (N, 3) in N recorded states.
    """
    if len(rows) < element.recorded_steps.size:
        rows = [(math.nan,) * 9] * element.recorded_steps.size
    table = np.array(rows)
    return table[:, :3], table[:, 3:6], table[:, 6:]


_NO_TIME = 1e-12
"""Duration in seconds that is too short for a step."""
CONTACT_PENETRATION = 1e-9
"""Depth in metres at which a ball is placed inside the ground for contact.

It is larger than rounding, so that contact certainly acts.
"""


class BallBody(Protocol):
    """Ball in an engine; vectors are x, y, z, and forces are per unit mass."""

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare the world for a rollout, independent of the previous one."""
        ...

    def set_step(self, step: float) -> None:
        """Set the step in seconds."""
        ...

    def set_state(self, x: Vector, w: Vector) -> None:
        """Set the position and the engine's velocity.

        Args:
            x: position, m.
            w: velocity at the time half a step before, m/s.
        """
        ...

    def advance(self, force: Vector) -> BallState:
        """Advance by one step with a force per unit mass (m/s^2) in addition to gravity."""
        ...


class BallWithImpacts(BallBody, Protocol):
    """Ball over level ground."""

    def solve_impact(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """Return the velocity after the engine's contact with the ground at x.

        Nothing else moves. `set_state` must be called afterwards.

        Args:
            x: position at the impact.
            v: velocity before the impact.
            restitution: restitution coefficient.
            friction: friction coefficient.
        """
        ...

    def set_resting_contact(self) -> None:
        """Set contact that only supports the resting ball; `set_state` must be called next."""
        ...


def integrate_ball(ball: BallWithImpacts, element: ElementWork) -> Trajectory:
    """Integrate one batch element, a ball, with impacts at their exact times.

    A ball that diverges ends the integration early.

    Args:
        ball: Ball in the engine.
        element: Batch element: initial state, steps, constants and effects, in arrays of one row.

    Returns:
        Positions, velocities and accelerations (N, 3) in N recorded states; NaN if the integration
        failed.
    """
    ball.reset_world(element.plain_constants)
    rollout = BallRollout(ball, element)
    recorded_steps = set(element.recorded_steps.tolist())
    recorded_states = [rollout.state]
    for number, step in enumerate(element.steps[0].tolist(), start=1):
        rollout.advance(step)
        if number in recorded_steps:
            recorded_states.append(rollout.state)
            # The missing states make the whole trajectory NaN.
            if not math.isfinite(sum(rollout.state)):
                break
    return make_trajectory(element, recorded_states)


class BallRollout:
    """Rollout of one ball.

    Attributes:
        x: position.
        v: velocity.
        a: acceleration.
        lift: vertical acceleration without the ground.
        w: the engine's velocity; None when it must be set again.
        step: the engine's step in seconds; NaN when it must be set again.
        rests: whether the ball rests on the ground.
        time: seconds since the start.
    """

    def __init__(self, ball: BallWithImpacts, element: ElementWork) -> None:
        """Set the ball to its initial state; it rests if it lies still on the ground.

        Args:
            ball: Ball in the engine, with impacts at their exact time.
            element: Initial state, constants, inputs and steps, in arrays of one row.
        """
        self._ball = ball
        self._forces = ElementForces(element, 1)
        self._short_flights = 0
        self._gravity = get_gravity(element)
        self._floor = float(element.system.floor(element.constants)[0, 0])
        x, y, z = element.x[0].tolist()
        self.x: Vector = x, y, max(z, self._floor)  # not inside the ground
        self.v: Vector = element.v[0].tolist()
        self.a = self._gravity
        self.lift = self._gravity[2]
        self.w: Vector | None = None
        self.step = math.nan
        self.rests = False
        self.time = 0.0
        self._update_acceleration()
        if self._time_to_ground() == 0.0 and self.v[2] == 0.0:
            self._begin_rest()
            self._update_acceleration()

    @property
    def state(self) -> tuple[float, ...]:
        """Position, velocity and acceleration."""
        return (*self.x, *self.v, *self.a)

    def advance(self, step: float) -> None:
        """Advance by one step of `step` seconds; it is divided at the impacts that it contains."""
        # A resting ball that is pulled upward takes off.
        if self.rests and self.lift > 0.0:
            self.rests = False
            self.w = None  # the engine's state must be set again
            self._update_acceleration()
        if self.rests or self._time_to_ground() >= step:
            self._advance_without_impact(step)
        else:
            self.advance_with_impacts(step)

    def advance_with_impacts(self, remaining: float) -> None:
        """Advance by a step that contains impacts.

        The engine flies to each impact in a step of its own, the impact is computed, and the rest
        of the step follows, which may contain further impacts. A resting ball has none.

        Args:
            remaining: length of the step in seconds.
        """
        while remaining > _NO_TIME:
            time_to_impact = math.inf if self.rests else self._time_to_ground()
            if time_to_impact > _NO_TIME:
                part = min(time_to_impact, remaining)
                self._advance_without_impact(part)
            # No impact is left in the step, which is finished.
            if time_to_impact >= remaining:
                return
            remaining -= time_to_impact
            self._apply_impact()

    def _prepare_step(self, step: float) -> Vector:
        """Set the engine's step, and its state if necessary; return the engine's velocity.

        The engine's velocity belongs to half a step before the position, so it depends on the step.
        """
        if step != self.step:
            self._ball.set_step(step)
            self.step = step
            self.w = None
        if self.w is None:
            # The velocity half a step earlier: w = v - h/2 a.
            half_step = 0.5 * step
            vx, vy, vz = self.v
            ax, ay, az = self.a
            self.w = vx - half_step * ax, vy - half_step * ay, vz - half_step * az
            self._ball.set_state(self.x, self.w)
        return self.w

    def _advance_without_impact(self, step: float) -> None:
        """Advance by one step of `step` seconds in flight or at rest.

        With the velocity v and the acceleration a at the position, the engine's velocity w belongs
        to the time half a step earlier. The applied force per unit mass in addition to gravity g,
        (v + h/2 a - w) / h - g (4), makes w' = v + h/2 a. The velocity after the step,
        v' = w' + h/2 a' (3), is then of second order in the step h.
        """
        half_step = 0.5 * step
        wx, wy, wz = self._prepare_step(step)
        vx, vy, vz = self.v
        ax, ay, az = self.a
        gx, gy, gz = self._gravity
        # (4); at rest the engine's contact balances any force that presses the ball on the ground.
        lift = self.lift - gz if self.rests else (vz + half_step * az - wz) / step - gz
        force_x = (vx + half_step * ax - wx) / step - gx
        force_y = (vy + half_step * ay - wy) / step - gy
        self.x, self.w = self._ball.advance((force_x, force_y, lift))
        self.time += step
        wx, wy, wz = self.w
        # The acceleration at the end is evaluated at the velocity that (3) gives with the
        # acceleration at the beginning; then (3) is evaluated with the result.
        self.v = 2.0 * wx - vx, 2.0 * wy - vy, 0.0 if self.rests else 2.0 * wz - vz
        self._update_acceleration()
        ax, ay, az = self.a
        self.v = (
            wx + half_step * ax,
            wy + half_step * ay,
            0.0 if self.rests else wz + half_step * az,
        )

    def _update_acceleration(self) -> None:
        """Evaluate the acceleration at the present state; at rest the vertical one is zero."""
        ax, ay, az = self._gravity
        if self._forces.acts:  # forces per unit mass, with gravity
            ax, ay, az = self._forces.evaluate(self.time, self.x, self.v)
        self.lift = az
        self.a = ax, ay, 0.0 if self.rests else az

    def _time_to_ground(self) -> float:
        """Return the seconds until the ball meets the ground with its present acceleration.

        From height H with upward speed u and upward acceleration l, it is (u + r) / -l =
        2 H / (r - u), r = sqrt(u^2 - 2 l H) (5). Of these equal forms, the one without cancellation
        is used. It is inf for a ball that never meets the ground, and for one at rest on it.
        """
        gap = max(self.x[2] - self._floor, 0.0)
        rate = self.v[2]
        lift = self.a[2]
        discriminant = rate * rate - 2.0 * lift * gap
        # It rises, or is still and begins to fall.
        if rate > 0.0 or (rate == 0.0 and lift < 0.0):
            return (rate + math.sqrt(discriminant)) / -lift if lift < 0.0 else math.inf
        # It sinks, but turns above the ground; or it stays still, or is still and begins to rise.
        if discriminant < 0.0 or (rate == 0.0 and lift >= 0.0):
            return math.inf
        # It sinks to the ground: at once if it is there.
        return 2.0 * gap / (math.sqrt(discriminant) - rate)

    def _apply_impact(self) -> None:
        """Compute one impact with the engine's contact solver, when the ball touches the ground.

        After the last impact the ball rests; then it slides or lies on the ground.
        """
        speed = -self.v[2]
        self.w = None  # contact changes the velocity, so the engine's state must be set again
        restitution, friction, is_last = self._compute_impact(max(speed, 0.0), -self.a[2])
        if speed > 0.0:
            self.v = self._ball.solve_impact(self.x, self.v, restitution, friction)
            self.step = math.nan  # the engine's step is still that of the contact
        if is_last:
            self._begin_rest()
        self._update_acceleration()

    def _compute_impact(self, speed: float, down: float) -> tuple[float, float, bool]:
        """Return the parameters of an impact, and whether bouncing ends with it.

        With restitution e, friction mu and normal speed n, the ball rebounds with n' = e n and
        flies for 2 n' / down seconds. Bouncing ends if this is too short, or after many short
        flights. Then the ball does not rebound, and this impact removes the tangential speed that
        it and all omitted ones would remove: mu (1 + e) n and mu (1 + e) n' / (1 - e).

        Args:
            speed: normal speed before the impact in m/s.
            down: downward acceleration in m/s^2.

        Returns:
            Restitution, friction coefficient, and whether bouncing is finished.
        """
        restitution, friction = self._forces.compute_impact(speed)
        rebound_speed = restitution * speed
        flight = 2.0 * rebound_speed / down if down > 0.0 else math.inf
        self._short_flights = self._short_flights + 1 if flight < SHORT_FLIGHT_SECONDS else 0
        if flight >= MIN_FLIGHT_SECONDS and self._short_flights <= MAX_SHORT_FLIGHTS:
            return restitution, friction, False
        # Engines remove mu (1 + e) n with the returned e, which is 0. Therefore the factor 1 + e,
        # and the sum n' / (1 - e) of the speeds of omitted impacts, are included in the friction.
        omitted_speed = rebound_speed / (1.0 - restitution) if restitution < 1.0 else 0.0
        total = friction * (1.0 + restitution) * (1.0 + omitted_speed / speed) if speed else 0.0
        return 0.0, total, True

    def _begin_rest(self) -> None:
        """Put the ball on the ground without normal velocity, in continuous contact from now on."""
        self.rests = True
        # Slightly inside the ground, so that the engine's contact acts from the first step on.
        x, y, z = self.x
        self.x = x, y, min(z, self._floor - CONTACT_PENETRATION)
        self.v = self.v[0], self.v[1], 0.0
        self._ball.set_resting_contact()


_MAX_RESTING_SPEED = 0.2
"""Speed in m/s below which Bullet treats a ball on the ground as resting."""


class NativeContactBall(BallBody, Protocol):
    """Ball over level ground in an engine."""

    damping: float
    """Coefficient of the engine's air damping: -damping v (1 + |v|), in m/s^2."""

    def set_contact_parameters(self, restitution: float, friction: float) -> None:
        """Set restitution and friction coefficient of the following impacts."""
        ...

    def is_near_contact(self, gap: float) -> bool:
        """Return whether contact may act with the ball's lowest point `gap` m above the ground."""
        ...


def integrate_native_ball(ball: NativeContactBall, element: ElementWork) -> Trajectory:
    """Integrate one batch element, a ball, with the engine's own contact model.

    The smooth acceleration is g + f - k v (1 + |v|), with the effects' force f per unit mass and
    the engine's air damping k (6).

    Args:
        ball: Ball in the engine, with the engine's own contact.
        element: Batch element: initial state, steps, constants and effects, in arrays of one row.

    Returns:
        Positions, velocities and accelerations (N, 3) in N recorded states; NaN if the integration
        failed.
    """
    # Unlike in `BallRollout`, velocity and contact of the engine are used without correction.
    forces = ElementForces(element, 1)
    changes_impacts = any(isinstance(effect, Contact) for effect, _ in element.effects)
    gx, gy, gz = get_gravity(element)

    def compute_force(t: float, x: Vector, v: Vector) -> Vector:
        """Compute the force in addition to gravity, which the engine applies itself.

        The force program includes gravity, so that it is subtracted. All values are per
        unit mass.

        Args:
            t: time since the start, s.
            x: position, m.
            v: velocity, m/s.
        """
        if not forces.acts:
            return 0.0, 0.0, 0.0
        fx, fy, fz = forces.evaluate(t, x, v)
        return fx - gx, fy - gy, fz - gz

    floor = float(element.system.floor(element.constants)[0, 0])
    ball.reset_world(element.plain_constants)
    x: Vector = element.x[0].tolist()
    w: Vector = element.v[0].tolist()  # velocity in the engine
    # Restitution may depend on the impact speed; w[2] is negative while the ball falls.
    ball.set_contact_parameters(*forces.compute_impact(max(-w[2], 0.0)))
    ball.set_state(x, w)
    recorded_steps = set(element.recorded_steps.tolist())
    t = 0.0
    step = math.nan
    # Nine numbers for each state: position, velocity and force of the effects.
    recorded_states = [(*x, *w, *compute_force(t, x, w))]
    for number, seconds in enumerate(element.steps[0].tolist(), start=1):
        if seconds != step:
            step = seconds
            ball.set_step(step)
        # Contact can act only if the predicted end of the step is near the ground.
        if changes_impacts and w[2] < 0.0 and ball.is_near_contact(x[2] + step * w[2] - floor):
            ball.set_contact_parameters(*forces.compute_impact(-w[2]))
        x, w = ball.advance(compute_force(t, x, w))
        t += step
        if number in recorded_steps:
            recorded_states.append((*x, *w, *compute_force(t, x, w)))
            # The missing states make the whole trajectory NaN.
            if not math.isfinite(sum(recorded_states[-1])):
                break
    # The engine reports no acceleration: it is computed from the effects' forces.
    positions, v, effect_forces = make_trajectory(element, recorded_states)
    speed = np.sqrt((v * v).sum(axis=1, keepdims=True))
    a: Array = np.array([gx, gy, gz]) + effect_forces - ball.damping * v * (1.0 + speed)  # (6)
    # A ball that rests on the ground has no vertical acceleration.
    for i in np.flatnonzero(np.abs(v[:, 2]) < _MAX_RESTING_SPEED):
        if ball.is_near_contact(positions[i, 2] - floor):
            a[i, 2] = 0.0
    return positions, v, a
