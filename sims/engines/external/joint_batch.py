"""Integrate many one-coordinate systems together: `external.joint_rollout` with arrays.

Each batch element gets the same result as when it is integrated alone, bit for bit. Elements are
sorted by their number of steps, largest first, so that the unfinished ones are always the first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.batch_schedule import StepSchedule, pad_rows
from sims.engines.external.external_engine import ElementWork, Indices, Mask, Trajectory, is_finite
from sims.engines.external.external_forces import (
    integrate_velocity_batch,
    subtract_dry_friction_batch,
)
from sims.engines.external.joint_batch_forces import (
    ClosedFormJointBatchForces,
    EvaluatedJointBatchForces,
    JointBatchForces,
)
from sims.engines.external.joint_forces import compute_drive_forces
from sims.engines.external.joint_rollout import (
    choose_integration_mode,
    compute_transition_force,
    make_failed_trajectory,
    read_trajectory,
    to_full_step_velocity,
    to_half_step_velocity,
)


class JointBatch(Protocol):
    """Bodies on one hinge or guide each, one per batch element, that an engine steps together."""

    open_loop: bool
    """Whether the system's drive depends on its inputs alone."""
    min_batch_size: Mapping[str, int]
    """Minimum number of batch elements for which integration together is faster, by kind.

    The kinds are ``open`` (the engine runs on its own over the whole run), ``stretches`` (the
    engine runs on its own between changes of the step size), ``known`` (forces have closed-form
    laws) and ``asked`` (effects are evaluated at each step). A kind that is missing is never faster
    together.
    """
    max_batch_size: int
    """Maximum number of batch elements for which integration together is faster."""
    alike: bool
    """Whether elements can be integrated together only if their steps are equal."""

    def reset_world(self, constants: dict[str, float], count: int) -> None:
        """Prepare the world for `count` batch elements with equal constants."""
        ...

    def compute_gravity_force(self, x: Array) -> Array:
        """Return the generalised force (n,) of the engine's own gravity at positions (n,)."""
        ...

    def set_step(self, lanes: Indices, step: Array, inertia: Array, damping: Array) -> Mask:
        """Set step, generalised inertia and damping of some batch elements.

        Args:
            lanes: (n,) indices of the elements.
            step: (n,) step sizes in seconds.
            inertia: (n,) generalised inertias.
            damping: (n,) viscous joint dampings.

        Returns:
            (n,) False where the engine cannot represent the inertia.

        Raises:
            NotBatchableError: these elements cannot share a world.
        """
        ...

    def set_state(self, lanes: Indices, x: Array, w: Array) -> None:
        """Set position (n,) and the engine's velocity (n,) of the elements `lanes` (n,)."""
        ...

    def get_state(self, count: int) -> tuple[Array, Array]:
        """Return positions and velocities (n,) of the first `count` elements.

        The arrays are views: they change when the engine steps.
        """
        ...

    def advance(self, force: Array) -> None:
        """Advance the first n elements by one step with forces (n,) in addition to gravity."""
        ...

    def advance_steps(self, force: Array) -> tuple[Array, Array]:
        """Advance the first n elements by k steps with forces (n, k) in addition to gravity.

        Returns:
            Positions and velocities (n, k) after each step.
        """
        ...

    def find_elements_to_redo(self, failed: Mask) -> Mask:
        """Return which batch elements (L,) must be integrated again, one by one.

        Args:
            failed: (L,) elements without a finite result.
        """
        ...


class JointBatchIntegrator:
    """Integrate bodies on joints together; see `batch_grouping.BatchIntegrator`."""

    def __init__(self, joints: JointBatch) -> None:
        self._joints = joints
        self.min_batch_size = joints.min_batch_size
        self.max_batch_size = joints.max_batch_size
        self.requires_equal_steps = joints.alike

    def get_batch_kind(self, lane: ElementWork) -> str:
        """Return the kind of a batch element; see `JointBatch.min_batch_size`."""
        way = choose_integration_mode(lane, self._joints.open_loop)
        if way.damping is not None:
            even = bool((lane.steps == lane.steps[0]).all())
            return "open" if even else "stretches"
        return "asked" if way.opposing is None else "known"

    def integrate(self, lanes: Sequence[ElementWork]) -> list[Trajectory | None]:
        """Integrate batch elements together; see `batch_grouping.BatchIntegrator`.

        Args:
            lanes: batch elements of one kind with equal constants.

        Returns:
            The trajectory of each element; None where it must be integrated by itself.

        Raises:
            NotBatchableError: the elements must be integrated one by one.
        """
        order = sorted(range(len(lanes)), key=lambda i: -lanes[i].steps.size)
        chosen = [lanes[i] for i in order]
        self._joints.reset_world(chosen[0].plain_constants, len(lanes))
        paths = self._run(chosen).paths()
        again = self._joints.find_elements_to_redo(
            np.array([not is_finite(path) for path in paths])
        )
        return [None if again[place] else paths[place] for place in np.argsort(order)]

    def _run(self, lanes: Sequence[ElementWork]) -> _Run:
        ways = [choose_integration_mode(lane, self._joints.open_loop) for lane in lanes]
        dampings = [way.damping for way in ways]
        if None not in dampings:
            return _OpenLoopRun(self._joints, lanes, np.array(dampings, dtype=np.float64))
        if None not in [way.opposing for way in ways]:
            return _StepwiseRun(
                self._joints,
                lanes,
                ClosedFormJointBatchForces(self._joints.compute_gravity_force, lanes),
            )
        return _StepwiseRun(
            self._joints,
            lanes,
            EvaluatedJointBatchForces(self._joints.compute_gravity_force, lanes),
        )


