"""Read units from the names of columns, such as ``q1 [deg]``, ``elbow_deg`` and ``Zeit [ms]``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal, NamedTuple

Quantity = Literal["time", "angle", "length", "angular velocity", "velocity", "acceleration",
                   "torque", "force", "current", "counts", "other"]  # fmt: skip
"""Quantity that a unit measures."""
_SPELLINGS: Mapping[tuple[str, Quantity], str] = {
    ("s", "time"): "s sec secs second seconds sek sekunden",
    ("ms", "time"): "ms msec msecs millis millisecond milliseconds",
    ("us", "time"): "us µs μs usec usecs micros microsec microsecond microseconds",
    ("ns", "time"): "ns nsec nsecs nanos nanosec nanosecond nanoseconds",
    ("deg", "angle"): "deg degs degree degrees ° grad grado grados degre degres degré degrés",
    ("rad", "angle"): "rad rads radian radians radiant",
    ("mrad", "angle"): "mrad mrads milliradian milliradians",
    ("turn", "angle"): "turn turns rev revs revolution revolutions rotations umdrehungen",
    ("m", "length"): "m meter meters metre metres",
    ("cm", "length"): "cm",
    ("mm", "length"): "mm millimeter millimeters millimetre millimetres",
    ("deg/s", "angular velocity"): "deg/s °/s degree/s degrees/s deg/sec degrees/sec degps dps "
    "deg_s deg_per_s deg_per_sec deg_sec deg*s^-1 degs^-1 degs-1 grad/s",
    ("rad/s", "angular velocity"): "rad/s rad/sec radian/s radians/s radians/sec radps rad_s "
    "rad_per_s rad_per_sec rad_sec rad*s^-1 rads^-1 rads-1",
    ("mrad/s", "angular velocity"): "mrad/s mrad/sec mrad_s",
    ("rpm", "angular velocity"): "rpm rev/min r/min u/min 1/min min^-1 min-1 rev_min",
    ("turn/s", "angular velocity"): "rev/s turn/s turns/s rps rev_s",
    ("m/s", "velocity"): "m/s m/sec m_s mps m*s^-1 ms^-1 ms-1",
    ("mm/s", "velocity"): "mm/s mm/sec mm_s mmps",
    ("rad/s^2", "acceleration"): "rad/s^2 rad/s2 rad/s² rad/s/s rad_s2 rad/sec^2 rad/sec2",
    ("deg/s^2", "acceleration"): "deg/s^2 deg/s2 deg/s² deg/s/s °/s^2 °/s² °/s2 deg_s2",
    ("m/s^2", "acceleration"): "m/s^2 m/s2 m/s² m/s/s m_s2",
    ("N*m", "torque"): "nm n*m n·m n⋅m n.m n_m newtonmeter newtonmeters newtonmetre",
    ("mN*m", "torque"): "mnm mn*m mn·m mn⋅m",
    ("N*cm", "torque"): "ncm n*cm n·cm",
    ("kgf*cm", "torque"): "kgf*cm kgf·cm kgfcm kg*cm kg·cm kgcm kg.cm",
    ("N", "force"): "n newton newtons",
    ("A", "current"): "a amp amps ampere amperes",
    ("mA", "current"): "ma milliamp milliamps milliampere",
    ("V", "other"): "v volt volts",
    ("Hz", "other"): "hz",
    ("degC", "other"): "°c degc celsius",
    ("%", "other"): "% percent",
    ("1", "other"): "1 -",
    ("counts", "counts"): "count counts tick ticks lsb raw digit digits inc incs increments steps "
    "pulses encoder_counts",
}  # fmt: skip
_UNITS: Mapping[str, tuple[str, Quantity]] = {
    spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split()
}
# Spellings that also end names for other reasons (`joint_m`, `q_s`, `motor_a`, `robot_state_raw`).
_NEEDS_BRACKETS = frozenset(
    {"s", "m", "n", "a", "v", "1", "-", "%", "raw", "inc", "digit", "digits", "steps", "amp",
     "second", "count", "grad", "cm", "turn", "turns", "rev", "n_m", "ma"}
)  # fmt: skip
_BRACKETED_UNIT_PATTERN = re.compile(
    r"(?P<name>.*?)\s*[_.]?[\[({<](?P<unit>[^\[\](){}<>]{1,24})[\])}>]\s*"
)
_JOINERS = " _,:;./-\t"
"""Characters between a name and the unit that follows it."""
_CAMEL_CASE_UNIT_PATTERN = re.compile(
    r"(?P<name>.+[a-z0-9])(?P<unit>Deg|Degrees|Rad|Radians|Nm|RadPerSec|Ms|Us|Ns)"
)


class NamedUnit(NamedTuple):
    """Name of a column without its unit, and the unit that was found in the name.

    Attributes:
        name: Name without the unit.
        unit: Unit as read by `recording.unit_conversion`, or ``counts`` of an encoder; empty if the
            name states none.
        quantity: Quantity that the unit measures; None if the name states none.
    """

    name: str
    unit: str = ""
    quantity: Quantity | None = None


def read_unit(text: str) -> tuple[str, Quantity] | None:
    """Return the unit that a text spells and its quantity; None if it is not a known unit.

    Case and blanks around operators do not count, and other blanks mean products.
    """
    normalised_text = re.sub(r"\s*([*/^·⋅])\s*", r"\1", text.strip().lower().replace("**", "^"))
    return _UNITS.get(normalised_text) or _UNITS.get(normalised_text.replace(" ", "*"))


def split_unit(name: str) -> NamedUnit:
    """Split the name of a column into the name proper and the unit that follows it.

    A unit may be in brackets (`q [rad]`), after punctuation or a blank (`q_rad_s`), or in camel
    case (`speedRadPerSec`).

    Returns:
        The name without its unit, and the unit; the whole name without a unit if none is found.
    """
    bracket_match = _BRACKETED_UNIT_PATTERN.fullmatch(name)
    # The brackets of `q[1]` hold an index and no unit.
    if bracket_match and bracket_match["name"] and not bracket_match["unit"].strip().isdigit():
        unit = read_unit(bracket_match["unit"])
        if unit is not None:
            return NamedUnit(bracket_match["name"], *unit)
    # `q_rad_s` is in rad/s and not in s: use the longest unit at the end of the name.
    for position in range(1, len(name)):
        if name[position] not in _JOINERS:
            continue
        unit_text = name[position:].strip(_JOINERS).removeprefix("in_").removeprefix("in ")
        unit = read_unit(unit_text)
        if unit is not None and unit_text.lower() not in _NEEDS_BRACKETS:
            return NamedUnit(name[:position], *unit)
    camel_match = _CAMEL_CASE_UNIT_PATTERN.fullmatch(name)
    if camel_match:
        # Of the units of the pattern, only RadPerSec is not spelled like a unit.
        unit = read_unit(camel_match["unit"]) or ("rad/s", "angular velocity")
        return NamedUnit(camel_match["name"], *unit)
    return NamedUnit(name)
