"""Names of the columns of a log, from names of joints in the log, and units in names.

A message of joint states has a list of names and lists of numbers in the same order, which may
differ from the order of the model: ROS drivers sort names alphabetically. Logs store the names as
columns (``field.name0`` next to ``field.position0`` of ``rostopic echo -p``), as a text in each row
(``['base', 'elbow']``), or as an array of texts (NumPy). A number then gets the name of its joint:
``field.position.base``.

Examples are ``q1 [deg]``, ``pos (rad)``, ``elbow_deg`` and ``Zeit [ms]``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from sims.core.simulator import Array, make_read_only

_NAMES_WORD = r"(?:joint[_ ]?|motor[_ ]?)?names?"
_NUMBERED_COLUMN_PATTERN = re.compile(
    r"(?P<stem>.*?)(?P<left>[\[(._]?)(?P<place>\d{1,4})(?P<right>[\])]?)"
)
_NAMES_COLUMN = re.compile(rf"(?:(?P<prefix>.*?)[._/ ])??{_NAMES_WORD}", re.IGNORECASE)
_LIST_OF_TEXTS = re.compile(r"[\[(](?P<inside>.*)[\])]")


def name_numbered_columns(
    columns: Mapping[str, Array], texts: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the numbered columns of a table by the columns that hold their names.

    ROS logs, for example, have columns ``name[0]``, ``name[1]``, ... with names of joints and
    ``position[0]``, ``position[1]``, ... with numbers. Names are looked up in each row, because
    some loggers change their order.

    Args:
        columns: Numbers (T,) by column name.
        texts: Texts (T,) by column name.

    Returns:
        The numbers by the names of their joints, and the numbered columns that they replace.
    """
    groups: dict[tuple[str, str, str], dict[int, str]] = {}
    for column in texts:
        match = _NUMBERED_COLUMN_PATTERN.fullmatch(column)
        stem = _NAMES_COLUMN.fullmatch(match["stem"]) if match else None
        if match and stem:
            prefix = column[: len(stem["prefix"]) + 1] if stem["prefix"] else ""
            style = prefix, match["left"], match["right"]
            groups.setdefault(style, {})[int(match["place"])] = column
    named_columns: dict[str, Array] = {}
    unlisted: set[str] = set()
    for style, columns_by_position in groups.items():
        names = [
            list(texts[columns_by_position[position]]) for position in sorted(columns_by_position)
        ]
        for siblings, columns_by_number in _group_numbered_columns(columns, *style).items():
            if set(columns_by_number) != set(columns_by_position):
                continue
            values = np.column_stack(
                [columns[columns_by_number[position]] for position in sorted(columns_by_number)]
            )
            entries = _sort_by_name(values, names, f"{siblings}.")
            if entries and not entries.keys() & columns.keys():
                named_columns |= entries
                unlisted |= set(columns_by_number.values())
    return named_columns, frozenset(unlisted)


