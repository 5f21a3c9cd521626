"""Transmission effects: two inertias, drive and load, of which the sensor shows the drive.

With x the coordinate that the sensor shows, y that of the load, M the inertia of both, s the share
of the load, W the weight of both, U all other forces, and T the force between drive and load,

    (1 - s) M x'' = U + (1 - s) W(x) - T                                   (1)
    s M y'' = T + s W(y)                                                   (2)

* (3) flexibility: T = s M (w^2 (x - y) + 2 z w (x' - y')), with w the frequency at which the load
  oscillates while the drive is fixed, and z its damping ratio
* (4) backlash: T = s (1 - s) M (k^2 d + 4 k (x' - y') |d| / (|d| + `CONTACT_DAMPING_DEPTH` gap)),
with d the
  excess over the gap and k `CONTACT_FREQUENCY`; flanks push and never pull, so that the load stays
  on a flank after contact and does not bounce

All other effects of the library act on x, where the drive acts.

* (5) coupling: a motor whose shaft passes the previous joint, as in a wrist, turns q + c p, with q
  its own joint and p the previous one; therefore its torque t also acts there, as c t, and its
  servo follows q + c p (by virtual work)

In a robot, the model file specifies the inertia of the links, and as armature that of the drive.
There, the element between them has separate numbers, those of `between`: its compliance (the
inverse of its stiffness), or its gap. If the file specifies no armature, the inertia of the drive
is an additional number, as a share of the joint's.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from sims.core.effect import (
    Coefficient,
    Effect,
    HiddenState,
    HiddenStateEffect,
    ModelValueEffect,
    SeriesElement,
)
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

CONTACT_FREQUENCY = 150.0
"""Frequency in rad/s of two inertias that oscillate against closed, undamped flanks.

It is far above the frequencies visible in a log, and low enough to be integrated.
"""
CONTACT_DAMPING_DEPTH = 0.01
"""Penetration of a flank at which half of its damping acts, as a fraction of the gap."""
_MAX_LOAD_SHARE = 0.98
"""Maximum share of the inertia on the load side of a transmission."""
_MIN_COMPLIANCE = 1e-12
"""Smallest compliance in rad/(N m) or m/N, which counts as zero."""
_SPONG_1987 = "M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860"
_NORDIN_2002 = (
    "M. Nordin, P.-O. Gutman, Automatica 38(10), 1633 (2002), doi:10.1016/S0005-1098(02)00047-X"
)
_CORKE_1994 = (
    "P. I. Corke, B. Armstrong-Helouvry, Proc. IEEE ICRA, 1608 (1994),"
    " doi:10.1109/ROBOT.1994.351360: the wrist of the Puma 560"
)
_DIMENSIONLESS = ("1", "1", "1")
"""Units of a dimensionless coefficient on every kind of system."""
_SPRING_SHARE_RANGES = ((0, 0.9), (0, 0.9), (0, 0.9))
"""Plausible shares of the inertia on the load side of a spring."""
_BACKLASH_SHARE_RANGES = ((0.1, 0.9), (0.1, 0.9), (0.1, 0.9))
"""Plausible shares of the inertia on the load side of backlash."""
_FREQUENCY_RANGES = ((5, 400), (5, 400), (5, 400))
"""Plausible frequencies in rad/s at which a load oscillates on its drive."""
_DAMPING_RATIO_RANGES = ((0.005, 1), (0.005, 1), (0.005, 1))
"""Plausible damping ratios."""
_GAP_RANGES = ((0, 0.02), (0, 0.02), (0, 0.1))
"""Plausible gaps in m or rad."""
_LOAD_SPRING_COEFFICIENTS = (
    Coefficient("share", _DIMENSIONLESS, _SPRING_SHARE_RANGES, most=_MAX_LOAD_SHARE),
    Coefficient("frequency", ("rad/s", "rad/s", "rad/s"), _FREQUENCY_RANGES),
    Coefficient("damping", _DIMENSIONLESS, _DAMPING_RATIO_RANGES, tried=(0.03, 0.3)),
)
_LOAD_BACKLASH_COEFFICIENTS = (
    Coefficient("gap", ("m", "m", "rad"), _GAP_RANGES, of="travel"),
    Coefficient("share", _DIMENSIONLESS, _BACKLASH_SHARE_RANGES, tried=(0.2, 0.5, 0.8)),
)
_COMPLIANCE_UNITS = ("m/N", "m/N", "rad/(N*m)")
_COMPLIANCE_RANGES = ((0, 1e-3), (0, 1e-3), (0, 0.1))
"""Plausible compliances, if nothing is known about the load."""
_DRIVE_SHARE_RANGES = ((0.01, 1), (0.01, 1), (0.01, 1))
"""Plausible inertias of a drive, as a share of the joint's."""
_ROTOR_COEFFICIENT = Coefficient(
    "rotor", _DIMENSIONLESS, _DRIVE_SHARE_RANGES, of="rotor", tried=(0.03,)
)
_SERIES_SPRING_COEFFICIENTS = (
    Coefficient("compliance", _COMPLIANCE_UNITS, _COMPLIANCE_RANGES, of="give"),
    Coefficient("damping", _DIMENSIONLESS, _DAMPING_RATIO_RANGES, tried=(0.05,)),
    _ROTOR_COEFFICIENT,
)
_SERIES_BACKLASH_COEFFICIENTS = (
    Coefficient("gap", ("m", "m", "rad"), _GAP_RANGES, of="travel"),
    _ROTOR_COEFFICIENT,
)


