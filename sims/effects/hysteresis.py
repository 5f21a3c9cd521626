"""Friction that remembers where it began: surfaces that yield before they slide.

With v the velocity, F the limit and d the deflection, the friction is -F w, where w, which no
sensor shows, goes towards the sign of the motion over about the deflection:

    w' = r - |r| w,  r = v / d, no faster than `FASTEST`                   (1)

which at a steady speed is w = 1 - exp(-x / d) after a way of x from rest, and Coulomb friction
where the deflection is next to nothing.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Hidden, Moment, State

FASTEST = 400.0
"""1/s with which friction follows a change of the motion: far above what a log shows, and slow
enough to be stepped."""
_SMALLEST = 1e-9
"""m or rad; the deflection that stands for none, by which nothing can be divided."""
_WAY = ((2e-4, 0.05), (2e-4, 0.05), (1e-3, 0.3))
"""Plausible deflections before surfaces slide, m or rad."""
_DAHL = (
    Coefficient("coulomb", ("m/s^2", "N", "N*m"), ((0, 5), (0, 5), (0, 0.5))),
    Coefficient("deflection", ("m", "m", "rad"), _WAY),
)


class Hysteresis(Hidden):
    """Dry friction that builds up over a small way after each reversal (Dahl)."""

    name = "friction.hysteresis"
    noun = "friction with hysteresis"
    says = "friction builds up over a small way after each reversal, and gives that way back"
    source = "P. R. Dahl, AIAA Journal 14(12), 1675 (1976), doi:10.2514/3.61511"
    needs, contains = "joint", ("friction.coulomb",)
    coefficients = _DAHL

    def act(self, c: Array, moment: Moment, state: State) -> tuple[Array, Array]:
        """Against the way that it has come."""
        ratio = moment.v[:, :1] / np.maximum(c[1], _SMALLEST)
        rate = np.clip(ratio, -FASTEST, FASTEST)
        return moment.along_primary(-c[0] * state.v), rate - np.abs(rate) * state.v  # (1)
