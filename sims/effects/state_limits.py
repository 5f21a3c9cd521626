"""Limits of a state and contacts: overflow, end stops, impacts and contacts of a robot.

With h the stored level and c the rim, x a position with velocity v, k the stiffness, p the place
and a the loss of a stop:

* (1) overflow: h <= c; the excess over the rim is lost
* (2) stop: F = -k d (d / D)^(1/2) (1 + a s v) if this pushes away from the stop, else zero, with s
  the sign of k and d = max(s (x - p), 0) the penetration; k > 0 limits upward motion, k < 0
  downward motion; k is the stiffness at the depth D, 1 cm or 0.01 rad

A rim of zero is no rim. If a user-defined simulator has several levels, an effect on levels has one
class for each, named ``effect@level``, with the unit and the typical size of the level. (2) is the
law of Hunt and Crossley with Hertz's contact; the rebound speed after contact at a small speed w is
(1 - 2 a w / 3) w for any stiffness.

With e0 the simulator's restitution, vn the normal speed before the impact and c the coefficient:

* (1) e = e0 |vn|^c, vn in m/s
* (2) tangential speed lost: c (1 + e) |vn|, Coulomb's law for the impulse, never more than there is

With the parameters of a contact of two geoms in a robot's model file:

* (3) sliding friction coefficient plus c
* (4) time constant of `solref` times 1 + c; without the mass of the bodies, a contact is a spring
  and a damper with stiffness 1 / (t^2 z^2) and damping 2 / t per unit mass, with the time constant
  t and the damping ratio z
* (5) damping ratio of `solref` times 1 + c
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from sims.core.effect import Coefficient, Contact, Effect, Force, Level, ModelValueEffect
from sims.core.registry import PartUnavailableError
from sims.core.simulator import Array, InputError, make_unknown_name_error
from sims.core.system import StateSnapshot, System
from sims.effects import registry

_LEVEL_UNITS = ("m", "m", "m")
"""Units of a level; a level may have another unit."""
_RIM_RANGES = ((0, 4), (0, 4), (0, 4))
"""Plausible rims, relative to the typical size of the level."""
_REFERENCE_PENETRATION = 0.01
"""Penetration in m or rad at which the stiffness of a stop is specified."""
_STIFFNESS_UNITS = (None, "N/m", "N*m/rad")
"""Units of a stop's stiffness; a body in free flight meets the ground instead."""
_STIFFNESS_RANGES = ((0, 0), (-5000, 5000), (-20, 20))
"""Plausible stiffnesses of a stop, in the units of `_STIFFNESS_UNITS`."""
_STOP_POSITION_RANGES = ((0, 0), (-0.5, 0.5), (-0.5, 0.5))
"""Plausible places of a stop in m or rad; a fit searches the range of the recorded motion."""
_LOSS_RANGES = ((0, 0), (0, 2), (0, 1))
"""Plausible losses of a stop in s/m or s/rad."""
_STOP_COEFFICIENTS = (
    Coefficient("stiffness", _STIFFNESS_UNITS, _STIFFNESS_RANGES, of="stop"),
    Coefficient("place", (None, "m", "rad"), _STOP_POSITION_RANGES),
    Coefficient("loss", (None, "s/m", "s/rad"), _LOSS_RANGES),
)
"""Coefficients of an end stop."""
_CONTACT = "K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42(2), 440 (1975), doi:10.1115/1.3423596"


class LevelOverflow(Level):
    """Overflow of a level at c; a rim of zero is no rim."""

    name = "state.overflow"
    noun = "an overflow"
    says = "a level cannot rise above a rim; the excess overflows and is lost"
    source = "M. Schoukens, J. P. Noel, IFAC-PapersOnLine 50(1), 446 (2017)"
    coefficients = (Coefficient("coefficient", _LEVEL_UNITS, _RIM_RANGES, of="level"),)

    def keep(self, c: Array, level: Array) -> Array:
        """Return the level (L, 1), limited by the rim.

        Args:
            c: (1, L, 1) rim; none if not above zero.
            level: (L, 1) level before the overflow.
        """
        return np.where(c[0] > 0, np.minimum(level, c[0]), level)  # (1)


