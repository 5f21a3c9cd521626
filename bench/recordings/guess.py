"""What the columns of a log may be, told from their names and from a robot's model.

Names say most: of a command or of a sensor, of a position, a rate or a force, of which joint. The
numbers check it: a position lies within its joint's range, in radians or in degrees, and a rate is
the derivative of its position,

    v = b dq/dt,    b = <v dq/dt> / <(dq/dt)^2>                                                (1)

with b = 1 in the same unit, and 57.3 in degrees beside radians.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from sims.base import Array
from sims.recording.mapping import MAX_REPEATED
from sims.recording.unit_names import read_unit, split_unit
from sims.recording.units import scale
from sims.robot.model import Joint

Role = Literal["command", "position", "velocity", "force", "other"]

_WORD_LISTS: Mapping[Role, str] = {
    "command": "control controls command commands commanded cmd cmds target targets goal goals "
    "action actions desired des ref refs reference references setpoint setpoints ctrl u demand "
    "demanded soll sollwert sollwerte vorgabe consigne consignes referencia",
    "velocity": "velocity velocities vel vels qd dq qvel speed speeds rate rates omega qdot rpm "
    "geschwindigkeit geschwindigkeiten drehzahl vitesse velocidad",
    "force": "torque torques effort efforts tau taus current currents load loads force forces "
    "moment momente drehmoment drehmomente kraft strom couple",
    "position": "position positions pos q qpos angle angles state states joint joints encoder "
    "winkel lage istwert",
    "other": "temperature temperatures temp temps voltage voltages volt acceleration accelerations "
    "accel acc qdd ddq error errors err status mode modes enable enabled flag covariance pwm seq "
    "stiffness damping",
}
WORDS: Mapping[Role, frozenset[str]] = {
    role: frozenset(words.split()) for role, words in _WORD_LISTS.items()
}
"""Words of a column's name, or of its file's, by what they say it is."""
_VAGUE = frozenset({"joint", "joints", "state", "states", "current", "currents", "load", "loads"})
"""Words that say what a column is only where no other word does."""
_MEASURED = frozenset(["meas", "measured", "actual", "act", "present", "sensed", "ist", "istwert"])
"""Words of what a sensor measured, where a log has several signals of a kind."""
_GLUED = re.compile(r"(?P<what>q|dq|qd|tau|pos|vel)(?P<command>des|cmd|ref|goal|target|desired)")
"""Words of two, as ``qdes`` and ``taucmd``."""
_ROLE_OF_QUANTITY: Mapping[str, Role] = {
    "angular velocity": "velocity",
    "velocity": "velocity",
    "torque": "force",
    "force": "force",
    "current": "force",
    "acceleration": "other",
    "other": "other",
}
"""What a column is by the quantity that its unit measures."""
_TIME_WORDS = "t time times timestamp timestamps stamp stamps sec seconds secs clock zeit uhrzeit"
TIMES = frozenset((_TIME_WORDS + " temps tiempo tempo").split())
"""Words of a column of stamps."""
UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""What a stamp's unit may be worth, seconds."""
RATES = (2.0, 5000.0)
"""Hz between which a log is sampled."""
WIDER = 0.5
"""Times the width of its range, a position may lie beyond its end."""
TURNS = 4.0 * np.pi
"""A position of a joint without a range that is larger is taken for degrees."""
ALIKE = 0.7
"""Correlation of a rate with the derivative of its position, at least."""
BETWEEN = (0.7, 1.4)
"""Slopes of (1) that are one unit, times the unit's own."""
DEGREES = 180.0 / np.pi


class Column(NamedTuple):
    """A column of a log.

    Attributes:
        file: name of its file.
        name: as the file has it.
        values: (T,) numbers.
        units_row: unit in the file's row of units; empty where it has none.
    """

    file: str
    name: str
    values: Array
    units_row: str = ""

    @property
    def bare(self) -> str:
        """The name without its unit."""
        return split_unit(self.name).name

    @property
    def unit(self) -> str:
        """The unit that the file states; empty where it states none."""
        return self.units_row or split_unit(self.name).unit

    @property
    def quantity(self) -> str:
        """What the stated unit measures; empty where none is stated."""
        found = read_unit(self.unit) if self.unit else None
        return found[1] if found else ""


