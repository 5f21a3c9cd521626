"""Accelerations during a step: forces, dry friction, and the ground that bears what rests on it.

Dry friction opposes motion with all of its limit. Its direction is held during a step, so that the
step is smooth. A lane that is still sticks while what pulls is within the limit, else it slips
where it is pulled. With generalised inertia M, pull F (all forces but friction), limit L and the
unit vector d of the motion,

    M a = F - L d          while it moves, d = v / |v|                     (1)
    a = 0                  at rest, as long as |F| <= L                    (2)
    M a = F - L F / |F|    at rest, where |F| > L                          (3)

(C. Coulomb's law; see E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations
I, 1993, section II.6, on such discontinuities: a step must not reach across one).
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.engines.batch.field import Field
from sims.engines.ground import Indices


class Dynamics:
    """Accelerations of lanes during their steps.

    Attributes:
        rests: (L, 1) lanes that lie on the ground.
        sticks: (L, 1) lanes that dry friction holds during the present step.
        way: (L, D) direction of motion at the beginning of the present step; unit vectors.
        rubs: (L, D) dry friction at each instant asked for since the present step began, had it
            acted against motion.
        excess: (L, 1) by how much what pulled exceeded the limit, at the beginning of the step and
            in the last call.
    """

    def __init__(self, field: Field, shape: tuple[int, int]) -> None:
        self.field = field
        self.rests = np.zeros((shape[0], 1), dtype=bool)
        self.sticks = np.zeros((shape[0], 1), dtype=bool)
        self.way = np.zeros(shape)
        self.rubs: list[Array] = []
        self.excess = (np.zeros((shape[0], 1)),) * 2
        self._any_rests = False
        self._guided = field.guided
        self._along_guide = np.arange(shape[1]) < field.guided

    def begin(self, t: Array, x: Array, v: Array) -> Array:
        """(L, D) acceleration at the beginning of a step; decides what sticks and which way the
        rest moves.
        """
        pull = self._borne(t, x, v)
        if not self.field.dry:
            return pull / self.field.mass
        limit = self.field.limit(t, x, v)
        size = self.size(pull)
        speed = self.size(v)
        still = speed == 0
        excess = size - limit
        self.excess = (excess, excess)
        self.rubs = []
        self.sticks = still & (size <= limit) & self.field.rubs  # (2)
        # (1) and (3): along the motion, or where there is none along what pulls; a lane without
        # either has no direction, and must not divide by zero.
        pulled = np.where(size > 0, size, 1.0)
        self.way = np.where(still, pull, v) / np.where(still, pulled, speed)
        if self._guided < v.shape[1]:
            self.way = np.where(self._along_guide, self.way, 0.0)
        return self._rubbed(pull, limit, self.way)

    def during(self, t: Array, x: Array, v: Array) -> Array:
        """(L, D) acceleration within the step that was begun last."""
        pull = self._borne(t, x, v)
        if not self.field.dry:
            return pull / self.field.mass
        limit = self.field.limit(t, x, v)
        self.excess = (self.excess[0], self.size(pull) - limit)
        return self._rubbed(pull, limit, self._along(v))

    def halted(self, v: Array, faint: Array) -> Array:
        """Velocities v (n, D) with none along the guide where it is no larger than `faint`
        (n, 1).
        """
        return np.where((self.size(v) <= faint) & self._along_guide, 0.0, v)

    def lay(self, lanes: Indices) -> None:
        """These lanes (n,) rest on the ground from now on."""
        self.rests[lanes] = True
        self._any_rests = True

    def lift(self, v: Array) -> None:
        """Lanes that move up, v (L, D), rest no longer."""
        if self._any_rests:
            self.rests &= v[:, -1:] <= 0
            self._any_rests = bool(self.rests.any())

    def _borne(self, t: Array, x: Array, v: Array) -> Array:
        """Forces but for dry friction, without what the ground takes."""
        pull = self.field.force(t, x, v)
        if self._any_rests:
            pull = pull + 0.0  # a copy: a constant force is the same array at every instant
            # The ground pushes and does not pull: what lifts the lane is left to it.
            lift = pull[:, -1:]
            pull[:, -1:] = np.where(self.rests, np.maximum(lift, 0.0), lift)
        return pull

    def _along(self, v: Array) -> Array:
        """Directions of v, turned to the side of the direction at the beginning."""
        if self._guided == 1:
            return self.way
        # In a plane the direction may turn within the step, but not over to the other side: that
        # is a reversal, which the step is cut for.
        speed = length(v)
        divisor = np.where(speed > 0, speed, 1.0)
        unit = np.where(speed > 0, v / divisor, self.way)
        side = np.where(dot(unit, self.way) < 0, -1.0, 1.0)
        turned: Array = unit * side
        return turned

    def _rubbed(self, pull: Array, limit: Array, way: Array) -> Array:
        friction = limit * way
        self.rubs.append(friction)  # four a step, from which it is told how friction bends
        slipping = (pull - friction) / self.field.mass
        result: Array = np.where(self.sticks & self._along_guide, 0.0, slipping)
        return result

    def size(self, v: Array) -> Array:
        """(n, 1) magnitudes along the guide."""
        return length(v[:, : self._guided])


def dot(a: Array, b: Array) -> Array:
    """(L, 1) inner products."""
    if a.shape[1] == 1:
        return a * b
    result: Array = (a * b).sum(axis=1, keepdims=True)
    return result


def length(v: Array) -> Array:
    """(L, 1) magnitudes."""
    if v.shape[1] == 1:
        return np.abs(v)
    result: Array = np.sqrt((v * v).sum(axis=1, keepdims=True))
    return result
