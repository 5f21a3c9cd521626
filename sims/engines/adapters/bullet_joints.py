"""Bodies on joints in PyBullet: one at a time, or several in one world without contact.

Bullet needs little less time for several bodies than for one after another. The gain is that
effects are evaluated once per step for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.adapters import bullet_world
from sims.engines.external.external_engine import Indices, Mask, NotBatchableError
from sims.engines.external.world_interface import BulletJointWorldModule

MIN_BATCH_SIZE: dict[str, int] = {"asked": 8}
MAX_BODIES_PER_WORLD = 16
"""Maximum number of bodies in one world: with more, Bullet needs more time for each."""


class BulletJoint:
    """Body on one hinge or guide; see `sims.engines.external.joint_rollout.JointBody`."""

    def __init__(
        self, world: bullet_world.PersistentBulletWorld, module: BulletJointWorldModule
    ) -> None:
        self._world = world
        self._load = module.load
        self._gravity = module.gravity
        self.open_loop: bool = module.OPEN_LOOP

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants; `set_step` and `set_state` set everything else."""
        self._constants, self.compute_gravity_force = constants, self._gravity(constants)
        self._client, self._body = self._world.get_body(constants)

    def set_step(self, step: float, inertia: float, damping: float) -> bool:
        """Set step (s), inertia and damping; return False if Bullet cannot represent them."""
        p = bullet_world.import_pybullet()
        if not self._load(self._client, self._body, inertia, self._constants):
            return False
        p.setTimeStep(step, self._client)
        p.changeDynamics(self._body, 0, jointDamping=damping, physicsClientId=self._client)
        return True

    def set_state(self, x: float, w: float) -> None:
        """Set the joint's position and velocity."""
        bullet_world.import_pybullet().resetJointState(self._body, 0, x, w, self._client)

    def advance(self, force: float) -> tuple[float, float]:
        """Advance by one step; return position and velocity."""
        return self.advance_freely(force, (1,))[0]

    def advance_freely(self, force: float, counts: Sequence[int]) -> list[tuple[float, float]]:
        """Advance by each number of steps in `counts` with a constant force or torque at the joint.

        Returns:
            Position and velocity after each count.
        """
        p = bullet_world.import_pybullet()
        client = self._client
        body = self._body
        # The attributes are looked up once, because a rollout has thousands of steps.
        step = p.stepSimulation
        push = p.setJointMotorControl2
        torque = p.TORQUE_CONTROL
        read = p.getJointState
        states = []
        for count in counts:
            for _ in range(count):
                if force:  # Bullet resets applied torques after each step
                    push(body, 0, torque, force=force, physicsClientId=client)
                step(client)
            states.append(read(body, 0, client)[:2])
        return states

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in ("_world", "_load", "_gravity", "open_loop")}


