"""Forces of effects on a robot: those that are known beforehand, and those that are asked for in
every step, of all lanes at once.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sims.base import Array
from sims.robot.lanes import Addresses, Mask
from sims.robot.moment import RobotMoment
from sims.robot.native import FIELDS
from sims.robot.remembered import advanced
from sims.robot.series import is_series
from sims.robot.system import RobotSystem
from sims.system import Acting, Force, Friction, Hidden, State

OVER_TIME = frozenset({"force.bias", "force.periodic"})
"""Effects whose force hangs on nothing but time."""

LOADED = frozenset(
    {"friction.load", "friction.load_direction", "friction.load_quadratic", "supply.sag"}
)
"""Effects that look at what transmissions carry."""


def moment_of(
    system: RobotSystem,
    t: Array,
    x: Array,
    v: Array,
    inputs: Mapping[str, Array],
    carried: Array,
    stiffness: Array | None = None,
) -> RobotMoment:
    """The instant of lanes; t (L, 1), `carried` (2, L, D), all others (L, D); without `stiffness`
    no servo is at work.
    """
    theta = np.zeros((len(x), 0))
    stiff = np.zeros((0, 0)) if stiffness is None else stiffness
    drives, servos = dict(system.drives), dict(system.servos)
    joints = system.alone, drives, servos, stiff
    return RobotMoment(system, theta, {}, t, x, v, inputs, carried, *joints)


def over_time(system: RobotSystem, acting: Acting, t: Array, size: int, lanes: int) -> Array:
    """(L, S, D) forces that hang on time alone, at the beginnings t (S,) of steps and half a step
    later.
    """
    result = np.zeros((lanes, t.size, size))
    half = 0.5 * (t[1] - t[0]) if t.size > 1 else 0.0
    nothing = np.zeros((t.size, size))
    # The force in the middle of a step gives the momentum that the force over it does.
    moment = moment_of(system, (t + half)[:, None], nothing, nothing, {}, np.stack([nothing] * 2))
    for effect, c in acting:
        if effect.of not in OVER_TIME or not isinstance(effect, Force):
            continue
        for lane in np.flatnonzero((c != 0).any(axis=0)[:, 0]):
            own = np.repeat(c[:, lane : lane + 1], t.size, axis=1)
            result[lane] += effect.force(own, moment)
    return result


class Forces:
    """Forces of effects that hang on where the robot is.

    Attributes:
        rubs: (L, D) where dry friction is among them.

    Args:
        system: the robot's.
        acting: effects at one place each.
        count: how many lanes.
        addresses: of the joints.
        stiffness: (L, D) of their position servos.
        step: seconds.
    """

    def __init__(
        self,
        system: RobotSystem,
        acting: Acting,
        count: int,
        addresses: Addresses,
        stiffness: Array | None = None,
        step: float = 0.0,
    ) -> None:
        self._system = system
        self._stiffness = stiffness
        self._count = count
        self.addresses = addresses
        asked = [(e, c) for e, c in acting if e.hook == "force" and e.of not in OVER_TIME]
        self._forces = [(e, c) for e, c in asked if isinstance(e, Force) and e.of not in FIELDS]
        self._frictions = [
            (e, c) for e, c in asked if isinstance(e, Friction) and e.of not in FIELDS
        ]
        self.rubs: Mask = np.zeros((count, len(addresses.velocities)), dtype=bool)
        for effect, c in self._frictions:
            self.rubs[:, effect.coordinate] |= (c != 0).any(axis=0)[:, 0]
        self._hidden = [(e, c) for e, c in acting if isinstance(e, Hidden) and not is_series(e)]
        self._states: list[State] = []
        self._last: float | None = None
        self._half = 0.5 * step

    def at(
        self, t: float, x: Array, v: Array, inputs: Mapping[str, Array], carried: Array
    ) -> tuple[Array, Array]:
        """Forces and limits of dry friction (L, D) each, at an instant."""
        now = np.full((len(x), 1), t)
        moment = moment_of(self._system, now, x, v, inputs, carried, self._stiffness)
        force = np.zeros_like(x)
        for effect, c in self._forces:
            force += effect.force(c, moment)
        if self._hidden:
            force += self._remembered(moment)
        limit = np.zeros_like(x)
        for dry, c in self._frictions:
            joint = dry.coordinate
            assert joint is not None
            limit[:, joint] += dry.limit(c, moment)[:, 0]
        return force, limit

    def _remembered(self, moment: RobotMoment) -> Array:
        """(L, D) forces of effects with states, which go from the middle of the last step to that
        of this one.
        """
        now = float(moment.t[0, 0])
        total = np.zeros_like(moment.x)
        for k, (effect, c) in enumerate(self._hidden):
            if self._last is None:
                self._states.append(effect.begin(c, moment))
            step = self._half if self._last is None else now - self._last
            self._states[k] = advanced(effect, c, moment, self._states[k], step)
            force, _ = effect.act(c, moment, self._states[k])
            total += np.where(c[0] > 0, force, 0.0)
        self._last = now
        return total
