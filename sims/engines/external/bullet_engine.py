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
from sims.engines.external.bullet_ball_contact import BulletBall, BulletNativeBall
from sims.engines.external.external_engine import (
    RolloutFunction,
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

        Args:
            system: System that the engine will integrate.
            largest_step: Longest step, s.
            native_settings: Bullet's damping, friction and restitution by name; None for exact
                impacts.

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
