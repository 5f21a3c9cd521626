"""Drag and lift: forces of a fluid on a moving body, and drag of a bearing.

With v the velocity and w that of the air:

* (1) linear: F = -c v
* (2) quadratic: F = -c |v| v
* (3) wind: F = -c |v - w| (v - w)

The drag of a sphere of mass m is ``c = rho Cd A / (2 m)`` per unit mass. Wind includes quadratic
drag and replaces it. With drag proportional to speed, the wind would need only one coefficient, but
would be equivalent to a tilt.

(1) F = s x v with s = c (0, -1, 0) + vertical (0, 0, 1), x the vector product.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_BATCHELOR_1967 = (
    "G. K. Batchelor, An Introduction to Fluid Dynamics (1967), doi:10.1017/CBO9780511800955"
)
_QUADRATIC_DRAG_UNITS = ("1/m", "N*s^2/m^2", "N*m*s^2/rad^2")
"""Units of the coefficient of drag that is quadratic in speed."""


class LinearDrag(Force):
    """Viscous drag: -c v."""

    name = "drag.linear"
    noun = "linear drag"
    says = "motion is resisted in proportion to speed"
    source = "J. R. Taylor, Classical Mechanics (2005), section 2.2"
    coefficients = (
        Coefficient("coefficient", ("1/s", "N*s/m", "N*m*s/rad"), ((0, 0.5), (0, 5), (0, 0.1))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), opposite to the velocity.

        Args:
            c: (1, L, 1) coefficient.
            moment: state snapshot of L batch elements.
        """
        return -c[0] * moment.v  # (1)


class QuadraticDrag(Force):
    """Drag of a fluid at high Reynolds number: -c |v| v."""

    name = "drag.quadratic"
    noun = "quadratic drag"
    says = "motion is resisted in proportion to the square of speed"
    source = "J. R. Taylor, Classical Mechanics (2005), section 2.4"
    coefficients = (
        Coefficient("coefficient", _QUADRATIC_DRAG_UNITS, ((0, 0.3), (0, 5), (0, 0.02))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), opposite to the velocity.

        Args:
            c: (1, L, 1) coefficient.
            moment: state snapshot of L batch elements.
        """
        return -c[0] * moment.speed * moment.v  # (2)


class Wind(Force):
    """Quadratic drag in air that moves horizontally with velocity w: -c |v - w| (v - w)."""

    name = "wind"
    noun = "wind"
    says = "moving air exerts drag on the body"
    needs, contains, source = "push", ("drag.quadratic",), _BATCHELOR_1967
    coefficients = (
        Coefficient("drag", ("1/m", "N*s^2/m^2", None), ((0, 0.3), (0, 5), (0, 0))),
        Coefficient("x", ("m/s", "m/s", None), ((-10, 10), (-10, 10), (0, 0))),
        Coefficient("y", ("m/s", None, None), ((-10, 10), (0, 0), (0, 0))),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), opposite to the velocity relative to the air.

        F = -c |v - w| (v - w) (3), with the velocity v and that of the air w.

        Args:
            c: (3, L, 1) coefficients: drag, and wind speed along x and along y, m/s.
            moment: state snapshot of L batch elements with D coordinates.
        """
        return -c[0] * _compute_signed_square(moment.v - _compute_air_velocity(c, moment))  # (3)


def _compute_signed_square(v: Array) -> Array:
    """Return |v| v, (L, D)."""
    return np.sqrt((v * v).sum(axis=1, keepdims=True)) * v


def _compute_air_velocity(c: Array, moment: StateSnapshot) -> Array:
    """Return the velocity (L, D) of the air along the system's coordinates.

    Shapes: L batch elements, D coordinates.

    Args:
        c: (3, L, 1) coefficients of the effect: drag, wind along x, and wind along y.
        moment: state of the batch.
    """
    # `push` is the generalised force that accelerates the system by 1 m/s^2 along an axis. Divided
    # by the mass, it is this axis in the system's coordinates.
    mass = moment.system.mass(moment.theta, moment.constants)
    return (c[1] * moment.push("x") + c[2] * moment.push("y")) / mass


_SPINNING = "G. Robinson, I. Robinson, Physica Scripta 88, 018101 (2013), "
_SPINNING += "doi:10.1088/0031-8949/88/01/018101"
_LIFT_UNITS = ("1/s", None, None)
"""Units of the lift coefficient; it exists only for bodies in free flight."""
_LIFT_RANGES = ((-1, 1), (0, 0), (0, 0))
"""Plausible lift in 1/s; spin has two directions."""


class MagnusLift(Force):
    """Lift of a spinning ball: c times spin axis x velocity, about -y (backspin lifts) and z."""

    name = "lift.magnus"
    noun = "Magnus lift"
    says = "spin causes a force perpendicular to the direction of flight"
    needs, source = "space", _SPINNING
    coefficients = (
        Coefficient("coefficient", _LIFT_UNITS, _LIFT_RANGES),
        Coefficient("vertical", _LIFT_UNITS, _LIFT_RANGES),
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, 3) of a spinning body: vector product of spin axis and velocity.

        It is perpendicular to the velocity, so that it does no work. With the coefficients b
        (backspin) and u (upright), F = (-b vz - u vy, u vx, b vx) (1).

        Args:
            c: (2, L, 1) coefficients: lift by backspin (about -y), and by spin about the vertical
                z.
            moment: state snapshot of L batch elements.
        """
        (backspin, upright), (vx, vy, vz) = c[:, :, 0], moment.v.T
        return np.stack([-backspin * vz - upright * vy, upright * vx, backspin * vx], axis=1)  # (1)
