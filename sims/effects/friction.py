"""Dry friction: opposes motion, holds the body at rest within its limit, and may have hysteresis.

Each law gives its limit. The engine adds the limits and applies one force, so that sticking is
exact. With v the velocity, limits are

* (1) Coulomb: c
* (2) Stribeck: coulomb + extra exp(-(v / speed)^2)
* (3) load: c |drive - load|, each counted in the direction in which it pushes the joint
* (4) load, by direction: |motor drive - external load|
* (5) load, quadratic: c |drive - load| + quadratic through^2, where `through` is the smaller of
  drive and load if they pull against each other: the force transmitted by the gears
* (6) position: least + a + sine sin(2 pi x / period) + cosine cos(2 pi x / period), with a the
  amplitude (sine^2 + cosine^2)^(1/2), so that the minimum of friction is `least`
* (7) warming: (dry + viscous |v|) exp(-t / time), t since the start of the run

A negative limit counts as zero. One law is a force instead of a limit, since it vanishes at rest:

* (8) direction: -viscous+ v where v > 0, -viscous- v where v < 0

Dry friction that differs by direction needs no separate law: with limits d+ and d- it is, at rest
and in motion, Coulomb friction of (d+ + d-) / 2 and a constant force of -(d+ - d-) / 2.

With v the velocity, F the limit and d the deflection, the friction is -F w, where w, a hidden
state, approaches the sign of the motion over a distance of about the deflection:

    w' = r - |r| w,  r = v / d, no faster than `MAX_STATE_RATE`                   (1)

At a steady speed this is w = 1 - exp(-x / d) after a distance x from rest, and Coulomb friction if
the deflection is almost zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.core.effect import Coefficient, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

_SURVEY = (
    "B. Armstrong-Helouvry et al., Automatica 30(7), 1083 (1994), doi:10.1016/0005-1098(94)90209-7"
)
_SERVOS = "M. Duclusaud et al. (2024), arXiv:2410.08650, model "
_WARM = (
    "A. C. Bittencourt, S. Gunnarsson, J. Dyn. Sys. Meas. Control 134(5), 051013 (2012); time as in"
    " L. Simoni et al., Robotica 36 (2018), doi:10.1017/S0263574717000509"
)
_PLACE = (
    "M. R. Popovic, A. A. Goldenberg, IEEE Trans. Robot. Autom. 14(1), 114 (1998); B. Armstrong,"
    " Proc. IEEE ICRA, 1422 (1988)"
)
_MIN_DIVISOR = 1e-9
"""Smallest speed, period or time, which replaces zero to avoid 0 / 0."""
_FORCE_UNITS = ("m/s^2", "N", "N*m")
"""Units of a force on the three kinds of system."""
VISCOUS_UNITS = (None, "N*s/m", "N*m*s/rad")
"""Units of viscous friction on the kinds of system that can move in two directions."""
_VISCOUS_RANGES = ((0, 0), (0, 5), (0, 0.05))
"""Plausible viscous friction, in the units of `VISCOUS_UNITS`."""
_LOAD_COEFFICIENT = Coefficient("coefficient", (None, "1", "1"), ((0, 0), (0, 0.5), (0, 0.5)))
"""Coefficient of load-dependent friction, as a fraction of the load."""
_DRY_RANGES = ((0, 5), (0, 5), (0, 0.5))
"""Plausible friction limits, in the units of a force."""
_WAVE_RANGES = ((-5, 5), (-5, 5), (-0.5, 0.5))
"""Plausible amplitudes of friction that varies with position, in the units of a force."""
_PERIOD_RANGES = ((0.2, 5), (0.2, 5), (0.5, 6.2832))
"""Plausible periods in m or rad: from one period per turn to several."""
_WAVE_COEFFICIENTS = (
    Coefficient("sine", _FORCE_UNITS, _WAVE_RANGES),
    Coefficient("cosine", _FORCE_UNITS, _WAVE_RANGES),
    Coefficient("period", ("m", "m", "rad"), _PERIOD_RANGES),
)
"""Coefficients of a wave over position."""
_SQUARED_FORCE = ((None, "1/N", "1/(N*m)"), ((0, 0), (0, 0.1), (0, 1)))
"""Units and plausible values of the coefficient of a squared force."""
_WARMING_COEFFICIENTS = (
    Coefficient("dry", _FORCE_UNITS, _DRY_RANGES),
    Coefficient("viscous", VISCOUS_UNITS, _VISCOUS_RANGES),
    Coefficient("time", ("s", "s", "s"), ((0.5, 500), (0.5, 500), (0.5, 500))),
)
"""Coefficients of friction that decreases by warming."""


class CoulombFriction(Friction):
    """Friction that does not depend on speed: c sign(v)."""

    name = "friction.coulomb"
    noun = "Coulomb friction"
    says = "a constant friction opposes motion, and smaller forces do not start motion"
    source = _SURVEY
    needs = "guide"
    coefficients = (Coefficient("coefficient", _FORCE_UNITS, _DRY_RANGES),)

    def limit(self, c: Array, moment: StateSnapshot) -> Array:  # noqa: ARG002
        """Return the limit (L, 1), equal to the coefficient.

        Args:
            c: (1, L, 1) limit.
            moment: state snapshot of L batch elements.
        """
        return np.maximum(c[0], 0.0)  # (1)


class StribeckFriction(Friction):
    """Friction that decreases with speed: coulomb + extra exp(-(v / speed)^2)."""

    name = "friction.stribeck"
    noun = "Stribeck friction"
    says = "friction is greatest at rest and decreases with speed"
    needs, contains, source = "guide", ("friction.coulomb",), _SURVEY
    coefficients = (
        Coefficient("coulomb", _FORCE_UNITS, _DRY_RANGES),
        Coefficient("extra", _FORCE_UNITS, _DRY_RANGES),
        Coefficient("speed", ("m/s", "m/s", "rad/s"), ((0.005, 0.5), (0.005, 0.5), (0.02, 2))),
    )

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the limit (L, 1): `coulomb` in fast motion, `coulomb` + `extra` at rest.

        The limit is coulomb + extra exp(-(v / speed)^2) (2), or zero if that is negative.

        Args:
            c: (3, L, 1) coefficients: coulomb, extra and speed.
            moment: state snapshot of L batch elements.
        """
        return np.maximum(c[0] + c[1] * _compute_stribeck_factor(moment.speed, c[2]), 0.0)  # (2)


