"""Errors of numbers that a robot's model file specifies, its geometry included.

The coefficients are relative errors c or differences, so that zero is the number in the file:

* (1) mass: m (1 + c), and the inertia tensor with it; the centre of mass does not change
* (2) centre of mass: moved by (x, y, z) in the body's frame; mass and inertia about it are constant
* (3) inertia: the tensor alone times (1 + c)
* (4) armature: the inertia of the rotor at the joint plus c
* (5) stiffness: the servo's kp (1 + c)
* (6) damping: the servo's kv (1 + c)
* (7) limit: the actuator's force limited to c in both directions; zero is the limit of the file

The range of c keeps masses positive and inertia tensors physical: a tensor times a positive number
keeps the triangle inequality of its moments.

The coefficients are differences or relative errors, so that zero is the number in the file:

* (1) joint zero: the joint is in its reference pose where its encoder shows c more than the file
  says (MJCF ``ref``); command and reading refer to the same zero
* (2) joint axis: the axis a of the file turned by the rotation vector r = (x, y, z) in the frame of
  the body, exp([r]) a; a turn by pi reverses it
* (3) link length: the distance of a body's frame from the frame of its parent times (1 + c), in the
  same direction
* (4) radius: that of a round geom (sphere, capsule, cylinder; all half axes of an ellipsoid) times
  (1 + c); a wheel that rolls without slip moves by its radius times its angle
* (5) payload: a point mass m on the body, at (x, y, z) from the body's stated centre of mass, along
  the axes of the body's frame
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.effect import Coefficient, ModelValueEffect
from sims.core.simulator import Array

_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_RELATIVE_ERROR_RANGES = ((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible relative errors: up to 50 % more or less."""
_LENGTH_UNITS = ("m", "m", "m")
_OFFSET_RANGES = ((-0.1, 0.1), (-0.1, 0.1), (-0.1, 0.1))
"""Plausible offsets of a centre of mass in metres."""
_IDENTIFICATION = "W. Khalil, E. Dombre, Modeling, Identification and Control of Robots (2002)"
_MIN_RELATIVE_ERROR = -0.99
"""Smallest relative error of a number that must stay positive."""
_RELATIVE_ERROR = Coefficient(
    "coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=_MIN_RELATIVE_ERROR
)
"""Coefficient of an effect that scales a positive number."""


class MassScale(ModelValueEffect):
    """Mass and, with it, inertia of a body times 1 + c."""

    name = "mass.scale"
    noun = "a wrong mass"
    says = "the body is heavier or lighter than the model file states"
    source = _IDENTIFICATION + ", chapter 12"
    at = "body"
    coefficients = (_RELATIVE_ERROR,)


class CentreOfMassOffset(ModelValueEffect):
    """Centre of mass of a body moved by x, y and z in its own frame."""

    name = "mass.offset"
    noun = "a misplaced centre of mass"
    says = "the body's centre of mass differs from the model file"
    source = _IDENTIFICATION + ", chapter 12"
    at = "body"
    coefficients = tuple(Coefficient(axis, _LENGTH_UNITS, _OFFSET_RANGES) for axis in "xyz")


class InertiaScale(ModelValueEffect):
    """Inertia tensor of a body times 1 + c."""

    name = "inertia.scale"
    noun = "a wrong inertia"
    says = "the body's moment of inertia differs from the model file"
    source = _IDENTIFICATION + ", chapter 12"
    at = "body"
    coefficients = (_RELATIVE_ERROR,)


class ArmatureOffset(ModelValueEffect):
    """Inertia of the rotor at the joint, plus c."""

    name = "inertia.armature"
    noun = "a wrong armature"
    says = "the rotor inertia, reflected to the joint, differs from the model file"
    source = _IDENTIFICATION + ", section 9.4"
    at = "joint"
    coefficients = (
        Coefficient("coefficient", (None, "kg", "kg*m^2"), ((0, 0), (0, 5), (0, 0.05))),
    )


class ActuatorStiffnessScale(ModelValueEffect):
    """Proportional gain of the servo times 1 + c."""

    name = "actuator.stiffness"
    noun = "a wrong servo stiffness"
    says = "the servo's proportional gain differs from the model file"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008), chapter 10"
    at = "actuator"
    coefficients = (_RELATIVE_ERROR,)


class ActuatorDampingScale(ModelValueEffect):
    """Velocity gain of the servo times 1 + c."""

    name = "actuator.damping"
    noun = "a wrong servo damping"
    says = "the servo's damping gain differs from the model file"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008), chapter 10"
    at = "actuator"
    coefficients = (_RELATIVE_ERROR,)


class ActuatorForceLimit(ModelValueEffect):
    """Force of the actuator limited to c in both directions; zero is the limit of the file."""

    name = "actuator.limit"
    noun = "a force limit of the actuator"
    says = "the force of the actuator is limited"
    source = "H. K. Khalil, Nonlinear Systems (2002), section 1.2"
    at = "actuator"
    coefficients = (
        Coefficient("coefficient", ("N", "N", "N*m"), ((0, 50), (0, 50), (0, 5)), of="drive"),
    )


