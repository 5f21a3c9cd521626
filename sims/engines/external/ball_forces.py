"""Effect forces and impact parameters of a ball that an external engine integrates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array
from sims.engines.external.external_engine import ElementWork, Trajectory
from sims.engines.external.external_forces import ExternalForces
from sims.engines.external.resistance_laws import make_resistance, make_resistance_batch
from sims.engines.ground_contact import MAX_SHORT_FLIGHTS, MIN_FLIGHT_SECONDS, SHORT_FLIGHT_SECONDS

Vector = Sequence[float]
"""Vector x, y, z."""
BallState = tuple[Vector, Vector]
"""Position and the engine's velocity."""


def get_gravity(lane: ElementWork) -> Vector:
    """Return the acceleration of gravity, which is constant."""
    start = np.zeros((1, 1))
    nothing = np.zeros((1, 3))
    moment = lane.make_snapshot(start, nothing, nothing, {})
    weight: list[float] = lane.system.weight(moment)[0].tolist()
    return weight


def make_trajectory(lane: ElementWork, rows: list[tuple[float, ...]]) -> Trajectory:
    """Split rows of position, velocity and acceleration; all NaN if rows are missing.

    Args:
        lane: integrated batch element.
        rows: nine numbers for each recorded state.

    Returns:
        Positions, velocities and accelerations (N, 3).
    """
    if len(rows) < lane.recorded_steps.size:
        rows = [(math.nan,) * 9] * lane.recorded_steps.size
    table = np.array(rows)
    return table[:, :3], table[:, 3:6], table[:, 6:]


class EffectForce:
    """Force per unit mass of the effects, in addition to gravity."""

    def __init__(self, lane: ElementWork) -> None:
        self._ask = ExternalForces([lane], 1)
        self._opposing = make_resistance(lane)
        self.any = self._ask.any

    def compute(self, t: float, x: Vector, v: Vector) -> Vector:
        """Return the force per unit mass in m/s^2 at a state.

        Dry friction, which no effect of the library applies to a free ball, opposes the velocity.

        Args:
            t: time in seconds.
            x: position.
            v: velocity.
        """
        vx, vy, vz = v
        speed = math.sqrt(vx * vx + vy * vy + vz * vz)
        # Resistance is counted per unit of velocity: force = -share v.
        if self._opposing:
            share = self._opposing.compute(speed)[0]
            limit = self._opposing.limit
            fx = fy = fz = 0.0
        else:
            moment = self._ask.moment
            moment.t.fill(t)
            moment.x[0] = x
            moment.v[0] = v
            fx, fy, fz = self._ask.compute_force()[0].tolist()
            share = 0.0
            limit = self._ask.compute_friction_limit()
        # Dry friction has no direction at rest.
        if limit and speed:
            share += limit / speed
        return fx - share * vx, fy - share * vy, fz - share * vz


class EffectForceBatch:
    """Force per unit mass of the effects on many batch elements; see `EffectForce`.

    If all effects of all elements have closed forms, these are used; otherwise effects are
    evaluated.
    """

    def __init__(self, lanes: Sequence[ElementWork]) -> None:
        self._take(lanes)

    def truncate(self, count: int) -> None:
        """Continue with the first `count` elements only."""
        if count < len(self._lanes):
            self._take(self._lanes[:count])

    def _take(self, lanes: Sequence[ElementWork]) -> None:
        self._lanes = lanes
        known = all(make_resistance(lane) is not None for lane in lanes)
        self._opposing = make_resistance_batch(lanes) if known else None
        self._ask = None if known else ExternalForces(lanes, 1)

    def compute(self, t: Array, x: Array, v: Array) -> Array:
        """Return the forces per unit mass (n, 3) in m/s^2.

        Args:
            t: (n,) times in seconds.
            x: (n, 3) positions.
            v: (n, 3) velocities.
        """
        vx, vy, vz = v.T
        speed = np.sqrt(vx * vx + vy * vy + vz * vz)
        limit: Array | None
        if self._opposing:
            share = self._opposing.compute(speed)[0]
            limit = self._opposing.limit
            force = np.zeros(v.shape)
        else:
            assert self._ask is not None
            moment = self._ask.moment
            moment.t[:, 0] = t
            moment.x[:] = x
            moment.v[:] = v
            force = self._ask.compute_force()
            share = np.zeros(t.size)
            limit = self._ask.compute_friction_limits() if self._ask.rubs else None
        # Dry friction has no direction at rest.
        if limit is not None:
            rubs = (limit != 0.0) & (speed != 0.0)
            share = share + np.where(rubs, limit / np.where(rubs, speed, 1.0), 0.0)
        result: Array = force - share[:, None] * v
        return result


class ImpactParameters:
    """Parameters of impacts, from the system and the contact effects."""

    def __init__(self, lane: ElementWork) -> None:
        self._restitution = lane.system.restitution(lane.theta)
        self._effects = lane.contact_effects
        self._shorts = 0

    @property
    def has_contact_effects(self) -> bool:
        """Whether any contact effect is active."""
        return bool(self._effects)

    def compute(self, speed: float) -> tuple[float, float]:
        """Return restitution and friction coefficient of an impact at this speed (m/s)."""
        restitution = self._restitution
        friction = 0.0
        for effect, c in self._effects:
            restitution = effect.restitution(c, restitution, np.array([[speed]]))
            friction += float(effect.friction(c)[0, 0])
        return float(restitution[0, 0]), friction

    def compute_with_rest_condition(self, speed: float, down: float) -> tuple[float, float, bool]:
        """Return the parameters of an impact, and whether bouncing ends with it.

        The friction of the last impact includes the friction of all omitted bounces.

        Args:
            speed: normal speed before the impact in m/s.
            down: downward acceleration in m/s^2.

        Returns:
            Restitution, friction coefficient, and whether bouncing is finished.
        """
        # Equation numbers refer to `sims.engines.ground_contact`.
        restitution, friction = self.compute(speed)
        up = restitution * speed  # (1)
        flight = 2.0 * up / down if down > 0.0 else math.inf  # (3)
        self._shorts = self._shorts + 1 if flight < SHORT_FLIGHT_SECONDS else 0
        if flight >= MIN_FLIGHT_SECONDS and self._shorts <= MAX_SHORT_FLIGHTS:
            return restitution, friction, False
        # Engines remove mu (1 + e) |vn| with the returned e, which is 0. Therefore all of (4) and
        # the factor 1 + e of this impact are included in the friction.
        later = up / (1.0 - restitution) if restitution < 1.0 else 0.0  # (4), divided by mu (1 + e)
        total = friction * (1.0 + restitution) * (1.0 + later / speed) if speed else 0.0
        return 0.0, total, True
