"""Bodies on joints in MuJoCo, many at once: `mujoco.batch.Batch`, where this MuJoCo has it.

A world module's `load` writes into one compiled model (`sims.engines.worlds`). What it wrote is
found by comparing the model's binary form with what it was before, and goes into the fields that
the batch keeps for each lane.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.engines.external import ApartError, Mask, Places
from sims.engines.mujoco_bodies import CompiledWorld, library
from sims.engines.worlds import MujocoJointModule

_UNINTERRUPTED = 40_000
"""Steps of all lanes together in one call: a tenth of a second, after which Ctrl-C is heard."""

FEWEST = {"open": 1, "stretches": 16, "known": 24, "asked": 5}
MOST = 256
"""Lanes of a batch: of more, what is held for them leaves the processor's cache."""
KEPT = 4
"""Worlds of other constants or numbers of lanes that are kept."""

Bytes = NDArray[np.uint8]


@functools.cache
def there() -> bool:
    """Whether this MuJoCo steps batches; it is not imported."""
    found = find_spec("mujoco")
    folders = found.submodule_search_locations if found else None
    return any((Path(folder) / "batch.py").exists() for folder in folders or ())


class Joints:
    """Bodies on one hinge or guide each; see `sims.engines.joints.Joints`.

    Args:
        world: whose model the lanes share.
        module: the system's ``mujoco_world``.
        threads: over which lanes are spread; the results do not depend on it.
    """

    fewest: Mapping[str, int] = FEWEST
    most = MOST
    alike = False

    def __init__(self, world: CompiledWorld, module: MujocoJointModule, threads: int) -> None:
        self._world = world
        self._load = module.load
        self._gravity = module.gravity
        self._threads = threads
        self.open_loop: bool = module.OPEN_LOOP
        # By constants and number of lanes; making one costs as much as a few hundred steps.
        self._worlds: dict[object, _World] = {}

    def start(self, constants: dict[str, float], count: int) -> None:
        """A world for these constants, as newly made."""
        self._constants = constants
        self._weigh = self._gravity(constants)
        key = (*constants.items(), count)
        if key not in self._worlds:
            if len(self._worlds) == KEPT:
                self._worlds.clear()
            self._worlds[key] = _World(self._world.fresh(constants)[0], count, self._threads)
        world = self._worlds[key]
        world.reset()
        self._now = world
        self._ran = False
        self._count = count

    def gravity(self, x: Array) -> Array:
        """See `sims.engines.joints.Joints`."""
        # The very function that one lane asks: NumPy's sine may round otherwise.
        return np.array([self._weigh(value) for value in x.tolist()])

    def pace(self, lanes: Places, step: Array, inertia: Array, damping: Array) -> Mask:
        """See `sims.engines.joints.Joints`."""
        world = self._now
        world.step[lanes] = step
        world.damping[lanes, 0] = damping
        able = np.ones(lanes.size, dtype=bool)
        for i in np.flatnonzero(inertia != world.loaded[lanes]).tolist():
            able[i] = self._load(world.model, float(inertia[i]), self._constants)
            if able[i]:
                world.take(int(lanes[i]))
                world.loaded[lanes[i]] = inertia[i]
        return able

    def place(self, lanes: Places, x: Array, w: Array) -> None:
        """See `sims.engines.joints.Joints`."""
        self._now.x[lanes, 0] = x
        self._now.w[lanes, 0] = w

    def state(self, count: int) -> tuple[Array, Array]:
        """See `sims.engines.joints.Joints`."""
        return self._now.x[:count, 0], self._now.w[:count, 0]

    def advance(self, force: Array) -> None:
        """See `sims.engines.joints.Joints`."""
        self._now.force[: force.size, 0] = force
        self._now.batch.step(self._ids(force.size))

    def run(self, force: Array) -> tuple[Array, Array]:
        """See `sims.engines.joints.Joints`."""
        self._ran = True
        lanes, steps = force.shape
        x = np.empty(force.shape)
        w = np.empty(force.shape)
        largest = max(_UNINTERRUPTED // lanes, 1)
        applied = int(library().mjtState.mjSTATE_QFRC_APPLIED)
        for begin in range(0, steps, largest):
            part = slice(begin, min(begin + largest, steps))
            pushed = force[:, part, None]
            done = self._now.batch.rollout(
                pushed.shape[1], pushed, applied, ("qpos", "qvel"), self._ids(lanes)
            )
            x[:, part] = done["qpos"][:, :, 0]
            w[:, part] = done["qvel"][:, :, 0]
        return x, w

    def again(self, failed: Mask) -> Mask:
        """See `sims.engines.joints.Joints`."""
        if not self._ran:
            return np.zeros(failed.size, dtype=bool)
        # A run ends where MuJoCo warns, though it might go on.
        warned: Mask = (self._now.batch.warning[:, :, 1] > 0).any(axis=1)
        return warned

    def close(self) -> None:
        """Give back what is kept."""
        self._worlds.clear()
        self.__dict__.pop("_now", None)

    def _ids(self, count: int) -> Places | None:
        return None if count == self._count else np.arange(count)

    def __getstate__(self) -> dict[str, Any]:
        kept = ("_world", "_load", "_gravity", "_threads", "open_loop")
        return {name: self.__dict__[name] for name in kept} | {"_worlds": {}}


class _World:
    """A batch of as many lanes, and one model that a world module loads.

    Attributes:
        model: what `load` writes into, before it goes to a lane.
        loaded: (L,) inertia of each lane; NaN where none is loaded.
        step: (L,) seconds.
        damping: (L, 1) of the joint.
        x: (L, 1) positions.
        w: (L, 1) velocities.
        force: (L, 1) beside gravity.
    """

    def __init__(self, model: Any, count: int, threads: int) -> None:
        from mujoco import batch

        self.model = model.__copy__()
        self.batch: Any = batch.Batch(model, count, threads)
        self.loaded = np.full(count, np.nan)
        self.step: Array = self.batch.expand("opt.timestep").reshape(count)
        self.damping: Array = self.batch.expand("dof_damping")
        self.x: Array = self.batch.bind("qpos")
        self.w: Array = self.batch.bind("qvel")
        self.force: Array = self.batch.bind("qfrc_applied")
        self._base = _binary(model)
        # Fields that `load` writes, as the lanes have them.
        self._fields: dict[str, Any] = {}
        self._covered = np.zeros(self._base.size, dtype=bool)

    def reset(self) -> None:
        """All lanes as newly made."""
        self.batch.reset(stage=int(library().mjtStage.mjSTAGE_NONE))

    def take(self, lane: int) -> None:
        """Give a lane what has been loaded into the model."""
        left = (_binary(self.model) != self._base) & ~self._covered
        if left.any():
            self._find(left)
        for name, values in self._fields.items():
            values[lane] = getattr(self.model, name)

    def _find(self, changed: Mask) -> None:
        """Find the fields to which these bytes belong."""
        from mujoco import batch

        for name in sorted(batch.MODEL_FIELDS):
            if not name.startswith("opt."):
                own = _bytes_of(self.model, name)
                if (own & changed).any():
                    self._fields[name] = self.batch.expand(name)
                    self._covered |= own
        if (changed & ~self._covered).any():
            raise ApartError("the world writes what lanes of one batch share")


def _binary(model: Any) -> Bytes:
    """A compiled model as bytes."""
    mujoco = library()
    result = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, result)
    return result


def _bytes_of(model: Any, name: str) -> Mask:
    """Which bytes of the binary form are those of a field."""
    values = getattr(model, name)
    before = _binary(model)
    kept = values.copy()
    values.view(np.uint8)[...] ^= 0xFF
    own: Mask = _binary(model) != before
    values[...] = kept
    return own
