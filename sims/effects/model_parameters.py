"""Errors of numbers that a robot's model file specifies.

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
"""

from __future__ import annotations

from sims.core.effect import Coefficient, ModelValueEffect

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


class MassScale(ModelValueEffect):
    """Mass and, with it, inertia of a body times 1 + c."""

    name = "mass.scale"
    noun = "a wrong mass"
    says = "the body is heavier or lighter than the model file states"
    source = _IDENTIFICATION + ", chapter 12"
    at = "body"
    coefficients = (
        Coefficient(
            "coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=_MIN_RELATIVE_ERROR
        ),
    )


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
    coefficients = (
        Coefficient(
            "coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=_MIN_RELATIVE_ERROR
        ),
    )


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
    coefficients = (
        Coefficient(
            "coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=_MIN_RELATIVE_ERROR
        ),
    )


class ActuatorDampingScale(ModelValueEffect):
    """Velocity gain of the servo times 1 + c."""

    name = "actuator.damping"
    noun = "a wrong servo damping"
    says = "the servo's damping gain differs from the model file"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008), chapter 10"
    at = "actuator"
    coefficients = (
        Coefficient(
            "coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=_MIN_RELATIVE_ERROR
        ),
    )


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