class LoadFriction(Friction):
    """Friction of a loaded transmission, proportional to |drive - load|."""

    name = "friction.load"
    noun = "load-dependent friction"
    says = "friction increases with the load of the drive"
    source = _SERVOS + "M3"
    needs = "input"
    coefficients = (_LOAD_COEFFICIENT,)

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the limit (L, 1), proportional to the load |drive - external load|.

        Args:
            c: (1, L, 1) limit as a share of the load.
            moment: state snapshot of L batch elements.
        """
        return np.maximum(c[0], 0.0) * moment.load  # (3)


class DirectionalLoadFriction(Friction):
    """Load-dependent friction with separate coefficients for motor and external load.

    The limit is |motor drive - external load|.
    """

    name = "friction.load_direction"
    noun = "load-dependent friction by direction"
    says = "friction differs between the motor driving the load and the load driving the motor"
    needs, contains, source = "input", ("friction.load",), _SERVOS + "M5"
    coefficients = (
        replace(_LOAD_COEFFICIENT, name="motor"),
        replace(_LOAD_COEFFICIENT, name="external"),
    )

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the limit (L, 1) from the loads by the motor and from outside.

        The limit is |motor drive - external load| (4), each force counted in the direction in which
        it pushes the joint.

        Args:
            c: (2, L, 1) coefficients: motor and external.
            moment: state snapshot of L batch elements; `sides` are the drive force and the passive
                force of the joint, each (L, 1).
        """
        drive, passive = moment.sides  # the passive force is minus the external load
        return np.abs(np.maximum(c[0], 0.0) * drive + np.maximum(c[1], 0.0) * passive)  # (4)


class QuadraticLoadFriction(Friction):
    """Load-dependent friction with a term quadratic in the force transmitted by the gears."""

    name = "friction.load_quadratic"
    noun = "friction that increases with load and its square"
    says = "friction increases with the drive's load and with the square of the load"
    needs, contains, source = "input", ("friction.load",), _SERVOS + "M6"
    coefficients = (_LOAD_COEFFICIENT, Coefficient("quadratic", *_SQUARED_FORCE))

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the limit (L, 1) from the load and the square of the transmitted force.

        The limit is c |drive - load| + quadratic through^2 (5). The gears transmit the force
        `through`: the smaller of drive and load if they pull against each other, else zero.

        Args:
            c: (2, L, 1) coefficients: c and quadratic.
            moment: state snapshot of L batch elements; `sides` are the drive force and the passive
                force of the joint, each (L, 1).
        """
        through = _limit_to_opposing(*moment.sides)
        return np.maximum(c[0] * moment.load + c[1] * through**2, 0.0)  # (5)


class PositionFriction(Friction):
    """Dry friction of eccentric gears and bearings: a wave over position that is never negative."""

    name = "friction.position"
    noun = "friction that varies over the joint"
    says = "friction varies periodically with position"
    needs, contains, source = "guide", ("friction.coulomb",), _PLACE
    coefficients = (Coefficient("least", _FORCE_UNITS, _DRY_RANGES), *_WAVE_COEFFICIENTS)

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the limit (L, 1), periodic in the primary coordinate.

        The limit is least + a + sine sin(2 pi x / period) + cosine cos(2 pi x / period), with the
        amplitude a = (sine^2 + cosine^2)^(1/2) (6).

        Args:
            c: (4, L, 1) coefficients: least, sine, cosine and period.
            moment: state snapshot of L batch elements.
        """
        angle = 2 * np.pi * moment.primary / np.maximum(c[3], _MIN_DIVISOR)
        mean = c[0] + np.sqrt(c[1] ** 2 + c[2] ** 2)
        return np.maximum(mean + c[1] * np.sin(angle) + c[2] * np.cos(angle), 0.0)  # (6)


