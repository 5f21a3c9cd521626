"""Drag: what a fluid or a bearing does to motion, in air that may move.

With v the velocity and w that of the air:

* (1) linear: F = -c v
* (2) quadratic: F = -c |v| v
* (3) wind: F = -c |v - w| (v - w)

The drag of a sphere of mass m is ``c = rho Cd A / (2 m)`` per unit mass. Wind carries that drag
itself, so it stands in place of quadratic drag, not beside it: with drag in proportion to speed it
would be one number, but the same as a tilt.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.system import Coefficient, Force, Moment

_FLUIDS = "G. K. Batchelor, An Introduction to Fluid Dynamics (1967), doi:10.1017/CBO9780511800955"
_FLUID = ("1/m", "N*s^2/m^2", "N*m*s^2/rad^2")
"""Units of drag that grows with the square of speed."""


class Linear(Force):
    """Viscous drag: -c v."""

    name = "drag.linear"
    noun = "linear drag"
    says = "motion is resisted in proportion to speed"
    source = "J. R. Taylor, Classical Mechanics (2005), section 2.2"
    coefficients = (
        Coefficient("coefficient", ("1/s", "N*s/m", "N*m*s/rad"), ((0, 0.5), (0, 5), (0, 0.1))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Against the velocity."""
        return -c[0] * moment.v  # (1)


class Quadratic(Force):
    """Drag of a fluid at high Reynolds number: -c |v| v."""

    name = "drag.quadratic"
    noun = "quadratic drag"
    says = "motion is resisted in proportion to the square of speed"
    source = "J. R. Taylor, Classical Mechanics (2005), section 2.4"
    coefficients = (Coefficient("coefficient", _FLUID, ((0, 0.3), (0, 5), (0, 0.02))),)

    def force(self, c: Array, moment: Moment) -> Array:
        """Against the velocity."""
        return -c[0] * moment.speed * moment.v  # (2)


class Wind(Force):
    """Quadratic drag in air that moves horizontally with w: -c |v - w| (v - w)."""

    name = "wind"
    noun = "wind"
    says = "moving air drags along what is in it"
    needs, contains, source = "push", ("drag.quadratic",), _FLUIDS
    coefficients = (
        Coefficient("drag", ("1/m", "N*s^2/m^2", None), ((0, 0.3), (0, 5), (0, 0))),
        Coefficient("x", ("m/s", "m/s", None), ((-10, 10), (-10, 10), (0, 0))),
        Coefficient("y", ("m/s", None, None), ((-10, 10), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Against the velocity relative to the air."""
        return -c[0] * _squared(moment.v - _air(c, moment))  # (3)


def _squared(v: Array) -> Array:
    """|v| v, (L, D)."""
    return np.sqrt((v * v).sum(axis=1, keepdims=True)) * v


def _air(c: Array, moment: Moment) -> Array:
    """Velocity (L, D) of the air along the coordinates, which push and mass tell from x and y."""
    # a push is what 1 m/s^2 of everything does: force over mass turns it into the axis's direction
    mass = moment.system.mass(moment.theta, moment.constants)
    return (c[1] * moment.push("x") + c[2] * moment.push("y")) / mass
