"""Accelerations within a step: forces, dry friction, and the ground that supports resting bodies.

Dry friction opposes motion with its full limit. Its direction is fixed during a step, so that the
step is smooth. An element at rest sticks while the pulling force is within the limit, otherwise it
slips in the direction of that force. With generalised inertia M, pulling force F (all forces except
dry friction), limit L and the unit vector d of the motion,

    M a = F - L d          while it moves, d = v / |v|                     (1)
    a = 0                  at rest, as long as |F| <= L                    (2)
    M a = F - L F / |F|    at rest, where |F| > L                          (3)

(C. Coulomb's law; see E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations
I, 1993, section II.6, on such discontinuities: a step must not extend across one).
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array
from sims.engines.batch.force_field import ForceField
from sims.engines.ground_contact import Indices


class StepDynamics:
    """Accelerations of batch elements during their steps.

    Attributes:
        rests: (L, 1) elements that rest on the ground.
        sticks: (L, 1) elements that dry friction holds during the present step.
        way: (L, D) unit vectors of the direction of motion at the beginning of the present step.
        rubs: (L, D) dry friction of sliding motion at each evaluation since the present step began.
        excess: (L, 1) pulling force minus friction limit, at the beginning of the step and in the
            last call.
    """

    def __init__(self, field: ForceField, shape: tuple[int, int]) -> None:
        self.field = field
        self.rests = np.zeros((shape[0], 1), dtype=bool)
        self.sticks = np.zeros((shape[0], 1), dtype=bool)
        self.way = np.zeros(shape)
        self.rubs: list[Array] = []
        self.excess = (np.zeros((shape[0], 1)),) * 2
        self._any_rests = False
        self._guided = field.guided
        self._along_guide = np.arange(shape[1]) < field.guided

    def begin_step(self, t: Array, x: Array, v: Array) -> Array:
        """Return the acceleration (L, D) at the beginning of a step.

        It also determines which elements stick, and the direction of motion of the others.

        Args:
            t: (L, 1) times in seconds.
            x: (L, D) positions.
            v: (L, D) velocities.
        """
        pull = self._borne(t, x, v)
        if not self.field.has_dry_friction:
            return pull / self.field.mass
        limit = self.field.compute_friction_limit(t, x, v)
        size = self.compute_speed(pull)
        speed = self.compute_speed(v)
        still = speed == 0
        excess = size - limit
        self.excess = (excess, excess)
        self.rubs = []
        self.sticks = still & (size <= limit) & self.field.rubs  # (2)
        # (1) and (3): along the motion, or at rest along the pulling force. An element with neither
        # has no direction, and the division by zero must be avoided.
        pulled = np.where(size > 0, size, 1.0)
        self.way = np.where(still, pull, v) / np.where(still, pulled, speed)
        if self._guided < v.shape[1]:
            self.way = np.where(self._along_guide, self.way, 0.0)
        return self._rubbed(pull, limit, self.way)

    def compute_acceleration(self, t: Array, x: Array, v: Array) -> Array:
        """Return the acceleration (L, D) within the present step.

        Args:
            t: (L, 1) times in seconds.
            x: (L, D) positions.
            v: (L, D) velocities.
        """
        pull = self._borne(t, x, v)
        if not self.field.has_dry_friction:
            return pull / self.field.mass
        limit = self.field.compute_friction_limit(t, x, v)
        self.excess = (self.excess[0], self.compute_speed(pull) - limit)
        return self._rubbed(pull, limit, self._along(v))

    def zero_small_velocities(self, v: Array, faint: Array) -> Array:
        """Return velocities (n, D) without their part along the guide where it is negligible.

        Args:
            v: (n, D) velocities.
            faint: (n, 1) largest negligible speed.
        """
        return np.where((self.compute_speed(v) <= faint) & self._along_guide, 0.0, v)

    def set_resting(self, lanes: Indices) -> None:
        """Mark the elements `lanes` (n,) as resting on the ground."""
        self.rests[lanes] = True
        self._any_rests = True

    def clear_resting(self, v: Array) -> None:
        """Clear the resting state of elements that move upward, v (L, D)."""
        if self._any_rests:
            self.rests &= v[:, -1:] <= 0
            self._any_rests = bool(self.rests.any())

    def _borne(self, t: Array, x: Array, v: Array) -> Array:
        """Return all forces except dry friction, without the part that the ground supports."""
        pull = self.field.compute_force(t, x, v)
        if self._any_rests:
            pull = pull + 0.0  # a copy: a constant force is the same array in every call
            # The ground pushes but does not pull: an upward force remains.
            lift = pull[:, -1:]
            pull[:, -1:] = np.where(self.rests, np.maximum(lift, 0.0), lift)
        return pull

    def _along(self, v: Array) -> Array:
        """Return the directions of v, with signs that agree with the direction at the beginning."""
        if self._guided == 1:
            return self.way
        # In a plane the direction may turn within the step, but must not reverse: a reversal is an
        # event at which the step is cut.
        speed = compute_norm(v)
        divisor = np.where(speed > 0, speed, 1.0)
        unit = np.where(speed > 0, v / divisor, self.way)
        side = np.where(dot(unit, self.way) < 0, -1.0, 1.0)
        turned: Array = unit * side
        return turned

    def _rubbed(self, pull: Array, limit: Array, way: Array) -> Array:
        friction = limit * way
        self.rubs.append(friction)  # four per step, from which its nonlinearity is estimated
        slipping = (pull - friction) / self.field.mass
        result: Array = np.where(self.sticks & self._along_guide, 0.0, slipping)
        return result

    def compute_speed(self, v: Array) -> Array:
        """Return the magnitudes (n, 1) along the guide."""
        return compute_norm(v[:, : self._guided])


def dot(a: Array, b: Array) -> Array:
    """Return the inner products (L, 1)."""
    if a.shape[1] == 1:
        return a * b
    result: Array = (a * b).sum(axis=1, keepdims=True)
    return result


def compute_norm(v: Array) -> Array:
    """Return the magnitudes (L, 1)."""
    if v.shape[1] == 1:
        return np.abs(v)
    result: Array = np.sqrt((v * v).sum(axis=1, keepdims=True))
    return result
