"""Balls in MuJoCo, many at once: `mujoco.batch.Batch`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sims.base import Array
from sims.engines.external import Places
from sims.engines.flight import FlyingBall
from sims.engines.mujoco_batch import KEPT
from sims.engines.mujoco_bodies import CompiledWorld, MujocoBall, library

FEWEST = {"known": 48, "asked": 8}


class Balls:
    """Balls over level ground; see `sims.engines.flights.Balls`.

    Args:
        world: whose model the lanes share.
        threads: over which lanes are spread; the results do not depend on it.
    """

    fewest: Mapping[str, int] = FEWEST
    most = 256

    def __init__(self, world: CompiledWorld, threads: int) -> None:
        self._ball = MujocoBall(world)
        self._threads = threads
        self._worlds: dict[object, _World] = {}

    def start(self, constants: dict[str, float], count: int) -> FlyingBall:
        """See `sims.engines.flights.Balls`."""
        self._mass = constants["mass"]
        self._ball.start(constants)
        key = (*constants.items(), count)
        if key not in self._worlds:
            if len(self._worlds) == KEPT:
                self._worlds.clear()
            self._worlds[key] = _World(self._ball.model, count, self._threads)
        self._now = self._worlds[key]
        self._now.reset()
        return self._ball

    def pace(self, lanes: Places, step: Array) -> None:
        """See `sims.engines.flights.Balls`."""
        self._now.step[lanes] = step
        for i, h in zip(lanes.tolist(), step.tolist(), strict=True):
            if self._now.held[i]:
                self._now.contact[i] = self._ball.holding(h)

    def place(self, lanes: Places, x: Array, w: Array) -> None:
        """See `sims.engines.flights.Balls`."""
        self._now.x[lanes] = x
        self._now.w[lanes] = w

    def state(self, count: int) -> tuple[Array, Array]:
        """See `sims.engines.flights.Balls`."""
        return self._now.x[:count], self._now.w[:count]

    def advance(self, lanes: Places, force: Array) -> None:
        """See `sims.engines.flights.Balls`."""
        self._now.force[lanes] = self._mass * force
        self._now.batch.step(lanes)

    def lend(self, lane: int) -> None:
        """See `sims.engines.flights.Balls`."""
        self._ball.be(bool(self._now.held[lane]), self._now.before[lane])

    def take_back(self, lane: int) -> None:
        """See `sims.engines.flights.Balls`."""
        held, flags, before = self._ball.became
        self._now.held[lane] = held
        self._now.flags[lane] = flags
        self._now.before[lane] = before

    def close(self) -> None:
        """Give back what is kept."""
        self._worlds.clear()
        self.__dict__.pop("_now", None)

    def __getstate__(self) -> dict[str, Any]:
        return {"_ball": self._ball, "_threads": self._threads, "_worlds": {}}


class _World:
    """A batch of as many balls.

    Attributes:
        step: (L,) seconds.
        contact: (L, G, 2) of each geom, as MuJoCo's ``solref``.
        flags: (L,) what is disabled.
        held: (L,) whether contact holds the ball up.
        x: (L, 3) positions.
        w: (L, 3) velocities.
        force: (L, 3) newtons beside gravity.
        before: (L, 3) the acceleration of the step before, from which MuJoCo's solver begins.
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
        """All balls as newly made, without contact."""
        self.batch.reset(stage=int(library().mjtStage.mjSTAGE_NONE))
        self.held[:] = False
