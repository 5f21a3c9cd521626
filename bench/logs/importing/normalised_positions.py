"""Normalised positions of LeRobot: -100 to 100 of a joint's range (0 to 100 for a gripper).

They look like degrees: only a calibration file or the user can distinguish them, not the numbers of
a dataset. With the calibrated range r = range_max - range_min of a motor in encoder counts,
N = 4096 counts per turn and the zero angle in the middle of the range, a position x is the angle

    q = s x r / 200 * 360 / (N - 1),            x in -100 to 100                                 (1)
    q = s (x - 50) r / 100 * 360 / (N - 1),     x in 0 to 100                                    (2)

in degrees, where s is -1 if ``drive_mode`` is set. The counts include the homing offset already.
(Formulas: huggingface/lerobot, src/lerobot/motors/motors_bus.py, ``_normalize``.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.logs.quality.quality_finding import Anomaly
from sims.core.simulator import Array, InputError
from sims.core.toml_validation import read_toml
from sims.recording.log_formats.lerobot_dataset import (
    MotorRange,
    find_calibration,
    read_calibration,
    split_episode_path,
)
from sims.recording.recording import Recording

if TYPE_CHECKING:  # A recording without a robot needs no model.
    from sims.robot.robot_model import Joint

MAX_NORMALISED = 100.0 + 1e-3
"""Largest magnitude of a normalised position, including the rounding of 32-bit floats."""
UNIT_REMEDY = (
    "if they are normalised, import them with --calibration FILE (LeRobot keeps it in "
    "~/.cache/huggingface/lerobot/calibration) or with --position-unit normalised (by the model's "
    "ranges); if they are degrees, with --position-unit deg"
)
"""Advice for positions that may be normalised."""


class NormalisedPositions(NamedTuple):
    """Conversion of the normalised positions of a log to angles.

    Attributes:
        motors: Calibrated ranges by motor; empty if only the model's ranges are known.
        source: The calibration file; None if there is none.
    """

    motors: Mapping[str, MotorRange]
    source: Path | None

    def get_position_scale(
        self, column: str, values: Array, joint: Joint
    ) -> tuple[str, AngleScale] | None:
        """Return the unit to which a column's positions are converted, and the conversion.

        The calibration of a hinge's motor gives angles in degrees. Without one, the normalised
        range is mapped to the range of the joint in the model. Grippers count from 0 to 100, other
        motors from -100 to 100.

        Args:
            column: Name of the column.
            values: (T,) numbers of the column.
            joint: Joint of the column.

        Returns:
            Unit and conversion; None if neither a calibration nor the model gives the joint's
            range.
        """
        from_zero = "gripper" in column.lower() and float(np.nanmin(values)) >= 0.0
        motor = find_motor(column, self.motors)
        # Encoder counts of a slide joint's motor are not metres, so the model's range is used.
        if motor is not None and joint.kind == "hinge":
            return "deg", compute_angle_scale(self.motors[motor], from_zero)
        if joint.range is None:
            return None
        return joint.unit, compute_range_scale(*joint.range, from_zero)

    @property
    def description(self) -> str:
        """The ranges to which the positions are normalised, as text."""
        ranges = "the joints' ranges in the model"
        if self.source is not None:
            ranges = f"the ranges in {self.source.name}, zero in the middle of each"
        return f"normalised, -100 to 100 (a gripper's 0 to 100) of {ranges}"


def find_position_conversion(
    log: Path, largest: float, stated_unit: str, calibration: Path | None
) -> NormalisedPositions | None:
    """Return the conversion of normalised positions to angles; None if they are angles already.

    They are normalised in two cases: the user says so or names a calibration file; or the user
    states no unit, they lie within -100 to 100, and a calibration file is in the LeRobot dataset or
    next to it.

    Args:
        log: Log that contains the positions.
        largest: Largest magnitude of the positions.
        stated_unit: Unit that the user states; empty if none is stated.
        calibration: Calibration file that the user names, or None.

    Raises:
        InputError: Positions stated as normalised are out of range, or the file cannot be read.
    """
    is_within_range = largest <= MAX_NORMALISED
    is_normalised = stated_unit == "normalised" or calibration is not None
    if is_normalised and not is_within_range:
        raise InputError(
            f"{log}: expected normalised positions within -100 to 100, found {largest:.4g}; leave "
            "out --calibration and --position-unit normalised"
        )
    if calibration is None and is_within_range and not stated_unit:
        # Only a log of a LeRobot dataset is an episode; its dataset may have a calibration file.
        episode = split_episode_path(log)
        if episode:
            dataset, _ = episode
            folders = [dataset, dataset / "meta", dataset / "calibration", dataset.parent]
            calibration = find_calibration(folders)
        is_normalised = calibration is not None
    if not is_normalised:
        return None
    motors = read_calibration(calibration) if calibration is not None else {}
    return NormalisedPositions(motors, calibration)


def is_lerobot(log: Path, columns: Iterable[str]) -> bool:
    """Return whether a log is from LeRobot: an episode, or a table with its column names."""
    names = ("observation.state", "observation/state")
    return split_episode_path(log) is not None or any(
        column.startswith(names) for column in columns
    )


def check_normalised_positions(recording: Recording) -> Iterator[Anomaly]:
    """Yield an anomaly if positions of a LeRobot dataset may be normalised and not in degrees.

    That is so if the description states degrees and all positions lie within -100 to 100. A `scale`
    in the description shows that the user knows the unit, so channels with one are not checked.

    Args:
        recording: the recording, whose description lies next to its table.
    """
    description = recording.path.with_suffix(".toml")
    if not description.is_file():
        return
    meta = read_toml(description)
    channels = meta.get("channels")
    if not isinstance(channels, dict) or not _has_dataset_episodes(description, meta):
        return
    names_in_degrees = [
        name
        for name, table in channels.items()
        if name.startswith("q.")
        and isinstance(table, dict)
        and str(table.get("unit", "")).startswith("deg")
        and "scale" not in table
    ]
    # Largest magnitude in each run; the values of a recording are in radians.
    largest_angles = [
        float(np.nanmax(np.abs(run.channels[name]), initial=0.0))
        for run in recording.runs
        for name in names_in_degrees
        if name in run.channels
    ]
    if largest_angles and np.degrees(max(largest_angles)) <= MAX_NORMALISED:
        yield Anomaly(
            "positions of a LeRobot dataset are read as degrees and lie within -100 to 100, as "
            f"normalised ones do; {UNIT_REMEDY} (scale = 1 in the description)",
            False,
        )


def _has_dataset_episodes(description: Path, meta: Mapping[str, object]) -> bool:
    """Return whether the runs of a description are episodes of a LeRobot dataset.

    The first run that states its folder decides.

    Args:
        description: path of the description, to which folders are relative.
        meta: content of the description.
    """
    runs = meta.get("runs")
    tables = runs.values() if isinstance(runs, dict) else ()
    folder = next((table.get("folder") for table in tables if isinstance(table, dict)), None)
    if not isinstance(folder, str):
        return False
    # The name of a log in the folder of an episode; the log itself need not exist.
    return split_episode_path(description.parent / folder / "frames") is not None


COUNTS_PER_TURN = 4096
"""Encoder counts per turn of a Feetech or Dynamixel servo."""


class AngleScale(NamedTuple):
    """Conversion of a normalised position to an angle: ``gain`` * position + ``offset``."""

    gain: float
    offset: float


def find_motor(column: str, motors: Iterable[str]) -> str | None:
    """Return the motor whose name is part of a column's name; the longest one if several match.

    Returns:
        The name of the motor; None if none matches.
    """
    matching_motors = [motor for motor in motors if motor.lower() in column.lower()]
    return max(matching_motors, key=len, default=None)


def compute_angle_scale(motor: MotorRange, from_zero: bool) -> AngleScale:
    """Return the conversion of a normalised position x to an angle q in degrees.

    With the calibrated range r in encoder counts, N = 4096 counts per turn, and the sign s of the
    motor, it is

    * q = s x r / 200 * 360 / (N - 1) for x in -100 to 100 (1)
    * q = s (x - 50) r / 100 * 360 / (N - 1) for x in 0 to 100 (2)

    Args:
        motor: Calibrated range of the motor.
        from_zero: Whether positions are 0 to 100 (2) instead of -100 to 100 (1).
    """
    # Angle over which the normalised position goes through its whole range.
    degrees = 360.0 / (COUNTS_PER_TURN - 1) * (motor.highest - motor.lowest)
    sign = -1.0 if motor.reversed else 1.0
    if from_zero:
        return AngleScale(sign * degrees / 100.0, -sign * degrees / 2.0)
    return AngleScale(sign * degrees / 200.0, 0.0)


def compute_range_scale(lowest: float, highest: float, from_zero: bool) -> AngleScale:
    """Return the conversion of a normalised position to a position between two given ends.

    Args:
        lowest: Lower end of the range.
        highest: Upper end of the range, in the same unit.
        from_zero: Whether positions are 0 to 100 instead of -100 to 100.
    """
    width = highest - lowest
    if from_zero:
        return AngleScale(width / 100.0, lowest)
    return AngleScale(width / 200.0, (highest + lowest) / 2.0)
