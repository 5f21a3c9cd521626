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
(`forces.kick`).

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
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.external_engine import ElementWork, Trajectory, split_into_legs
from sims.engines.external.external_forces import integrate_velocity
from sims.engines.external.joint_forces import (
    ClosedFormJointForces,
    EvaluatedJointForces,
    JointForces,
    compute_drive_forces,
)
from sims.engines.external.resistance_laws import Resistance, is_builtin_effect, make_resistance


class JointBody(Protocol):
    """Body on one hinge or guide in an engine."""

    open_loop: bool
    """Whether the system's drive depends on its inputs alone."""

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
        """Set the position and the engine's velocity."""
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


def integrate_joint(joint: JointBody, lane: ElementWork) -> Trajectory:
    """Integrate one batch element.

    Args:
        joint: body in an engine.
        lane: batch element to integrate.

    Returns:
        The trajectory; NaN if the engine cannot represent the element.
    """
    joint.reset_world(lane.plain_constants)
    inertia = float(lane.system.mass(lane.theta, lane.constants)[0, 0])
    way = choose_integration_mode(lane, joint.open_loop)
    if way.damping is not None:
        return _integrate_open_loop(joint, lane, inertia, way.damping)
    if way.opposing is not None:
        return _integrate_stepwise(
            joint,
            lane,
            inertia,
            ClosedFormJointForces(joint.compute_gravity_force, lane, inertia, way.opposing),
        )
    return _integrate_stepwise(
        joint, lane, inertia, EvaluatedJointForces(joint.compute_gravity_force, lane, inertia)
    )


@dataclass(frozen=True)
class IntegrationMode:
    """Integration mode of a batch element: the fastest of three that includes all active forces.

    Evaluating effects takes longer than the engine's own step.

    Attributes:
        damping: viscous damping, if nothing else acts except inputs, so that the engine runs on its
            own; None otherwise.
        opposing: closed-form resistance, if all forces depend on speed alone; None if effects must
            be evaluated at each step.
    """

    damping: float | None
    opposing: Resistance | None


def choose_integration_mode(lane: ElementWork, open_loop: bool) -> IntegrationMode:
    """Choose the fastest integration mode of a batch element.

    Args:
        lane: batch element to integrate.
        open_loop: whether the drive depends on the inputs alone.
    """
    opposing = make_resistance(lane) if open_loop else None
    return IntegrationMode(None if opposing is None else _find_equivalent_damping(lane), opposing)


def _find_equivalent_damping(lane: ElementWork) -> float | None:
    """Return the viscous damping that is equivalent to all effects; None if there is none."""
    if not lane.effects:
        return 0.0
    (effect, c), *others = lane.effects
    damping = float(c[0, 0, 0])
    alone = is_builtin_effect(effect, "drag.linear") and not others
    return damping if alone and damping > 0.0 else None


def _integrate_open_loop(
    joint: JointBody, lane: ElementWork, inertia: float, damping: float
) -> Trajectory:
    """Integrate without feedback except viscous damping.

    The engine runs on its own while the input is constant.
    """
    drive = compute_drive_forces(lane)
    forces = drive.tolist()
    steps = lane.steps.tolist()
    kept = set(lane.recorded_steps.tolist())
    x = float(lane.x[0])
    w = math.nan
    v = float(lane.v[0])
    step = math.nan
    felt = forces[0]
    rows = [(x, w, step, felt)]
    for begin, counts in split_into_legs(lane, drive):
        h = steps[begin]
        u = forces[begin]
        end = begin + sum(counts)
        if h != step:
            # The velocity half a step earlier depends on the step size.
            if begin:
                v = to_full_step_velocity(
                    w, joint.compute_gravity_force(x) + felt, inertia, damping, step
                )
            if not joint.set_step(h, inertia + 0.5 * h * damping, damping):  # (5)
                break
            joint.set_state(
                x, to_half_step_velocity(v, joint.compute_gravity_force(x) + u, inertia, damping, h)
            )
        elif u != felt:
            joint.advance(compute_transition_force(felt, u, inertia, damping, h))
            counts[0] -= 1
        states = joint.advance_freely(u, counts)
        x, w = states[-1]
        if not math.isfinite(x + w):
            break
        step = h
        felt = u
        # A leg may end between two samples, where the input changes and no state is recorded.
        if end not in kept:
            states.pop()
        rows.extend((*state, h, u) for state in states)
    if len(rows) < lane.recorded_steps.size:
        return make_failed_trajectory(lane)
    return read_trajectory(lane, np.array(rows), inertia, damping)


