"""Forces of a system and its effects on one batch element that an external engine integrates."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sims.core.effect import Force, Friction
from sims.core.system import System
from sims.engines.compiled.data_layout import (
    BOUNCES,
    HAS_FRICTION,
    IN_E,
    IN_MU,
    IN_P,
    IN_SPEED,
    IN_T,
    IN_U,
    IN_V,
    IN_X,
    OUT_E,
    OUT_LIMIT,
    OUT_MU,
)
from sims.engines.external.external_engine import ElementWork

Vector = Sequence[float]
"""Vector x, y, z."""


class ElementForces:
    """Forces of system and effects at one or several states of a batch element.

    Attributes:
        acts: whether forces act in addition to gravity.
    """

    def __init__(self, element: ElementWork, states: int) -> None:
        """Write the element's parameters into the registers, and find the offsets of numbers.

        The force program reads its inputs from registers, and writes its results there. A register
        holds one number for each of the `states`, so that register k begins at the offset
        k * `states` in the flat memory of all registers.

        Args:
            element: batch element.
            states: number of states that are evaluated in one call.
        """
        prepared, layout = element.program.prepare(states)
        # `rows` has the first register of each kind of input and output.
        rows, flags, r = layout.rows, layout.flags, prepared.r
        r[rows[IN_P] : rows[IN_E]] = element.parameters[:, None]
        compute_constants, self._run_moment, self._run_impact = prepared.make_runners()
        # Single numbers are read and written much faster by a memory view than by an array.
        self._numbers = memoryview(r.data).cast("B").cast("d")
        offsets = (rows * states).tolist()
        self._t, self._x, self._v, self._u = (offsets[k] for k in (IN_T, IN_X, IN_V, IN_U))
        self._e, self._mu, self._speed = (offsets[k] for k in (IN_E, IN_MU, IN_SPEED))
        self._force = (layout.out * states).tolist()
        self._limit = offsets[OUT_LIMIT] if flags[HAS_FRICTION] else None
        self._impact = offsets[OUT_E], offsets[OUT_MU]
        self._states = states
        self._signals = [values[0].tolist() for values in element.inputs.values()]
        self._restitution = (
            float(element.system.restitution(element.theta)[0, 0]) if flags[BOUNCES] else 0.0
        )
        # Most systems have no passive force except gravity.
        is_driven = bool(element.inputs) or type(element.system).passive is not System.passive
        self.acts = is_driven or any(isinstance(e, Force | Friction) for e, _ in element.effects)
        self.set_inputs(0)
        compute_constants()

    def set_inputs(self, step: int) -> bool:
        """Set the inputs of a step; return whether any differs from the previous step.

        Args:
            step: Index of the step.
        """
        has_changed = step == 0
        for k, values in enumerate(self._signals):
            if step == 0 or values[step] != values[step - 1]:
                has_changed = True
                for state in range(self._states):
                    self._numbers[self._u + k * self._states + state] = values[step]
        return has_changed

    def evaluate_at_velocities(
        self, t: float, x: float, velocities: tuple[float, float]
    ) -> tuple[float, float]:
        """Return the generalised forces of an element with one coordinate at two velocities.

        Dry friction is not included; `limit` is its limit at the first velocity.

        Args:
            t: time in seconds.
            x: position.
            velocities: the two velocities.
        """
        numbers = self._numbers
        # Each register has two numbers, one for each velocity.
        numbers[self._t] = numbers[self._t + 1] = t
        numbers[self._x] = numbers[self._x + 1] = x
        numbers[self._v], numbers[self._v + 1] = velocities
        self._run_moment()
        force = self._force[0]
        return numbers[force], numbers[force + 1]

    def evaluate(self, t: float, x: Vector, v: Vector) -> tuple[float, float, float]:
        """Return the force on a ball per unit mass in m/s^2, with gravity and dry friction.

        Dry friction, which no effect of the library applies to a free ball, opposes the velocity.

        Args:
            t: time in seconds.
            x: position.
            v: velocity.
        """
        numbers = self._numbers
        numbers[self._t] = t
        numbers[self._x], numbers[self._x + 1], numbers[self._x + 2] = x
        numbers[self._v], numbers[self._v + 1], numbers[self._v + 2] = vx, vy, vz = v
        self._run_moment()
        fx, fy, fz = (numbers[k] for k in self._force)
        limit = self.limit
        speed = math.sqrt(vx * vx + vy * vy + vz * vz) if limit else 0.0
        # Dry friction has no direction at rest.
        share = limit / speed if speed else 0.0
        return fx - share * vx, fy - share * vy, fz - share * vz

    @property
    def limit(self) -> float:
        """Limit of dry friction at the first state of the last evaluation."""
        return 0.0 if self._limit is None else self._numbers[self._limit]

    def compute_impact(self, speed: float) -> tuple[float, float]:
        """Return restitution and friction coefficient of an impact at this speed (m/s).

        The compiled program reads its inputs from `_numbers`, and writes its results there.
        """
        numbers = self._numbers
        numbers[self._e], numbers[self._mu], numbers[self._speed] = self._restitution, 0.0, speed
        self._run_impact()
        e, mu = self._impact
        return numbers[e], numbers[mu]
