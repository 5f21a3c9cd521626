"""Integrate a ball with an engine's native integrator and contact model, without corrections.

The result is of first order in the step.

Effects act through their force at the beginning of each step. Their contact parameters are set when
the next step may bring the ball to the ground. The smooth acceleration in flight, which no engine
reports, is

    a = g + f - k v (1 + |v|)                                              (1)

with f the effects' force per unit mass and k the engine's air damping
(`systems.ball_bullet_world`). There is no vertical acceleration where the ball rests.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from sims.core.effect import Contact
from sims.core.simulator import Array
from sims.engines.external.ball_rollout import BallBody, get_gravity, make_trajectory
from sims.engines.external.external_engine import (
    ElementForces,
    ElementWork,
    Trajectory,
    Vector,
    split_into_legs,
)

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

    Args:
        ball: ball in an engine.
        element: batch element to integrate.

    Returns:
        Positions, velocities and accelerations (N, 3); NaN if the integration failed.
    """
    # Unlike in `ball_rollout`, velocity and contact of the engine are used without correction.
    forces = ElementForces(element, 1)
    changes_impacts = any(isinstance(effect, Contact) for effect, _ in element.effects)
    gx, gy, gz = get_gravity(element)

    def compute_force(t: float, x: Vector, v: Vector) -> Vector:
        """Compute the force in addition to gravity, which the engine applies itself.

        The force program includes gravity, so that it is subtracted. All values are per
        unit mass.
        """
        if not forces.acts:
            return 0.0, 0.0, 0.0
        fx, fy, fz = forces.evaluate(t, x, v)
        return fx - gx, fy - gy, fz - gz

    floor = float(element.system.floor(element.constants)[0, 0])
    ball.reset_world(element.plain_constants)
    x: Vector = element.x.tolist()
    w: Vector = element.v.tolist()
    ball.set_contact_parameters(*forces.compute_impact(max(-w[2], 0.0)))
    ball.set_state(x, w)
    recorded_steps = set(element.recorded_steps.tolist())
    steps = element.steps.tolist()
    t = 0.0
    step = math.nan
    rows = [(*x, *w, *compute_force(t, x, w))]
    for first, counts in split_into_legs(element):
        if steps[first] != step:
            step = steps[first]
            ball.set_step(step)
        if forces.acts or changes_impacts:
            states = []
            for count in counts:
                for _ in range(count):
                    # Contact can act only if the predicted end of the next step is near the ground.
                    if (
                        changes_impacts
                        and w[2] < 0.0
                        and ball.is_near_contact(x[2] + step * w[2] - floor)
                    ):
                        ball.set_contact_parameters(*forces.compute_impact(-w[2]))
                    x, w = ball.advance(compute_force(t, x, w))
                    t += step
                states.append((*x, *w, *compute_force(t, x, w)))
        else:
            # No force must be evaluated: the engine runs from sample to sample.
            states = [(*x, *w, 0.0, 0.0, 0.0) for x, w in ball.advance_freely(counts)]
        rows.extend(states if first + sum(counts) in recorded_steps else states[:-1])
        if not math.isfinite(sum(rows[-1])):
            break
    positions, v, effect_forces = make_trajectory(element, rows)
    speed = np.sqrt((v * v).sum(axis=1, keepdims=True))
    a: Array = np.array([gx, gy, gz]) + effect_forces - ball.damping * v * (1.0 + speed)  # (1)
    for i in np.flatnonzero(np.abs(v[:, 2]) < _MAX_RESTING_SPEED):
        if ball.is_near_contact(positions[i, 2] - floor):
            a[i, 2] = 0.0
    return positions, v, a
