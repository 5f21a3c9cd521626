"""World of the pendulum in Bullet.

Only mass x length and the inertia about the hinge affect the motion. Bullet requires the inertia
about the centre of mass,

    inertia - mass length^2                                                (1)

which would be negative for small inertias. A body k times heavier on an arm k times shorter has the
same torque of gravity, and almost no inertia from its arm:

    k mass (length / k)^2 = mass length^2 / k                              (2)

So the inertia may be anything above mass length^2 / 1000, also values that no rigid body with this
centre of mass could have (below mass length^2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sims.engines.external import bullet_world

LENGTH_REDUCTION_FACTOR = 1000.0
"""Factor k of equation (2), by which the body is heavier and its arm is shorter."""


def build(client: int, constants: Mapping[str, float]) -> int:
    """Build a fixed hinge along y with one hanging link; return the body's id.

    Args:
        client: Bullet client of an empty world.
        constants: constants of the system by name.
    """
    pybullet = bullet_world.import_pybullet()
    pybullet.setGravity(0.0, 0.0, -constants["gravity"], physicsClientId=client)
    hanging = (0.0, 0.0, -constants["length"] / LENGTH_REDUCTION_FACTOR)
    return bullet_world.create_jointed_body(
        client,
        pybullet.JOINT_REVOLUTE,
        (0.0, 1.0, 0.0),
        constants["mass"] * LENGTH_REDUCTION_FACTOR,
        hanging,
    )


def load(client: int, body: int, inertia: float, constants: Mapping[str, float]) -> bool:
    """Set the link's inertia about the hinge; return False if Bullet cannot represent it.

    Args:
        client: Bullet client of the world.
        body: id of the body.
        inertia: generalised inertia in kg or kg*m^2.
        constants: constants of the system by name.
    """
    at_centre = (
        inertia - constants["mass"] * constants["length"] ** 2 / LENGTH_REDUCTION_FACTOR
    )  # (1), (2)
    if not at_centre > 0.0:  # also for NaN
        return False
    diagonal = (at_centre, at_centre, at_centre)
    bullet_world.import_pybullet().changeDynamics(
        body, 0, localInertiaDiagonal=diagonal, physicsClientId=client
    )
    return True


def gravity(constants: Mapping[str, float]) -> Callable[[float], float]:
    """Return a function from angle to Bullet's gravity torque on the joint in N*m."""
    weight = constants["mass"] * constants["length"] * constants["gravity"]
    return lambda q: -weight * math.sin(q)
