"""Six kinds of ball. Masses, sizes and bounces are those that their sports' rules ask for, or that
were measured.

The rules give a height that the ball is dropped from on a hard floor and the heights that it may
come back to; the restitution is the square root of their ratio, at the impact speed of that drop.
Balls of a kind differ within those limits. Chosen here, not taken from tables: the power of the
impact speed with which restitution falls (a yielding ball's is -1/4, a viscoelastic one's weaker:
K. L. Johnson, Contact Mechanics, 1985, chapter 11), the moments of inertia (a solid sphere's, a
thin shell's, or between for a thick one) and the drag coefficients (0.5 for a sphere below the drag
crisis: G. K. Batchelor, An Introduction to Fluid Dynamics, 1967; 0.6 for a fuzzy one).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from sims.base import unknown


@dataclass(frozen=True)
class Ball:
    """One ball.

    Attributes:
        name: its kind.
        mass: kg.
        radius: m.
        restitution: at an impact of `speed`, on a hard surface.
        spread: balls of the kind lie within this of it.
        speed: m/s.
        exponent: restitution goes with this power of the impact speed.
        inertia_ratio: moment of inertia over mass x radius^2.
        drag: drag coefficient, of the cross-section.
        source: where mass, radius and restitution stand.
    """

    name: str
    mass: float
    radius: float
    restitution: float
    spread: float
    speed: float
    exponent: float
    inertia_ratio: float
    drag: float
    source: str

    def restitution_at(self, speed: float) -> float:
        """At an impact speed in m/s; at most 1."""
        return min(1.0, self.restitution * float((max(speed, 1e-3) / self.speed) ** self.exponent))

    def one(self, rng: np.random.Generator) -> Ball:
        """A ball of this kind, as its restitution goes."""
        return replace(
            self, restitution=self.restitution + self.spread * float(rng.uniform(-1.0, 1.0))
        )


_BALLS = (
    Ball(
        "table-tennis",
        0.0027,
        0.0200,
        0.905,
        0.018,
        2.44,
        -0.06,
        0.66,
        0.50,
        "ITTF Laws 2.3 (2.7 g, 40 mm) and Technical Leaflet T3 (dropped 305 mm, back to 240-260 mm)",
    ),
    Ball(
        "tennis",
        0.0577,
        0.0335,
        0.745,
        0.016,
        7.06,
        -0.10,
        0.55,
        0.60,
        "ITF Rules of Tennis, appendix I (56.0-59.4 g, 65.4-68.6 mm, dropped 254 cm, back to 135-147 cm)",
    ),
    Ball(
        "golf",
        0.0459,
        0.02135,
        0.858,
        0.015,
        4.25,
        -0.05,
        0.40,
        0.50,
        "R&A and USGA, Equipment Rules (at most 45.93 g, at least 42.67 mm); restitution of a range ball dropped "
        "92 cm: The Physics Factbook, Coefficients of Restitution",
    ),
    Ball(
        "basketball",
        0.610,
        0.1210,
        0.767,
        0.018,
        5.94,
        -0.05,
        0.62,
        0.50,
        "FIBA Basketball Equipment, size 7 (750-770 mm round, 567-650 g, dropped 1800 mm, back to 960-1160 mm)",
    ),
    Ball(
        "rubber",
        0.0460,
        0.0225,
        0.890,
        0.015,
        4.50,
        -0.04,
        0.40,
        0.50,
        "a ball of 45 mm that loses a fifth of its energy, as superballs in R. Cross, Am. J. Phys. 67, 222 (1999), "
        "doi:10.1119/1.19229; mass of a solid sphere of polybutadiene, 0.96 g/cm^3",
    ),
    Ball(
        "squash",
        0.0240,
        0.0200,
        0.543,
        0.031,
        7.06,
        -0.12,
        0.60,
        0.50,
        "World Squash, Rules, appendix 7: yellow dot (24 g, 40 mm, dropped 254 cm at 45 C, back to 26-33 % of it)",
    ),
)
BALLS = MappingProxyType({ball.name: ball for ball in _BALLS})


def ball_named(name: str) -> Ball:
    """The kind of ball of this name.

    Raises:
        InputError: there is none.
    """
    if name not in BALLS:
        raise unknown("ball", name, list(BALLS))
    return BALLS[name]