def name_list_entries(
    columns: Mapping[str, Array], texts: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the entries of lists by a column that holds a list of names in each row.

    Args:
        columns: Numbers (T,) or (T, k) by column name.
        texts: Texts (T,) by column name.

    Returns:
        The numbers by the names of their joints, and the lists that they replace.
    """
    named_columns: dict[str, Array] = {}
    unlisted: set[str] = set()
    for names_column, cells in texts.items():
        stem = _NAMES_COLUMN.fullmatch(names_column)
        lists = [_parse_text_list(cell) for cell in cells] if stem else []
        if not lists or not lists[0] or len({len(name_list) for name_list in lists}) > 1:
            continue
        names = [list(entry_names) for entry_names in zip(*lists, strict=True)]
        for name, values in columns.items():
            if values.ndim == 2 and values.shape[1] == len(names):
                entries = _sort_by_name(values, names, f"{name}.")
                if entries and not entries.keys() & columns.keys():
                    named_columns |= entries
                    unlisted.add(name)
    return named_columns, frozenset(unlisted)


def arrays_by_name(
    columns: Mapping[str, Array], names: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the entries of arrays by an array of names of the same length.

    Args:
        columns: Numbers (T,) or (T, k) by array name.
        names: Texts (k,) by array name.

    Returns:
        The numbers by the names of their joints, and the arrays that they replace.
    """
    named_columns: dict[str, Array] = {}
    unlisted: set[str] = set()
    for array, entry_names in names.items():
        if not re.search(r"name|joint|motor|label", array, re.IGNORECASE):
            continue
        for name, values in columns.items():
            if values.ndim == 2 and values.shape[1] == len(entry_names) == len(set(entry_names)):
                named_columns |= {
                    f"{name}.{entry_name}": make_read_only(values[:, k])
                    for k, entry_name in enumerate(entry_names)
                }
                unlisted.add(name)
    return named_columns, frozenset(unlisted)


def _group_numbered_columns(
    columns: Mapping[str, Array], prefix: str, opening: str, closing: str
) -> dict[str, dict[int, str]]:
    """Group numbered columns by the text before their number.

    Args:
        columns: Numbers by column name.
        prefix: Required beginning of the names.
        opening: Required character before the number.
        closing: Required character after the number.

    Returns:
        Column names by number, for each text before the number.
    """
    columns_by_stem: dict[str, dict[int, str]] = {}
    for column, values in columns.items():
        match = _NUMBERED_COLUMN_PATTERN.fullmatch(column)
        if match is None or values.ndim > 1 or not column.startswith(prefix):
            continue
        if (match["left"], match["right"]) == (opening, closing):
            columns_by_stem.setdefault(match["stem"], {})[int(match["place"])] = column
    return columns_by_stem


def _sort_by_name(values: Array, names: Sequence[Sequence[str]], prefix: str) -> dict[str, Array]:
    """Sort numbers into columns by name, looking up the names in each row.

    Texts that differ in most rows are not names; then nothing is sorted.

    Args:
        values: Numbers (T, k).
        names: Names (k, T), one for each number in each row.
        prefix: Beginning of the names of the new columns.

    Returns:
        Columns (T,) by name, NaN in rows without the name; empty if a row has a name twice, or if
        there are far more names than columns.
    """
    distinct_names = list(dict.fromkeys(name for column in names for name in column if name))
    if not distinct_names or len(distinct_names) > 4 * len(names):
        return {}
    table = np.array(names, dtype=object).T
    columns: dict[str, Array] = {}
    for name in distinct_names:
        mask = table == name
        if (mask.sum(axis=1) > 1).any():
            return {}
        columns[prefix + name] = make_read_only(np.where(mask, values, 0.0).sum(axis=1))
        missing = ~mask.any(axis=1)
        if missing.any():
            column = columns[prefix + name].copy()
            column[missing] = np.nan
            columns[prefix + name] = make_read_only(column)
    return columns


def _parse_text_list(cell: str) -> list[str]:
    """Return the texts of a list that is written in a cell as ``['base', 'elbow']``."""
    match = _LIST_OF_TEXTS.fullmatch(cell.strip())
    if not match:
        return []
    return [part.strip(" '\"") for part in re.split(r"[,;]", match["inside"])]


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
    """Return the unit that a text spells and its quantity; None if it is not a known unit."""
    normalised_text = re.sub(r"\s*([*/^·⋅])\s*", r"\1", text.strip().lower().replace("**", "^"))
    return _UNITS.get(normalised_text) or _UNITS.get(normalised_text.replace(" ", "*"))


def split_unit(name: str) -> NamedUnit:
    """Split the name of a column into the name proper and the unit that follows it.

    A unit may be in brackets (`q [rad]`), after a joiner (`q_rad_s`) or in camel case
    (`speedRadS`).

    Returns:
        The name without its unit; the whole name without a unit if none is found.
    """
    bracket_match = _BRACKETED_UNIT_PATTERN.fullmatch(name)
    # The brackets of `q[1]` hold an index and no unit.
    if bracket_match and bracket_match["name"] and not bracket_match["unit"].strip().isdigit():
        unit = read_unit(bracket_match["unit"])
        if unit is not None:
            return NamedUnit(bracket_match["name"], *unit)
    # `q_rad_s` is in rad/s: use the longest unit at the end of the name.
    for position in range(1, len(name)):
        if name[position] not in _JOINERS:
            continue
        unit_text = name[position:].strip(_JOINERS).removeprefix("in_").removeprefix("in ")
        unit = read_unit(unit_text)
        if unit is not None and unit_text.lower() not in _NEEDS_BRACKETS:
            return NamedUnit(name[:position], *unit)
    camel_match = _CAMEL_CASE_UNIT_PATTERN.fullmatch(name)
    if camel_match:
        unit = read_unit(camel_match["unit"]) or read_unit("rad/s")
        assert unit is not None
        return NamedUnit(camel_match["name"], *unit)
    return NamedUnit(name)
