"""Read calibration files of LeRobot, which convert normalised positions to angles.

A file has a table for each motor, ``{"elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": 85,
"range_min": 820, "range_max": 3110}}``, in counts of the encoder. In a dataset, a position x is
-100 to 100 of that range, or 0 to 100 for a gripper. With the range r = range_max - range_min,
N = 4096 counts per turn and the zero angle in the middle of the range, the angle is

    q = s x r / 200 * 360 / (N - 1),            x in -100 to 100                                 (1)
    q = s (x - 50) r / 100 * 360 / (N - 1),     x in 0 to 100                                    (2)

in degrees, where s is -1 if ``drive_mode`` is set. The counts include the homing offset already.
(Formulas: huggingface/lerobot, src/lerobot/motors/motors_bus.py, ``_normalize``.)
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sims.core.path_checks import require_file
from sims.core.simulator import InputError

COUNTS_PER_TURN = 4096
"""Encoder counts per turn of a Feetech or Dynamixel servo."""
MAX_FILE_BYTES = 1_000_000
"""Maximum size of a file that is read as a possible calibration, in bytes."""
_KEYS = ("range_min", "range_max")


class MotorRange(NamedTuple):
    """Calibrated range of one motor in counts, and whether its sign is reversed."""

    lowest: float
    highest: float
    reversed: bool


class AngleScale(NamedTuple):
    """Conversion of a normalised position to an angle: ``gain`` * position + ``offset``."""

    gain: float
    offset: float


def read_calibration(path: Path) -> dict[str, MotorRange]:
    """Read the ranges of all motors from a calibration file.

    The file states which positions of a motor, in encoder counts, are the ends of the
    normalised range.

    Raises:
        InputError: The file is not a calibration file of LeRobot; the message is one line.
    """
    require_file(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{path}: expected JSON, a calibration file of LeRobot") from None
    motors = _get_motor_tables(document)
    if motors is None:
        raise InputError(
            f"{path}: expected a calibration file of LeRobot, a table for each motor with "
            "range_min and range_max"
        )
    ranges = {}
    for name, motor in motors.items():
        lowest, highest = float(motor["range_min"]), float(motor["range_max"])
        if not lowest < highest:
            raise InputError(
                f"{path}: {name}: expected range_min below range_max, found {lowest:g} and "
                f"{highest:g}; calibrate the robot again"
            )
        ranges[name] = MotorRange(lowest, highest, bool(motor.get("drive_mode", 0)))
    return ranges


def find_calibration(folders: Iterable[Path]) -> Path | None:
    """Return the only calibration file in some folders; None if there is none or more than one."""
    calibration_files = []
    for folder in folders:
        if not folder.is_dir():
            continue
        for path in sorted(folder.glob("*.json")):
            try:
                small = path.stat().st_size <= MAX_FILE_BYTES
                document = json.loads(path.read_text(encoding="utf-8-sig")) if small else None
            except (OSError, ValueError, RecursionError):
                continue
            if _get_motor_tables(document) is not None:
                calibration_files.append(path)
    return calibration_files[0] if len(calibration_files) == 1 else None


def motor_of(column: str, motors: Iterable[str]) -> str | None:
    """Return the motor whose name is part of a column's name; the longest one if several match.

    Args:
        column: Name of the column.
        motors: Names of the motors.

    Returns:
        The name of the motor; None if none matches.
    """
    matching_motors = [motor for motor in motors if motor.lower() in column.lower()]
    return max(matching_motors, key=len, default=None)


def compute_angle_scale(motor: MotorRange, from_zero: bool) -> AngleScale:
    """Return the conversion of a normalised position to an angle in degrees.

    Args:
        motor: Calibrated range of the motor.
        from_zero: Whether positions are 0 to 100, equation (2), instead of -100 to 100, equation
            (1).
    """
    degrees = 360.0 / (COUNTS_PER_TURN - 1) * (motor.highest - motor.lowest)
    sign = -1.0 if motor.reversed else 1.0
    if from_zero:
        return AngleScale(sign * degrees / 100.0, -sign * degrees / 2.0)
    return AngleScale(sign * degrees / 200.0, 0.0)


def range_scale(lowest: float, highest: float, from_zero: bool) -> AngleScale:
    """Return the conversion of a normalised position to the unit of its range.

    Args:
        lowest: Lower end of the range.
        highest: Upper end of the range, in the same unit.
        from_zero: Whether positions are 0 to 100 instead of -100 to 100.
    """
    width = highest - lowest
    if from_zero:
        return AngleScale(width / 100.0, lowest)
    return AngleScale(width / 200.0, (highest + lowest) / 2.0)


def _get_motor_tables(document: Any) -> Mapping[str, Mapping[str, Any]] | None:
    """Return the tables of the motors; None if the document is not a calibration."""
    if not isinstance(document, dict) or not document:
        return None
    for motor in document.values():
        if not isinstance(motor, dict):
            return None
        if not all(isinstance(motor.get(key), int | float) for key in _KEYS):
            return None
    return document
