"""PyBullet connection: importing the engine, lifetime of a world, a body on a joint.

PyBullet runs in this process and without a window.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import weakref
from collections.abc import Callable, Iterator, Mapping
from typing import Any

NO_LIMIT = 1e100
"""Speed limit in m/s or rad/s that has no effect; by default Bullet clips speeds at 100."""


@functools.cache
def import_pybullet() -> Any:
    """Import the module ``pybullet`` on first use, because most commands never simulate."""
    with _discard_output():
        import pybullet
    return pybullet


@contextlib.contextmanager
def _discard_output() -> Iterator[None]:
    """Discard the output of C code, such as PyBullet's build date."""
    # PyBullet prints from C and bypasses `sys.stdout`, so redirect the file descriptors.
    flush = ctypes.CDLL(None).fflush if os.name == "posix" else lambda _: None
    flush(None)  # keep earlier output of others
    with contextlib.ExitStack() as undo:
        for stream in (1, 2):
            with contextlib.suppress(OSError):  # a process may lack this stream
                # At the end, these steps are undone in reverse order.
                saved_descriptor = os.dup(stream)
                undo.callback(os.close, saved_descriptor)
                undo.callback(os.dup2, saved_descriptor, stream)
                sink = os.open(os.devnull, os.O_WRONLY)
                undo.callback(os.close, sink)
                os.dup2(sink, stream)
        undo.callback(flush, None)  # C has its own buffer, which would be printed later
        yield


class PersistentBulletWorld:
    """Bullet world that is connected when first needed and reused until its owner is closed.

    Building a world costs as much as simulating a hundred samples, so it is built once for each set
    of constants. At the start of each rollout, the owner must reset everything that a rollout may
    have changed.
    """

    def __init__(self, build: Callable[[int, Mapping[str, float]], int]) -> None:
        """Store the build function; Bullet is connected when the body is first requested.

        Args:
            build: Function called with (client, constants) on an empty world; returns the id of the
                moving body.
        """
        self._build = build
        self._client = -1
        self._body = -1
        self._built_for: dict[str, float] | None = None
        self._disconnect: Callable[[], object] | None = None

    def __reduce__(
        self,
    ) -> tuple[type[PersistentBulletWorld], tuple[Callable[[int, Mapping[str, float]], int]]]:
        """Pickle the build function alone, because a connection to Bullet cannot be copied."""
        # A copy of a simulator, also in another process, gets its own world.
        return PersistentBulletWorld, (self._build,)

    def get_body(self, constants: Mapping[str, float]) -> tuple[int, int]:
        """Return the ids (client, body) of a world with these constants.

        The world is only built again if the constants have changed.

        Args:
            constants: Constants of the system, such as mass and length.
        """
        if self._disconnect is None:
            self._client = import_pybullet().connect(import_pybullet().DIRECT)
            self._disconnect = weakref.finalize(self, import_pybullet().disconnect, self._client)
        if self._built_for != constants:
            # Invalidate first, because building may fail half way.
            self.invalidate()
            import_pybullet().resetSimulation(physicsClientId=self._client)
            self._body = self._build(self._client, constants)
            self._built_for = dict(constants)
        return self._client, self._body

    def invalidate(self) -> None:
        """Have the world built again before the next rollout.

        Used when the world is in a state that resetting its bodies cannot restore.
        """
        self._built_for = None

    def close(self) -> None:
        """Disconnect the world if it is connected."""
        if self._disconnect is not None:
            self._disconnect()
        self._disconnect = None
        self.invalidate()


def build_jointed_body(kind: str, client: int, constants: Mapping[str, float]) -> int:  # noqa: ARG001
    """Build a body on one joint without friction and gravity; its centre of mass is on the joint.

    Args:
        kind: ``JOINT_REVOLUTE`` or ``JOINT_PRISMATIC``, at the origin.
        client: Id of an empty world.
        constants: unused; the forces of the system depend on them, and the body does not.

    Returns:
        The id of the body, whose joint has the index 0.
    """
    pybullet = import_pybullet()
    body: int = pybullet.createMultiBody(
        linkMasses=[1.0],
        linkCollisionShapeIndices=[-1],
        linkVisualShapeIndices=[-1],
        linkPositions=[(0.0, 0.0, 0.0)],
        linkOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkInertialFramePositions=[(0.0, 0.0, 0.0)],
        linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkParentIndices=[0],
        linkJointTypes=[getattr(pybullet, kind)],
        linkJointAxis=[(1.0, 0.0, 0.0)],
        physicsClientId=client,
    )
    # By default Bullet adds air resistance, sleeping, a speed limit of 100, and a motor that brakes
    # the joint. -1 is Bullet's index of the body's fixed base, 0 that of its only joint.
    pybullet.changeDynamics(
        body,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        jointDamping=0.0,
        activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        maxJointVelocity=NO_LIMIT,
        physicsClientId=client,
    )
    # Replace the default motor of the joint by one without force.
    pybullet.setJointMotorControl2(
        body, 0, pybullet.VELOCITY_CONTROL, force=0.0, physicsClientId=client
    )
    return body


class BulletJoint:
    """Body on one hinge or guide; see `sims.engines.external.joint_integration.JointBody`."""

    def __init__(self, world: PersistentBulletWorld, is_hinge: bool) -> None:
        self._world, self._is_hinge = world, is_hinge

    def reset_world(self) -> None:
        """Prepare a world; `set_step` and `set_state` set everything else."""
        self._client, self._body = self._world.get_body({})

    def set_step(self, step: float, inertia: float) -> None:
        """Set step (s) and inertia (kg or kg*m^2)."""
        pybullet = import_pybullet()
        pybullet.setTimeStep(step, self._client)
        changes: dict[str, Any] = (
            {"localInertiaDiagonal": (inertia,) * 3} if self._is_hinge else {"mass": inertia}
        )
        pybullet.changeDynamics(self._body, 0, physicsClientId=self._client, **changes)

    def set_state(self, x: float, w: float) -> None:
        """Set the joint's position and velocity.

        Args:
            x: position, rad or m.
            w: velocity at the time half a step before.
        """
        import_pybullet().resetJointState(self._body, 0, x, w, self._client)

    def advance(self, force: float) -> tuple[float, float]:
        """Advance by one step; return position and velocity."""
        p = import_pybullet()
        if force:
            p.setJointMotorControl2(
                self._body, 0, p.TORQUE_CONTROL, force=force, physicsClientId=self._client
            )
        p.stepSimulation(self._client)
        x, w, *_ = p.getJointState(self._body, 0, self._client)
        return x, w

    def __getstate__(self) -> dict[str, Any]:
        return {"_world": self._world, "_is_hinge": self._is_hinge}
