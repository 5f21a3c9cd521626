"""Integrate a one-coordinate system with an engine, at second order in the step.

The engine moves a body with the inertia M of the system on a hinge or a guide; all forces f(t, x,
v, u), gravity among them, are applied to the joint. The engine's velocity w belongs to the time
half a step before the position. Each step of length h from (x, v) is

    start:  w  = v + h/2 f(t, x, v, u) / M                                 (1)
    engine: x' = x + h w                                                   (2)
    end:    v' = w + h/2 f(t', x', v', u) / M                              (3)

where (1) is applied as one force over the step,

    F = (w - w_before) M / h                                               (4)

and (3) is solved for v' by one Newton step, so that damping is stable however strong it is (the two
halves together are the trapezoidal rule in v), and dry friction is exact in each half
(`integrate_velocity`). Dry friction with limit L changes a force F at velocity v to

    F - L sign(v)                      where v is not 0                    (9)
    F - L sign(F), or 0 if |F| <= L    where v is 0                        (10)
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from sims.engines.external.element_forces import ElementForces
from sims.engines.external.external_engine import ElementWork, Trajectory

VELOCITY_STEP = 1e-3
"""Velocity difference (m/s or rad/s) used to compute the slope of the force."""


class JointBody(Protocol):
    """Body on one hinge or guide in an engine, without gravity."""

    def reset_world(self) -> None:
        """Prepare the world for a rollout."""
        ...

    def set_step(self, step: float, inertia: float) -> None:
        """Set step size and generalised inertia.

        Args:
            step: step size in seconds.
            inertia: generalised inertia in kg or kg*m^2.
        """
        ...

    def set_state(self, x: float, w: float) -> None:
        """Set the position and the engine's velocity.

        Args:
            x: position, rad or m.
            w: velocity at the time half a step before.
        """
        ...

    def advance(self, force: float) -> tuple[float, float]:
        """Advance by one step with a generalised force.

        Returns:
            Position and the engine's velocity after the step.
        """
        ...


class LinearisedForces:
    """Forces on one coordinate, linear in the velocity around the last evaluation.

    Attributes:
        limit: limit of dry friction.
    """

    def __init__(self, element: ElementWork, inertia: float) -> None:
        """Start with zero forces; the force at two velocities is evaluated in one call.

        Args:
            element: Batch element with one coordinate.
            inertia: Inertia at the joint, in kg m^2 on a hinge or kg on a guide.
        """
        self._forces = ElementForces(element, 2)
        self._inertia = inertia
        self.set_inputs = self._forces.set_inputs
        self.limit = self._velocity = self._force = self._slope = 0.0

    def linearise(self, t: float, x: float, v: float) -> None:
        """Evaluate all forces at a state, and their slope by the velocity as a difference quotient.

        The half steps of the velocity at both ends of a step then find the force at other
        velocities without evaluating it again.

        Args:
            t: time since the start, s.
            x: position, rad or m.
            v: velocity, rad/s or m/s.
        """
        # The second velocity is farther from zero, where forces may be discontinuous.
        velocity_step = math.copysign(VELOCITY_STEP, v)
        force, perturbed_force = self._forces.evaluate_at_velocities(t, x, (v, v + velocity_step))
        self.limit = self._forces.limit
        self._velocity = v
        self._force = force
        self._slope = (perturbed_force - force) / velocity_step

    def compute_force(self, v: float) -> float:
        """Return all forces except dry friction, near the evaluated velocity."""
        return self._force + self._slope * (v - self._velocity)

    def compute_end_velocity(self, w: float, step: float) -> float:
        """Return the velocity half a step after `w`, with the force at the end of the half step.

        A force that increases with the velocity is taken without its slope.

        It solves v' = w + h/2 f(t', x', v', u) / M (3) by one Newton step.

        Args:
            w: the engine's velocity.
            step: step size in seconds.
        """
        # Equation (3) with f linear in v: the slope is added to the inertia. An increasing force
        # would reduce this inertia, possibly to zero.
        slope = min(self._slope, 0.0)
        force = self._force + slope * (w - self._velocity)
        inverse = 1.0 / (self._inertia - 0.5 * step * slope)
        return integrate_velocity(w, force, self.limit, inverse, 0.5 * step)

    def compute_acceleration(self, v: float) -> float:
        """Return the acceleration of the smooth motion; zero where dry friction holds the body."""
        return subtract_dry_friction(v, self.compute_force(v), self.limit) / self._inertia


def subtract_dry_friction(velocity: float, force: float, limit: float) -> float:
    """Return a force F minus dry friction with the limit L.

    In motion it is F - L sign(v) (9), at rest F - L sign(F), or 0 if |F| <= L (10).

    Args:
        velocity: velocity of the body.
        force: force without dry friction.
        limit: limit of dry friction.
    """
    if not limit:
        return force
    if velocity:
        return force - math.copysign(limit, velocity)  # (9)
    return force - math.copysign(limit, force) if abs(force) > limit else 0.0  # (10)


def integrate_velocity(
    velocity: float, force: float, limit: float, inverse: float, duration: float
) -> float:
    """Return the velocity after a constant force and dry friction have acted for `duration`.

    The result is exact: friction opposes the motion until the body stops, and then holds it if the
    force is within the limit.

    Args:
        velocity: velocity before.
        force: force without dry friction.
        limit: limit of dry friction.
        inverse: inverse of the inertia.
        duration: time in seconds.
    """
    if velocity and limit:
        acceleration = subtract_dry_friction(velocity, force, limit) * inverse
        final_velocity = velocity + acceleration * duration
        # The body keeps its direction: it does not stop. The sign of a product is not tested,
        # because the product of two tiny velocities may underflow to zero.
        if (final_velocity < 0) == (velocity < 0):
            return final_velocity
        # The body stops at the time -velocity / acceleration; the remaining time begins there.
        duration += velocity / acceleration
        velocity = 0.0
    return velocity + subtract_dry_friction(velocity, force, limit) * inverse * duration


def integrate_joint(joint: JointBody, element: ElementWork) -> Trajectory:
    """Integrate one batch element, a body on a hinge or guide, at second order in the step.

    The engine's velocity w belongs to the time half a step before the position. With the inertia M
    and all forces f, each step of length h is

        start:  w  = v + h/2 f(t, x, v) / M       (1)
        engine: x' = x + h w                      (2)
        end:    v' = w + h/2 f(t', x', v') / M    (3)

    where the engine reaches w (1) by the force (w - w_before) M / h (4), and (3) is implicit in the
    damping.

    Args:
        joint: the body of the engine.
        element: batch element: initial state, steps, constants and effects, in arrays of one row.

    Returns:
        The trajectory; NaN if it diverges, or if the inertia is not positive.
    """
    # `limit` of the forces is that of dry friction; `w` is the engine's velocity, `v` the true one.
    joint.reset_world()
    # Moment of inertia in kg m^2, or mass in kg.
    inertia = float(element.system.mass(element.theta, element.constants)[0, 0])
    failed = np.full((element.recorded_steps.size, 1), np.nan)
    if not inertia > 0.0:
        return failed, failed, failed
    forces = LinearisedForces(element, inertia)
    x = float(element.x[0, 0])
    v = float(element.v[0, 0])
    t = 0.0
    step = math.nan
    w = v
    inverse = 1.0 / inertia
    forces.linearise(t, x, v)
    recorded_steps = set(element.recorded_steps.tolist())
    step_records = [(x, v, forces.compute_acceleration(v))]
    for i, h in enumerate(element.steps[0].tolist()):
        if i and forces.set_inputs(i):
            forces.linearise(t, x, v)
        start = integrate_velocity(
            v, forces.compute_force(v), forces.limit, inverse, 0.5 * h
        )  # (1)
        if h != step:
            joint.set_step(h, inertia)
            # The velocity half a step before: w = v - h/2 f / M by (1), so that (4) is f itself.
            w = 2.0 * v - start
            joint.set_state(x, w)
            step = h
        x, w = joint.advance((start - w) * inertia / h)  # (4), (2)
        # The missing records make the whole trajectory NaN, see below.
        if not math.isfinite(x + w):
            break
        t += h
        # Forces are evaluated at the velocity without a change of force: w is the mean of v and
        # that velocity.
        forces.linearise(t, x, 2.0 * w - v)
        v = forces.compute_end_velocity(w, h)  # (3)
        if i + 1 in recorded_steps:
            step_records.append((x, v, forces.compute_acceleration(v)))
    if len(step_records) < element.recorded_steps.size:
        return failed, failed, failed
    x_at, v_at, a_at = np.array(step_records).T[:, :, None]
    return x_at, v_at, a_at
