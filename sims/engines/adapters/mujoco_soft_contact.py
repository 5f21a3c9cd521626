"""Ball on MuJoCo's native soft contact: a spring and a damper."""

from __future__ import annotations

import functools
import math

from sims.engines.adapters.mujoco_bodies import CompiledWorld, MujocoMover
from sims.engines.external.ball_rollout import BallState
from sims.engines.external.element_forces import Vector

_MAX_DAMPING_RATIO = 2.0
"""Largest damping ratio of a soft contact."""


class MujocoSoftBall(MujocoMover):
    """Ball on MuJoCo's soft contact; see `sims.engines.external.native_contact.NativeContactBall`.

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
        """Set friction, and the damping that gives this restitution for short steps."""
        if (restitution, friction) != self._contact_values:
            self._contact_values = restitution, friction
            # For stiffness k and damping b per unit mass, the damping ratio is b / (2 sqrt k).
            damping = 2.0 * compute_damping_ratio(restitution) * math.sqrt(self._stiffness)
            self._set_contact_parameters(self._stiffness, damping)

    def is_near_contact(self, gap: float) -> bool:
        """Return whether the ball touches the ground."""
        return gap <= 0.0

    def advance(self, force: Vector) -> BallState:
        """Advance by one step with a force per unit mass at the centre, and contact friction."""
        friction = self._contact_values[1]
        if friction and self._data.nefc:
            vx, vy, _ = self._w.tolist()
            slip = math.hypot(vx, vy)
            normal = float(self._data.efc_force[0])
            # Friction must not do more than stop the slip within the step.
            share = min(friction * normal / self._mass / slip, self._inverse_step) if slip else 0.0
            force = force[0] - share * vx, force[1] - share * vy, force[2]
        return super().advance(force)


@functools.cache
def compute_damping_ratio(
    restitution: float, max_damping_ratio: float = _MAX_DAMPING_RATIO
) -> float:
    """Return the damping ratio of a spring and damper that only push, for a given restitution.

    T. Schwager, T. Poeschel, Granular Matter 9, 465 (2007), doi:10.1007/s10035-007-0065-z, equation
    20.

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
    """Return the restitution of a spring and damper with this damping ratio."""
    if ratio >= 1.0:
        root = math.sqrt(ratio * ratio - 1.0)
        return math.exp(-2.0 * ratio * math.acosh(ratio) / root) if root else math.exp(-2.0)
    root = math.sqrt(1.0 - ratio * ratio)
    return math.exp(-ratio / root * math.atan2(2.0 * ratio * root, 2.0 * ratio * ratio - 1.0))
