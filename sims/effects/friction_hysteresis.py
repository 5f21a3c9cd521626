"""Friction hysteresis (Dahl model): surfaces deform before they slide.

With v the velocity, F the limit and d the deflection, the friction is -F w, where w, a hidden
state, approaches the sign of the motion over a distance of about the deflection:

    w' = r - |r| w,  r = v / d, no faster than `MAX_STATE_RATE`                   (1)

At a steady speed this is w = 1 - exp(-x / d) after a distance x from rest, and Coulomb friction if
the deflection is almost zero.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

MAX_STATE_RATE = 400.0
"""Maximum rate in 1/s at which friction follows a change of the motion.

It is far above the rates visible in a log, and low enough to be integrated.
"""
_MIN_DEFLECTION = 1e-9
"""Smallest deflection in m or rad, which replaces zero to avoid division by zero."""
_DEFLECTION_RANGES = ((2e-4, 0.05), (2e-4, 0.05), (1e-3, 0.3))
"""Plausible deflections in m or rad before surfaces slide."""
_DAHL_COEFFICIENTS = (
    Coefficient("coulomb", ("m/s^2", "N", "N*m"), ((0, 5), (0, 5), (0, 0.5))),
    Coefficient("deflection", ("m", "m", "rad"), _DEFLECTION_RANGES),
)


class FrictionHysteresis(HiddenStateEffect):
    """Dry friction that builds up over a short distance after each reversal (Dahl model)."""

    name = "friction.hysteresis"
    noun = "friction with hysteresis"
    says = "friction builds up over a small distance after each reversal, like a spring"
    source = "P. R. Dahl, AIAA Journal 14(12), 1675 (1976), doi:10.2514/3.61511"
    needs, contains = "joint", ("friction.coulomb",)
    coefficients = _DAHL_COEFFICIENTS

    def act(self, c: Array, moment: StateSnapshot, state: HiddenState) -> tuple[Array, Array]:
        """Return the force (L, D), and the rate (L, 1) of the hidden state.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
            state: hidden state w, as the velocity of the hidden coordinate.
        """
        ratio = moment.v[:, :1] / np.maximum(c[1], _MIN_DEFLECTION)
        rate = np.clip(ratio, -MAX_STATE_RATE, MAX_STATE_RATE)
        return moment.along_primary(-c[0] * state.v), rate - np.abs(rate) * state.v  # (1)
