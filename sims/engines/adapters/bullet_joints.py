"""Body on a joint in PyBullet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sims.engines.adapters import bullet_world
from sims.engines.external.world_interface import BulletJointWorldModule


class BulletJoint:
    """Body on one hinge or guide; see `sims.engines.external.joint_rollout.JointBody`."""

    def __init__(
        self, world: bullet_world.PersistentBulletWorld, module: BulletJointWorldModule
    ) -> None:
        """Take the load and gravity functions of the system's world module."""
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
        get_joint_state = p.getJointState
        states = []
        for count in counts:
            for _ in range(count):
                if force:  # Bullet resets applied torques after each step
                    push(body, 0, torque, force=force, physicsClientId=client)
                step(client)
            states.append(get_joint_state(body, 0, client)[:2])
        return states

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in ("_world", "_load", "_gravity", "open_loop")}
