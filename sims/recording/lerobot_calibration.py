"""Calibration files of LeRobot, by which normalised positions become angles.

A file has a table for each motor, ``{"elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": 85,
"range_min": 820, "range_max": 3110}}``, in counts of the encoder. A dataset has positions x in
-100 to 100 of that range, and those of a gripper in 0 to 100; with the range r = range_max -
range_min, N = 4096 counts a turn and the zero in the middle of the range, the angle is

    q = s x r / 200 * 360 / (N - 1),            x in -100 to 100                                 (1)
    q = s (x - 50) r / 100 * 360 / (N - 1),     x in 0 to 100                                    (2)

in degrees, where s is -1 if ``drive_mode`` is set. The homing offset is part of the counts already.
(Formulas: huggingface/lerobot, src/lerobot/motors/motors_bus.py, ``_normalize``.)
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sims.base import InputError
from sims.files import require_file

COUNTS = 4096
"""Counts of one turn of the encoder of a Feetech or Dynamixel servo."""
LARGEST_FILE = 1_000_000
"""Maximum number of bytes of a file that is looked at as a calibration."""
_KEYS = ("range_min", "range_max")


class MotorRange(NamedTuple):
    """The calibrated range of one motor, in counts, and whether its sign is turned."""

    lowest: float
    highest: float
    reversed: bool


class AngleScale(NamedTuple):
    """How a normalised position becomes an angle: ``gain`` times it plus ``offset``."""

    gain: float
    offset: float


def read_calibration(path: Path) -> dict[str, MotorRange]:
    """Read the ranges of all motors of a calibration file.

    Raises:
        InputError: it is no calibration file of LeRobot, in one line.
    """
    require_file(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{path}: expected JSON, a calibration file of LeRobot") from None
    motors = _motors(document)
    if motors is None:
        raise InputError(
            f"{path}: expected a calibration file of LeRobot, a table for each motor with "
            "range_min and range_max"
        )
    ranges = {}
    for name, own in motors.items():
        lowest, highest = float(own["range_min"]), float(own["range_max"])
        if not lowest < highest:
            raise InputError(
                f"{path}: {name}: expected range_min below range_max, found {lowest:g} and "
                f"{highest:g}; calibrate the robot again"
            )
        ranges[name] = MotorRange(lowest, highest, bool(own.get("drive_mode", 0)))
    return ranges


def find_calibration(folders: Iterable[Path]) -> Path | None:
    """Return the only calibration file in some folders; None if there is none, or several."""
    found = []
    for folder in folders:
        if not folder.is_dir():
            continue
        for path in sorted(folder.glob("*.json")):
            try:
                small = path.stat().st_size <= LARGEST_FILE
                document = json.loads(path.read_text(encoding="utf-8-sig")) if small else None
            except (OSError, ValueError, RecursionError):
                continue
            if _motors(document) is not None:
                found.append(path)
    return found[0] if len(found) == 1 else None


def motor_of(column: str, motors: Iterable[str]) -> str | None:
    """Return the motor whose name stands in that of a column; the longest of several."""
    named = [motor for motor in motors if motor.lower() in column.lower()]
    return max(named, key=len, default=None)


def angle_scale(motor: MotorRange, from_zero: bool) -> AngleScale:
    """Return how a normalised position becomes an angle, by (1), or by (2) if it is `from_zero`."""
    degrees = 360.0 / (COUNTS - 1) * (motor.highest - motor.lowest)
    sign = -1.0 if motor.reversed else 1.0
    if from_zero:
        return AngleScale(sign * degrees / 100.0, -sign * degrees / 2.0)
    return AngleScale(sign * degrees / 200.0, 0.0)


def range_scale(lowest: float, highest: float, from_zero: bool) -> AngleScale:
    """Return how a position that is normalised to a range becomes one in the unit of the range:
    -100 to 100, or 0 to 100 if it is `from_zero`.
    """
    width = highest - lowest
    if from_zero:
        return AngleScale(width / 100.0, lowest)
    return AngleScale(width / 200.0, (highest + lowest) / 2.0)


def _motors(document: Any) -> Mapping[str, Mapping[str, Any]] | None:
    """The tables of the motors; None where the document is something else."""
    if not isinstance(document, dict) or not document:
        return None
    for own in document.values():
        if not isinstance(own, dict):
            return None
        if not all(isinstance(own.get(key), int | float) for key in _KEYS):
            return None
    return document