class _Run(Protocol):
    """Integration of several batch elements."""

    def paths(self) -> list[Trajectory]:
        """Return the trajectory of each batch element."""
        ...


class _OpenLoopRun:
    """Integration without feedback except viscous damping; see `joint`.

    The engine receives all steps of equal length in one call.
    """

    def __init__(self, joints: JointBatch, lanes: Sequence[ElementWork], damping: Array) -> None:
        self._joints = joints
        self._lanes = lanes
        self._table = StepSchedule(lanes)
        self._drive = pad_rows([compute_drive_forces(lane) for lane in lanes])
        self._inertia = _inertia(lanes)
        self._damping = damping
        self._failed = np.zeros(len(lanes), dtype=bool)
        self._rows = np.full((self._table.kept, len(lanes), 4), np.nan)
        self._rows[0, :, 0] = [lane.x[0] for lane in lanes]
        self._rows[0, :, 3] = self._drive[:, 0]

    def paths(self) -> list[Trajectory]:
        """Return the trajectory of each batch element."""
        for begin, end, count in self._table.list_phases():
            borders = begin + np.flatnonzero(self._table.paced[begin:end])
            ends = [*borders[borders > begin].tolist(), end]
            for first, last in zip([begin, *ends], ends, strict=False):
                self._stretch(first, last, count)
        return [self._path(i) for i in range(len(self._lanes))]

    def _stretch(self, begin: int, end: int, count: int) -> None:
        """Advance through steps in which the step size of no batch element changes."""
        u = self._drive[:count, begin:end]
        before = self._drive[:count, max(begin - 1, 0) : end - 1]
        if not begin:
            before = np.concatenate([u[:, :1], before], axis=1)
        some = slice(count)
        step = self._table.steps[some, begin, None]
        turned = compute_transition_force(
            before, u, self._inertia[some, None], self._damping[some, None], step
        )
        force = np.where(u == before, u, turned)
        if self._table.paced[begin]:
            new = self._pace(begin, count)
            force[new, 0] = u[new, 0]  # a newly placed element has no previous step
        x, w = self._joints.advance_steps(force)
        rows = self._table.rows[begin + 1 : end + 1]
        kept = np.flatnonzero(rows >= 0)
        to = self._rows[rows[kept], :count]
        to[:, :, 0] = x[:, kept].T
        to[:, :, 1] = w[:, kept].T
        to[:, :, 2] = step[:, 0]
        to[:, :, 3] = u[:, kept].T
        self._rows[rows[kept], :count] = to

    def _pace(self, begin: int, count: int) -> Indices:
        """Set the step sizes that change at step `begin`; return the indices of these elements."""
        h = self._table.steps[:count, begin]
        inertia = self._inertia[:count]
        damping = self._damping[:count]
        if begin:
            old = self._table.steps[:count, begin - 1]
            new = np.flatnonzero(h != old)
            x, w = (values[new] for values in self._joints.get_state(count))
            # A failed element is put back to its initial position, and its result is discarded.
            bad = ~np.isfinite(x + w)
            self._failed[new[bad]] = True
            x = np.where(bad, self._rows[0, new, 0], x)
            w = np.where(bad, 0.0, w)
            force = self._joints.compute_gravity_force(x) + self._drive[new, begin - 1]
            v = to_full_step_velocity(w, force, inertia[new], damping[new], old[new])
        else:
            new = np.arange(count)
            x = self._rows[0, :, 0]
            v = np.array([lane.v[0] for lane in self._lanes])
        h, inertia, damping = h[new], inertia[new], damping[new]
        carried = inertia + 0.5 * h * damping
        self._failed[new[~self._joints.set_step(new, h, carried, damping)]] = True
        force = self._joints.compute_gravity_force(x) + self._drive[new, begin]
        self._joints.set_state(new, x, to_half_step_velocity(v, force, inertia, damping, h))
        return new

    def _path(self, i: int) -> Trajectory:
        lane = self._lanes[i]
        if self._failed[i]:
            return make_failed_trajectory(lane)
        rows = self._rows[self._table.rows[lane.recorded_steps], i]
        return read_trajectory(lane, rows, float(self._inertia[i]), float(self._damping[i]))


