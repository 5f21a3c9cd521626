"""Many bodies on joints in MuJoCo: `mujoco.batch.Batch`, if this MuJoCo version has it.

The function `load` of a world module writes into one compiled model (`external.world_interface`).
The fields that it wrote are found by comparing the model's binary form before and after, and their
values are stored in the batch's fields for each element.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.engines.adapters.mujoco_bodies import CompiledWorld, import_mujoco
from sims.engines.external.external_engine import Indices, Mask, NotBatchableError
from sims.engines.external.world_interface import MujocoJointWorldModule

_UNINTERRUPTED = 40_000
"""Maximum number of steps of all elements in one call.

They take a tenth of a second, after which Ctrl-C can take effect.
"""

MIN_BATCH_SIZE = {"open": 1, "stretches": 16, "known": 24, "asked": 5}
MAX_BATCH_SIZE = 256
"""Maximum number of elements in a batch: with more, the data exceed the processor's cache."""
MAX_CACHED_WORLDS = 4
"""Maximum number of cached worlds with different constants or numbers of elements."""

Bytes = NDArray[np.uint8]


@functools.cache
def is_batch_available() -> bool:
    """Return whether this MuJoCo version can step batches, without importing it."""
    found = find_spec("mujoco")
    folders = found.submodule_search_locations if found else None
    return any((Path(folder) / "batch.py").exists() for folder in folders or ())


class MujocoJointBatch:
    """Bodies on one hinge or guide each; see `sims.engines.external.joint_batch.JointBatch`.

    Args:
        world: world whose model the elements share.
        module: module ``<system>_mujoco_world`` of the system.
        threads: number of threads; the results do not depend on it.
    """

    min_batch_size: Mapping[str, int] = MIN_BATCH_SIZE
    max_batch_size = MAX_BATCH_SIZE
    alike = False

    def __init__(self, world: CompiledWorld, module: MujocoJointWorldModule, threads: int) -> None:
        self._world = world
        self._load = module.load
        self._gravity = module.gravity
        self._threads = threads
        self.open_loop: bool = module.OPEN_LOOP
        # Worlds by constants and number of elements; making one costs as much as a few hundred
        # steps.
        self._worlds: dict[object, _World] = {}

    def reset_world(self, constants: dict[str, float], count: int) -> None:
        """Prepare a world for these constants and `count` elements, in its initial state."""
        self._constants = constants
        self._weigh = self._gravity(constants)
        key = (*constants.items(), count)
        if key not in self._worlds:
            if len(self._worlds) == MAX_CACHED_WORLDS:
                self._worlds.clear()
            self._worlds[key] = _World(self._world.get_fresh(constants)[0], count, self._threads)
        world = self._worlds[key]
        world.reset()
        self._now = world
        self._ran = False
        self._count = count

    def compute_gravity_force(self, x: Array) -> Array:
        """Return the generalised force of gravity (n,) at positions (n,)."""
        # The same function as for one element is used, because NumPy's sine may round differently.
        return np.array([self._weigh(value) for value in x.tolist()])

    def set_step(self, lanes: Indices, step: Array, inertia: Array, damping: Array) -> Mask:
        """Set step, inertia and damping of some elements; see `joint_batch.JointBatch`."""
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

    def set_state(self, lanes: Indices, x: Array, w: Array) -> None:
        """Set position and velocity of some elements; see `joint_batch.JointBatch`."""
        self._now.x[lanes, 0] = x
        self._now.w[lanes, 0] = w

    def get_state(self, count: int) -> tuple[Array, Array]:
        """Return states of the first elements; see `joint_batch.JointBatch`."""
        return self._now.x[:count, 0], self._now.w[:count, 0]

    def advance(self, force: Array) -> None:
        """Advance the first elements by one step; see `joint_batch.JointBatch`."""
        self._now.force[: force.size, 0] = force
        self._now.batch.step(self._ids(force.size))

    def advance_steps(self, force: Array) -> tuple[Array, Array]:
        """Advance the first elements by several steps; see `joint_batch.JointBatch`."""
        self._ran = True
        lanes, steps = force.shape
        x = np.empty(force.shape)
        w = np.empty(force.shape)
        largest = max(_UNINTERRUPTED // lanes, 1)
        applied = int(import_mujoco().mjtState.mjSTATE_QFRC_APPLIED)
        for begin in range(0, steps, largest):
            part = slice(begin, min(begin + largest, steps))
            pushed = force[:, part, None]
            done = self._now.batch.rollout(
                pushed.shape[1], pushed, applied, ("qpos", "qvel"), self._ids(lanes)
            )
            x[:, part] = done["qpos"][:, :, 0]
            w[:, part] = done["qvel"][:, :, 0]
        return x, w

    def find_elements_to_redo(self, failed: Mask) -> Mask:
        """Return which elements must be integrated again; see `joint_batch.JointBatch`."""
        if not self._ran:
            return np.zeros(failed.size, dtype=bool)
        # A batch rollout ends where MuJoCo warns, although a single element might continue.
        warned: Mask = (self._now.batch.warning[:, :, 1] > 0).any(axis=1)
        return warned

    def close(self) -> None:
        """Release stored worlds."""
        self._worlds.clear()
        self.__dict__.pop("_now", None)

    def _ids(self, count: int) -> Indices | None:
        return None if count == self._count else np.arange(count)

    def __getstate__(self) -> dict[str, Any]:
        kept = ("_world", "_load", "_gravity", "_threads", "open_loop")
        return {name: self.__dict__[name] for name in kept} | {"_worlds": {}}


class _World:
    """Batch of elements, and one model into which the world module writes the inertia.

    Attributes:
        model: model that `load` writes into before the values are copied to an element.
        loaded: (L,) inertia of each element; NaN where none is set.
        step: (L,) step sizes in seconds.
        damping: (L, 1) joint damping.
        x: (L, 1) positions.
        w: (L, 1) velocities.
        force: (L, 1) applied forces in addition to gravity.
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
        # Model fields that `load` writes, with their values of all elements.
        self._fields: dict[str, Any] = {}
        self._covered = np.zeros(self._base.size, dtype=bool)

    def reset(self) -> None:
        """Reset all elements to their initial state."""
        self.batch.reset(stage=int(import_mujoco().mjtStage.mjSTAGE_NONE))

    def take(self, lane: int) -> None:
        """Copy the values that `load` has written into the model to an element."""
        left = (_binary(self.model) != self._base) & ~self._covered
        if left.any():
            self._find(left)
        for name, values in self._fields.items():
            values[lane] = getattr(self.model, name)

    def _find(self, changed: Mask) -> None:
        """Find the fields to which the changed bytes belong."""
        from mujoco import batch

        for name in sorted(batch.MODEL_FIELDS):
            if not name.startswith("opt."):
                own = _bytes_of(self.model, name)
                if (own & changed).any():
                    self._fields[name] = self.batch.expand(name)
                    self._covered |= own
        if (changed & ~self._covered).any():
            raise NotBatchableError("the world writes what lanes of one batch share")


def _binary(model: Any) -> Bytes:
    """Return a compiled model as bytes."""
    mujoco = import_mujoco()
    result = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, result)
    return result


def _bytes_of(model: Any, name: str) -> Mask:
    """Return which bytes of the binary form belong to a field."""
    values = getattr(model, name)
    before = _binary(model)
    kept = values.copy()
    values.view(np.uint8)[...] ^= 0xFF
    own: Mask = _binary(model) != before
    values[...] = kept
    return own
