"""Many balls in MuJoCo, stepped together with `mujoco.batch.Batch`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.adapters.mujoco_bodies import CompiledWorld, MujocoBall, import_mujoco
from sims.engines.adapters.mujoco_joint_batch import MAX_CACHED_WORLDS
from sims.engines.external.ball_rollout import BallWithImpacts
from sims.engines.external.external_engine import Indices

MIN_BATCH_SIZE = {"known": 48, "asked": 8}


class MujocoBallBatch:
    """Balls over level ground; see `sims.engines.external.ball_batch.BallBatch`.

    Args:
        world: world whose model the elements share.
        threads: number of threads; the results do not depend on it.
    """

    min_batch_size: Mapping[str, int] = MIN_BATCH_SIZE
    max_batch_size = 256

    def __init__(self, world: CompiledWorld, threads: int) -> None:
        self._ball = MujocoBall(world)
        self._threads = threads
        self._worlds: dict[object, _World] = {}

    def reset_world(self, constants: dict[str, float], count: int) -> BallWithImpacts:
        """Prepare the world for `count` elements; see `ball_batch.BallBatch`."""
        self._mass = constants["mass"]
        self._ball.reset_world(constants)
        key = (*constants.items(), count)
        if key not in self._worlds:
            if len(self._worlds) == MAX_CACHED_WORLDS:
                self._worlds.clear()
            self._worlds[key] = _World(self._ball.model, count, self._threads)
        self._now = self._worlds[key]
        self._now.reset()
        return self._ball

    def set_step(self, lanes: Indices, step: Array) -> None:
        """Set the steps of some elements; see `sims.engines.external.ball_batch.BallBatch`."""
        self._now.step[lanes] = step
        for i, h in zip(lanes.tolist(), step.tolist(), strict=True):
            if self._now.held[i]:
                self._now.contact[i] = self._ball.get_resting_solref(h)

    def set_state(self, lanes: Indices, x: Array, w: Array) -> None:
        """Set position and velocity of some elements; see `ball_batch.BallBatch`."""
        self._now.x[lanes] = x
        self._now.w[lanes] = w

    def get_state(self, count: int) -> tuple[Array, Array]:
        """Return states of the first elements; see `sims.engines.external.ball_batch.BallBatch`."""
        return self._now.x[:count], self._now.w[:count]

    def advance(self, lanes: Indices, force: Array) -> None:
        """Advance some elements by one step; see `sims.engines.external.ball_batch.BallBatch`."""
        self._now.force[lanes] = self._mass * force
        self._now.batch.step(lanes)

    def export_element(self, lane: int) -> None:
        """Copy the contact state of an element to the separate ball."""
        self._ball.load_state(bool(self._now.held[lane]), self._now.before[lane])

    def import_element(self, lane: int) -> None:
        """Copy the contact state of the separate ball back to an element."""
        held, flags, before = self._ball.exported_state
        self._now.held[lane] = held
        self._now.flags[lane] = flags
        self._now.before[lane] = before

    def close(self) -> None:
        """Release stored worlds."""
        self._worlds.clear()
        self.__dict__.pop("_now", None)

    def __getstate__(self) -> dict[str, Any]:
        return {"_ball": self._ball, "_threads": self._threads, "_worlds": {}}


class _World:
    """Batch of balls.

    Attributes:
        step: (L,) step sizes in seconds.
        contact: (L, G, 2) contact parameters of each geom, as MuJoCo's ``solref``.
        flags: (L,) disable flags.
        held: (L,) whether contact supports the ball.
        x: (L, 3) positions.
        w: (L, 3) velocities.
        force: (L, 3) applied forces in newtons, in addition to gravity.
        before: (L, 3) acceleration of the previous step, with which MuJoCo's solver is
            warm-started.
    """

    def __init__(self, model: Any, count: int, threads: int) -> None:
        from mujoco import batch

        self.batch: Any = batch.Batch(model, count, threads)
        self.step: Array = self.batch.expand("opt.timestep").reshape(count)
        self.contact: Array = self.batch.expand("geom_solref")
        self.flags = self.batch.expand("opt.disableflags").reshape(count)
        self.held = np.zeros(count, dtype=bool)
        self.x: Array = self.batch.bind("qpos")
        self.w: Array = self.batch.bind("qvel")
        self.force: Array = self.batch.bind("qfrc_applied")
        self.before: Array = self.batch.bind("qacc_warmstart")

    def reset(self) -> None:
        """Reset all balls to their initial state, without contact."""
        self.batch.reset(stage=int(import_mujoco().mjtStage.mjSTAGE_NONE))
        self.held[:] = False
