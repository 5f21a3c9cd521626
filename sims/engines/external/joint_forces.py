"""Forces on one joint, linearised in the velocity, for `sims.engines.external.joint_rollout`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import copysign

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.external_engine import ElementWork
from sims.engines.external.external_forces import (
    ExternalForces,
    integrate_velocity,
    subtract_dry_friction,
)
from sims.engines.external.resistance_laws import Resistance

VELOCITY_STEP = 1e-3
"""Velocity difference (m/s or rad/s) used to compute the slope of the force."""


class JointForces(ABC):
    """Forces on one coordinate, linear in the velocity around the last evaluation.

    Attributes:
        weight: force of the engine's own gravity at the last evaluation.
        limit: limit of dry friction.
    """

    def __init__(self, gravity: Callable[[float], float], inertia: float) -> None:
        self._gravity = gravity
        self._inertia = inertia
        self.weight = self.limit = self._at = self._force = self._slope = 0.0

    @abstractmethod
    def set_inputs(self, i: int) -> bool:
        """Set the inputs of step i; return whether any input differs from the previous step."""

    @abstractmethod
    def linearise(self, t: float, x: float, v: float) -> None:
        """Evaluate all forces at this state and linearise them in the velocity."""

    def compute_force(self, v: float) -> float:
        """Return gravity and all forces except dry friction, near the evaluated velocity."""
        return self._force + self._slope * (v - self._at)

    def compute_end_velocity(self, w: float, step: float) -> float:
        """Return the velocity half a step after `w`, with the force at the end of the half step.

        A force that increases with the velocity is taken without its slope.

        Args:
            w: the engine's velocity.
            step: step size in seconds.
        """
        # Equation (3) with f linear in v: the slope is added to the inertia. An increasing force
        # would reduce this inertia, possibly to zero.
        slope = min(self._slope, 0.0)
        force = self._force + slope * (w - self._at)
        return integrate_velocity(
            w, force, self.limit, 1.0 / (self._inertia - 0.5 * step * slope), 0.5 * step
        )

    def compute_acceleration(self, v: float) -> float:
        """Return the acceleration of the smooth motion; zero where dry friction holds the body."""
        return subtract_dry_friction(v, self.compute_force(v), self.limit) / self._inertia


class EvaluatedJointForces(JointForces):
    """Forces evaluated by calling system and effects, at two velocities to get the slope."""

    def __init__(
        self, gravity: Callable[[float], float], lane: ElementWork, inertia: float
    ) -> None:
        super().__init__(gravity, inertia)
        self._ask = ExternalForces([lane], 2)
        self._signals = {name: values.tolist() for name, values in lane.inputs.items()}

    def set_inputs(self, i: int) -> bool:
        """Set the inputs of step i; return whether any input differs from the previous step."""
        # The first step has no previous step, so that its inputs always count as changed.
        changed = i == 0 or any(values[i] != values[i - 1] for values in self._signals.values())
        if changed:
            self._ask.set_inputs({name: values[i] for name, values in self._signals.items()})
        return changed

    def linearise(self, t: float, x: float, v: float) -> None:
        """Evaluate all forces at this state and linearise them in the velocity."""
        moment = self._ask.moment
        moment.t.fill(t)
        moment.x.fill(x)
        moment.v[0, 0] = v
        # The second velocity is farther from zero, where forces may be discontinuous.
        nudge = copysign(VELOCITY_STEP, v)
        moment.v[1, 0] = v + nudge
        force, nudged = self._ask.compute_force()[:, 0].tolist()
        self.weight = self._gravity(x)
        self.limit = self._ask.compute_friction_limit()
        self._at = v
        self._force = self.weight + force
        self._slope = (nudged - force) / nudge


class ClosedFormJointForces(JointForces):
    """Forces in closed form: an unmodified input, and resistance laws of the speed."""

    def __init__(
        self,
        gravity: Callable[[float], float],
        lane: ElementWork,
        inertia: float,
        opposing: Resistance,
    ) -> None:
        super().__init__(gravity, inertia)
        self._drive: list[float] = compute_drive_forces(lane).tolist()
        self._felt = self._drive[0]
        self._resistance = opposing.compute
        self.limit = opposing.limit

    def set_inputs(self, i: int) -> bool:
        """Set the input of step i; return whether it differs from the previous step."""
        before = self._felt
        self._felt = self._drive[i]
        return bool(self._felt != before)

    def linearise(self, t: float, x: float, v: float) -> None:  # noqa: ARG002
        """Evaluate all forces at this state and linearise them in the velocity."""
        opposed, slope = self._resistance(abs(v))
        self.weight = self._gravity(x)
        self._at = v
        self._force = self.weight + self._felt - opposed * v
        self._slope = -slope


def compute_drive_forces(lane: ElementWork) -> Array:
    """Return the generalised force (S,) of the inputs over each step, at least one value."""
    if not lane.inputs:
        return np.zeros(max(lane.steps.size, 1))
    signals = {name: values[:, None] for name, values in lane.inputs.items()}
    size = len(next(iter(signals.values())))
    nothing = np.zeros((size, 1))
    moment = lane.make_snapshot(nothing, nothing, nothing, signals)
    drive: Array = lane.system.drive(moment)[:, 0]
    return drive