class WarmingFriction(Friction):
    """Additional dry and viscous friction of a cold joint, which decays as the joint warms."""

    name = "friction.warming"
    noun = "friction that decreases as the joint warms"
    says = (
        "friction is higher at the start of a run, when the joint is cold, and decreases as it "
        "warms"
    )
    needs, contains, source = "guide", ("friction.coulomb", "drag.linear"), _WARM
    coefficients = _WARMING_COEFFICIENTS

    def limit(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the remaining limit (L, 1); the viscous part is zero at rest.

        The limit is (dry + viscous |v|) exp(-t / time), with the time t since the start of the run
        (7).

        Args:
            c: (3, L, 1) coefficients: dry, viscous and time (s).
            moment: state snapshot of L batch elements.
        """
        remaining_share = np.exp(-moment.t / np.maximum(c[2], _MIN_DIVISOR))
        return (
            np.maximum(c[0], 0.0) + np.maximum(c[1], 0.0) * moment.speed
        ) * remaining_share  # (7)


class DirectionalViscousFriction(Force):
    """Viscous friction that depends on the direction of motion."""

    name = "friction.direction"
    noun = "friction that differs by direction"
    says = "friction is larger in one direction than in the other"
    source = "A. Janot, M. Gautier, M. Brunot, Nonlinear System Identification Benchmarks (2019)"
    needs, contains = "guide", ("drag.linear",)
    coefficients = tuple(
        Coefficient(f"viscous{way}", VISCOUS_UNITS, _VISCOUS_RANGES) for way in "+-"
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), proportional to speed, with a coefficient per direction.

        Shapes: D coordinates.

        F = -viscous+ v where v > 0, -viscous- v where v < 0 (8).

        Args:
            c: (2, L, 1) coefficients: viscous+ and viscous-.
            moment: state snapshot of L batch elements.
        """
        # One of them is zero.
        forward_velocity, backward_velocity = np.maximum(moment.v, 0.0), np.minimum(moment.v, 0.0)
        return -c[0] * forward_velocity - c[1] * backward_velocity  # (8)


def _limit_to_opposing(drive: Array, passive: Array) -> Array:
    """Return the smaller magnitude of two opposing forces (L, 1); zero where they do not oppose.

    The equation of motion is M a = drive - passive. Therefore forces of equal signs oppose each
    other.

    Shapes: L batch elements.

    Args:
        drive: (L, 1) force of the drive.
        passive: (L, 1) passive force, which the drive works against.
    """
    low, high = np.minimum(drive, passive), np.maximum(drive, passive)
    # The first term is zero unless both are positive, the second unless both are negative.
    return np.maximum(low, 0.0) - np.minimum(high, 0.0)


def _compute_stribeck_factor(speed: Array, scale: Array) -> Array:
    """Return exp(-(v / scale)^2) (L, 1), the share of Stribeck's extra friction (2) at a speed."""
    ratio = speed / np.maximum(scale, _MIN_DIVISOR)
    factor: Array = np.exp(-np.square(ratio))
    return factor


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
        """Return the friction force (L, D), and the rate (L, 1) of the hidden state w (Dahl model).

        Shapes: L batch elements, D coordinates.

        The force is -F w with the limit F. w approaches the sign of the velocity v over a distance
        of about the deflection d: w' = r - |r| w, r = v / d (1). |r| is limited, so that (1) can be
        integrated.

        Args:
            c: (2, L, 1) coefficients: limit F and deflection d.
            moment: state snapshot of L batch elements; `along_primary` turns a force (L, 1) on the
                primary coordinate into one (L, D) on all.
            state: hidden state; its `v` is w.
        """
        ratio = moment.v[:, :1] / np.maximum(c[1], _MIN_DEFLECTION)
        rate = np.clip(ratio, -MAX_STATE_RATE, MAX_STATE_RATE)
        return moment.along_primary(-c[0] * state.v), rate - np.abs(rate) * state.v  # (1)