def words_of(text: str) -> list[str]:
    """The words of a name: ``jointPositions[2]`` is joint, positions, 2."""
    split = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", text)
    words = []
    for part in re.split(r"[\W_]+|(?<=[^\W\d_])(?=\d)", split):
        glued = _GLUED.fullmatch(part.lower())
        words += [glued["what"], glued["command"]] if glued else [part.lower()]
    return [word for word in words if word]


def role_of(column: Column) -> Role | None:
    """Return what a column is by its name and unit, else by its file's; None if none says it."""
    own, file = _words(column)
    if own & WORDS["command"] or (file & WORDS["command"] and not own & WORDS["other"]):
        return "command"
    if column.quantity in _ROLE_OF_QUANTITY:
        return _ROLE_OF_QUANTITY[column.quantity]
    return _measured(own) or _measured(file)


def commanded_role(column: Column) -> Role | None:
    """Return what a command asks for by its name and unit, else by its file's name: a position, a
    velocity or a force; None if none says it.
    """
    if column.quantity in _ROLE_OF_QUANTITY:
        return _ROLE_OF_QUANTITY[column.quantity]
    if column.quantity in ("angle", "length"):
        return "position"
    own, file = _words(column)
    # `joint_command` says no more than `command`; `joint_position_command` does.
    return _measured(own - _VAGUE) or _measured(file - _VAGUE)


def is_measured(column: Column) -> bool:
    """Return whether a column's name says that it was measured."""
    return bool(set(words_of(column.bare)) & _MEASURED)


def _words(column: Column) -> tuple[set[str], set[str]]:
    """The words of a column's name and of its file's."""
    # A topic of a bag has no ending.
    stem = column.file.rpartition(".")[0] or column.file
    return set(words_of(column.bare)), set(words_of(stem))


def _measured(words: set[str]) -> Role | None:
    """What some words say of a measured signal."""
    roles: tuple[Role, ...] = ("other", "velocity", "force", "position")
    # The current position is no current, and the state of a joint may be its velocity.
    for some in (words - _VAGUE, words & {"current", "currents", "load", "loads"}, words):
        for role in roles:
            if some & WORDS[role]:
                return role
    return None


def joint_of(column: Column, joints: Sequence[Joint]) -> Joint | None:
    """The joint whose name stands in a column's; the longest where there are several."""
    text = _plain(column.bare)
    for names in ([joint.name for joint in joints], _stems(joints)):
        named = [
            (len(name), joint)
            for name, joint in zip(names, joints, strict=True)
            if _plain(name) and _plain(name) in text
        ]
        if named:
            return max(named, key=lambda pair: pair[0])[1]
    return None


def _stems(joints: Sequence[Joint]) -> list[str]:
    """Names of joints without words that all of them may have: ``elbow`` of ``elbow_joint``."""
    usual = {"joint", "motor", "link", "actuator", "dof"}
    stems = ["".join(w for w in words_of(joint.name) if w not in usual) for joint in joints]
    # A short one, or one that two joints share, may be anything.
    return [
        stem if len(stem) > 2 and not stem.isdigit() and stems.count(stem) == 1 else ""
        for stem in stems
    ]


def numbered(columns: Sequence[Column], joints: Sequence[Joint]) -> dict[str, Joint]:
    """Joints by number, for columns of one kind that are numbered or stand in a list: as many as
    the robot has joints, or fewer, in the model's order; none where there are more.
    """
    places: dict[str, int] = {}
    for column in columns:
        digits = re.findall(r"\d+", column.bare)
        if not digits:
            return {}
        places[column.name] = int(digits[-1])
    first = min(places.values(), default=0)
    if len(columns) > len(joints) or len(set(places.values())) < len(columns):
        return {}
    order = {name: place - first for name, place in places.items()}
    if max(order.values(), default=0) >= len(joints):
        return {}
    return {name: joints[place] for name, place in order.items()}


