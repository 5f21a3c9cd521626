"""Balls in MuJoCo: over level ground with exact impacts, or on a soft contact.

MuJoCo's contact computes a reference acceleration along the normal and applies the share d of it.
With the penetration r, its rate v, and the acceleration a_0 without contact,

    a_ref = -b v - k r                                                     (1)
    a = (1 - d) a_0 + d a_ref, never pulling                               (2)

("Solver parameters", https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters).
Written as ``solref = (-stiffness, -damping)`` with constant impedance d and zero stiffness, a_ref =
-(damping / d) v. Therefore, with

    damping = (1 + e) / h                                                  (3)

a single step of length h from the surface, with other forces compensated (a_0 = 0), changes v to v
- (1 + e) v = -e v: exactly the restitution e, for any h. A resting ball is supported with

    damping = 1 / h,    stiffness = 0.1 / h^2                              (4)

which lets it sink in by 10 (1 - d) g h^2. MuJoCo's friction is a convex relaxation that turns slip
into lift (Todorov, ICRA 2014, doi:10.1109/ICRA.2014.6907751). Therefore contact is frictionless
here, and the tangential speed lost in an impact is applied as an impulse, through ``qfrc_applied``
in the step of the impact.
"""

from __future__ import annotations

import functools
import math
from typing import Any

from sims.core.mujoco_import import import_mujoco
from sims.engines.external import ball_integration
from sims.engines.external.ball_integration import BallState
from sims.engines.external.element_forces import Vector
from sims.engines.external.mujoco_world import CompiledWorld

_IMPACT_STEP_SECONDS = 1e-4
"""Length of the time step of an impact in seconds.

MuJoCo treats accelerations above 1e10 as a failure.
"""
_CONTACT_IMPEDANCE = 0.9999
"""Impedance d of the contact: the largest value that MuJoCo allows."""


