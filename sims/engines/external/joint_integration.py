"""Integrate a one-coordinate system with an engine, at second order in the step.

The engine's velocity w belongs to the time half a step before the position. With force f(t, x, v,
u) in addition to the gravity G(x), each step of length h from (x, v) is

    start:  w  = v + h/2 (G(x) + f(t, x, v, u)) / M                        (1)
    engine: x' = x + h w                                                   (2)
    end:    v' = w + h/2 (G(x') + f(t', x', v', u)) / M                    (3)

where (1) is applied as one force over the step,

    F = (w - w_before) M / h - G(x)                                        (4)

and (3) is solved for v' by one Newton step, so that damping is stable however strong it is (the two
halves together are the trapezoidal rule in v), and dry friction is exact in each half
(`integrate_velocity`). Dry friction with limit L changes a force F at velocity v to

    F - L sign(v)                      where v is not 0                    (9)
    F - L sign(F), or 0 if |F| <= L    where v is 0                        (10)

If only inputs and viscous damping c act, the engine's own joint damping, explicit in w, represents
it, and the engine runs without interruption. With J = M + h c / 2 in place of M,

    w' = w + h (T - c w) / J,  which is  w' - w = h (T - c (w + w') / 2) / M    (5)

has its damping at the midpoint, so that v = (w + w') / 2 is the velocity at x. The conversions
between the engine's velocity w, half a step before x, and v are

    v = (w + h/2 (G + u) / M) / (1 + h/2 c / M)                            (6)
    w = (1 + h/2 c / M) v - h/2 (G + u) / M                                (7)

When the input changes from u to u', the step has half an impulse of each: w' - w = h (G + (u + u')
/ 2 - c v) / M with v of (6) is (5) with T = G plus

    u' + (1/2 - h c / (4 M)) (u - u')                                      (8)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.external_engine import (
    ElementForces,
    ElementWork,
    Trajectory,
    split_into_legs,
)

VELOCITY_STEP = 1e-3
"""Velocity difference (m/s or rad/s) used to compute the slope of the force."""


class JointBody(Protocol):
    """Body on one hinge or guide in an engine."""

    open_loop: bool
    """True if the system's drive depends on its inputs alone."""

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare the world for a rollout with these constants."""
        ...

    def set_step(self, step: float, inertia: float, damping: float) -> bool:
        """Set step size, generalised inertia and viscous damping.

        Args:
            step: step size in seconds.
            inertia: generalised inertia in kg or kg*m^2.
            damping: viscous joint damping.

        Returns:
            False if the engine cannot represent the inertia.
        """
        ...

    def set_state(self, x: float, w: float) -> None:
        """Set the position and the engine's velocity.

        Args:
            x: position, rad or m.
            w: velocity at the time half a step before.
        """
        ...

    def compute_gravity_force(self, x: float) -> float:
        """Return the generalised force of the engine's own gravity at position x."""
        ...

    def advance(self, force: float) -> tuple[float, float]:
        """Advance by one step with a generalised force in addition to gravity.

        Returns:
            Position and the engine's velocity after the step.
        """
        ...

    def advance_freely(self, force: float, counts: Sequence[int]) -> list[tuple[float, float]]:
        """Advance by each number of steps in `counts` with a constant generalised force.

        Args:
            force: generalised force in addition to gravity.
            counts: numbers of steps.

        Returns:
            Position and the engine's velocity after each count.
        """
        ...


def integrate_joint(joint: JointBody, element: ElementWork) -> Trajectory:
    """Integrate one batch element, a body on a hinge or guide.

    If the drive depends on the inputs alone and the other forces equal a linear damping, the
    engine runs on its own while the inputs are constant; otherwise forces are set in each step.

    Returns:
        The trajectory; NaN if the engine cannot represent the element.
    """
    joint.reset_world(element.plain_constants)
    inertia = float(element.system.mass(element.theta, element.constants)[0, 0])
    damping = _find_equivalent_damping(element) if joint.open_loop else None
    if damping is not None:
        return _integrate_open_loop(joint, element, inertia, damping)
    return _integrate_stepwise(joint, element, inertia)


def _find_equivalent_damping(element: ElementWork) -> float | None:
    """Return the viscous damping that is equivalent to all effects; None if there is none.

    Only then can the engine run without interruption, with its own joint damping.

    Args:
        element: Batch element with its effects.

    Returns:
        Damping coefficient, 0 without any effect.
    """
    if not element.effects:
        return 0.0
    (effect, c), *other_effects = element.effects
    damping = float(c[0, 0, 0])
    # A plugin may replace an effect of this name with another law.
    is_drag = effect.name == "drag.linear" and type(effect).__module__ == "sims.effects.drag"
    return damping if is_drag and not other_effects and damping > 0.0 else None