_CALIBRATION = (
    "J. M. Hollerbach, W. Khalil, M. Gautier, Model Identification, in Springer Handbook of "
    "Robotics (2016), chapter 6"
)
_TILT_RANGES = ((0.0, 0.0), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible tilts of an axis in rad."""
_ANGLE_UNITS = (None, "rad", "rad")
_PAYLOAD_OFFSET_RANGES = ((-0.1, 0.1), (-0.1, 0.1), (-0.1, 0.1))
"""Plausible distances of a payload from the centre of mass of its body, in metres."""
_SMALL_MASS = 1e-4
"""Mass whose change of the motion is linear in it, as a share of the largest plausible one."""
_LENGTH_ERROR_RANGES = ((-0.3, 0.3), (-0.3, 0.3), (-0.3, 0.3))
"""Plausible relative errors of lengths and radii."""
_MASS_RANGES = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
"""Plausible mass of a payload in kg."""


class JointZeroOffset(ModelValueEffect):
    """Zero of a joint moved by c, for its command and its encoder alike."""

    name = "joint.zero"
    noun = "a wrong joint zero"
    says = "the zero position of the joint, for command and encoder, differs from the model file"
    source = _CALIBRATION
    at = "joint"
    coefficients = (
        Coefficient("coefficient", (None, "m", "rad"), ((0, 0), (-0.05, 0.05), (-0.2, 0.2))),
    )


class JointAxisTilt(ModelValueEffect):
    """Axis of a joint turned by a rotation vector in the frame of its body."""

    name = "joint.axis"
    noun = "a wrong joint axis"
    says = "the joint axis has a different direction than in the model file"
    source = _CALIBRATION
    at = "joint"
    coefficients = tuple(
        Coefficient(axis, _ANGLE_UNITS, _TILT_RANGES, least=-np.pi, most=np.pi) for axis in "xyz"
    )


class LinkLengthScale(ModelValueEffect):
    """Distance of a body from its parent times 1 + c."""

    name = "link.length"
    noun = "a wrong link length"
    says = "the distance of the body from its parent differs from the model file"
    source = _CALIBRATION
    at = "body"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _LENGTH_ERROR_RANGES, least=-0.99),)


class GeomRadiusScale(ModelValueEffect):
    """Radius of a round geom, such as a wheel or a foot, times 1 + c."""

    name = "geom.radius"
    noun = "a wrong radius"
    says = "the radius of the wheel or foot differs from the model file"
    source = "R. Siegwart, I. R. Nourbakhsh, D. Scaramuzza, Autonomous Mobile Robots (2011), ch. 3"
    at = "geom"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, _LENGTH_ERROR_RANGES, least=-0.9),)


class PayloadMass(ModelValueEffect):
    """Point mass on a body, which is no body of the model file."""

    name = "payload"
    noun = "a payload"
    says = "the body carries an additional mass that is not in the model file"
    source = "W. Khalil, E. Dombre, Modeling, Identification and Control of Robots (2002), ch. 12"
    at = "body"
    coefficients = (
        Coefficient("mass", ("kg", "kg", "kg"), _MASS_RANGES, least=0.0),
        *(Coefficient(axis, _LENGTH_UNITS, _PAYLOAD_OFFSET_RANGES) for axis in "xyz"),
    )

    def probe_points(self) -> Sequence[Array]:
        """Return coefficients at which a search compares the effect with the data, (4,) each.

        The coefficients are the mass (kg), then the position along x, y and z (m) from the body's
        centre of mass. The first point is a small mass in the middle of the plausible range; each
        of the others moves it along one observable axis, to three quarters of the range. Along an
        axis whose bounds `least` and `most` are equal, the position cannot be observed and is zero.
        """
        # The ranges are equal for all kinds of system: (4, 2), lower and upper end.
        ranges = np.array([c.plausible[0] for c in self.coefficients])
        is_observable = np.array([c.least != c.most for c in self.coefficients])
        middle = np.where(is_observable, ranges.mean(axis=1), 0.0)
        middle[0] = _SMALL_MASS * ranges[0, 1]
        points = [middle]
        for axis in np.flatnonzero(is_observable[1:]) + 1:
            point = middle.copy()
            point[axis] = 0.5 * (ranges[axis].mean() + ranges[axis, 1])
            points.append(point)
        return points

    def combine(self, points: Array, weights: Array) -> Array:
        """Return the point mass (4,) that replaces several: their sum, at their centre of mass.

        A sum that is not positive gives a mass of zero at the origin.

        Args:
            points: (n, 4) masses (kg) and positions x, y and z (m).
            weights: (n,) multiple of each mass.
        """
        masses = weights * points[:, 0]
        total = float(masses.sum())
        centre = masses @ points[:, 1:] / total if total > 0.0 else np.zeros(3)
        result: Array = np.array([max(total, 0.0), *centre])
        return result
