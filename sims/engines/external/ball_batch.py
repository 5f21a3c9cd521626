"""Integrate many balls together, with forces evaluated at each step.

The module contains the algorithm of `external.ball_rollout` with arrays instead of numbers.

Between impacts all elements step together. A step with an impact is integrated separately: the
element is transferred to a `ball_rollout.BallRollout`, which cuts the step at the impact, and
transferred back afterwards. Each element gets the same result as when it is integrated alone, bit
for bit. Elements are sorted by their number of steps, largest first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Force, Friction
from sims.engines.external.ball_forces import EffectForceBatch, get_gravity, make_trajectory
from sims.engines.external.ball_rollout import BallRollout, BallWithImpacts
from sims.engines.external.batch_schedule import StepSchedule
from sims.engines.external.external_engine import ElementWork, Indices, Trajectory
from sims.engines.external.resistance_laws import make_resistance


class BallBatch(Protocol):
    """Balls over level ground, one per batch element, that an engine steps together."""

    min_batch_size: Mapping[str, int]
    """Minimum number of elements for which integration together is faster, by kind.

    The kinds are ``known`` and ``asked``; see `sims.engines.external.joint_batch.JointBatch`.
    """
    max_batch_size: int
    """Maximum number of elements for which integration together is faster."""

    def reset_world(self, constants: dict[str, float], count: int) -> BallWithImpacts:
        """Prepare the world for `count` batch elements with equal constants.

        Returns:
            A separate ball for the integration of a single element, also prepared.
        """
        ...

    def set_step(self, lanes: Indices, step: Array) -> None:
        """Set the steps (m,) of the elements `lanes` (m,), in seconds."""
        ...

    def set_state(self, lanes: Indices, x: Array, w: Array) -> None:
        """Set position and the engine's velocity of some elements.

        Args:
            lanes: (m,) indices of the elements.
            x: (m, 3) positions.
            w: (m, 3) the engine's velocities.
        """
        ...

    def get_state(self, count: int) -> tuple[Array, Array]:
        """Return positions and velocities (n, 3) of the first `count` elements.

        The arrays are views: they change when the engine steps.
        """
        ...

    def advance(self, lanes: Indices, force: Array) -> None:
        """Advance some elements by one step.

        Args:
            lanes: (m,) indices of the elements.
            force: (m, 3) forces per unit mass in m/s^2, in addition to gravity.
        """
        ...

    def export_element(self, lane: int) -> None:
        """Copy the contact state of an element to the separate ball."""
        ...

    def import_element(self, lane: int) -> None:
        """Copy the contact state of the separate ball back to an element."""
        ...


class BallBatchIntegrator:
    """Integrate balls together; see `sims.engines.external.batch_grouping.BatchIntegrator`."""

    requires_equal_steps = False

    def __init__(self, balls: BallBatch) -> None:
        self._balls = balls
        self.min_batch_size = balls.min_batch_size
        self.max_batch_size = balls.max_batch_size

    def get_batch_kind(self, lane: ElementWork) -> str:
        """Return the kind of an element: ``known``, ``asked``, or ``plain`` (no flight forces)."""
        if not any(isinstance(effect, Force | Friction) for effect, _ in lane.effects):
            return "plain"
        return "asked" if make_resistance(lane) is None else "known"

    def integrate(self, lanes: Sequence[ElementWork]) -> list[Trajectory | None]:
        """Integrate batch elements together and return their trajectories.

        See `sims.engines.external.batch_grouping.BatchIntegrator`.
        """
        order = sorted(range(len(lanes)), key=lambda i: -lanes[i].steps.size)
        paths = _Flights(self._balls, [lanes[i] for i in order]).paths()
        return [paths[place] for place in np.argsort(order)]


class _Flights:
    """Integration of several balls."""

    def __init__(self, balls: BallBatch, lanes: Sequence[ElementWork]) -> None:
        count = len(lanes)
        self._balls = balls
        self._lanes = lanes
        self._table = StepSchedule(lanes)
        self._pulls = EffectForceBatch(lanes)
        self._gravity = np.array(get_gravity(lanes[0]))
        first = lanes[0]
        self._floor = float(first.system.floor(first.constants)[0, 0])
        ball = balls.reset_world(first.plain_constants, count)
        self._own: list[BallRollout] = []
        self._rests = np.zeros(count, dtype=bool)
        self._paced = np.full(count, np.nan)  # step that is set in the engine
        self._placed = np.zeros(count, dtype=bool)
        self._failed = np.zeros(count, dtype=bool)
        self._t = np.zeros(count)
        self._v = np.zeros((count, 3))
        self._a = np.zeros((count, 3))
        self._lift = np.zeros(count)
        self._x, self._w = balls.get_state(count)
        self._rows = np.full((self._table.kept, count, 9), np.nan)
        for i, lane in enumerate(lanes):
            balls.export_element(i)
            self._own.append(BallRollout(ball, lane))
            self._back(i)
        self._start = self._x.copy()
        self._keep(0)

    def paths(self) -> list[Trajectory]:
        """Return the trajectory of each element; NaN where it failed."""
        for begin, end, count in self._table.list_phases():
            self._only(count)
            for k in range(begin, end):
                self._step(k)
        return [self._path(i) for i in range(len(self._lanes))]

    def _only(self, count: int) -> None:
        """Continue with the first `count` elements only."""
        self._x, self._w = self._balls.get_state(count)
        for name in ("_rests", "_paced", "_placed", "_t", "_v", "_a", "_lift"):
            setattr(self, name, getattr(self, name)[:count])
        self._pulls.truncate(count)

    def _step(self, k: int) -> None:
        """Advance by step `k`: `BallRollout._stepwise` and its equations for arrays."""
        h = self._table.steps[: self._t.size, k]
        flies = self._rests & (self._lift > 0.0)
        if flies.any():
            self._rests = self._rests & ~flies
            self._placed = self._placed & ~flies
            self._a[flies, 2] = self._lift[flies]
        meets = ~self._rests & (self._time_to_ground() < h)
        some = np.flatnonzero(~meets)
        left = np.flatnonzero(meets)
        before = [values[left] for values in (self._v, self._a, self._lift, self._t)]
        if some.size:
            self._forced(some, h)
        # Elements with an impact have not been advanced yet: their state is restored.
        for values, kept in zip((self._v, self._a, self._lift, self._t), before, strict=True):
            values[left] = kept
        for i in left.tolist():
            self._meet(i, float(h[i]))
        if self._table.rows[k + 1] >= 0:
            self._keep(int(self._table.rows[k + 1]))

    def _forced(self, some: Indices, h: Array) -> None:
        """Advance some elements by one step, in flight or at rest, under all forces.

        Afterwards, time and velocity of the other elements are not valid.
        """
        half = 0.5 * h[:, None]
        ahead = self._v + half * self._a
        new = some[(self._paced[some] != h[some]) | ~self._placed[some]]
        if new.size:
            self._balls.set_step(new, h[new])
            self._paced[new] = h[new]
            self._placed[new] = True
            self._balls.set_state(new, self._x[new], (self._v - half * self._a)[new])
        force = (ahead - self._w) / h[:, None] - self._gravity  # (4)
        force[:, 2] = np.where(self._rests, self._lift - self._gravity[2], force[:, 2])
        self._balls.advance(some, force[some])
        if not np.isfinite(self._x.sum() + self._w.sum()):
            self._set_aside()
        self._t = self._t + h
        self._v = 2.0 * self._w - self._v
        self._v[self._rests, 2] = 0.0
        self._look()
        self._v = self._w + half * self._a  # (3)
        self._v[self._rests, 2] = 0.0

    def _look(self) -> None:
        """Evaluate the accelerations at the present states; at rest the vertical one is zero."""
        self._a = self._gravity + self._pulls.compute(self._t, self._x, self._v)
        self._lift = self._a[:, 2].copy()
        self._a[self._rests, 2] = 0.0

    def _time_to_ground(self) -> Array:
        """Return the seconds (n,) until each ball meets the ground; NaN for failed elements.

        See `BallRollout`.
        """
        gap = np.maximum(self._x[:, 2] - self._floor, 0.0)
        rate = self._v[:, 2]
        lift = self._a[:, 2]
        inside = rate * rate - 2.0 * lift * gap
        root = np.sqrt(inside)
        rises = (rate > 0.0) | ((rate == 0.0) & (lift < 0.0))
        back = np.where(lift < 0.0, (rate + root) / -lift, np.inf)  # (5)
        never = (inside < 0.0) | ((rate == 0.0) & (lift >= 0.0))
        down = np.where(never, np.inf, 2.0 * gap / (root - rate))
        return np.where(rises, back, down)

    def _meet(self, i: int, step: float) -> None:
        """Advance element `i` by a step that contains impacts."""
        own = self._own[i]
        self._balls.export_element(i)
        own.x = self._x[i].tolist()
        own.v = self._v[i].tolist()
        own.a = self._a[i].tolist()
        own.lift = float(self._lift[i])
        own.time = float(self._t[i])
        own.rests = False
        own.w = None
        own.step = np.nan
        own.advance_with_impacts(step)
        self._back(i)

    def _back(self, i: int) -> None:
        """Copy the state of element `i` back from its separate `BallRollout`."""
        own = self._own[i]
        self._balls.import_element(i)
        self._v[i] = own.v
        self._a[i] = own.a
        self._lift[i] = own.lift
        self._t[i] = own.time
        self._rests[i] = own.rests
        self._paced[i] = own.step
        self._placed[i] = own.w is not None
        one = np.array([i])
        if own.w is not None:
            self._balls.set_step(one, self._paced[one])
        self._balls.set_state(one, np.array([own.x]), np.array([own.w or own.v]))

    def _set_aside(self) -> None:
        """Put failed elements back to their initial state and discard their results."""
        bad = np.flatnonzero(~np.isfinite(self._x.sum(axis=1) + self._w.sum(axis=1)))
        self._failed[bad] = True
        self._v[bad] = 0.0
        self._balls.set_state(bad, self._start[bad], np.zeros((bad.size, 3)))

    def _keep(self, row: int) -> None:
        count = self._t.size
        self._rows[row, :count, :3] = self._x
        self._rows[row, :count, 3:6] = self._v
        self._rows[row, :count, 6:] = self._a

    def _path(self, i: int) -> Trajectory:
        lane = self._lanes[i]
        rows = self._rows[self._table.rows[lane.recorded_steps], i]
        return make_trajectory(
            lane, [] if self._failed[i] else [tuple(row) for row in rows.tolist()]
        )
