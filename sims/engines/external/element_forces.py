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
        self._memory = memoryview(r.data).cast("B").cast("d")
        offsets = (rows * states).tolist()
        # Time, position, velocity and inputs.
        self._t_offset, self._x_offset = offsets[IN_T], offsets[IN_X]
        self._v_offset, self._u_offset = offsets[IN_V], offsets[IN_U]
        # Restitution and friction without effects, and speed of an impact.
        self._e_offset, self._mu_offset = offsets[IN_E], offsets[IN_MU]
        self._speed_offset = offsets[IN_SPEED]
        # Results: force, limit of dry friction, restitution and friction with effects.
        self._force_offsets = (layout.out * states).tolist()
        self._limit_offset = offsets[OUT_LIMIT] if flags[HAS_FRICTION] else None
        self._impact_offsets = offsets[OUT_E], offsets[OUT_MU]
        self._state_count = states
        # For each input a list of its values, one per step.
        self._input_values = [values[0].tolist() for values in element.inputs.values()]
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
        has_changed = step == 0  # the first step has no previous one: all inputs are set
        for k, values in enumerate(self._input_values):
            if step == 0 or values[step] != values[step - 1]:
                has_changed = True
                # The input is the same for all states.
                for state in range(self._state_count):
                    self._memory[self._u_offset + k * self._state_count + state] = values[step]
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
        numbers = self._memory
        # Each register has two numbers, one for each velocity.
        numbers[self._t_offset] = numbers[self._t_offset + 1] = t
        numbers[self._x_offset] = numbers[self._x_offset + 1] = x
        numbers[self._v_offset], numbers[self._v_offset + 1] = velocities
        self._run_moment()
        force = self._force_offsets[0]  # of the only coordinate, two numbers
        return numbers[force], numbers[force + 1]

    def evaluate(self, t: float, x: Vector, v: Vector) -> tuple[float, float, float]:
        """Return the force on a ball per unit mass in m/s^2, with gravity and dry friction.

        Dry friction, which no effect of the library applies to a free ball, opposes the velocity.

        Args:
            t: time in seconds.
            x: position.
            v: velocity.
        """
        numbers = self._memory
        numbers[self._t_offset] = t
        # There is one state, so that registers of one number each follow each other: the three
        # coordinates are in consecutive places.
        x_offset, v_offset = self._x_offset, self._v_offset
        numbers[x_offset], numbers[x_offset + 1], numbers[x_offset + 2] = x
        vx, vy, vz = v
        numbers[v_offset], numbers[v_offset + 1], numbers[v_offset + 2] = vx, vy, vz
        self._run_moment()
        fx, fy, fz = (numbers[k] for k in self._force_offsets)
        limit = self.limit
        speed = math.sqrt(vx * vx + vy * vy + vz * vz) if limit else 0.0
        # Dry friction has no direction at rest.
        share = limit / speed if speed else 0.0
        return fx - share * vx, fy - share * vy, fz - share * vz

    @property
    def limit(self) -> float:
        """Limit of dry friction at the first state of the last evaluation."""
        return 0.0 if self._limit_offset is None else self._memory[self._limit_offset]

    def compute_impact(self, speed: float) -> tuple[float, float]:
        """Return restitution and friction coefficient of an impact at this speed (m/s).

        The compiled program reads its inputs from `_memory`, and writes its results there.
        """
        numbers = self._memory
        numbers[self._e_offset] = self._restitution
        numbers[self._mu_offset] = 0.0
        numbers[self._speed_offset] = speed
        self._run_impact()
        e, mu = self._impact_offsets
        return numbers[e], numbers[mu]