class LinearisedForces:
    """Forces on one coordinate, linear in the velocity around the last evaluation.

    Attributes:
        weight: force of the engine's own gravity at the last evaluation.
        limit: limit of dry friction.
    """

    def __init__(self, joint: JointBody, element: ElementWork, inertia: float) -> None:
        """Start with zero forces; both states of a step are evaluated in one call.

        `inertia` is the inertia at the joint, in kg m^2 on a hinge or kg on a guide.
        """
        self._joint = joint
        self._forces = ElementForces(element, 2)
        self._inertia = inertia
        self.set_inputs = self._forces.set_inputs
        self.weight = self.limit = self._velocity = self._force = self._slope = 0.0

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
        self.weight = self._joint.compute_gravity_force(x)
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

        It solves v' = w + h/2 (G(x') + f(t', x', v', u)) / M (3) by one Newton step.

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
        slope = subtract_dry_friction(velocity, force, limit) * inverse
        final_velocity = velocity + slope * duration
        if final_velocity * velocity >= 0:
            return final_velocity
        # The body stops at time -v / slope; the remaining time begins there.
        duration += velocity / slope
        velocity = 0.0
    return velocity + subtract_dry_friction(velocity, force, limit) * inverse * duration


def _compute_drive_forces(element: ElementWork) -> Array:
    """Return the generalised force (S,) of the inputs over each step, at least one value.

    Shapes: S steps.

    Args:
        element: Batch element with inputs that are constant over each step.
    """
    if not element.inputs:
        return np.zeros(max(element.steps.size, 1))
    signals = {name: values[:, None] for name, values in element.inputs.items()}
    size = len(next(iter(signals.values())))
    zeros = np.zeros((size, 1))
    moment = element.make_snapshot(zeros, zeros, zeros, signals)
    drive: Array = element.system.drive(moment)[:, 0]
    return drive


def _integrate_open_loop(
    joint: JointBody, element: ElementWork, inertia: float, damping: float
) -> Trajectory:
    """Integrate without feedback except viscous damping.

    The engine runs on its own while the input is constant.

    The engine steps w' = w + h (T - c w) / J with J = M + h c / 2 (5), for viscous damping c and
    force T.

    Args:
        joint: the body in the engine.
        element: batch element with its input and steps.
        inertia: generalised inertia, kg m² or kg.
        damping: viscous damping, N m s/rad or N s/m.
    """
    drive = _compute_drive_forces(element)
    forces = drive.tolist()
    steps = element.steps.tolist()
    recorded_steps = set(element.recorded_steps.tolist())
    x = float(element.x[0])
    w = math.nan
    v = float(element.v[0])
    step = math.nan
    drive_force = forces[0]
    step_records = [(x, w, step, drive_force)]
    for first, counts in split_into_legs(element, drive):
        h = steps[first]
        u = forces[first]
        end = first + sum(counts)
        if h != step:
            # The velocity half a step earlier depends on the step size.
            if first:
                v = _to_full_step_velocity(
                    w, joint.compute_gravity_force(x) + drive_force, inertia, damping, step
                )
            if not joint.set_step(h, inertia + 0.5 * h * damping, damping):  # (5)
                break
            joint.set_state(
                x,
                _to_half_step_velocity(v, joint.compute_gravity_force(x) + u, inertia, damping, h),
            )
        elif u != drive_force:
            joint.advance(_compute_transition_force(drive_force, u, inertia, damping, h))
            counts[0] -= 1
        states = joint.advance_freely(u, counts)
        x, w = states[-1]
        if not math.isfinite(x + w):
            break
        step = h
        drive_force = u
        # A leg may end between two samples, where the input changes and no state is recorded.
        if end not in recorded_steps:
            states.pop()
        step_records.extend((*state, h, u) for state in states)
    if len(step_records) < element.recorded_steps.size:
        return _make_failed_trajectory(element)
    return _read_trajectory(element, np.array(step_records), inertia, damping)


def _read_trajectory(
    element: ElementWork, rows: Array, inertia: float, damping: float
) -> Trajectory:
    """Convert the states of an uninterrupted run to a trajectory.

    Args:
        element: integrated batch element.
        rows: (N, 4) position, the engine's velocity, step size and force of the inputs at each
            recorded state.
        inertia: generalised inertia.
        damping: viscous damping.

    Returns:
        Positions, velocities and accelerations (N, 1).
    """
    positions, engine_velocities, steps, drive_forces = rows.T
    force = _compute_weights(element, positions) + drive_forces
    velocities = _to_full_step_velocity(engine_velocities, force, inertia, damping, steps)
    velocities[0] = element.v[0]
    accelerations = (force - damping * velocities) / inertia
    return positions[:, None], velocities[:, None], accelerations[:, None]


def _to_full_step_velocity(w: Any, force: Any, inertia: Any, damping: Any, step: Any) -> Any:
    """Return the velocity at the time of the position, (w + h/2 F / M) / (1 + h/2 c / M) (6).

    The engine's velocity w belongs to the time half a step h before. All arguments are numbers or
    arrays.

    Args:
        w: the engine's velocity, half a step before the position.
        force: force at the position.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    half_step_mobility = 0.5 * step / inertia
    return (w + half_step_mobility * force) / (1.0 + half_step_mobility * damping)  # (6)


def _to_half_step_velocity(v: Any, force: Any, inertia: Any, damping: Any, step: Any) -> Any:
    """Return the engine's velocity, half a step before the position.

    This is the inverse of `_to_full_step_velocity`.

    It is w = (1 + h/2 c / M) v - h/2 (G + u) / M (7), with gravity G, input u, mass M and damping
    c.

    Args:
        v: velocity at the time of the position.
        force: force at the position.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    half_step_mobility = 0.5 * step / inertia
    return (1.0 + half_step_mobility * damping) * v - half_step_mobility * force  # (7)


def _compute_transition_force(
    drive_force: Any, u: Any, inertia: Any, damping: Any, step: Any
) -> Any:
    """Return the force over the step in which the input changes from u to u', equation (8).

    It is u' + (1/2 - h c / (4 M)) (u - u'), so that the step has half an impulse of each.

    Args:
        drive_force: force of the input before the change.
        u: force of the input after the change.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    return u + (0.5 - 0.25 * step * damping / inertia) * (drive_force - u)  # (8)


def _integrate_stepwise(joint: JointBody, element: ElementWork, inertia: float) -> Trajectory:
    """Integrate a joint, with forces that are evaluated in each step, by equations (1) to (4).

    The engine's velocity w belongs to the time half a step before the position. Each step begins
    with half a step of the velocity (1), which is applied as one force (4); the engine moves the
    joint (2); the second half of the velocity is implicit in the damping (3).

    It is used unless the forces are those of the inputs and linear damping alone. `inertia` is in
    kg m^2 or kg. A failed integration is NaN throughout.

    Args:
        joint: the body of the engine.
        element: batch element: initial state, steps, constants and effects.
        inertia: inertia in kg m^2 or mass in kg.
    """
    forces = LinearisedForces(joint, element, inertia)
    x = float(element.x[0])
    v = float(element.v[0])
    t = 0.0
    step = math.nan
    w = v
    inverse = 1.0 / inertia
    forces.linearise(t, x, v)
    recorded_steps = set(element.recorded_steps.tolist())
    step_records = [(x, v, forces.compute_acceleration(v))]
    for i, h in enumerate(element.steps.tolist()):
        if i and forces.set_inputs(i):
            forces.linearise(t, x, v)
        start = integrate_velocity(
            v, forces.compute_force(v), forces.limit, inverse, 0.5 * h
        )  # (1)
        if h != step:
            if not joint.set_step(h, inertia, 0.0):
                break
            w = 2.0 * v - start  # then the applied force equals the true force
            joint.set_state(x, w)
            step = h
        x, w = joint.advance((start - w) * inertia / h - forces.weight)  # (4), (2)
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
        return _make_failed_trajectory(element)
    x_at, v_at, a_at = np.array(step_records).T[:, :, None]
    return x_at, v_at, a_at


def _compute_weights(element: ElementWork, x: Array) -> Array:
    """Return the force of gravity (n,) at positions (n,).

    Args:
        element: the batch element, with its system and parameters.
        x: (n,) positions, rad or m.
    """
    zeros = np.zeros((x.size, 1))
    moment = element.make_snapshot(zeros, x[:, None], zeros, {})
    weights: Array = element.system.weight(moment)[:, 0]
    return weights


def _make_failed_trajectory(element: ElementWork) -> Trajectory:
    """Return a trajectory of NaN for a failed element."""
    missing_values = np.full((element.recorded_steps.size, 1), np.nan)
    return missing_values, missing_values, missing_values