class EndStop(Force):
    """End stop with stiffness and loss: an upper stop for positive stiffness, else a lower one."""

    name = "state.limit"
    noun = "an end stop"
    says = "it hits an end stop, which limits its position and absorbs some of its speed"
    needs, source, sharp = "guide", _CONTACT, True
    coefficients = _STOP_COEFFICIENTS

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the force (L, D), which pushes away from the stop and never towards it.

        Shapes: D coordinates.

        F = -k d (d / D)^(1/2) (1 + a s v), with the stiffness k, its sign s, the penetration d =
        max(s (x - p), 0) beyond the place p, the depth D of 1 cm or 0.01 rad, and the loss a (2).

        Args:
            c: (3, L, 1) coefficients: stiffness k, place p and loss a.
            moment: state snapshot of L batch elements; `primary` and `primary_rate` are position x
                and velocity v (L, 1) of the coordinate on which the effect acts, `along_primary`
                turns a force (L, 1) on that coordinate into one (L, D) on all.
        """
        side = np.sign(c[0])
        depth = np.maximum(side * (moment.primary - c[1]), 0.0)
        damping_factor = np.maximum(1.0 + c[2] * side * moment.primary_rate, 0.0)
        return moment.along_primary(
            -c[0] * depth * np.sqrt(depth / _REFERENCE_PENETRATION) * damping_factor
        )  # (2)


_MIN_IMPACT_SPEED = 1e-9
"""Minimum impact speed in m/s for the power law, so that a negative power is finite."""
_POWER_RANGES = ((-0.4, 0.2), (-0.4, 0.2), (0, 0))
"""Plausible powers of the impact speed: yielding bodies have about -1/4, viscoelastic ones less."""
_DIMENSIONLESS = ("1", "1", "1")
_RELATIVE_ERROR_RANGES = ((-0.8, 4.0), (-0.8, 4.0), (-0.8, 4.0))
"""Plausible relative errors of the solver parameters of a contact."""


class SpeedDependentRestitution(Contact):
    """Restitution that depends on the impact speed; at most 1, so that no energy is created."""

    name = "restitution.speed"
    noun = "speed-dependent restitution"
    says = "the restitution depends on the speed of the impact"
    source = "K. L. Johnson, Contact Mechanics (1985), chapter 11, doi:10.1017/CBO9781139171731"
    needs = "ground"
    coefficients = (Coefficient("coefficient", ("1", "1", None), _POWER_RANGES),)

    def restitution(self, c: Array, restitution: Array, speed: Array) -> Array:
        """Return the restitution (L, 1): its value at 1 m/s, times a power of the speed.

        It is at most 1, so that no energy is created.

        Shapes: L batch elements.

        e = e0 |vn|^c, with the simulator's restitution e0 and the normal speed vn in m/s before the
        impact (1).

        Args:
            c: (1, L, 1) power c of the impact speed.
            restitution: (L, 1) restitution without the effect.
            speed: (L, 1) impact speed in m/s.
        """
        scaled = restitution * np.maximum(speed, _MIN_IMPACT_SPEED) ** c[0]  # (1)
        # A restitution above 1 without the effect stays above 1, since c = 0 must change nothing.
        return np.minimum(scaled, np.maximum(restitution, 1.0))


class ContactFriction(Contact):
    """Friction in the impact: tangential speed lost is c (1 + e) |vn|, never more than there is.

    At a contact of two geoms of a robot it is (3).
    """

    name = "contact.friction"
    noun = "friction at impacts"
    says = "at each impact, friction reduces the speed along the surface"
    noun_at_place = "a wrong friction"
    says_at_place = "the friction coefficient of the contact is not that of the model file"
    source = "R. M. Brach, Mechanical Impact Dynamics: Rigid Body Collisions (1991)"
    needs = "ground"
    at = "contact"
    coefficients = (Coefficient("coefficient", ("1", None, None), ((0, 1), (0, 0), (0, 0))),)

    def friction(self, c: Array) -> Array:
        """Return the friction coefficient (L, 1); a negative one counts as zero."""
        # the engine applies (2), because only the engine knows the tangential speed
        return np.maximum(c[0], 0.0)


class ContactSoftness(ModelValueEffect):
    """Time constant of a contact times 1 + c (4): a harder contact has a negative c."""

    name = "contact.softness"
    noun = "a wrong softness"
    says = "the contact yields or bounces in another way than the model file states"
    source = "MuJoCo documentation, Modeling, solver parameters"
    at = "contact"
    coefficients = (
        Coefficient("coefficient", _DIMENSIONLESS, _RELATIVE_ERROR_RANGES, least=-0.99),
    )


class ContactDamping(ContactSoftness):
    """Damping ratio of a contact times 1 + c (5): a contact that bounces less has a positive c."""

    name = "contact.damping"
    noun = "a wrong damping"


@lru_cache(maxsize=64)
def make_level_effects(effect: type[Level], system: type[System]) -> tuple[type[Effect], ...]:
    """Return the effect at each level of a system; empty if it has no levels.

    A level is a state that a user's simulator integrates itself, such as the filling of a tank.
    With several levels, the effect has one class for each, named after it.

    Args:
        effect: Registered effect.
        system: System of a user-defined simulator.
    """
    levels = [channel for channel in system.channels if channel.name in system.levels]
    has_several_levels = len(levels) > 1
    effects = []
    for channel in levels:
        body = {
            "name": f"{effect.name}@{channel.name}" if has_several_levels else effect.name,
            "of": effect.name,  # the registered effect of which this is a form
            "place": channel.name if has_several_levels else "",
            "coefficients": [
                _convert_to_level_size(c, channel.unit, channel.scale) for c in effect.coefficients
            ],
            "__module__": __name__,
            "__doc__": effect.__doc__,
        }
        effects.append(type(f"{effect.__name__}At", (effect,), body))
    return tuple(effects)


def _convert_to_level_size(c: Coefficient, unit: str, scale: float) -> Coefficient:
    """Convert a coefficient to the unit and size of a level.

    Args:
        c: coefficient of the effect: name, units and plausible ranges.
        unit: unit of the level.
        scale: typical size of the level, in this unit.
    """
    # The range is relative to the level's size. Units and ranges are stated for each of the three
    # kinds of system, which are the same for a level.
    low, high = c.plausible[0]
    return replace(c, units=(unit,) * 3, plausible=((low * scale, high * scale),) * 3)


def find_level_effect(name: str, system: type[System]) -> type[Effect] | None:
    """Return the effect on a level with a name such as ``state.overflow@upper``.

    The result is None if the effect does not act on levels, or the system has none.

    Args:
        name: Name of the effect, with the level after ``@`` if the system has several levels.
        system: System of a user-defined simulator.

    Raises:
        InputError: The effect is not possible on this system or at this place; the message states
            the reason or the possible places.
    """
    effect_name, separator, place = name.partition("@")
    try:
        effect = registry.get(effect_name)
    except PartUnavailableError:
        # The effect is registered, but cannot be used on this machine.
        return None
    if not issubclass(effect, Level) or not system.levels:
        return None
    if reason := effect.misses(system):
        raise InputError(f"system {system.name} cannot have effect {name}: {reason}")
    level_effects = {one.name: one for one in make_level_effects(effect, system)}
    if name in level_effects:
        return level_effects[name]
    if not separator:
        alternatives = ", ".join(level_effects)
        raise InputError(
            f"effect {effect_name} of simulator {system.name} needs a place: {alternatives}"
        )
    raise make_unknown_name_error(
        f"place of effect {effect_name} in simulator {system.name}", place, list(system.levels)
    )
