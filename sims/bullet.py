"""What every world in Bullet shares: the engine itself, the life of a world, a body on a joint.

Bullet is reached through PyBullet, in this process and without a window.
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
"""m/s or rad/s: Bullet clips speeds, by default at 100."""


@functools.cache
def engine() -> Any:
    """The module ``pybullet``, imported on first use: it takes a while and most commands never
    simulate.
    """
    with _output_discarded():
        import pybullet
    return pybullet


@contextlib.contextmanager
def _output_discarded() -> Iterator[None]:
    """Discard what C code prints (PyBullet says when it was built), so that the output is ours
    alone.
    """
    # PyBullet prints from C, past Python's `sys.stdout`, so the file descriptors are turned.
    flush = ctypes.CDLL(None).fflush if os.name == "posix" else lambda _: None
    flush(None)  # what others printed before is theirs to keep
    with contextlib.ExitStack() as undo:
        for stream in (1, 2):
            with contextlib.suppress(OSError):  # a process may have no such stream
                kept = os.dup(stream)
                undo.callback(os.close, kept)
                undo.callback(os.dup2, kept, stream)
                sink = os.open(os.devnull, os.O_WRONLY)
                undo.callback(os.close, sink)
                os.dup2(sink, stream)
        undo.callback(flush, None)  # C has a buffer of its own, which would come out later
        yield


class PersistentWorld:
    """One Bullet world: connected when first needed, kept from rollout to rollout, closed with its
    owner.

    Building a world costs as much as simulating a hundred samples, so it is built once for each set
    of constants; the owner must start every rollout by setting all that a rollout may have changed.

    Args:
        build: called with (client, constants) on an empty world; returns the moving body's id.
    """

    def __init__(self, build: Callable[[int, Mapping[str, float]], int]) -> None:
        self._build = build
        self._client = -1
        self._body = -1
        self._built_for: dict[str, float] | None = None
        self._disconnect: Callable[[], object] | None = None

    def __reduce__(
        self,
    ) -> tuple[type[PersistentWorld], tuple[Callable[[int, Mapping[str, float]], int]]]:
        # A copy of a simulator, here or in another process, gets a world of its own.
        return PersistentWorld, (self._build,)

    def body(self, constants: Mapping[str, float]) -> tuple[int, int]:
        """The ids (client, body) of a world with these constants."""
        if self._disconnect is None:
            self._client = engine().connect(engine().DIRECT)
            self._disconnect = weakref.finalize(self, engine().disconnect, self._client)
        if self._built_for != constants:
            # Before the building, which may fail half way.
            self.discard()
            engine().resetSimulation(physicsClientId=self._client)
            self._body = self._build(self._client, constants)
            self._built_for = dict(constants)
        return self._client, self._body

    def discard(self) -> None:
        """Build afresh before the next rollout: this world is in a state that resetting bodies
        cannot undo.
        """
        self._built_for = None

    def close(self) -> None:
        """Disconnect; harmless when there is nothing to disconnect."""
        if self._disconnect is not None:
            self._disconnect()
        self._disconnect = None
        self.discard()


def joint(
    client: int,
    kind: int,
    axis: tuple[float, float, float],
    mass: float,
    centre: tuple[float, float, float],
) -> int:
    """A body on one joint that is fixed to the world and resists nothing; returns the body's id,
    the joint being 0.

    Args:
        client: the world.
        kind: ``JOINT_REVOLUTE`` or ``JOINT_PRISMATIC``, at the origin.
        axis: of the joint.
        mass: kg.
        centre: of mass, where the joint's position is 0.
    """
    p = engine()
    body: int = p.createMultiBody(
        linkMasses=[mass],
        linkCollisionShapeIndices=[-1],
        linkVisualShapeIndices=[-1],
        linkPositions=[(0.0, 0.0, 0.0)],
        linkOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkInertialFramePositions=[centre],
        linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkParentIndices=[0],
        linkJointTypes=[kind],
        linkJointAxis=[axis],
        physicsClientId=client,
    )
    # By default Bullet adds air resistance, sleep when nothing moves, a speed limit of 100, and a
    # motor that brakes the joint.
    p.changeDynamics(
        body,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING,
        maxJointVelocity=NO_LIMIT,
        physicsClientId=client,
    )
    # A motor without force in place of the one that every joint begins with.
    p.setJointMotorControl2(body, 0, p.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
    return body
