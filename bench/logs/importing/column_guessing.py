"""Guess the meaning of log columns from their names and from a robot's model.

The names show most: whether a column is a command or a sensor signal; a position, a rate or a
force; and its joint. The numbers verify it: a position lies within its joint's range, in radians or
in degrees.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from bench.logs.quality.range_checks import is_within_widened_range
from sims.core.simulator import Array
from sims.recording.log_formats.unit_names import read_unit, split_unit
from sims.recording.log_time_alignment import MAX_REPEATED
from sims.robot.robot_model import Joint

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
    "stiffness damping estop emergency stop brake brakes power armed fault",
}
ROLE_KEYWORDS: Mapping[Role, frozenset[str]] = {
    role: frozenset(words.split()) for role, words in _WORD_LISTS.items()
}
"""Words in the name of a column or of its file, by the role that they indicate."""
_WEAK_ROLE_WORDS = frozenset(
    {"joint", "joints", "state", "states", "current", "currents", "load", "loads"}
)
"""Words that indicate a role only if no other word does."""
_MEASURED_WORDS = frozenset(
    ["meas", "measured", "actual", "act", "present", "sensed", "ist", "istwert"]
)
"""Words for a measured signal, if a log has several signals of one kind."""
_JOINED_WORDS_PATTERN = re.compile(
    r"(?P<what>q|dq|qd|tau|pos|vel)(?P<command>des|cmd|ref|goal|target|desired)"
)
"""Pattern of two words written as one, for example ``qdes`` and ``taucmd``."""
_ROLE_OF_QUANTITY: Mapping[str, Role] = {
    "angular velocity": "velocity",
    "velocity": "velocity",
    "torque": "force",
    "force": "force",
    "current": "force",
    "acceleration": "other",
    "other": "other",
}
"""Role of a column by the quantity that its unit measures."""
_TIME_WORDS = "t time times timestamp timestamps stamp stamps sec seconds secs clock zeit uhrzeit"
TIME_COLUMN_NAMES = frozenset((_TIME_WORDS + " temps tiempo tempo").split())
"""Words in the name of a column of time stamps."""
TIME_UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Possible units of time stamps, with their values in seconds."""
SAMPLING_RATE_RANGE_HZ = (2.0, 5000.0)
"""Minimum and maximum sampling rate of a log, in Hz."""
MAX_RANGE_EXCESS = 0.5
"""Maximum distance of a position beyond its joint's range, as a fraction of the range."""
MAX_UNLIMITED_POSITION_RAD = 4.0 * np.pi
"""Largest position in radians of a joint without a range; a larger one is taken for degrees."""
DEGREES_PER_RADIAN = 180.0 / np.pi


class LogColumn(NamedTuple):
    """A column of a log.

    Attributes:
        file: Name of its file.
        name: Name in the file.
        values: (T,) numbers.
        units_row: Unit in the file's row of units; empty if it has none.
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
        """The unit in the file; empty if there is none."""
        return self.units_row or split_unit(self.name).unit

    @property
    def quantity(self) -> str:
        """The quantity that the stated unit measures; empty if there is no unit."""
        unit_and_quantity = read_unit(self.unit) if self.unit else None
        return unit_and_quantity[1] if unit_and_quantity else ""


def split_name(text: str) -> list[str]:
    """Split a name into words in lower case: ``jointPositions[2]`` becomes joint, positions, 2.

    Words end at punctuation, at capital letters and before digits. Words such as ``qdes``, which
    consist of a quantity and a word for a command, are divided into both.

    Args:
        text: name of a column, file or joint.
    """
    # A space before each capital letter.
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", text)
    words: list[str] = []
    # Split at punctuation and underscores, and between a letter and a digit.
    for part in re.split(r"[\W_]+|(?<=[^\W\d_])(?=\d)", spaced):
        word = part.lower()
        joined_words = _JOINED_WORDS_PATTERN.fullmatch(word)
        words += joined_words.groups() if joined_words else [word]
    return [word for word in words if word]


def guess_role(column: LogColumn) -> Role | None:
    """Guess the role of a column from its name and unit, or else from the name of its file.

    The role is the quantity of the signal. The first of these decides:

    1. Words for a command in the column's name: ``position_command`` is a command. In the file's
       name they count unless the column's name has a word for another quantity, such as an error.
    2. The quantity of the column's unit, such as "torque" for N*m.
    3. Other words of the column's name, then of the file's name.

    Args:
        column: Column of a log, with the name of its file.

    Returns:
        Command, position, velocity, force or other; None if nothing indicates a role.
    """
    column_words, file_words = _split_into_words(column)
    # Role "other" has words for signals that are no command, such as errors and temperatures.
    if column_words & ROLE_KEYWORDS["command"] or (
        file_words & ROLE_KEYWORDS["command"] and not column_words & ROLE_KEYWORDS["other"]
    ):
        return "command"
    if column.quantity in _ROLE_OF_QUANTITY:
        return _ROLE_OF_QUANTITY[column.quantity]
    return _guess_role(column_words) or _guess_role(file_words)


def get_commanded_role(column: LogColumn) -> Role | None:
    """Return the quantity that a command sets: position, velocity, force or other; None if unknown.

    The column's unit decides (an angle or a length is a position). Without a unit, words of the
    column's name do, then words of its file's name.

    Args:
        column: Column that contains a command.
    """
    if column.quantity in _ROLE_OF_QUANTITY:
        return _ROLE_OF_QUANTITY[column.quantity]
    if column.quantity in ("angle", "length"):
        return "position"
    column_words, file_words = _split_into_words(column)
    # `joint_command` gives no more information than `command`; `joint_position_command` does.
    return _guess_role(column_words - _WEAK_ROLE_WORDS) or _guess_role(
        file_words - _WEAK_ROLE_WORDS
    )


def is_measured(column: LogColumn) -> bool:
    """Return whether a column's name says that it was measured."""
    return bool(set(split_name(column.bare)) & _MEASURED_WORDS)


