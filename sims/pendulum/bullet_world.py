"""The pendulum's world in Bullet.

Only mass x length and the inertia about the hinge matter to the motion. Bullet wants the inertia
about the centre of mass,

    inertia - mass length^2                                                (1)

which would be negative for light inertias; a body k times heavier on an arm k times shorter has the
same gravity torque and next to no inertia from its arm:

    k mass (length / k)^2 = mass length^2 / k                              (2)

So the inertia may be anything above mass length^2 / 1000, also what no rigid body with this centre
of mass could have (below mass length^2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sims import bullet

OPEN_LOOP = True
"""The torque is the input, whatever the motion."""
SHORTER = 1000.0
"""k of eq. (2)."""


def build(client: int, constants: Mapping[str, float]) -> int:
    """A fixed hinge along y with one link hanging from it; returns the body's id."""
    p = bullet.engine()
    p.setGravity(0.0, 0.0, -constants["gravity"], physicsClientId=client)
    hanging = (0.0, 0.0, -constants["length"] / SHORTER)
    return bullet.joint(
        client, p.JOINT_REVOLUTE, (0.0, 1.0, 0.0), constants["mass"] * SHORTER, hanging
    )


def load(client: int, body: int, inertia: float, constants: Mapping[str, float]) -> bool:
    """Give the link this inertia about the hinge; False if Bullet cannot represent it."""
    at_centre = inertia - constants["mass"] * constants["length"] ** 2 / SHORTER  # (1), (2)
    if not at_centre > 0.0:  # also what is not a number
        return False
    diagonal = (at_centre, at_centre, at_centre)
    bullet.engine().changeDynamics(body, 0, localInertiaDiagonal=diagonal, physicsClientId=client)
    return True


def gravity(constants: Mapping[str, float]) -> Callable[[float], float]:
    """Bullet's torque on the joint, N*m, at an angle."""
    weight = constants["mass"] * constants["length"] * constants["gravity"]
    return lambda q: -weight * math.sin(q)
