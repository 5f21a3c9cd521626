"""What lies between a drive and what it carries: two masses, of which the sensor shows the first.

With x the coordinate that the sensor shows, y that of what is behind the transmission, M the
inertia of both, s the share behind, W the weight of both, U all else that acts, and T the force in
between,

    (1 - s) M x'' = U + (1 - s) W(x) - T                                   (1)
    s M y'' = T + s W(y)                                                   (2)

* (3) flexibility: T = s M (w^2 (x - y) + 2 z w (x' - y')), with w the frequency at which what is
  behind swings while the drive is held, and z its damping ratio
* (4) play: T = s (1 - s) M (k^2 d + 4 k (x' - y') |d| / (|d| + `SOFT` gap)), with d by how much
  the gap is exceeded and k `CONTACT`; flanks push and never pull, so that what meets them stays on
  them and does not bounce

The rest of the library acts on x, where the drive does.

* (5) coupling: a motor whose shaft runs past the joint before, as in a wrist, turns q + c p, with q
  its own joint and p the one before; so its torque t acts there, too, as c t, and its servo follows
  q + c p (by virtual work)

In a robot the model file states the inertia of the links, and as armature that of the drive. There
the element between them has numbers of its own, those of `between`: how far it yields to a force
(the inverse of its stiffness), or its gap. Where the file states no armature the drive's inertia is
one more number, as a share of the joint's.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Element, Hidden, Moment, State, Value

CONTACT = 150.0
"""rad/s with which two masses would swing on each other through closed flanks without damping: far
above what a log shows, and slow enough to be stepped."""
SOFT = 0.01
"""Share of the gap by which a flank is pressed in where half of its damping acts."""
_MOST = 0.98
"""Share of the inertia behind a transmission at most."""
_LEAST = 1e-12
"""rad/(N m) or m/N; a compliance that stands for none."""
_ELASTIC = "M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860"
_PLAY = "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"
_WRIST = (
    "P. I. Corke, B. Armstrong-Helouvry, Proc. IEEE ICRA, 1608 (1994),"
    " doi:10.1109/ROBOT.1994.351360: the wrist of the Puma 560"
)
_PURE = ("1", "1", "1")
"""A pure number, on every kind of system."""
_ANY_SHARE = ((0, 0.9), (0, 0.9), (0, 0.9))
"""Plausible shares of the inertia behind a spring."""
_SOME_SHARE = ((0.1, 0.9), (0.1, 0.9), (0.1, 0.9))
"""Plausible shares of the inertia behind a gap."""
_SWING = ((5, 400), (5, 400), (5, 400))
"""Plausible frequencies at which a load swings on its drive, rad/s."""
_RATIO = ((0.005, 1), (0.005, 1), (0.005, 1))
"""Plausible damping ratios."""
_GAP = ((0, 0.02), (0, 0.02), (0, 0.1))
"""Plausible gaps, m or rad."""
_SPRUNG = (
    Coefficient("share", _PURE, _ANY_SHARE, most=_MOST),
    Coefficient("frequency", ("rad/s", "rad/s", "rad/s"), _SWING),
    Coefficient("damping", _PURE, _RATIO, tried=(0.03, 0.3)),
)
_GAPPED = (
    Coefficient("gap", ("m", "m", "rad"), _GAP, of="travel"),
    Coefficient("share", _PURE, _SOME_SHARE, tried=(0.2, 0.5, 0.8)),
)
_GIVING = ("m/N", "m/N", "rad/(N*m)")
_GIVE = ((0, 1e-3), (0, 1e-3), (0, 0.1))
"""Plausible compliances, where nothing is known of what is carried."""
_DRIVE = ((0.01, 1), (0.01, 1), (0.01, 1))
"""Plausible inertias of a drive, as a share of the joint's."""
_ROTOR = Coefficient("rotor", _PURE, _DRIVE, of="rotor", tried=(0.03,))
_SPRING = (
    Coefficient("compliance", _GIVING, _GIVE, of="give"),
    Coefficient("damping", _PURE, _RATIO, tried=(0.05,)),
    _ROTOR,
)
_FLANKS = (Coefficient("gap", ("m", "m", "rad"), _GAP, of="travel"), _ROTOR)


