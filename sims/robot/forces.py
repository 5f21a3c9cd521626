"""Forces of effects on a robot: those that are known beforehand, and those that are asked for in
every step, of all lanes at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sims.base import Array
from sims.robot.lanes import Addresses
from sims.robot.midway import Look, Mask, middle
from sims.robot.moment import RobotMoment
from sims.robot.native import FIELDS
from sims.robot.places import COMMON
from sims.robot.remembered import advanced
from sims.robot.series import is_series
from sims.robot.system import RobotSystem
from sims.system import Acting, Effect, Force, Friction, Hidden, State

OVER_TIME = frozenset({"force.bias", "force.periodic"})
"""Effects whose force hangs on nothing but time."""

LOADED = frozenset(
    {
        "friction.load",
        "friction.load_direction",
        "friction.load_quadratic",
        "supply.braking",
        "supply.sag",
    }
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
        loaded: (L,) where one looks at what transmissions carry.
        system: the robot's.
        felt: inputs as they are felt, (L, S) by name.
        addresses: of the joints.
        stiffness: (L, D) of their position servos.
        step: seconds.
        forces: the effects that push, with their coefficients (K, L, 1).
        frictions: those that rub.
        hidden: those with states.
        working: (L, S, D) 0 where a position servo is switched off and 1 elsewhere; None where all
            are on.

    Args:
        system: see above.
        acting: effects at one place each.
        felt: see above.
        addresses: see above.
        stiffness: see above.
        step: see above.
    """

    def __init__(
        self,
        system: RobotSystem,
        acting: Acting,
        felt: Mapping[str, Array],
        addresses: Addresses,
        stiffness: Array,
        step: float,
    ) -> None:
        self.system = system
        self.felt = felt
        self.addresses = addresses
        self.stiffness = stiffness
        self.step = step
        asked = [(e, c) for e, c in acting if e.hook == "force" and e.of not in OVER_TIME]
        self.forces = [(e, c) for e, c in asked if isinstance(e, Force) and e.of not in FIELDS]
        self.frictions = [
            (e, c) for e, c in asked if isinstance(e, Friction) and e.of not in FIELDS
        ]
        self.rubs: Mask = np.zeros((len(stiffness), len(addresses.velocities)), dtype=bool)
        for effect, c in self.frictions:
            self.rubs[:, effect.coordinate] |= (c != 0).any(axis=0)[:, 0]
        self.hidden = [(e, c) for e, c in acting if isinstance(e, Hidden) and not is_series(e)]
        self.loaded: Mask = np.zeros(len(stiffness), dtype=bool)
        for loading, c in asked:
            if loading.of in LOADED:
                self.loaded |= (c != 0).any(axis=0)[:, 0]
        self.working: Array | None = None
        self._states: list[State] = []

    def at(self, k: int, look: Look) -> tuple[Array, Array]:
        """Forces and limits of dry friction (L, D) each, over step k: those of its middle.

        Args:
            k: every step in turn.
            look: the lanes at its beginning.
        """
        x, v = middle(look.x, look.v, look.a, self.step)
        moment = self._moment(k + 0.5, k, (x, v, *look.later))
        force = pushed(self.forces, moment)
        if self.hidden:
            begun = self.begun(k, look)
            self._states = self._states or [e.begin(c, begun) for e, c in self.hidden]
            # From the middle of the last step to that of this one.
            step = self.step if k else 0.5 * self.step
            more, self._states = remembered(self.hidden, (begun, moment), self._states, step)
            force += more
        return force, rubbed(self.frictions, moment)

    def begun(self, k: int, look: Look) -> RobotMoment:
        """The instant at which step k begins."""
        return self._moment(k, k, (look.x, look.v, *look.carried))

    def _moment(self, steps: float, k: int, motion: Sequence[Array]) -> RobotMoment:
        """The instant after so many steps, with what is felt in step k."""
        x, v, *sides = motion
        now = np.full((len(x), 1), steps * self.step)
        inputs = {name: u[:, k, None] for name, u in self.felt.items()}
        stiffness = self.stiffness
        if self.working is not None:
            stiffness = stiffness * self.working[:, k]
        return moment_of(self.system, now, x, v, inputs, np.stack(sides), stiffness)


def is_in_drive(effect: Effect) -> bool:
    """Whether its force is the drive's own, and a sensor of what drives exert shows it."""
    return isinstance(effect, Force) and (effect.at == "actuator" or effect.of in COMMON)


def exerted(acting: Acting, moment: RobotMoment) -> Array:
    """(L, D) what effects in drives add to what these exert."""
    return pushed([(e, c) for e, c in acting if isinstance(e, Force) and is_in_drive(e)], moment)


def pushed(forces: Sequence[tuple[Force, Array]], moment: RobotMoment) -> Array:
    """(L, D) what effects exert."""
    total = np.zeros_like(moment.x)
    for effect, c in forces:
        total = total + effect.force(c, moment)
    return total


def rubbed(frictions: Sequence[tuple[Friction, Array]], moment: RobotMoment) -> Array:
    """(L, D) limits of dry friction."""
    limit = np.zeros_like(moment.x)
    for effect, c in frictions:
        joint = effect.coordinate
        assert joint is not None
        limit[:, joint] = limit[:, joint] + effect.limit(c, moment)[:, 0]
    return limit


def remembered(
    hidden: Sequence[tuple[Hidden, Array]],
    moments: tuple[RobotMoment, RobotMoment],
    states: Sequence[State],
    step: float,
) -> tuple[Array, list[State]]:
    """(L, D) forces of effects with states, and these so many seconds later.

    Args:
        hidden: the effects with their coefficients.
        moments: the one in the middle of those seconds, and the one at their end.
        states: as they begin.
        step: the seconds.
    """
    between, end = moments
    total = np.zeros_like(end.x)
    later = []
    for (effect, c), state in zip(hidden, states, strict=True):
        after = advanced(effect, c, between, state, step)
        force, _ = effect.act(c, end, after)
        total = total + np.where(c[0] > 0, force, 0.0)
        later.append(after)
    return total, later
