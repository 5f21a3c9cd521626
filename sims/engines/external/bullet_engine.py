"""PyBullet engine: forces through Bullet's force and torque interfaces, impacts by its solver.

A system with one coordinate is a body on a hinge or guide. For a bouncing system, the module
``<system>_bullet_world`` in its package builds the world; its interface is specified in
`sims.engines.external.world_interface`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import cast

from sims.core.engine import Engine, IntegrationBatch, Trajectories
from sims.core.simulator import InputError
from sims.core.system import System
from sims.engines.external import ball_integration, bullet_world, joint_integration
from sims.engines.external.ball_integration import BallState
from sims.engines.external.external_engine import (
    RolloutFunction,
    Vector,
    integrate_batch,
    resolve_time_step,
)
from sims.engines.external.world_interface import (
    BulletBallWorldModule,
    BulletWorldModule,
    check_one_coordinate,
    find_world_module,
)

REQUIRED_PACKAGES = ("pybullet",)

_PUBLISHED_SETTINGS = {"linear_damping": 0.04, "lateral_friction": 0.2, "plane_restitution": 1.0}
"""Settings of the published scene (TuneNet, arXiv 1907.11200): 1/s, and dimensionless numbers."""
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
"""Identity rotation as a quaternion x, y, z, w."""
_ZERO_VECTOR = (0.0, 0.0, 0.0)
"""Zero vector: the origin, or zero velocity."""
_IMPACT_STEP_SECONDS = 1e-4
"""Length of the time step of an impact, in seconds."""
_CONTACT_HEIGHT_RADII = 0.02 * math.sqrt(3)
"""Height above the ground, in radii of the ball, at which Bullet's contact begins."""


def make_engine(
    system: type[System],
    *,
    time_step: float | None = None,
    native_contact: bool = False,
    linear_damping: float | None = None,
    lateral_friction: float | None = None,
    plane_restitution: float | None = None,
) -> Engine:
    """Make the PyBullet engine for one simulator.

    By default impacts are computed exactly, not by Bullet; settings that apply to its own contact
    only are refused without it.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds; each sampling interval is divided into equal steps not
            longer than this.
        native_contact: for a bouncing system: use Bullet's native contact
            (`sims.systems.ball_bullet_world`), stepped and read at first order as in the published
            experiments; without `time_step`, each sample interval is one step.
        linear_damping: with `native_contact`: Bullet's linear air damping in 1/s (0.04).
        lateral_friction: with `native_contact`: friction of both ball and ground (0.2); the contact
            uses the product.
        plane_restitution: with `native_contact`: restitution of the ground (1.0); the contact uses
            the product.

    Returns:
        The engine.

    Raises:
        InputError: a setting is not valid.
    """
    native_settings = {
        "linear_damping": linear_damping,
        "lateral_friction": lateral_friction,
        "plane_restitution": plane_restitution,
    }
    given_settings = {name: value for name, value in native_settings.items() if value is not None}
    if not native_contact:
        if given_settings:
            raise InputError(
                f"setting {next(iter(given_settings))} applies to Bullet's native contact only: set"
                " native_contact = true"
            )
        return BulletEngine(system, resolve_time_step(time_step, system))
    if not system.bounces:
        raise InputError(f"system {system.name} does not bounce: leave native_contact out")
    for name, value in given_settings.items():
        if not 0 <= value < math.inf:
            raise InputError(f"{name} must be a number of at least 0, found {value}")
    step = math.inf if time_step is None else resolve_time_step(time_step, system)
    return BulletEngine(system, step, {**_PUBLISHED_SETTINGS, **given_settings})


class BulletEngine:
    """PyBullet engine for one system.

    Batch elements are integrated one after the other in one world.
    """

    name: str = "pybullet"

    def __init__(
        self,
        system: type[System],
        largest_step: float,
        native_settings: Mapping[str, float] | None = None,
    ) -> None:
        """Choose how batch elements are integrated: native contact, exact impacts, or a joint.

        With `native_settings`, Bullet's own contact and air damping move a ball. Otherwise
        a system that bounces gets impacts at their exact times, and any other system is a
        body on a joint.

        Raises:
            InputError: Bullet cannot simulate the system.
        """
        self.largest_step = largest_step
        self._rollout: RolloutFunction
        if not system.bounces:
            check_one_coordinate(self.name, system)
            is_hinge = system.kind == "rotary"
            kind = "JOINT_REVOLUTE" if is_hinge else "JOINT_PRISMATIC"
            self._world = bullet_world.PersistentBulletWorld(
                partial(bullet_world.build_jointed_body, kind)
            )
            joint = bullet_world.BulletJoint(self._world, is_hinge)
            self._rollout = partial(joint_integration.integrate_joint, joint)
            return
        protocol = BulletWorldModule if native_settings is None else BulletBallWorldModule
        module = find_world_module(self.name, system, "bullet_world", protocol)
        if native_settings is None:
            self._world = bullet_world.PersistentBulletWorld(cast(BulletWorldModule, module).build)
            self._rollout = partial(ball_integration.integrate_ball, BulletBall(self._world))
        else:
            build = cast(BulletBallWorldModule, module).build_native
            self._world = bullet_world.PersistentBulletWorld(
                partial(build, settings=native_settings)
            )
            native_ball = BulletNativeBall(self._world, native_settings)
            self._rollout = partial(ball_integration.integrate_native_ball, native_ball)

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Integrate all batch elements; see `Engine`."""
        return integrate_batch(batch, [self._rollout], self._world.invalidate)

    def close(self) -> None:
        """Close the Bullet world; the next integration opens a new one."""
        self._world.close()


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
        """Advance by one step with a force per unit mass at the ball's last known centre."""
        # Bullet expects the force in newtons and the point where it acts.
        p = bullet_world.import_pybullet()
        mass = self._mass
        newtons = mass * force[0], mass * force[1], mass * force[2]
        p.applyExternalForce(self._body, -1, newtons, self._x, p.WORLD_FRAME, self._client)
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

        `friction` is added to that of the settings, which is the product of both bodies'
        coefficients.
        """
        if (restitution, friction) == self._contact:
            return
        # The contact uses the product of both bodies' friction. With 1 for the ground, the ball's
        # coefficient is the product from the settings plus the friction of the effect.
        ball_friction = self._lateral_friction
        ground_friction = self._lateral_friction
        if friction:
            ball_friction = self._lateral_friction**2 + friction
            ground_friction = 1.0
        pybullet = bullet_world.import_pybullet()
        _, previous_friction = self._contact
        if friction or previous_friction:  # NaN before the first call
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
