"""Worlds of the ball in Bullet.

Bullet integrates a free body of a multibody world (``btMultiBody``,
``btMultiBodyConstraintSolver``) as follows; measurements agree up to rounding. With step h, gravity
g, damping k and the gap d = z - radius before the step,

    v' = v + h (-g ez - k v (1 + |v|))                                     (1)
    x' = x + h v'                                                          (2)

so "linear damping" is a linear *and* a quadratic drag with one coefficient, and the method is
semi-implicit Euler, of first order in h. Contact acts if d <= 0.02 sqrt(3) radius: then v'_z is
raised to at least

    e |v'_z| - (d + s) / h                                                 (3)

above the ground (d + s > 0), where the second term is the velocity that brings the ball to the
ground by the next step, and to

    e |v'_z| - 0.08 (d + s) / h                                            (4)

below the ground, where the ball is also pushed out, with e the product of both restitutions (0 for
impacts below 0.2 m/s) and s = 1e-5 m. Therefore rebounds depend on the position at the end of the
last step before the impact, and the shorter the step, the more rebounds are lost above the ground.

`build_native` makes that world, as in the published experiments (TuneNet, arXiv 1907.11200): 400
samples at 60 Hz with gravity 9.8. For a drop from 4.5 m and restitution 0.7 its first bounce
reaches 0.656 (square root of the ratio of heights); the same air resistance without Bullet's
contact and step errors gives 0.616, without air 0.7.

`build` makes a world of ideal physics: no air, a ball that cannot spin, and contact that acts at
the ground with the specified restitution at any speed and does not push out.
"""

from __future__ import annotations

from collections.abc import Mapping

from sims.engines.external import bullet_world


def build(client: int, constants: Mapping[str, float]) -> int:
    """Build ground with restitution and friction 1, and a ball; return the ball's id.

    Args:
        client: Bullet client of an empty world.
        constants: constants of the system by name.
    """
    pybullet = bullet_world.import_pybullet()
    ground, ball = _create_ground_and_ball(client, constants)
    # Bodies that overlap are not pushed apart, contact acts at the surface, slow impacts rebound.
    pybullet.setPhysicsEngineParameter(
        contactERP=0.0, contactSlop=0.0, restitutionVelocityThreshold=0.0, physicsClientId=client
    )
    # The contact uses the product of both bodies' values: with 1 for the ground, the ball's own.
    # -1 is Bullet's index of a body's base.
    pybullet.changeDynamics(
        ground, -1, restitution=1.0, lateralFriction=1.0, physicsClientId=client
    )
    pybullet.changeDynamics(
        ball,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        localInertiaDiagonal=(0.0, 0.0, 0.0),  # zero means infinite in Bullet
        contactProcessingThreshold=0.0,
        maxJointVelocity=bullet_world.NO_LIMIT,  # also limits the speed of the base
        physicsClientId=client,
    )
    return ball


def build_native(client: int, constants: Mapping[str, float], settings: Mapping[str, float]) -> int:
    """Build the published scene of ground plane and ball; return the ball's id.

    Contacts are Bullet's own, with the settings of friction, restitution and damping.

    Args:
        client: Bullet client of an empty world.
        constants: constants of the system by name.
        settings: ``lateral_friction`` of both bodies, ``plane_restitution``, and the air damping
            ``linear_damping`` in 1/s.
    """
    pybullet = bullet_world.import_pybullet()
    ground, ball = _create_ground_and_ball(client, constants)
    friction = settings["lateral_friction"]
    # -1 is Bullet's index of a body's base.
    pybullet.changeDynamics(
        ground,
        -1,
        restitution=settings["plane_restitution"],
        lateralFriction=friction,
        physicsClientId=client,
    )
    pybullet.changeDynamics(
        ball,
        -1,
        lateralFriction=friction,
        linearDamping=settings["linear_damping"],
        maxJointVelocity=bullet_world.NO_LIMIT,
        physicsClientId=client,
    )
    return ball


def _create_ground_and_ball(client: int, constants: Mapping[str, float]) -> tuple[int, int]:
    """Create level ground and a ball in an empty Bullet world; return both body ids.

    Args:
        client: id of Bullet's world.
        constants: gravity (m/s²), radius (m) and mass (kg).
    """
    pybullet = bullet_world.import_pybullet()
    pybullet.setGravity(0.0, 0.0, -constants["gravity"], physicsClientId=client)
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    ground: int = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
    sphere = pybullet.createCollisionShape(
        pybullet.GEOM_SPHERE, radius=constants["radius"], physicsClientId=client
    )
    ball: int = pybullet.createMultiBody(constants["mass"], sphere, physicsClientId=client)
    return ground, ball