def _split_into_words(column: LogColumn) -> tuple[set[str], set[str]]:
    """Return the words of a column's name and those of its file's name."""
    # The name of a bag's topic has no file extension.
    stem = column.file.rpartition(".")[0] or column.file
    return set(split_name(column.bare)), set(split_name(stem))


def _guess_role(words: set[str]) -> Role | None:
    """Return the role of a signal that words indicate; None if they indicate none.

    Clear words decide first. `current` in "current position" is not an electric current, and a
    joint state may be a velocity; so the ambiguous words `current` and `load`, and after them
    `joint` and `state`, only decide if no other word does. Of several roles, the first of other,
    velocity, force and position is returned.

    Args:
        words: Words of a column's or file's name, in lower case.
    """
    roles: tuple[Role, ...] = ("other", "velocity", "force", "position")
    for word_subset in (
        words - _WEAK_ROLE_WORDS,
        words & {"current", "currents", "load", "loads"},
        words,
    ):
        for role in roles:
            if word_subset & ROLE_KEYWORDS[role]:
                return role
    return None


def match_joint(column: LogColumn, joints: Sequence[Joint]) -> Joint | None:
    """Return the joint whose name is part of a column's name; the longest if there are several.

    If no whole name matches, names without words that all joints share are tried: ``elbow`` for
    ``elbow_joint``. Case and punctuation do not count.

    Args:
        column: Column of a log.
        joints: Joints of the robot.

    Returns:
        The joint, or None if no name matches.
    """
    text = _strip_punctuation(column.bare)
    for names in ([joint.name for joint in joints], _strip_shared_words(joints)):
        matches = [
            (len(name), joint)
            for name, joint in zip(names, joints, strict=True)
            if _strip_punctuation(name) and _strip_punctuation(name) in text
        ]
        if matches:
            _, longest_match = max(matches, key=lambda length_and_joint: length_and_joint[0])
            return longest_match
    return None


def _strip_shared_words(joints: Sequence[Joint]) -> list[str]:
    """Return joint names without words that any joint may have: ``elbow`` for ``elbow_joint``.

    Args:
        joints: Joints of the robot.

    Returns:
        One stem per joint; empty where it would be ambiguous.
    """
    shared_words = {"joint", "motor", "link", "actuator", "dof"}
    stems = [
        "".join(w for w in split_name(joint.name) if w not in shared_words) for joint in joints
    ]
    # A short stem, or one that two joints share, is ambiguous.
    return [
        stem if len(stem) > 2 and not stem.isdigit() and stems.count(stem) == 1 else ""
        for stem in stems
    ]


