"""Balls in PyBullet: with impacts at their exact time, or with Bullet's native contact."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sims.engines.external import ball_integration, bullet_world
from sims.engines.external.ball_integration import BallState
from sims.engines.external.element_forces import Vector

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
"""Identity rotation as a quaternion x, y, z, w."""
_ZERO_VECTOR = (0.0, 0.0, 0.0)
"""Zero vector: the origin, or zero velocity."""
_IMPACT_STEP_SECONDS = 1e-4
"""Length of the time step of an impact, in seconds."""
_CONTACT_HEIGHT_RADII = 0.02 * math.sqrt(3)
"""Height above the ground, in radii of the ball, at which Bullet's contact begins."""


class _BulletMover:
    """Free ball; see `sims.engines.external.ball_integration.BallBody`."""

    def __init__(self, world: bullet_world.PersistentBulletWorld) -> None:
        """Start without a body; NaN and -1 are values that must be set before the first step."""
        self._world = world
        self._client = self._body = -1
        self._mass = math.nan
        self._contact = math.nan, math.nan
        self._x: Vector = _ZERO_VECTOR

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, without contact points of the previous rollout.

        Args:
            constants: Constants of the ball: mass, radius and others.
        """
        pybullet = bullet_world.import_pybullet()
        self._mass = constants["mass"]
        self._contact = (math.nan, math.nan)
        self._client, self._body = self._world.get_body(constants)
        # The world is reset in place, because building one is half the cost of a rollout. But
        # contact points survive a reset, and Bullet would use them as old contacts, which changes
        # the results by rounding. They are removed by placing the ball where it touches nothing.
        distant_position = 0.0, 0.0, 2.0 * constants["radius"] + 1.0
        pybullet.resetBasePositionAndOrientation(
            self._body, distant_position, _NO_ROTATION, self._client
        )
        pybullet.performCollisionDetection(self._client)

    def set_step(self, step: float) -> None:
        """Set the step in seconds."""
        bullet_world.import_pybullet().setTimeStep(step, self._client)

    def set_state(self, x: Vector, w: Vector) -> None:
        """Set position and velocity; the ball is upright and does not spin.

        Args:
            x: position, m.
            w: velocity at the time half a step before, m/s.
        """
        bullet_world.import_pybullet().resetBasePositionAndOrientation(
            self._body, x, _NO_ROTATION, self._client
        )
        bullet_world.import_pybullet().resetBaseVelocity(self._body, w, _ZERO_VECTOR, self._client)
        self._x = x

    def advance(self, force: Vector) -> BallState:
        """Advance by one step with a force per unit mass at the ball's last known centre.

        Args:
            force: force per unit mass in addition to gravity, m/s^2.

        Returns:
            Position (m) and Bullet's velocity (m/s) after the step.
        """
        # Bullet expects the force in newtons and the point where it acts.
        p = bullet_world.import_pybullet()
        mass = self._mass
        newtons = mass * force[0], mass * force[1], mass * force[2]
        base = -1  # Bullet's index of the body itself; others are its links
        p.applyExternalForce(self._body, base, newtons, self._x, p.WORLD_FRAME, self._client)
        p.stepSimulation(self._client)
        self._x, _ = p.getBasePositionAndOrientation(self._body, self._client)
        velocity, _ = p.getBaseVelocity(self._body, self._client)
        return self._x, velocity

    def set_contact_parameters(self, restitution: float, friction: float) -> None:
        """Set the ball's restitution and friction coefficient.

        Args:
            restitution: Ratio of normal speeds after and before an impact.
            friction: Coefficient of Coulomb friction.
        """
        if (restitution, friction) != self._contact:
            self._contact = restitution, friction
            bullet_world.import_pybullet().changeDynamics(
                self._body,
                -1,
                restitution=restitution,
                lateralFriction=friction,
                physicsClientId=self._client,
            )


class BulletBall(_BulletMover):
    """Ball without spin, on ground with restitution and friction 1.

    See `sims.engines.external.ball_integration.BallWithImpacts`.
    """

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, with contact switched off."""
        self._floor = constants["radius"]
        self._gravity = constants["gravity"]
        super().reset_world(constants)
        self._set_contact(False)

    def _set_contact(self, ground: bool) -> None:
        """Switch contact between ball and ground on or off."""
        # Contact is off in flight, because `ball_integration` computes when the ball meets the
        # ground.
        p = bullet_world.import_pybullet()
        floor = p.getBodyUniqueId(0, self._client)
        p.setCollisionFilterPair(floor, self._body, -1, -1, ground, self._client)

    def solve_impact(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """Return the velocity after an impact, from Bullet's contact solver in one short step.

        Args:
            x: position at the impact.
            v: velocity before the impact.
            restitution: restitution coefficient.
            friction: friction coefficient.
        """
        self.set_contact_parameters(restitution, friction)
        self.set_step(_IMPACT_STEP_SECONDS)
        # Bullet adds gravity's velocity change of the step before it solves the contact. This is
        # compensated, so that the solver gets v.
        contact_position = x[0], x[1], self._floor - ball_integration.CONTACT_PENETRATION
        self.set_state(contact_position, (v[0], v[1], v[2] + self._gravity * _IMPACT_STEP_SECONDS))
        self._set_contact(True)
        _, velocity = self.advance(_ZERO_VECTOR)
        self._set_contact(False)
        return velocity

    def set_resting_contact(self) -> None:
        """Set contact with zero restitution and zero friction."""
        self.set_contact_parameters(0.0, 0.0)
        self._set_contact(True)


class BulletNativeBall(_BulletMover):
    """Ball with Bullet's native contact; see `external.ball_integration.NativeContactBall`."""

    def __init__(
        self, world: bullet_world.PersistentBulletWorld, settings: Mapping[str, float]
    ) -> None:
        """Read the air damping and the lateral friction of Bullet from the settings."""
        super().__init__(world)
        self.damping = settings["linear_damping"]
        self._lateral_friction = settings["lateral_friction"]
        self._contact_height = math.nan

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants."""
        super().reset_world(constants)
        self._contact_height = _CONTACT_HEIGHT_RADII * constants["radius"]

    def set_contact_parameters(self, restitution: float, friction: float) -> None:
        """Set the ball's restitution and the friction of the contact.

        Bullet uses the product of the friction coefficients of both bodies. In the settings, both
        have the same coefficient f. With `friction`, the product is f^2 + friction.

        Args:
            restitution: Ratio of normal speeds after and before an impact.
            friction: Friction coefficient of effects, added to that of the settings.
        """
        if (restitution, friction) == self._contact:
            return
        # With 1 for the ground, the ball's coefficient is the whole product.
        ball_friction = self._lateral_friction
        ground_friction = self._lateral_friction
        if friction:
            ball_friction = self._lateral_friction**2 + friction
            ground_friction = 1.0
        pybullet = bullet_world.import_pybullet()
        _, previous_friction = self._contact
        # Without friction of effects, the coefficients of the settings are set already, except
        # after a call with friction, or before the first call, where the former value is NaN.
        if friction or previous_friction:
            floor = pybullet.getBodyUniqueId(0, self._client)
            for body, value in ((floor, ground_friction), (self._body, ball_friction)):
                pybullet.changeDynamics(
                    body, -1, lateralFriction=value, physicsClientId=self._client
                )
        pybullet.changeDynamics(
            self._body, -1, restitution=restitution, physicsClientId=self._client
        )
        self._contact = restitution, friction

    def is_near_contact(self, gap: float) -> bool:
        """Return whether the gap is within Bullet's contact distance."""
        return gap <= self._contact_height
