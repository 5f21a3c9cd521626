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
from sims.robot.model import Joint

Role = Literal["command", "position", "velocity", "force"]

WORDS: Mapping[str, frozenset[str]] = {
    "command": frozenset(
        {
            "control",
            "controls",
            "command",
            "commands",
            "commanded",
            "cmd",
            "cmds",
            "target",
            "targets",
            "goal",
            "goals",
            "action",
            "actions",
            "desired",
            "des",
            "ref",
            "reference",
            "setpoint",
            "ctrl",
            "u",
        }
    ),
    "velocity": frozenset(
        {
            "velocity",
            "velocities",
            "vel",
            "vels",
            "qd",
            "dq",
            "qvel",
            "speed",
            "speeds",
            "rate",
            "rates",
            "omega",
        }
    ),
    "force": frozenset(
        {
            "torque",
            "torques",
            "effort",
            "efforts",
            "tau",
            "current",
            "currents",
            "load",
            "loads",
            "force",
            "forces",
        }
    ),
    "position": frozenset(
        {
            "position",
            "positions",
            "pos",
            "q",
            "qpos",
            "angle",
            "angles",
            "state",
            "states",
            "joint",
            "joints",
            "encoder",
        }
    ),
}
"""Words of a column's name, or of its file's, by what they say it is."""
TIMES = ("t", "time", "times", "timestamp", "timestamps", "stamp", "sec", "seconds", "secs")
"""Names of a column of stamps."""
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
    """A column of a log: the file's name, its own, its numbers (T,)."""

    file: str
    name: str
    values: Array


def words_of(text: str) -> list[str]:
    """The words of a name: ``jointPositions[2]`` is joint, positions, 2."""
    split = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", text)
    return [word.lower() for word in re.split(r"[^A-Za-z0-9]+|(?<=[A-Za-z])(?=\d)", split) if word]


def role_of(column: Column) -> Role | None:
    """What a column is by its name, else by its file's; None if neither says it."""
    # A topic of a bag has no ending.
    stem = column.file.rpartition(".")[0] or column.file
    own, file = set(words_of(column.name)), set(words_of(stem))
    if own & WORDS["command"] or file & WORDS["command"]:
        return "command"
    for kinds in (own, file):
        for role in ("velocity", "force", "position"):
            if kinds & WORDS[role]:
                return role
    return None


def joint_of(column: Column, joints: Sequence[Joint]) -> Joint | None:
    """The joint whose name stands in a column's; the longest where there are several."""
    text = _plain(column.name)
    named = [joint for joint in joints if _plain(joint.name) and _plain(joint.name) in text]
    return max(named, key=lambda joint: len(joint.name), default=None)


def numbered(columns: Sequence[Column], joints: Sequence[Joint]) -> dict[str, Joint]:
    """Joints by number, for columns of one kind that are numbered or stand in a list: as many as
    the robot has joints, or fewer, in the model's order; none where there are more.
    """
    places: dict[str, int] = {}
    for column in columns:
        digits = re.findall(r"\d+", column.name)
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


def time_of(columns: Iterable[Column]) -> Column | None:
    """The column of stamps: the one that is called so and increases, else the first that does."""
    increasing = [c for c in columns if _increases(c.values)]
    for column in increasing:
        if set(words_of(column.name)) & set(TIMES):
            return column
    return increasing[0] if increasing else None


def unit_of_time(stamps: Array) -> str | None:
    """The unit of stamps whose usual interval is that of a log; None where no unit makes it so."""
    interval = float(np.median(np.diff(stamps)))
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
    low, high = joint.range
    slack = WIDER * (high - low)
    for unit, one in ((usual, 1.0), (other, size)):
        if low - slack <= ends[0] / one and ends[1] / one <= high + slack:
            return unit
    return None


def unit_of_rate(rate: Array, position: Array, seconds: Array, unit: str) -> str | None:
    """The unit of a rate beside its position's, by (1); None where it is no derivative of it."""
    slope = np.gradient(position, seconds)
    seen = np.isfinite(slope) & np.isfinite(rate)
    r, d = rate[seen], slope[seen]
    # Differences of an encoder's steps are noise: both are looked at over a few samples.
    r, d = _smooth(r), _smooth(d)
    if not (r @ r and d @ d) or abs(float(r @ d)) < ALIKE * float(np.sqrt((r @ r) * (d @ d))):
        return None
    b = float(r @ d) / float(d @ d)
    for other, times in ((unit, 1.0), ("deg", DEGREES), ("rad", 1.0 / DEGREES)):
        if BETWEEN[0] < b / times < BETWEEN[1]:
            return f"{other}/s"
    return None


def still(values: Array) -> bool:
    """Whether a column never changes."""
    return bool(np.nanmax(values) == np.nanmin(values))


def _smooth(values: Array) -> Array:
    kernel = np.ones(5) / 5.0
    return np.convolve(values, kernel, mode="same") if values.size > 5 else values


def _increases(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return known.size == values.size > 1 and bool((np.diff(known) > 0).all())


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())