def match_numbered_joints(
    columns: Sequence[LogColumn], joints: Sequence[Joint]
) -> dict[str, Joint]:
    """Assign joints to numbered columns of one kind, in the order of the model.

    The last number of a name counts. The column with the smallest number, such as ``q0`` or ``q1``,
    belongs to the first joint; a number that is left out leaves out a joint.

    Args:
        columns: Columns with a number in their names.
        joints: Joints of the robot in the order of the model.

    Returns:
        Joints by column name; empty if a column has no number, numbers repeat, or a number exceeds
            the number of joints.
    """
    column_numbers: dict[str, int] = {}
    for column in columns:
        digits = re.findall(r"\d+", column.bare)
        if not digits:
            return {}
        column_numbers[column.name] = int(digits[-1])
    if not columns or len(set(column_numbers.values())) < len(columns):
        return {}
    first, last = min(column_numbers.values()), max(column_numbers.values())
    # The first number counts as that of the first joint, so the last one must have a joint, too.
    if last - first >= len(joints):
        return {}
    return {name: joints[number - first] for name, number in column_numbers.items()}


def list_clock_columns(columns: Iterable[LogColumn]) -> list[LogColumn]:
    """Return the columns that may be time stamps, the most likely first.

    Time stamps increase from row to row. The order is: stamps of a message's header, other columns
    with a name or unit of time, and increasing columns with other names. A few repeated stamps are
    allowed in columns with a name or unit of time.

    Args:
        columns: all columns of one file.
    """
    header_stamps, named_stamps, increasing_columns = [], [], []
    for column in columns:
        words = set(split_name(column.bare))
        is_named = bool(words & TIME_COLUMN_NAMES) or column.quantity == "time"
        if not _is_increasing(column.values, MAX_REPEATED if is_named else 0.0):
            continue
        if not is_named:
            increasing_columns.append(column)
        elif "header" in words:
            header_stamps.append(column)
        else:
            named_stamps.append(column)
    return [*header_stamps, *named_stamps, *increasing_columns]


def guess_time_unit(stamps: Array) -> str | None:
    """Return the unit of time stamps for a plausible sampling rate; None if no unit gives one.

    Args:
        stamps: (T,) time stamps in an unknown unit.

    Returns:
        First of s, ms, us and ns for which the median interval gives a sampling rate within
        `SAMPLING_RATE_RANGE_HZ`.
    """
    steps = np.diff(stamps)
    interval = float(np.median(steps[steps > 0]))
    min_rate, max_rate = SAMPLING_RATE_RANGE_HZ
    for unit, seconds_per_unit in TIME_UNITS.items():
        rate = 1.0 / max(interval * seconds_per_unit, 1e-300)
        if min_rate <= rate <= max_rate:
            return unit
    return None


def guess_position_unit(values: Array, joint: Joint) -> str | None:
    """Guess the unit of a position from the joint's range: rad or deg, for a slide joint m or mm.

    It is the first of these units in which the positions lie within the widened range. For a hinge
    without a range, angles of more than two turns in rad are taken for degrees.

    Args:
        values: (T,) positions.
        joint: Joint that they belong to.

    Returns:
        The unit, or None if neither fits the range.
    """
    is_hinge = joint.kind == "hinge"
    si_unit, small_unit = ("rad", "deg") if is_hinge else ("m", "mm")
    extremes = np.array([np.nanmin(values), np.nanmax(values)])
    if joint.range is None:
        is_in_degrees = is_hinge and np.abs(extremes).max() > MAX_UNLIMITED_POSITION_RAD
        return small_unit if is_in_degrees else si_unit
    if is_within_widened_range(extremes, joint.range, MAX_RANGE_EXCESS):
        return si_unit
    # The same numbers, read in the small unit and converted to the unit of the range.
    converted_extremes = extremes / (DEGREES_PER_RADIAN if is_hinge else 1e3)
    if is_within_widened_range(converted_extremes, joint.range, MAX_RANGE_EXCESS):
        return small_unit
    return None


def is_constant(values: Array) -> bool:
    """Return whether a column never changes."""
    return bool(np.nanmax(values) == np.nanmin(values))


def _is_increasing(values: Array, max_repeated: float) -> bool:
    """Return whether a column increases from row to row, except for a share of repeated rows.

    Args:
        values: (T,) numbers of the column; a missing one makes the result False.
        max_repeated: largest share of rows that may repeat the one before.
    """
    if values.size < 2 or not np.isfinite(values).all():
        return False
    steps = np.diff(values)
    return bool(
        (steps >= 0).all() and steps.any() and (steps == 0).sum() <= max_repeated * values.size
    )


def _strip_punctuation(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())