class DrivenLoad(HiddenStateEffect):
    """Load behind a drive, with its own motion.

    Attributes:
        share: index of the coefficient that is the load's share of the inertia.
    """

    share: ClassVar[int] = 0

    def behind(self, c: Array) -> Array:
        """Return the load's share of the inertia (L, 1), limited to its maximum."""
        return np.clip(c[self.share], 0.0, _MAX_LOAD_SHARE)

    def element(self, c: Array) -> SeriesElement:
        """Return the series element: a spring with damper for a compliance, else backlash.

        Shapes: L batch elements, K coefficients.

        Args:
            c: Coefficients (K, L, 1) in the order of `between`: compliance or gap, damping, and
                inertia of the rotor.
        """
        coefficients = {
            coefficient.name: values for coefficient, values in zip(self.between, c, strict=True)
        }
        zeros = np.zeros_like(c[0])
        compliance = coefficients.get("compliance", zeros)
        # A compliance of zero is off; it adds no spring to a batch in which others are on.
        stiffness = np.where(compliance > 0, 1.0 / np.maximum(compliance, _MIN_COMPLIANCE), 0.0)
        gap = np.maximum(coefficients.get("gap", zeros), 0.0)
        damping = coefficients.get("damping", zeros)
        return SeriesElement(stiffness, damping, gap, drive=coefficients["rotor"])

    def begin(self, c: Array, moment: StateSnapshot) -> HiddenState:
        """Return the initial state of the load: moving with the drive, at the static deflection.

        Args:
            c: (K, L, 1) the K coefficients of the effect.
            moment: state snapshot of L batch elements; `primary` is the position (L, 1) of the
                coordinate on which the effect acts.
        """
        deflection = self.compute_static_deflection(
            c, _compute_gravity_acceleration(moment, moment.primary)
        )
        return HiddenState(moment.primary + deflection, moment.v[:, :1])

    def act(self, c: Array, moment: StateSnapshot, state: HiddenState) -> tuple[Array, Array]:
        """Return the force (L, D) on the drive side and the acceleration (L, 1) of the load.

        Shapes: D coordinates, K coefficients.

        With the drive's position x, the load's y, the inertia M of both, the share s of the load,
        the other forces U, the weight W of both, and the force T between drive and load:
        (1 - s) M x'' = U + (1 - s) W(x) - T (1), s M y'' = T + s W(y) (2).

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements; `primary` is the position (L, 1) of the
                coordinate on which the effect acts, `along_primary` turns a force (L, 1) on that
                coordinate into one (L, D) on all.
            state: position and velocity of the load.
        """
        pull = self.compute_coupling_force(c, moment, state)  # T / (s M)
        fall = _compute_gravity_acceleration(moment, moment.primary)  # W(x) / M
        # The system's own weight W includes that of the load, which is subtracted here.
        reaction_force = -self.behind(c) * moment.inertia * (pull + fall)  # (1)
        # (2) divided by s M.
        load_acceleration = pull + _compute_gravity_acceleration(moment, state.x)
        return moment.along_primary(reaction_force), load_acceleration

    def compute_static_deflection(self, c: Array, fall: Array) -> Array:
        """Return the static deflection (L, 1) of the load under an acceleration of gravity.

        By default it is zero, as for backlash, where the load begins in the middle of the gap; NaN
        stays NaN.

        Args:
            c: (K, L, 1) the K coefficients of L batch elements.
            fall: (L, 1) acceleration by gravity.
        """
        return 0.0 * c[0] * fall

    @abstractmethod
    def compute_coupling_force(self, c: Array, moment: StateSnapshot, state: HiddenState) -> Array:
        """Return the force (L, 1) between drive and load per unit of load inertia.

        Args:
            c: (K, L, 1) coefficients.
            moment: state snapshot of L batch elements.
            state: position and velocity of the load.
        """


