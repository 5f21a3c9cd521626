"""Forces on many one-coordinate elements, linearised in the velocity.

The module contains the forces of `external.joint_forces` with arrays instead of numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.engines.external.external_engine import ElementWork
from sims.engines.external.external_forces import ExternalForces, integrate_velocity_batch
from sims.engines.external.joint_forces import VELOCITY_STEP, compute_drive_forces
from sims.engines.external.resistance_laws import make_resistance_batch

LinearisedForces = tuple[Array, Array | None, Array, Array]
"""Weight, limit of dry friction, force and its slope in the velocity, each (n,)."""


class JointBatchForces(ABC):
    """Forces on n batch elements, linear in the velocity around the last evaluation.

    Attributes:
        weight: (n,) force of the engine's own gravity at the last evaluation.
        limit: (n,) limits of dry friction; None where no element has any.
    """

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[ElementWork]) -> None:
        self._gravity = gravity
        self._lanes = lanes
        nothing = np.zeros(len(lanes))
        self.weight = self._at = self._force = self._slope = nothing
        self.limit: Array | None = None

    @abstractmethod
    def set_inputs(self, k: int, t: Array, x: Array, v: Array) -> None:
        """Set the inputs of step k and re-evaluate the elements whose inputs have changed.

        Args:
            k: index of the step.
            t: (n,) times in seconds.
            x: (n,) positions.
            v: (n,) velocities.
        """

    @abstractmethod
    def _see(self, t: Array, x: Array, v: Array) -> LinearisedForces:
        """Evaluate all forces at these states."""

    def truncate(self, count: int) -> None:
        """Continue with the first `count` elements only."""
        self._lanes = self._lanes[:count]
        self.weight = self.weight[:count]
        self.limit = None if self.limit is None else self.limit[:count]
        self._at = self._at[:count]
        self._force = self._force[:count]
        self._slope = self._slope[:count]

    def linearise(self, t: Array, x: Array, v: Array) -> None:
        """Evaluate all forces at these states and linearise them in the velocity.

        Args:
            t: (n,) times in seconds.
            x: (n,) positions.
            v: (n,) velocities.
        """
        self._at = v
        self.weight, self.limit, self._force, self._slope = self._see(t, x, v)

    def _look_again(self, where: Array, t: Array, x: Array, v: Array) -> None:
        """Evaluate all forces again for the elements where `where` (n,) is True."""
        weight, limit, force, slope = self._see(t, x, v)
        self._at = np.where(where, v, self._at)
        self.weight = np.where(where, weight, self.weight)
        self._force = np.where(where, force, self._force)
        self._slope = np.where(where, slope, self._slope)
        if limit is not None and self.limit is not None:
            self.limit = np.where(where, limit, self.limit)

    def compute_force(self, v: Array) -> Array:
        """Return gravity and all forces except dry friction (n,), near the evaluated velocities."""
        return self._force + self._slope * (v - self._at)

    def compute_end_velocity(self, w: Array, half: Array, inertia: Array) -> Array:
        """Return velocities half a step after `w`, with the force at the end; see `joint_forces`.

        Args:
            w: (n,) the engine's velocities.
            half: (n,) half step sizes in seconds.
            inertia: (n,) generalised inertias.

        Returns:
            Velocities (n,).
        """
        slope = np.minimum(self._slope, 0.0)
        force = self._force + slope * (w - self._at)
        return integrate_velocity_batch(w, force, self.limit, 1.0 / (inertia - half * slope), half)


class EvaluatedJointBatchForces(JointBatchForces):
    """Forces evaluated by calling system and effects, at two velocities to get the slope."""

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[ElementWork]) -> None:
        super().__init__(gravity, lanes)
        names = lanes[0].inputs
        size = max((lane.inputs[name].size for lane in lanes for name in names), default=1)
        # The shape is (S, lanes), so that the values of one step are contiguous in memory.
        self._signals = {name: _columns([lane.inputs[name] for lane in lanes]) for name in names}
        changes = np.zeros((size, len(lanes)), dtype=bool)
        for values in self._signals.values():
            changes[1:] |= values[1:] != values[:-1]
        self._changes = changes
        self._turns = _rows_with(changes)
        self._ask = ExternalForces(lanes, 2)

    def truncate(self, count: int) -> None:
        """Continue with the first `count` elements only."""
        if count < len(self._lanes):
            super().truncate(count)
            self._ask = ExternalForces(self._lanes, 2)
            self._signals = {name: u[:, :count] for name, u in self._signals.items()}
            self._changes = self._changes[:, :count]
            self._turns = _rows_with(self._changes)
            self._set(self._step)

    def set_inputs(self, k: int, t: Array, x: Array, v: Array) -> None:
        """Set the inputs of step k and re-evaluate the elements whose inputs have changed."""
        self._step = k
        if k in self._turns:
            self._set(k)
            self._look_again(self._changes[k], t, x, v)

    def _set(self, k: int) -> None:
        signals = {name: u[k] for name, u in self._signals.items()}
        self._ask.set_inputs({name: np.tile(u, 2)[:, None] for name, u in signals.items()})

    def _see(self, t: Array, x: Array, v: Array) -> LinearisedForces:
        moment = self._ask.moment
        count = t.size
        for half in (slice(count), slice(count, None)):
            moment.t[half, 0] = t
            moment.x[half, 0] = x
            moment.v[half, 0] = v
        # The second velocity is farther from zero, where forces may be discontinuous.
        nudge = np.copysign(VELOCITY_STEP, v)
        moment.v[count:, 0] += nudge
        both = self._ask.compute_force()[:, 0]
        force, nudged = both[:count], both[count:]
        weight = self._gravity(x)
        limit = self._ask.compute_friction_limits() if self._ask.rubs else None
        return weight, limit, weight + force, (nudged - force) / nudge


class ClosedFormJointBatchForces(JointBatchForces):
    """Forces in closed form: an unmodified input, and resistance laws of the speed."""

    def __init__(self, gravity: Callable[[Array], Array], lanes: Sequence[ElementWork]) -> None:
        super().__init__(gravity, lanes)
        self._drive = _columns([compute_drive_forces(lane) for lane in lanes])
        self._changes = np.zeros(self._drive.shape, dtype=bool)
        self._changes[1:] = self._drive[1:] != self._drive[:-1]
        self._turns = _rows_with(self._changes)
        self._now = self._drive[0]
        self._opposing = make_resistance_batch(lanes)
        self.limit = self._opposing.limit

    def truncate(self, count: int) -> None:
        """Continue with the first `count` elements only."""
        super().truncate(count)
        self._drive = self._drive[:, :count]
        self._changes = self._changes[:, :count]
        self._turns = _rows_with(self._changes)
        self._now = self._now[:count]
        self._opposing = self._opposing.truncate(count)

    def set_inputs(self, k: int, t: Array, x: Array, v: Array) -> None:
        """Set the input of step k and re-evaluate the elements whose input has changed."""
        if k in self._turns:
            self._now = self._drive[k]
            self._look_again(self._changes[k], t, x, v)

    def _see(self, t: Array, x: Array, v: Array) -> LinearisedForces:  # noqa: ARG002
        opposed, slope = self._opposing.compute(np.abs(v))
        weight = self._gravity(x)
        return weight, self._opposing.limit, weight + self._now - opposed * v, -slope


def _rows_with(where: NDArray[np.bool_]) -> set[int]:
    """Return the indices of the rows of (S, L) in which any value is True."""
    return set(np.flatnonzero(where.any(axis=1)).tolist())


def _columns(rows: Sequence[Array]) -> Array:
    """Stack rows of different sizes as columns (S, L); repeat the last value of shorter ones."""
    size = max(row.size for row in rows)
    result = np.empty((size, len(rows)))
    for i, row in enumerate(rows):
        result[: row.size, i] = row
        result[row.size :, i] = row[-1]
    return result
