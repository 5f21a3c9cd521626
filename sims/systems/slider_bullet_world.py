"""World of the slider in Bullet: a body on a guide along x.

There is no gravity, which the guide would support.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sims.engines.external import bullet_world


def build(client: int, constants: Mapping[str, float]) -> int:  # noqa: ARG001
    """Build a guide with one body; return the body's id.

    Args:
        client: Bullet client of an empty world.
        constants: constants of the system by name.
    """
    return bullet_world.create_jointed_body(
        client,
        bullet_world.import_pybullet().JOINT_PRISMATIC,
        (1.0, 0.0, 0.0),
        1.0,
        (0.0, 0.0, 0.0),
    )


def load(
    client: int,
    body: int,
    inertia: float,
    constants: Mapping[str, float],  # noqa: ARG001
) -> bool:
    """Set the body's mass; return False if it is not positive.

    Args:
        client: Bullet client of the world.
        body: id of the body.
        inertia: generalised inertia in kg or kg*m^2.
        constants: constants of the system by name.
    """
    if not inertia > 0.0:
        return False
    bullet_world.import_pybullet().changeDynamics(body, 0, mass=inertia, physicsClientId=client)
    return True


def gravity(constants: Mapping[str, float]) -> Callable[[float], float]:  # noqa: ARG001
    """Return a function that gives zero, because gravity does not act along the guide."""
    return lambda x: 0.0  # noqa: ARG005
