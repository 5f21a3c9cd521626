"""PyBullet engine: forces through Bullet's force and torque interfaces, impacts by its solver.

The module ``bullet_world`` in the system's package builds the world of a system; its interface is
specified in `sims.engines.worlds`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import cast

from sims import bullet
from sims.base import InputError
from sims.engines import bullet_joints, flight, joint, joints, native, together
from sims.engines.external import Rollouts, checked_time_step, in_turn, integrate
from sims.engines.point import State, Vector
from sims.engines.worlds import (
    BulletBallModule,
    BulletJointModule,
    BulletModule,
    world_module,
)
from sims.system import Engine, Lanes, Motion, System

REQUIRES = ("pybullet",)

_PUBLISHED = {"linear_damping": 0.04, "lateral_friction": 0.2, "plane_restitution": 1.0}
"""Settings of the published scene (TuneNet, arXiv 1907.11200): 1/s, and dimensionless numbers."""
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
"""Identity rotation as a quaternion x, y, z, w."""
_NOWHERE = (0.0, 0.0, 0.0)
"""Zero vector: the origin, or zero velocity."""
_IMPACT = 1e-4
"""Length of the time step of an impact, in seconds."""
_REACH = 0.02 * math.sqrt(3)
"""Height above the ground, in radii of the ball, at which Bullet's contact begins."""


def engine(
    system: type[System],
    *,
    time_step: float | None = None,
    native_contact: bool = False,
    linear_damping: float | None = None,
    lateral_friction: float | None = None,
    plane_restitution: float | None = None,
) -> Engine:
    """Make the PyBullet engine for one simulator.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds; each sampling interval is divided into equal steps not
            longer than this.
        native_contact: for a bouncing system: use Bullet's native contact
            (`sims.ball.bullet_world`), stepped and read at first order as in the published
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
    own = {
        "linear_damping": linear_damping,
        "lateral_friction": lateral_friction,
        "plane_restitution": plane_restitution,
    }
    given = {name: value for name, value in own.items() if value is not None}
    if not native_contact:
        if given:
            raise InputError(
                f"setting {next(iter(given))} belongs to Bullet's own contact: set"
                " native_contact = true"
            )
        return BulletEngine(system, checked_time_step(time_step, system))
    if not system.bounces:
        raise InputError(f"system {system.name} does not bounce: leave native_contact out")
    for name, value in given.items():
        if not 0 <= value < math.inf:
            raise InputError(f"{name} must be a number of at least 0, found {value}")
    step = math.inf if time_step is None else checked_time_step(time_step, system)
    return BulletEngine(system, step, {**_PUBLISHED, **given})


class BulletEngine:
    """PyBullet engine for one system.

    Batch elements are integrated one after the other in one world; where effects must be evaluated
    at each step, several bodies may share one world.
    """

    name: str = "pybullet"
    requires: tuple[str, ...] = REQUIRES

    def __init__(
        self, system: type[System], largest_step: float, own: Mapping[str, float] | None = None
    ) -> None:
        self.largest_step = largest_step
        self._rollouts: Rollouts | None = None
        self._many: bullet_joints.Joints | None = None
        asked = BulletModule if system.bounces else BulletJointModule
        if own is not None:
            asked = BulletBallModule
        module, self._reason = world_module(system, "bullet_world", asked)
        if module is None:
            return
        if own is not None:
            build = partial(cast(BulletBallModule, module).build_native, settings=own)
            self._world = bullet.PersistentWorld(build)
            rollout = partial(native.rollout, NativeBall(self._world, own))
            self._rollouts = partial(in_turn, rollout, self._world.discard)
        elif system.bounces:
            self._world = bullet.PersistentWorld(cast(BulletModule, module).build)
            ball = partial(flight.rollout, BulletBall(self._world))
            self._rollouts = partial(in_turn, ball, self._world.discard)
        else:
            body = cast(BulletJointModule, module)
            self._world = bullet.PersistentWorld(body.build)
            alone = partial(joint.rollout, bullet_joints.Joint(self._world, body))
            self._many = bullet_joints.Joints(body)
            company = joints.Company(self._many)
            self._rollouts = partial(together.rollouts, alone, company, self._world.discard)

    def integrate(self, lanes: Lanes) -> Motion:
        """Integrate all batch elements; see `Engine`."""
        assert self._rollouts is not None, "a system that the engine refuses"
        return integrate(lanes, self._rollouts, self._discard)

    def _discard(self) -> None:
        """Discard the worlds, so that the next rollout builds new ones."""
        self._world.discard()
        if self._many is not None:
            self._many.discard()

    def refuses(self, system: type[System]) -> str:  # noqa: ARG002
        """Return why the engine cannot integrate the system; see `Engine`."""
        return self._reason

    def close(self) -> None:
        """Close the Bullet worlds; the next integration opens new ones."""
        if self._rollouts is not None:
            self._world.close()
        if self._many is not None:
            self._many.close()


class _Mover:
    """Free ball; see `sims.engines.flight.Mover`."""

    def __init__(self, world: bullet.PersistentWorld) -> None:
        self._world = world
        self._client = self._body = -1
        self._mass = math.nan
        self._contact = math.nan, math.nan
        self._x: Vector = _NOWHERE

    def start(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, without contact points of the previous rollout."""
        p = bullet.engine()
        self._mass = constants["mass"]
        self._contact = (math.nan, math.nan)
        self._client, self._body = self._world.body(constants)
        # The world is reset in place, because building one is half the cost of a rollout. But
        # contact points survive a reset, and Bullet would use them as old contacts, which changes
        # the results by rounding. They are removed by placing the ball where it touches nothing.
        far = 0.0, 0.0, 2.0 * constants["radius"] + 1.0
        p.resetBasePositionAndOrientation(self._body, far, _UPRIGHT, self._client)
        p.performCollisionDetection(self._client)

    def pace(self, step: float) -> None:
        """Set the step in seconds."""
        bullet.engine().setTimeStep(step, self._client)

    def place(self, x: Vector, w: Vector) -> None:
        """Set position and velocity; the ball is upright and does not spin."""
        bullet.engine().resetBasePositionAndOrientation(self._body, x, _UPRIGHT, self._client)
        bullet.engine().resetBaseVelocity(self._body, w, _NOWHERE, self._client)
        self._x = x

    def advance(self, force: Vector) -> State:
        """Advance by one step with a force per unit mass at the ball's last known centre."""
        # Bullet expects the force in newtons and the point where it acts.
        p = bullet.engine()
        mass = self._mass
        newtons = mass * force[0], mass * force[1], mass * force[2]
        p.applyExternalForce(self._body, -1, newtons, self._x, p.WORLD_FRAME, self._client)
        return self.glide((1,))[0]

    def glide(self, counts: Sequence[int]) -> list[State]:
        """Advance by each number of steps in `counts` under gravity alone; return the states."""
        p = bullet.engine()
        client = self._client
        body = self._body
        step = p.stepSimulation
        at = p.getBasePositionAndOrientation
        moving = p.getBaseVelocity
        states: list[State] = []
        for count in counts:
            for _ in range(count):
                step(client)
            states.append((at(body, client)[0], moving(body, client)[0]))
        self._x = states[-1][0]
        return states

    def touch(self, restitution: float, friction: float) -> None:
        """Set the ball's restitution and friction coefficient."""
        if (restitution, friction) != self._contact:
            self._contact = restitution, friction
            bullet.engine().changeDynamics(
                self._body,
                -1,
                restitution=restitution,
                lateralFriction=friction,
                physicsClientId=self._client,
            )