class JointFlexibility(DrivenLoad):
    """Spring with a damper between the drive and its load."""

    name, noun = "joint.flexibility", "a flexible transmission"
    says = "the load is connected to the drive by a spring, and oscillates"
    source = _SPONG_1987
    coefficients = _LOAD_SPRING_COEFFICIENTS
    between = _SERIES_SPRING_COEFFICIENTS

    def compute_static_deflection(self, c: Array, fall: Array) -> Array:
        """Return the static deflection (L, 1) of the spring under the load's weight, fall / w^2.

        Args:
            c: (3, L, 1) coefficients: share s, frequency w (rad/s) and damping ratio z.
            fall: (L, 1) acceleration by gravity.
        """
        return fall / (c[1] * c[1])

    def compute_coupling_force(self, c: Array, moment: StateSnapshot, state: HiddenState) -> Array:
        """Return the force of spring and damper per unit of load inertia, T / (s M), (L, 1).

        T = s M (w^2 (x - y) + 2 z w (x' - y')) (3), with the inertia M of drive and load, the share
        s of the load, the drive's position x and the load's y.

        Args:
            c: (3, L, 1) coefficients: share s, frequency w (rad/s) and damping ratio z.
            moment: state snapshot of L batch elements; `primary` is the position (L, 1) of the
                coordinate on which the effect acts.
            state: position and velocity of the load.
        """
        damped = 2.0 * c[2] * (moment.v[:, :1] - state.v)
        return c[1] * (c[1] * (moment.primary - state.x) + damped)  # (3)


class JointCoupling(ModelValueEffect):
    """Coupled drive of a joint that also turns the previous joint, c times as much."""

    name, noun = "joint.coupling", "a coupled drive"
    says = "the joint's drive also acts on the previous joint, such as in a coupled wrist"
    source, at = _CORKE_1994, "joint"
    coefficients = (Coefficient("coefficient", _DIMENSIONLESS, ((-1, 1), (-1, 1), (-1, 1))),)  # (5)


class JointBacklash(DrivenLoad):
    """Backlash between the drive and its load: no force is transmitted between the flanks."""

    name, noun = "joint.backlash", "backlash in the transmission"
    says = "there is backlash between the drive and its load"
    source = _NORDIN_2002
    coefficients = _LOAD_BACKLASH_COEFFICIENTS
    between = _SERIES_BACKLASH_COEFFICIENTS
    share, fastest = 1, CONTACT_FREQUENCY

    def compute_coupling_force(self, c: Array, moment: StateSnapshot, state: HiddenState) -> Array:
        """Return the force of the flanks per unit of load inertia, T / (s M), (L, 1).

        T = s (1 - s) M (k^2 d + 4 k (x' - y') |d| / (|d| + depth)) (4), with the position x of the
        drive and y of the load, the excess d of x - y over the half gap to either side, the inertia
        M, the share s of the load, the contact's frequency k, and a depth of 1 % of the gap.
        Damping increases with the penetration |d|, so that the force is continuous. Flanks push and
        never pull.

        Args:
            c: (2, L, 1) coefficients: gap and share s.
            moment: state snapshot of L batch elements; `primary` is the position (L, 1) of the
                coordinate on which the effect acts.
            state: position and velocity of the load.
        """
        relative_position = moment.primary - state.x
        indentation = relative_position - np.clip(relative_position, -0.5 * c[0], 0.5 * c[0])
        # Share of the full damping that acts at this penetration.
        damping_share = np.abs(indentation) / (np.abs(indentation) + CONTACT_DAMPING_DEPTH * c[0])
        push = CONTACT_FREQUENCY * indentation + 4.0 * damping_share * (moment.v[:, :1] - state.v)
        force = (1.0 - self.behind(c)) * CONTACT_FREQUENCY * push  # (4)
        # A force against the penetration would pull.
        return np.where(indentation > 0, np.maximum(force, 0.0), np.minimum(force, 0.0))


def _compute_gravity_acceleration(moment: StateSnapshot, y: Array) -> Array:
    """Return the acceleration (L, 1) by gravity alone at positions y (L, 1).

    Shapes: L batch elements.

    Args:
        moment: state of the batch.
        y: (L, 1) positions of the primary coordinate.
    """
    moment_at_y = replace(moment, x=moment.along_primary(y))
    weight = moment.system.weight(moment_at_y)[:, moment.system.primary, None]
    fall: Array = weight / moment.inertia
    return fall


def make_series_element(kind: type[Effect], numbers: Mapping[str, Array]) -> SeriesElement:
    """Make the element in series with a joint, a spring or a gap, from an effect's coefficients.

    Args:
        kind: class of the effect, for which `is_series_effect` is true.
        numbers: coefficients (L,) of L batch elements by name; missing ones are zero.
    """
    assert issubclass(kind, HiddenStateEffect)
    zeros = np.zeros_like(next(iter(numbers.values())))
    # `between` are the coefficients of an element whose both sides are known, as in a robot.
    values = [numbers.get(coefficient.name, zeros) for coefficient in kind.between]
    return kind().element(np.stack(values))


def combine_elements(elements: Sequence[SeriesElement]) -> SeriesElement:
    """Combine several elements in series with one joint by adding their numbers."""
    names = ("stiffness", "damping", "gap", "drive")
    return SeriesElement(*(np.sum([getattr(e, name) for e in elements], axis=0) for name in names))