def read_trajectory(lane: ElementWork, rows: Array, inertia: float, damping: float) -> Trajectory:
    """Convert the states of an uninterrupted run to a trajectory.

    Args:
        lane: integrated batch element.
        rows: (N, 4) position, the engine's velocity, step size and force of the inputs at each
            recorded state.
        inertia: generalised inertia.
        damping: viscous damping.

    Returns:
        Positions, velocities and accelerations (N, 1).
    """
    positions, w_at, step_at, felt_at = rows.T
    force = _weights(lane, positions) + felt_at
    rates = to_full_step_velocity(w_at, force, inertia, damping, step_at)
    rates[0] = lane.v[0]
    accelerations = (force - damping * rates) / inertia
    return positions[:, None], rates[:, None], accelerations[:, None]


def to_full_step_velocity(w: Any, force: Any, inertia: Any, damping: Any, step: Any) -> Any:
    """Return the velocity at the time of the position, equation (6); numbers or arrays.

    Args:
        w: the engine's velocity, half a step before the position.
        force: force at the position.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    half = 0.5 * step / inertia
    return (w + half * force) / (1.0 + half * damping)  # (6)


def to_half_step_velocity(v: Any, force: Any, inertia: Any, damping: Any, step: Any) -> Any:
    """Return the engine's velocity, half a step before the position.

    This is the inverse of `to_full_step_velocity`.

    Args:
        v: velocity at the time of the position.
        force: force at the position.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    half = 0.5 * step / inertia
    return (1.0 + half * damping) * v - half * force  # (7)


def compute_transition_force(felt: Any, u: Any, inertia: Any, damping: Any, step: Any) -> Any:
    """Return the force over the step in which the input changes, equation (8).

    Args:
        felt: force of the input before the change.
        u: force of the input after the change.
        inertia: generalised inertia.
        damping: viscous damping.
        step: step size in seconds.
    """
    return u + (0.5 - 0.25 * step * damping / inertia) * (felt - u)  # (8)


def _integrate_stepwise(
    joint: JointBody, lane: ElementWork, inertia: float, forces: JointForces
) -> Trajectory:
    """Integrate with forces that are evaluated at each step."""
    x = float(lane.x[0])
    v = float(lane.v[0])
    t = 0.0
    step = math.nan
    w = v
    inverse = 1.0 / inertia
    forces.set_inputs(0)
    forces.linearise(t, x, v)
    kept = set(lane.recorded_steps.tolist())
    rows = [(x, v, forces.compute_acceleration(v))]
    for i, h in enumerate(lane.steps.tolist()):
        if forces.set_inputs(i):
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
        if i + 1 in kept:
            rows.append((x, v, forces.compute_acceleration(v)))
    if len(rows) < lane.recorded_steps.size:
        return make_failed_trajectory(lane)
    x_at, v_at, a_at = np.array(rows).T[:, :, None]
    return x_at, v_at, a_at


def _weights(lane: ElementWork, x: Array) -> Array:
    """Return the force of gravity (n,) at positions (n,)."""
    nothing = np.zeros((x.size, 1))
    moment = lane.make_snapshot(nothing, x[:, None], nothing, {})
    weights: Array = lane.system.weight(moment)[:, 0]
    return weights


def make_failed_trajectory(lane: ElementWork) -> Trajectory:
    """Return a trajectory of NaN for a failed element."""
    nothing = np.full((lane.recorded_steps.size, 1), np.nan)
    return nothing, nothing, nothing
