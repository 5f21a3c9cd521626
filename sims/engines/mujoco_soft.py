"""A ball on MuJoCo's contact as it comes: a spring and a damper."""

from __future__ import annotations

import math

from sims.engines.mujoco_bodies import CompiledWorld, Mover
from sims.engines.point import State, Vector

_MOST_DAMPED = 2.0
"""Largest damping ratio of a springy contact."""


class SoftBall(Mover):
    """A ball on MuJoCo's springy contact; see `sims.engines.native.NativeBall`.

    Friction is put in as a force, a share of the normal force of the step before.
    """

    damping = 0.0

    def __init__(self, world: CompiledWorld, stiffness: float) -> None:
        super().__init__(world)
        self._stiffness = stiffness

    def start(self, constants: dict[str, float]) -> None:
        """As every ball's, with contact."""
        super().start(constants)
        self._meets(True)
        self._touched = math.nan, math.nan

    def touch(self, restitution: float, friction: float) -> None:
        """Damping that gives this restitution if the step is short; friction."""
        if (restitution, friction) != self._touched:
            self._touched = restitution, friction
            # Of a spring of k and a damper of b per unit mass, the damping ratio is b / (2 sqrt k).
            damping = 2.0 * damping_ratio(restitution) * math.sqrt(self._stiffness)
            self._contact(self._stiffness, damping)

    def near(self, gap: float) -> bool:
        """Touching."""
        return gap <= 0.0

    def advance(self, force: Vector) -> State:
        """One step with a force at the centre and what friction there is."""
        friction = self._touched[1]
        if friction and self._data.nefc:
            vx, vy, _ = self._w.tolist()
            slip = math.hypot(vx, vy)
            normal = float(self._data.efc_force[0])
            # No more than stops the slip within the step.
            share = min(friction * normal / self._mass / slip, self._hertz) if slip else 0.0
            force = force[0] - share * vx, force[1] - share * vy, force[2]
        return super().advance(force)


def damping_ratio(restitution: float) -> float:
    """The damping ratio of a spring and damper that push but do not pull, for a restitution; at
    most 2, for 0.06.

    T. Schwager, T. Poeschel, Granular Matter 9, 465 (2007), doi:10.1007/s10035-007-0065-z, equation
    20.
    """
    # Restitution falls with damping; sixty halvings leave nothing but rounding.
    low = 0.0
    high = _MOST_DAMPED
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _rebound(middle) > restitution else (low, middle)
    return low


def _rebound(ratio: float) -> float:
    """Restitution of a spring and damper of this damping ratio."""
    if ratio >= 1.0:
        root = math.sqrt(ratio * ratio - 1.0)
        return math.exp(-2.0 * ratio * math.acosh(ratio) / root) if root else math.exp(-2.0)
    root = math.sqrt(1.0 - ratio * ratio)
    return math.exp(-ratio / root * math.atan2(2.0 * ratio * root, 2.0 * ratio * ratio - 1.0))
