"""The slider's world in Bullet: a body on a guide along x, without gravity, which the guide would
carry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sims import bullet

OPEN_LOOP = True
"""The force is the input, whatever the motion."""


def build(client: int, constants: Mapping[str, float]) -> int:  # noqa: ARG001
    """A guide with one body on it; returns the body's id."""
    return bullet.joint(
        client, bullet.engine().JOINT_PRISMATIC, (1.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0)
    )


def load(
    client: int,
    body: int,
    inertia: float,
    constants: Mapping[str, float],  # noqa: ARG001
) -> bool:
    """Give the body this mass; False if there is no such mass."""
    if not inertia > 0.0:
        return False
    bullet.engine().changeDynamics(body, 0, mass=inertia, physicsClientId=client)
    return True


def gravity(constants: Mapping[str, float]) -> Callable[[float], float]:  # noqa: ARG001
    """None along the guide."""
    return lambda x: 0.0  # noqa: ARG005