def clocks(columns: Iterable[Column]) -> list[Column]:
    """Return the columns that may be stamps, the likeliest first: the stamp of a message's header,
    others that are called so or have a unit of time, and columns of other names that increase.
    """
    ranked = []
    for place, column in enumerate(columns):
        words = set(words_of(column.bare))
        named = bool(words & TIMES) or column.quantity == "time"
        if _increases(column.values, MAX_REPEATED if named else 0.0):
            rank = 0 if named and "header" in words else 1 if named else 2
            ranked.append((rank, place, column))
    return [column for _, _, column in sorted(ranked, key=lambda one: one[:2])]


def unit_of_time(stamps: Array) -> str | None:
    """The unit of stamps whose usual interval is that of a log; None where no unit makes it so."""
    steps = np.diff(stamps)
    interval = float(np.median(steps[steps > 0]))
    for unit, second in UNITS.items():
        if RATES[0] <= 1.0 / max(interval * second, 1e-300) <= RATES[1]:
            return unit
    return None


def unit_of_position(values: Array, joint: Joint) -> str | None:
    """Rad or deg (m or mm of a slide) by the joint's range; None where neither can be."""
    usual, other, size = ("rad", "deg", DEGREES) if joint.kind == "hinge" else ("m", "mm", 1e3)
    ends = np.array([np.nanmin(values), np.nanmax(values)])
    if joint.range is None:
        return usual if joint.kind != "hinge" or np.abs(ends).max() <= TURNS else other
    for unit, one in ((usual, 1.0), (other, size)):
        if _within(ends / one, joint.range):
            return unit
    return None


def _within(ends: Array, limits: tuple[float, float]) -> bool:
    """Whether a lowest and a highest position lie within a joint's range, or hardly beyond."""
    slack = WIDER * (limits[1] - limits[0])
    return bool(limits[0] - slack <= ends[0] and ends[1] <= limits[1] + slack)


def unit_of_rate(rate: Array, slope: Array, joint: Joint, stated: str = "") -> str | None:
    """Return the unit of a rate by (1); None where it is not the derivative of the position.

    Args:
        rate: (T,) numbers of the rate.
        slope: (T,) derivative of the position, rad/s or m/s.
        joint: that moves.
        stated: unit that the log states, which is tried first.
    """
    seen = np.isfinite(slope) & np.isfinite(rate)
    r, d = rate[seen], slope[seen]
    # Differences of an encoder's steps are noise: both are looked at over a few samples.
    r, d = _smooth(r), _smooth(d)
    if not (r @ r and d @ d) or abs(float(r @ d)) < ALIKE * float(np.sqrt((r @ r) * (d @ d))):
        return None
    b = float(r @ d) / float(d @ d)
    si = f"{joint.unit}/s"
    usual = ("rad/s", "deg/s", "rpm", "turn/s") if joint.kind == "hinge" else ("m/s", "mm/s")
    units: Sequence[str] = (stated, *usual) if stated else usual
    for unit in units:
        if BETWEEN[0] < b * scale(unit, si).gain < BETWEEN[1]:
            return unit
    return None


def still(values: Array) -> bool:
    """Whether a column never changes."""
    return bool(np.nanmax(values) == np.nanmin(values))


def _smooth(values: Array) -> Array:
    kernel = np.ones(5) / 5.0
    return np.convolve(values, kernel, mode="same") if values.size > 5 else values


def _increases(values: Array, repeated: float) -> bool:
    """Whether a column increases from row to row but for a share of rows that repeat."""
    if values.size < 2 or not np.isfinite(values).all():
        return False
    steps = np.diff(values)
    return bool((steps >= 0).all() and steps.any() and (steps == 0).sum() <= repeated * values.size)


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())