class _StepwiseRun:
    """Integration that evaluates all forces at each step; see `joint`."""

    def __init__(
        self, joints: JointBatch, lanes: Sequence[ElementWork], felt: JointBatchForces
    ) -> None:
        self._joints = joints
        self._lanes = lanes
        self._table = StepSchedule(lanes)
        self._felt = felt
        self._start = np.array([lane.x[0] for lane in lanes])
        self._v = np.array([lane.v[0] for lane in lanes])
        self._t = np.zeros(len(lanes))
        self._inertia = _inertia(lanes)
        self._inverse = 1.0 / self._inertia
        self._h = self._half = np.zeros(len(lanes))
        self._failed = np.zeros(len(lanes), dtype=bool)
        self._rows = np.full((3, self._table.kept, len(lanes)), np.nan)

    def paths(self) -> list[Trajectory]:
        """Return the trajectory of each batch element."""
        every = np.arange(len(self._lanes))
        self._joints.set_state(every, self._start, np.zeros(every.size))
        self._felt.linearise(self._t, self._start, self._v)
        self._keep(0, self._start)
        for begin, end, count in self._table.list_phases():
            self._only(count)
            for k in range(begin, end):
                self._step(k)
        return [self._path(i) for i in range(len(self._lanes))]

    def _only(self, count: int) -> None:
        """Continue with the first `count` batch elements only."""
        self._x, self._w = self._joints.get_state(count)
        self._v = self._v[:count]
        self._t = self._t[:count]
        self._inertia = self._inertia[:count]
        self._inverse = self._inverse[:count]
        self._h = self._h[:count]
        self._half = self._half[:count]
        self._felt.truncate(count)

    def _step(self, k: int) -> None:
        felt = self._felt
        felt.set_inputs(k, self._t, self._x, self._v)
        if self._table.paced[k]:
            self._h = self._table.steps[: self._t.size, k]
            self._half = 0.5 * self._h
        start = integrate_velocity_batch(
            self._v, felt.compute_force(self._v), felt.limit, self._inverse, self._half
        )  # (1)
        if self._table.paced[k]:
            self._pace(k, start)
        push = (start - self._w) * self._inertia / self._h - felt.weight  # (4)
        self._joints.advance(push)  # (2)
        # The product is not finite if any of the numbers is not finite.
        if not math.isfinite(np.dot(self._x, self._w)):
            self._set_aside()
        self._t = self._t + self._h
        felt.linearise(self._t, self._x, 2.0 * self._w - self._v)
        self._v = felt.compute_end_velocity(self._w, self._half, self._inertia)  # (3)
        if self._table.rows[k + 1] >= 0:
            self._keep(self._table.rows[k + 1], self._x)

    def _pace(self, k: int, start: Array) -> None:
        """Set the step sizes that change at step `k`."""
        new = np.arange(self._t.size)
        if k:
            new = np.flatnonzero(self._h != self._table.steps[: self._t.size, k - 1])
        inertia = self._inertia[new]
        able = self._joints.set_step(new, self._h[new], inertia, np.zeros(new.size))
        self._failed[new[~able]] = True
        # With this velocity, the applied force equals the true force.
        self._joints.set_state(new, self._x[new], 2.0 * self._v[new] - start[new])

    def _set_aside(self) -> None:
        """Put failed elements back to their initial position and discard their results.

        Otherwise, effects would be evaluated with numbers that are not finite.
        """
        bad = np.flatnonzero(~np.isfinite(self._x + self._w))
        self._failed[bad] = True
        self._v[bad] = 0.0
        self._joints.set_state(bad, self._start[bad], np.zeros(bad.size))

    def _keep(self, row: int, x: Array) -> None:
        felt = self._felt
        force = felt.compute_force(self._v)
        left = (
            force if felt.limit is None else subtract_dry_friction_batch(self._v, force, felt.limit)
        )
        count = self._v.size
        self._rows[0, row, :count] = x
        self._rows[1, row, :count] = self._v
        self._rows[2, row, :count] = left / self._inertia

    def _path(self, i: int) -> Trajectory:
        lane = self._lanes[i]
        if self._failed[i]:
            return make_failed_trajectory(lane)
        x, v, a = self._rows[:, self._table.rows[lane.recorded_steps], i, None]
        return x, v, a


def _inertia(lanes: Sequence[ElementWork]) -> Array:
    return np.array([float(lane.system.mass(lane.theta, lane.constants)[0, 0]) for lane in lanes])
