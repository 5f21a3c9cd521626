"""Force programs of systems and effects that cannot be traced: NumPy evaluates their functions.

The program has one instruction for each of its parts, which calls a function of Python. It reads
the inputs from the registers of all slots, evaluates the array functions, and writes the results.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction
from sims.core.simulator import Array
from sims.core.system import StateSnapshot, System
from sims.engines.compiled.data_layout import (
    FORCES,
    IMPACTS,
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
    InputNames,
    IntTable,
    ProgramArrays,
    make_flags,
)
from sims.engines.compiled.traced_array import EXTERNAL

NUMPY_BLOCK_WIDTH = 1024
"""Number of slots of a block: a call of NumPy costs more than its rows."""
PART_COUNT = 3
"""Number of parts of a program: per element, per evaluation, per impact."""
_Callback = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)


class NumpyForces:
    """Forces of a system and its effects, evaluated on registers by the array functions.

    Attributes:
        error: first exception of an array function; all later results are NaN.
    """

    def __init__(
        self,
        system: System,
        names: InputNames,
        effects: Sequence[Effect],
        rows: IntTable,
        out: IntTable,
        r: Array,
    ) -> None:
        """Make the C callback through which machine code calls the Python functions.

        `_snapshots` caches, by the number of slots, arrays that are views of the registers.

        Args:
            system: system whose forces are evaluated.
            names: input names and sizes.
            effects: effects that act.
            rows: registers of inputs and outputs; see `ProgramArrays`.
            out: registers of the force.
            r: (registers, W) registers.
        """
        self.error: BaseException | None = None
        self._system = system
        self._names = names
        self._effects = effects
        self._rows = rows
        self._out = out
        self._r = r
        self._snapshots: dict[int, tuple[StateSnapshot, list[Array]]] = {}
        self.callback = _Callback(self._evaluate_part)

    @property
    def code(self) -> IntTable:
        """Instructions (3, 5) that call this object, one for each part of the program."""
        address = ctypes.cast(self.callback, ctypes.c_void_p).value
        return np.array(
            [[EXTERNAL, 0, 0, part, address] for part in range(PART_COUNT)], dtype=np.int64
        )

    def _evaluate_part(self, part: int, width: int) -> None:
        """Evaluate one part of the program for the first `width` slots (called by machine code).

        Values that depend on parameters alone (`CONSTANTS`) are not separated here, so that part
        has nothing to do. An exception cannot pass through machine code: it is stored, all results
        are NaN from then on, and the caller raises it afterwards.
        """
        if self.error is None:
            try:
                with np.errstate(all="ignore"):
                    if part == FORCES:
                        self._evaluate_forces(width)
                    elif part == IMPACTS:
                        self._evaluate_impact(width)
            except BaseException as error:
                self.error = error
        if self.error is not None:
            self._r[self._out] = np.nan
            self._r[self._rows[OUT_LIMIT:]] = np.nan

    def _evaluate_forces(self, width: int) -> None:
        """Write total force and friction limit of the first `width` slots into the registers.

        Args:
            width: Number of slots in use.
        """
        moment, coefficients = self._make_snapshot(width)
        force = self._system.force(moment)
        limit: Any = 0.0
        for effect, c in zip(self._effects, coefficients, strict=True):
            if isinstance(effect, Force):
                force = force + effect.force(c, moment)
            elif isinstance(effect, Friction):
                limit = limit + effect.limit(c, moment)
        self._r[self._out, :width] = force.T
        self._r[self._rows[OUT_LIMIT], :width] = np.broadcast_to(limit, (width, 1))[:, 0]

    def _evaluate_impact(self, width: int) -> None:
        """Write restitution and friction coefficient, with effects, into the registers.

        Args:
            width: Number of slots in use.
        """
        _, coefficients = self._make_snapshot(width)
        restitution, friction, speed = (
            self._view_registers(row, 1, width) for row in (IN_E, IN_MU, IN_SPEED)
        )
        for effect, c in zip(self._effects, coefficients, strict=True):
            if isinstance(effect, Contact):
                restitution = effect.restitution(c, restitution, speed)
                friction = friction + effect.friction(c)
        self._r[self._rows[OUT_E], :width] = restitution[:, 0]
        self._r[self._rows[OUT_MU], :width] = friction[:, 0]

    def _make_snapshot(self, width: int) -> tuple[StateSnapshot, list[Array]]:
        """Return the arguments of the array functions for the first W = `width` slots.

        They are views of the registers, so that they show the present values in every
        evaluation. One slice of registers holds all parameters: those of the system, its constants,
        and the coefficients of each effect, in this order.

        Returns:
            State, inputs and parameters; and the coefficients (K, W, 1) of each effect, which has
            K of them.
        """
        if width not in self._snapshots:
            names = self._names
            first = int(self._rows[IN_P])
            counts = [names.parameters, *(1 for _ in names.constants)]
            counts += [len(effect.coefficients) for effect in self._effects]
            parts = np.split(self._r[first : first + sum(counts), :width], np.cumsum(counts)[:-1])
            theta, *columns = (part.T for part in parts)
            constants = dict(zip(names.constants, columns, strict=False))
            coefficients = [part[:, :, None] for part in parts[1 + len(names.constants) :]]
            t, x, v = (
                self._view_registers(row, count, width)
                for row, count in ((IN_T, 1), (IN_X, names.coordinates), (IN_V, names.coordinates))
            )
            u = self._view_registers(IN_U, len(names.inputs), width)
            inputs = {name: u[:, k, None] for k, name in enumerate(names.inputs)}
            moment = StateSnapshot(self._system, theta, constants, t, x, v, inputs)
            self._snapshots[width] = moment, coefficients
        return self._snapshots[width]

    def _view_registers(self, row: int, count: int, width: int) -> Array:
        """Return a view (W, count) of input registers.

        Args:
            row: number of the group of inputs.
            count: number of registers.
            width: number W of slots in use.
        """
        first = self._rows[row]
        values: Array = self._r[first : first + count, :width].T
        return values


def lay_out_registers(
    system: System, names: InputNames, effects: Sequence[Effect]
) -> tuple[ProgramArrays, int]:
    """Assign registers to the inputs and outputs of a program that calls NumPy.

    Groups of registers follow each other in the order of `ProgramArrays.rows`, then those of the
    force.

    Args:
        system: system whose forces are evaluated.
        names: input names and sizes.
        effects: effects that act.

    Returns:
        The arrays of the program, without instructions yet, and its number of registers.
    """
    parameters = names.parameters + len(names.constants)
    parameters += sum(len(effect.coefficients) for effect in effects)
    d = names.coordinates
    # Time, position, velocity, inputs, parameters; restitution, ground friction and speed of an
    # impact; limit of dry friction, restitution and ground friction with effects; forces.
    sizes = [1, d, d, len(names.inputs), parameters, 1, 1, 1, 1, 1, 1, d]
    block_ends = np.cumsum(sizes)
    program = ProgramArrays(
        code=np.zeros((PART_COUNT, 5), dtype=np.int64),
        ends=np.arange(PART_COUNT + 1),
        rows=np.array([0, *block_ends[:10]]),
        out=np.arange(block_ends[10], block_ends[11]),
        flags=make_flags(system, names, effects),
    )
    return program, int(block_ends[-1])