class BulletJointBatch:
    """Bodies on one hinge or guide each; see `sims.engines.external.joint_batch.JointBatch`.

    All elements of one world have the same steps.
    """

    min_batch_size: Mapping[str, int] = MIN_BATCH_SIZE
    max_batch_size = MAX_BODIES_PER_WORLD
    alike = True

    def __init__(self, module: BulletJointWorldModule) -> None:
        self._several = _MultiBodyWorld(module.build)
        self._world = bullet_world.PersistentBulletWorld(self._several.build)
        self._load = module.load
        self._gravity = module.gravity
        self.open_loop: bool = module.OPEN_LOOP

    def reset_world(self, constants: dict[str, float], count: int) -> None:
        """Prepare a world for these constants; `set_step` and `set_state` set everything else."""
        self._constants = constants
        self._weigh = self._gravity(constants)
        if count != self._several.wanted:
            self._several.wanted = count
            self._world.invalidate()
        self._client, _ = self._world.get_body(constants)
        self._bodies = self._several.bodies
        self._x = np.zeros(count)
        self._w = np.zeros(count)

    def compute_gravity_force(self, x: Array) -> Array:
        """Return the generalised force of gravity (n,) at positions (n,)."""
        return np.array([self._weigh(value) for value in x.tolist()])

    def set_step(self, lanes: Indices, step: Array, inertia: Array, damping: Array) -> Mask:
        """Set step, inertia and damping of some elements; see `joint_batch.JointBatch`."""
        p = bullet_world.import_pybullet()
        p.setTimeStep(float(step[0]), self._client)
        able = np.ones(lanes.size, dtype=bool)
        for place, lane in enumerate(lanes.tolist()):
            body = self._bodies[lane]
            able[place] = self._load(self._client, body, float(inertia[place]), self._constants)
            p.changeDynamics(
                body, 0, jointDamping=float(damping[place]), physicsClientId=self._client
            )
        return able

    def set_state(self, lanes: Indices, x: Array, w: Array) -> None:
        """Set position and velocity of some elements; see `joint_batch.JointBatch`."""
        reset = bullet_world.import_pybullet().resetJointState
        self._x[lanes] = x
        self._w[lanes] = w
        for place, lane in enumerate(lanes.tolist()):
            reset(self._bodies[lane], 0, float(x[place]), float(w[place]), self._client)

    def get_state(self, count: int) -> tuple[Array, Array]:
        """Return states of the first elements; see `joint_batch.JointBatch`."""
        return self._x[:count], self._w[:count]

    def advance(self, force: Array) -> None:
        """Advance all elements by one step; see `sims.engines.external.joint_batch.JointBatch`."""
        p = bullet_world.import_pybullet()
        client = self._client
        push = p.setJointMotorControl2
        torque = p.TORQUE_CONTROL
        read = p.getJointState
        for body, value in zip(self._bodies, force.tolist(), strict=True):
            if value:  # Bullet resets applied torques after each step
                push(body, 0, torque, force=value, physicsClientId=client)
        p.stepSimulation(client)
        states = [read(body, 0, client)[:2] for body in self._bodies]
        self._x[:], self._w[:] = np.array(states).T

    def advance_steps(self, force: Array) -> tuple[Array, Array]:
        """Advance all elements by several steps; see `joint_batch.JointBatch`."""
        x = np.empty(force.shape)
        w = np.empty(force.shape)
        for k in range(force.shape[1]):
            self.advance(force[:, k])
            x[:, k] = self._x
            w[:, k] = self._w
        return x, w

    def find_elements_to_redo(self, failed: Mask) -> Mask:
        """Return which elements must be integrated again; see `joint_batch.JointBatch`."""
        # A failed body may have left the shared world in any state.
        if failed.any():
            self._world.invalidate()
        return np.full(failed.size, failed.any())

    def discard(self) -> None:
        """Discard the world, so that the next integration builds a new one."""
        self._world.invalidate()

    def close(self) -> None:
        """Close the world."""
        self._world.close()

    def __getstate__(self) -> dict[str, Any]:
        kept = ("_world", "_several", "_load", "_gravity", "open_loop")
        return {name: self.__dict__[name] for name in kept}


class _MultiBodyWorld:
    """Builder of several equal bodies in one world.

    Attributes:
        wanted: number of bodies to build.
        bodies: ids of the bodies after `build`.
    """

    def __init__(self, build: Callable[[int, Mapping[str, float]], int]) -> None:
        self._build = build
        self.wanted = 0
        self.bodies: list[int] = []

    def build(self, client: int, constants: Mapping[str, float]) -> int:
        """Build the bodies in an empty world.

        Args:
            client: Bullet client of the world.
            constants: constants of the system by name.

        Returns:
            The id of the first body.

        Raises:
            NotBatchableError: the bodies might collide.
        """
        p = bullet_world.import_pybullet()
        first = self._build(client, constants)
        links = range(-1, p.getNumJoints(first, client))
        shaped = any(p.getCollisionShapeData(first, link, client) for link in links)
        if shaped or p.getNumBodies(client) > 1 or p.getNumConstraints(client):
            raise NotBatchableError("bodies of this world may meet")
        self.bodies = [first, *(self._build(client, constants) for _ in range(self.wanted - 1))]
        # Bodies without a shape cannot collide, but Bullet would still check every pair of them.
        for body in self.bodies:
            for link in links:
                p.setCollisionFilterGroupMask(body, link, 0, 0, physicsClientId=client)
        return first