class BulletBall(_Mover):
    """Ball without spin, on ground with restitution and friction 1.

    See `sims.engines.flight.FlyingBall`.
    """

    def start(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, with contact switched off."""
        self._floor = constants["radius"]
        self._gravity = constants["gravity"]
        super().start(constants)
        self._meets(False)

    def _meets(self, ground: bool) -> None:
        """Switch contact between ball and ground on or off."""
        # Contact is off in flight, because `flight` computes when the ball meets the ground.
        p = bullet.engine()
        floor = p.getBodyUniqueId(0, self._client)
        p.setCollisionFilterPair(floor, self._body, -1, -1, ground, self._client)

    def strike(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """Return the velocity after an impact, from Bullet's contact solver in one short step.

        Args:
            x: position at the impact.
            v: velocity before the impact.
            restitution: restitution coefficient.
            friction: friction coefficient.
        """
        self.touch(restitution, friction)
        self.pace(_IMPACT)
        # Bullet adds gravity's velocity change of the step before it solves the contact. This is
        # compensated, so that the solver sees v.
        inside = x[0], x[1], self._floor - flight.INSIDE
        self.place(inside, (v[0], v[1], v[2] + self._gravity * _IMPACT))
        self._meets(True)
        _, after = self.glide((1,))[0]
        self._meets(False)
        return after

    def hold(self) -> None:
        """Set contact with zero restitution and zero friction."""
        self.touch(0.0, 0.0)
        self._meets(True)


class NativeBall(_Mover):
    """Ball with Bullet's native contact; see `sims.engines.native.NativeBall`."""

    def __init__(self, world: bullet.PersistentWorld, settings: Mapping[str, float]) -> None:
        super().__init__(world)
        self.damping = settings["linear_damping"]
        self._rough = settings["lateral_friction"]
        self._reach = math.nan

    def start(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants."""
        super().start(constants)
        self._reach = _REACH * constants["radius"]

    def touch(self, restitution: float, friction: float) -> None:
        """Set the ball's restitution and the friction of the contact.

        `friction` is added to that of the settings, which is the product of both bodies'
        coefficients.
        """
        if (restitution, friction) == self._contact:
            return
        # The contact uses the product of both bodies' friction. With 1 for the ground, the ball's
        # coefficient is the product from the settings plus the friction of the effect.
        own = self._rough
        ground = self._rough
        if friction:
            own = self._rough**2 + friction
            ground = 1.0
        p = bullet.engine()
        if friction or self._contact[1]:
            floor = p.getBodyUniqueId(0, self._client)
            p.changeDynamics(floor, -1, lateralFriction=ground, physicsClientId=self._client)
            p.changeDynamics(self._body, -1, lateralFriction=own, physicsClientId=self._client)
        p.changeDynamics(self._body, -1, restitution=restitution, physicsClientId=self._client)
        self._contact = restitution, friction

    def near(self, gap: float) -> bool:
        """Return whether the gap is within Bullet's contact distance."""
        return gap <= self._reach
