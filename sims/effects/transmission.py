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
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Hidden, Moment, State

CONTACT = 150.0
"""rad/s with which two masses would swing on each other through closed flanks without damping: far
above what a log shows, and slow enough to be stepped."""
SOFT = 0.01
"""Share of the gap by which a flank is pressed in where half of its damping acts."""
_MOST = 0.98
"""Share of the inertia behind a transmission at most."""
_ELASTIC = "M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860"
_PLAY = "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"
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


class Flexibility(Hidden):
    """A spring with a damper between the drive and what it carries."""

    name = "joint.flexibility"
    noun = "a flexible transmission"
    says = "what the drive carries hangs on it by a spring, and swings"
    source = _ELASTIC
    coefficients = (
        Coefficient("share", _PURE, _ANY_SHARE, most=_MOST),
        Coefficient("frequency", ("rad/s", "rad/s", "rad/s"), _SWING),
        Coefficient("damping", _PURE, _RATIO, tried=(0.03, 0.3)),
    )

    def behind(self, c: Array) -> Array:
        """As said."""
        return np.clip(c[0], 0.0, _MOST)

    def begin(self, c: Array, moment: Moment) -> State:
        """Hanging still on the spring, as far away as its weight draws it."""
        sag = _fall(moment, moment.primary) / (c[1] * c[1])
        return State(moment.primary + sag, moment.v[:, :1])

    def act(self, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """The spring's, to either side."""
        pull = c[1] * c[1] * (moment.primary - state.x)
        damp = 2.0 * c[2] * c[1] * (moment.v[:, :1] - state.v)
        return _two_masses(moment, state, pull + damp, self.behind(c))  # (3)


class Play(Hidden):
    """A gap between the drive and what it carries: between its flanks nothing is passed on."""

    name = "joint.backlash"
    noun = "play in the transmission"
    says = "there is a gap between the drive and what it carries, which knocks from flank to flank"
    source = _PLAY
    fastest = CONTACT
    coefficients = (
        Coefficient("gap", ("m", "m", "rad"), _GAP, of="travel"),
        Coefficient("share", _PURE, _SOME_SHARE, tried=(0.2, 0.5, 0.8)),
    )

    def behind(self, c: Array) -> Array:
        """As said."""
        return np.clip(c[1], 0.0, _MOST)

    def begin(self, c: Array, moment: Moment) -> State:  # noqa: ARG002
        """In the middle of the gap."""
        return State(moment.primary, moment.v[:, :1])

    def act(self, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """The flanks'."""
        apart = moment.primary - state.x
        beyond = apart - np.clip(apart, -0.5 * c[0], 0.5 * c[0])
        # Damped as far as a flank is pressed in, so that the force does not jump where it is met.
        pressed = np.abs(beyond) / (np.abs(beyond) + SOFT * c[0])
        rate = pressed * (moment.v[:, :1] - state.v)
        share = self.behind(c)
        pull = (1.0 - share) * CONTACT * (CONTACT * beyond + 4.0 * rate)  # (4)
        pull = np.where(beyond > 0, np.maximum(pull, 0.0), np.minimum(pull, 0.0))
        return _two_masses(moment, state, pull, share)


def _fall(moment: Moment, y: Array) -> Array:
    """(L, 1) what gravity alone accelerates it by at position y (L, 1)."""
    there = replace(moment, x=moment.along_primary(y))
    weight = moment.system.weight(there)[:, moment.system.primary, None]
    fall: Array = weight / moment.inertia
    return fall


def _two_masses(moment: Moment, state: State, pull: Array, share: Array) -> tuple[Array, Array]:
    """What the drive's side feels (L, D) and the acceleration (L, 1) of the other one, where the
    force in between is `pull` (L, 1) for each unit of inertia behind.
    """
    # What is behind takes its share of the weight along.
    near = -share * moment.inertia * (pull + _fall(moment, moment.primary))  # (1)
    return moment.along_primary(near), pull + _fall(moment, state.x)  # (2)
