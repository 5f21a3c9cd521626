"""Effects of drives: deviations from a proportional servo law, and the limits of a power supply.

With u the set point, q the position, e = u - q, K the servo's stiffness and c the coefficient, the
drive exerts in addition

* (1) dead zone: K (dz(e) - e), dz(e) = e - clip(e, -c, c); the limits of the drive apply to it, too
* (2) derivative: K c (u(t) - u(t - T)) / T: the servo's D term acts on the rate of the error,
  instead of the rate of q alone; c is the D gain divided by the P gain, and the rate is averaged
  over T, a period of the controller, so that a step of the set point gives a pulse, not an impulse
* (3) profile: the servo follows p instead of u, where p moves to u as fast as |d2p/dt2| <= c
  permits and arrives at rest: d2p/dt2 = c sign(u - p - |dp/dt| dp/dt / (2 c)), and zero after
  arrival

A negative width or limit counts as zero.

With U the force that the drive would exert and V the voltage of its supply: the drive exerts a
force proportional to V, and draws a current proportional to its actual force F; the internal
resistance of the supply reduces V in proportion to the current:

* F = U (1 - c |F|), so that F = U / (1 + c |U|), and U c |U| / (1 + c |U|) is lost        (1)

c is the fraction of the voltage lost per unit of force; 1 / c is a force that is never reached. A
negative coefficient counts as zero. If several drives share the supply, all their forces count:

* F_i = U_i (1 - c S), S = |F_1| + |F_2| + ..., so that S = D / (1 + c D), D = |U_1| + |U_2| + ...,
  and U_i c D / (1 + c D) is lost                                                        (2)

The current is that of a drive at standstill: the back electromotive force is not included.

A drive that brakes takes energy out of the motion, and needs a sink for it. A bridge that does not
reverse, a supply that cannot absorb energy, or a limit of the braking current reduces a force
against the motion to a fraction. With v the velocity and c the fraction that is lost:

* F = U where U v >= 0, and (1 - c) U where U v < 0                                       (3)

At c = 1 the drive accelerates and never brakes; c is limited to the range from 0 to 1.
"""

from __future__ import annotations

import numpy as np

from sims.core.effect import Coefficient, Force, Input, Signal
from sims.core.simulator import Array
from sims.core.system import StateSnapshot
from sims.effects.compiled_recursions import ACCELERATION_LIMIT, run_recursion
from sims.effects.input_effects import average_earlier_signal

_SET_POINT_UNITS = ("m/s^2", "m", "rad")
"""Units of a set point; point systems have no servo."""
_HALF_WIDTH_RANGES = ((0, 1), (0, 0.05), (0, 0.2))
"""Plausible half widths of a dead zone, in the units of `_SET_POINT_UNITS`."""
_SECONDS = ("s", "s", "s")
"""Seconds, on every kind of system."""
_CONTROL_PERIOD = 0.002
"""Time T in s over which a servo computes the rate of its set point; controllers run at 500 Hz."""
_ACCELERATION_UNITS = ("m/s^4", "m/s^2", "rad/s^2")
"""Units of `_SET_POINT_UNITS`, per second squared."""
_ACCELERATION_LIMIT_RANGES = ((0, 500), (0, 50), (0, 200))
"""Plausible limits of a set point's acceleration, in the units of `_ACCELERATION_UNITS`."""


class ServoDeadBand(Force):
    """Dead zone of a servo: no drive within c of the set point, drive from the excess beyond."""

    name = "servo.deadband"
    noun = "a dead zone of the servo"
    says = "the servo does not respond to small errors"
    source = "H. K. Khalil, Nonlinear Systems (2002), section 1.2"
    at = "actuator"
    needs = "servo"
    coefficients = (Coefficient("coefficient", _SET_POINT_UNITS, _HALF_WIDTH_RANGES, of="error"),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D) that is missing in comparison with the proportional law.

        Shapes: D coordinates.

        The force is K (dz(e) - e), dz(e) = e - clip(e, -c, c), with the stiffness K and the error e
        = set point - position (1).

        Args:
            c: (1, L, 1) half width c of the dead zone.
            moment: state snapshot of L batch elements; `error` (L, 1) is e, and `aimed` returns the
                change of the drive's force (L, D) by a shift (L, 1) of the set point.
        """
        width = np.maximum(c[0], 0.0)
        return moment.aimed(-np.clip(moment.error, -width, width))  # (1)


class ServoDerivativeAction(Input):
    """Set point with a lead of c times its rate, as if the D term acts on the error."""

    name = "servo.derivative"
    noun = "a D term on the error"
    says = "the servo's D term acts on the error, so it also responds to the set point's rate"
    source = "K. J. Astrom, R. M. Murray, Feedback Systems (2008), section 10.5"
    needs = "servo"
    coefficients = (Coefficient("coefficient", _SECONDS, ((0, 0.2), (0, 0.2), (0, 0.2))),)

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the set point (L, S) plus c times its rate.

        Shapes: L batch elements, S steps.

        The set point u(t) becomes u(t) + c (u(t) - u(t - T)) / T with the control period T, so that
        a servo of stiffness K exerts K c (u(t) - u(t - T)) / T in addition (2). Values are means
        over each step.

        Args:
            c: (1, L, 1) ratio c of D gain to P gain, s.
            signal: signal (L, S) over the steps.
        """
        lead = np.maximum(c[0], 0.0)
        earlier = average_earlier_signal(signal, np.where(lead > 0, _CONTROL_PERIOD, 0.0))
        return signal.values + lead / _CONTROL_PERIOD * (signal.values - earlier)  # (2)