class Carried(Hidden):
    """Something behind the drive that has a motion of its own.

    Attributes:
        share: which coefficient is the share of the inertia that it has.
    """

    share: ClassVar[int] = 0

    def behind(self, c: Array) -> Array:
        """As the coefficient says."""
        return np.clip(c[self.share], 0.0, _MOST)

    def element(self, c: Array) -> Element:
        """A spring with a damper where it is told how far that gives, else two flanks."""
        numbers = {one.name: values for one, values in zip(self.between, c, strict=True)}
        none = np.zeros_like(c[0])
        gives = numbers.get("compliance", none)
        # What gives nothing is off, and no spring beside one that is on.
        stiffness = np.where(gives > 0, 1.0 / np.maximum(gives, _LEAST), 0.0)
        gap = np.maximum(numbers.get("gap", none), 0.0)
        return Element(stiffness, numbers.get("damping", none), gap, numbers["rotor"])

    def begin(self, c: Array, moment: Moment) -> State:
        """Going along with the drive, as far away as the weight draws it."""
        away = self.hangs(c, _fall(moment, moment.primary))
        return State(moment.primary + away, moment.v[:, :1])

    def act(self, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """What the drive's side feels (L, D) and the acceleration (L, 1) of the other one."""
        pull, share = self.pull(c, moment, state), self.behind(c)
        # What is behind takes its share of the weight along.
        near = -share * moment.inertia * (pull + _fall(moment, moment.primary))  # (1)
        return moment.along_primary(near), pull + _fall(moment, state.x)  # (2)

    def hangs(self, c: Array, fall: Array) -> Array:
        """(L, 1) how far from the drive it rests where gravity would accelerate it by `fall`."""
        return 0.0 * c[0] * fall

    @abstractmethod
    def pull(self, c: Array, moment: Moment, state: State) -> Array:
        """(L, 1) force in between for each unit of inertia behind."""


class Flexibility(Carried):
    """A spring with a damper between the drive and what it carries."""

    name, noun = "joint.flexibility", "a flexible transmission"
    says = "what the drive carries hangs on it by a spring, and swings"
    source, coefficients, between = _ELASTIC, _SPRUNG, _SPRING

    def hangs(self, c: Array, fall: Array) -> Array:
        """As far as its spring gives."""
        return fall / (c[1] * c[1])

    def pull(self, c: Array, moment: Moment, state: State) -> Array:
        """The spring's and the damper's."""
        damped = 2.0 * c[2] * (moment.v[:, :1] - state.v)
        return c[1] * (c[1] * (moment.primary - state.x) + damped)  # (3)


class Coupling(Value):
    """The drive of a joint turns the joint before it as well, c times as much."""

    name, noun = "joint.coupling", "a coupled drive"
    says = "the joint's drive also acts on the joint before it, as where motors share an axis"
    source, at = _WRIST, "joint"
    coefficients = (Coefficient("coefficient", _PURE, ((-1, 1), (-1, 1), (-1, 1))),)  # (5)


class Play(Carried):
    """A gap between the drive and what it carries: between its flanks nothing is passed on."""

    name, noun = "joint.backlash", "play in the transmission"
    says = "there is a gap between the drive and what it carries, which knocks from flank to flank"
    source, coefficients, between = _PLAY, _GAPPED, _FLANKS
    share, fastest = 1, CONTACT

    def pull(self, c: Array, moment: Moment, state: State) -> Array:
        """The flanks'; damped as far as they are pressed in, so that no force jumps."""
        apart = moment.primary - state.x
        beyond = apart - np.clip(apart, -0.5 * c[0], 0.5 * c[0])
        pressed = np.abs(beyond) / (np.abs(beyond) + SOFT * c[0])
        push = CONTACT * beyond + 4.0 * pressed * (moment.v[:, :1] - state.v)
        pull = (1.0 - self.behind(c)) * CONTACT * push  # (4)
        return np.where(beyond > 0, np.maximum(pull, 0.0), np.minimum(pull, 0.0))


def _fall(moment: Moment, y: Array) -> Array:
    """(L, 1) what gravity alone accelerates it by at position y (L, 1)."""
    there = replace(moment, x=moment.along_primary(y))
    weight = moment.system.weight(there)[:, moment.system.primary, None]
    fall: Array = weight / moment.inertia
    return fall
