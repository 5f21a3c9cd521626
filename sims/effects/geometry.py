"""Errors of a robot's geometry, as numbers of its model file, and payloads that the file lacks.

The coefficients are differences or relative errors, so that zero is the number in the file:

* (1) joint zero: the joint is in its reference pose where its encoder shows c more than the file
  says (MJCF ``ref``); command and reading refer to the same zero
* (2) joint axis: the axis a of the file turned by the rotation vector r = (x, y, z) in the frame of
  the body, exp([r]) a; a turn by pi reverses it
* (3) link length: the distance of a body's frame from the frame of its parent times (1 + c), in the
  same direction
* (4) payload: a point mass m on the body, at (x, y, z) from the body's stated centre of mass, along
  the axes of the body's frame
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, ModelValueEffect

_CALIBRATION = (
    "J. M. Hollerbach, W. Khalil, M. Gautier, Model Identification, in Springer Handbook of "
    "Robotics (2016), chapter 6"
)
_ANGLES = ((0.0, 0.0), (-0.2, 0.2), (-0.2, 0.2))
"""Plausible tilts of an axis in rad."""
_RADIANS = (None, "rad", "rad")
_LENGTH = ("m", "m", "m")
_OFFSET = ((-0.1, 0.1), (-0.1, 0.1), (-0.1, 0.1))
"""Plausible distances of a payload from the centre of mass of its body, in metres."""
_MASS = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
"""Plausible mass of a payload in kg."""


class JointZeroOffset(ModelValueEffect):
    """Zero of a joint moved by c, for its command and its encoder alike."""

    name = "joint.zero"
    noun = "a wrong joint zero"
    says = "the joint's zero, of its command and its encoder alike, is not that of the model file"
    source = _CALIBRATION
    at = "joint"
    coefficients = (
        Coefficient("coefficient", (None, "m", "rad"), ((0, 0), (-0.05, 0.05), (-0.2, 0.2))),
    )


class JointAxisTilt(ModelValueEffect):
    """Axis of a joint turned by a rotation vector in the frame of its body."""

    name = "joint.axis"
    noun = "a wrong joint axis"
    says = "the axis of the joint points in another direction than the model file says"
    source = _CALIBRATION
    at = "joint"
    coefficients = tuple(
        Coefficient(axis, _RADIANS, _ANGLES, least=-np.pi, most=np.pi) for axis in "xyz"
    )


class LinkLengthScale(ModelValueEffect):
    """Distance of a body from its parent times 1 + c."""

    name = "link.length"
    noun = "a wrong link length"
    says = "the distance of the body from its parent is not that of the model file"
    source = _CALIBRATION
    at = "body"
    coefficients = (
        Coefficient(
            "coefficient", ("1", "1", "1"), ((-0.3, 0.3), (-0.3, 0.3), (-0.3, 0.3)), least=-0.99
        ),
    )


class PayloadMass(ModelValueEffect):
    """Point mass on a body, which is no body of the model file."""

    name = "payload"
    noun = "a payload"
    says = "the body carries a mass that is not in the model file"
    source = "W. Khalil, E. Dombre, Modeling, Identification and Control of Robots (2002), ch. 12"
    at = "body"
    coefficients = (
        Coefficient("mass", ("kg", "kg", "kg"), _MASS, least=0.0),
        *(Coefficient(axis, _LENGTH, _OFFSET) for axis in "xyz"),
    )