class ServoMotionProfile(Input):
    """Motion profile of the set point with acceleration of at most c; zero is no limit."""

    name = "servo.profile"
    noun = "a servo's motion profile"
    says = "the servo's set point moves to the command with limited acceleration"
    source = "L. Biagiotti, C. Melchiorri, Trajectory Planning (2008), section 4.6"
    needs = "servo"
    coefficients = (
        Coefficient("coefficient", _ACCELERATION_UNITS, _ACCELERATION_LIMIT_RANGES, of="input/s^2"),
    )

    def feel(self, c: Array, signal: Signal) -> Array:
        """Return the mean (L, S) of the limited set point over each step.

        Shapes: L batch elements, S steps.

        The servo follows p instead of the set point u, with d2p/dt2 = c sign(u - p - |dp/dt| dp/dt
        / (2 c)) until it arrives (3).

        Args:
            c: (1, L, 1) limit c of the acceleration; none if not above zero.
            signal: `values` (L, S) over the steps; `start` (L, 1) is its value before the first
                step.
        """
        limit = np.maximum(c[0], 0.0)
        start = np.column_stack([signal.start[:, 0], limit[:, 0]])
        means = run_recursion(ACCELERATION_LIMIT, signal.values, signal.steps, start)  # (3)
        return np.where(limit > 0, means, signal.values)


_VOLTAGE_LOSS_RANGES = ((0, 0), (0, 0.2), (0, 2))
"""Plausible voltage losses per unit of force, in 1/N and 1/(N m)."""
_LOST_FRACTION_RANGES = ((0, 0), (0, 1), (0, 1))
"""Plausible lost fractions of a braking force."""


class SupplySag(Force):
    """Reduction of the drive's force by the voltage drop of the supply."""

    name = "supply.sag"
    noun = "a supply voltage drop"
    says = "the supply voltage drops with the current, which reduces large forces"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 2: a source with resistance"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1/N", "1/(N*m)"), _VOLTAGE_LOSS_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), opposite to the drive.

        With the forces U_i of all drives that share the supply, and drawn = sum |U_i|, the lost
        force of a drive is U_i c drawn / (1 + c drawn) (2); for a single drive, this is (1).

        Args:
            c: (1, L, 1) share c of the voltage lost per unit of force.
            moment: state snapshot of L batch elements with D coordinates; `along_primary` turns a
                force (L, 1) on the primary coordinate into one (L, D) on all, `sides` are the drive
                force U_i and the passive force of the joint, each (L, 1).
        """
        drive, _ = moment.sides
        relative_drop = np.maximum(c[0], 0.0) * moment.drawn  # c drawn
        return moment.along_primary(-drive * relative_drop / (1.0 + relative_drop))  # (1), (2)


class SupplyBrakingLoss(Force):
    """Reduction of the drive's force where it acts against the motion."""

    name = "supply.braking"
    noun = "a drive with weak braking"
    says = "the drive exerts less than its commanded force when it brakes the motion"
    source = "R. Krishnan, Electric Motor Drives (2001), chapter 4: choppers of one quadrant"
    at = "actuator"
    needs = "input"
    coefficients = (Coefficient("coefficient", (None, "1", "1"), _LOST_FRACTION_RANGES),)

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), in the direction of motion.

        Shapes: D coordinates.

        The drive exerts U where U v >= 0, and (1 - c) U where U v < 0 (3).

        Args:
            c: (1, L, 1) lost share c of a braking force.
            moment: state snapshot of L batch elements; `primary_rate` is the velocity v (L, 1) of
                the coordinate on which the effect acts, `along_primary` turns a force (L, 1) on
                that coordinate into one (L, D) on all, `sides` are the drive force U and the
                passive force of the joint, each (L, 1).
        """
        drive, _ = moment.sides
        braking_force = np.where(drive * moment.primary_rate < 0.0, drive, 0.0)
        return moment.along_primary(-np.clip(c[0], 0.0, 1.0) * braking_force)  # (3)