class MujocoMover:
    """Ball on three slide joints; see `sims.engines.external.ball_integration.BallBody`."""

    def __init__(self, world: CompiledWorld) -> None:
        self._world = world

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants in its initial state, with contact switched off.

        Args:
            constants: Constants of the ball: mass, radius, gravity.
        """
        mujoco = import_mujoco()
        self._mass = constants["mass"]
        self._floor = constants["radius"]
        self._gravity = constants["gravity"]
        self._model, self._data = self._world.get_reset_world(constants)
        self._x = self._data.qpos
        self._w = self._data.qvel
        self._force = self._data.qfrc_applied
        self._no_contact = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        # Width, midpoint and power of the impedance are MuJoCo's defaults.
        self._model.geom_solimp[:] = _CONTACT_IMPEDANCE, _CONTACT_IMPEDANCE, 1e-3, 0.5, 2.0
        self._step_world = mujoco.mj_step
        self._inverse_step = math.nan
        self._set_contact(False)

    def _set_contact(self, ground: bool) -> None:
        """Switch contact on or off."""
        flags = self._model.opt.disableflags
        self._model.opt.disableflags = (
            flags & ~self._no_contact if ground else flags | self._no_contact
        )

    def _set_contact_parameters(self, stiffness: float, damping: float) -> None:
        """Set stiffness (1/s^2) and damping (1/s) of the following contacts."""
        self._model.geom_solref[:] = -stiffness, -damping

    def set_step(self, step: float) -> None:
        """Set the step in seconds."""
        self._model.opt.timestep = step
        self._inverse_step = 1.0 / step

    def set_state(self, x: Vector, w: Vector) -> None:
        """Set position and velocity.

        Args:
            x: position, m.
            w: velocity at the time half a step before, m/s.
        """
        self._x[:] = x
        self._w[:] = w

    def advance(self, force: Vector) -> BallState:
        """Advance by one step with a force per unit mass at the centre."""
        mass = self._mass
        self._force[:] = mass * force[0], mass * force[1], mass * force[2]
        self._step_world(self._model, self._data)
        self._force[:] = 0.0
        return self._x.tolist(), self._w.tolist()

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: self.__dict__[name] for name in ("_world", "_stiffness") if name in self.__dict__
        }


class MujocoBall(MujocoMover):
    """Ball whose impact MuJoCo's contact solves in one step.

    See `sims.engines.external.ball_integration.BallWithImpacts`.
    """

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, with contact switched off."""
        super().reset_world(constants)
        self._is_supported = False

    def set_step(self, step: float) -> None:
        """Set the step in seconds.

        Support has damping = 1 / h and stiffness = 0.1 / h^2 (4).
        """
        super().set_step(step)
        if self._is_supported:
            self._set_contact_parameters(0.1 * self._inverse_step**2, self._inverse_step)  # (4)

    def solve_impact(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """Return the velocity after an impact, from MuJoCo's contact solver in one short step.

        Gravity is compensated, and friction is applied as an impulse.

        With the damping (1 + e) / h (3) of the contact, a single step h changes the normal velocity
        v to -e v.

        Args:
            x: position at the impact.
            v: velocity before the impact.
            restitution: restitution coefficient.
            friction: friction coefficient.
        """
        self._is_supported = False
        self.set_step(_IMPACT_STEP_SECONDS)
        self.set_state((x[0], x[1], self._floor - ball_integration.CONTACT_PENETRATION), v)
        self._set_contact_parameters(0.0, (1.0 + restitution) * self._inverse_step)  # (3)
        # The impact removes tangential speed mu (1 + e) |vn| (`compiled.ground_impacts`), in
        # this one step.
        tangential_speed = math.hypot(v[0], v[1])
        removed_share = (
            min(friction * (1.0 + restitution) * -v[2] / tangential_speed, 1.0)
            if tangential_speed
            else 0.0
        )
        # Deceleration divided by the speed, 1/s.
        rate = removed_share * self._inverse_step
        self._set_contact(True)
        _, velocity = self.advance((-rate * v[0], -rate * v[1], self._gravity))
        self._set_contact(False)
        return velocity

    def set_resting_contact(self) -> None:
        """Set contact that supports the ball: damping, and a weak spring."""
        self._is_supported = True
        self._set_contact(True)
        # (4) depends on the step; if a step is already set, the contact is set for it.
        if not math.isnan(self._inverse_step):
            self.set_step(1.0 / self._inverse_step)


_MAX_DAMPING_RATIO = 2.0
"""Largest damping ratio of a soft contact."""


class MujocoSoftBall(MujocoMover):
    """Ball on MuJoCo's soft contact; see `external.ball_integration.NativeContactBall`.

    Friction is applied as a force: a fraction of the normal force of the previous step.
    """

    damping = 0.0

    def __init__(self, world: CompiledWorld, stiffness: float) -> None:
        super().__init__(world)
        self._stiffness = stiffness

    def reset_world(self, constants: dict[str, float]) -> None:
        """Prepare a world for these constants, with contact switched on."""
        super().reset_world(constants)
        self._set_contact(True)
        self._contact_values = math.nan, math.nan

    def set_contact_parameters(self, restitution: float, friction: float) -> None:
        """Set friction, and the damping with which the contact has this restitution.

        The contact is a spring and a damper, which have this restitution only if steps are short.

        Args:
            restitution: Ratio of normal speeds after and before an impact.
            friction: Coefficient of Coulomb friction; `advance` applies it.
        """
        if (restitution, friction) != self._contact_values:
            self._contact_values = restitution, friction
            # For stiffness k and damping b per unit mass, the damping ratio is b / (2 sqrt k).
            damping = 2.0 * compute_damping_ratio(restitution) * math.sqrt(self._stiffness)
            self._set_contact_parameters(self._stiffness, damping)

    def is_near_contact(self, gap: float) -> bool:
        """Return whether the ball touches the ground."""
        return gap <= 0.0

    def advance(self, force: Vector) -> BallState:
        """Advance by one step with a force per unit mass at the centre, and contact friction.

        MuJoCo's own contact is frictionless here. Friction opposes the horizontal velocity, and is
        proportional to the normal force of the last step.
        """
        _, friction = self._contact_values
        if friction and self._data.nefc:  # the contact is active
            vx, vy, _ = self._w.tolist()
            slip = math.hypot(vx, vy)
            # Without friction, the only contact has one constraint force, the normal one.
            normal = float(self._data.efc_force[0])
            # Deceleration divided by the speed, 1/s: friction must not do more than stop the slip
            # within the step.
            rate = min(friction * normal / self._mass / slip, self._inverse_step) if slip else 0.0
            force = force[0] - rate * vx, force[1] - rate * vy, force[2]
        return super().advance(force)


@functools.cache
def compute_damping_ratio(
    restitution: float, max_damping_ratio: float = _MAX_DAMPING_RATIO
) -> float:
    """Return the damping ratio of a spring and damper that only push, for a given restitution.

    The restitution of such a contact is known (T. Schwager, T. Poeschel, Granular Matter 9, 465,
    2007, doi:10.1007/s10035-007-0065-z, equation 20); it is inverted by bisection.

    Args:
        restitution: restitution of an impact.
        max_damping_ratio: largest damping ratio returned; 2 corresponds to a restitution of 0.06.
    """
    # Restitution decreases with damping. After 60 bisections, only rounding error remains.
    low = 0.0
    high = max_damping_ratio
    for _ in range(60):
        ratio = 0.5 * (low + high)
        low, high = (ratio, high) if _compute_restitution(ratio) > restitution else (low, ratio)
    return low


def _compute_restitution(ratio: float) -> float:
    """Return the restitution of a spring and damper that only push, with this damping ratio.

    Equation 20 of Schwager and Poeschel (2007), for strong damping (a ratio of at least 1) and weak
    damping; at a ratio of 1, it is the limit exp(-2) of both.
    """
    if ratio >= 1.0:
        root = math.sqrt(ratio * ratio - 1.0)
        return math.exp(-2.0 * ratio * math.acosh(ratio) / root) if root else math.exp(-2.0)
    root = math.sqrt(1.0 - ratio * ratio)
    return math.exp(-ratio / root * math.atan2(2.0 * ratio * root, 2.0 * ratio * ratio - 1.0))
