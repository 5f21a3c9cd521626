"""Tests of recorded poses of floating bodies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sims.core.angles_and_quaternions import compute_yaw_pitch_roll
from sims.core.simulator import InputError
from sims.recording.recorded_poses import convert_quaternions, find_recorded_bases

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
QUATERNION = [f"q.hull.{entry}" for entry in ("qw", "qx", "qy", "qz")]
POSITION = [f"q.hull.{axis}" for axis in "xyz"]
ANGLES = [f"q.hull.{angle}" for angle in ("yaw", "pitch", "roll")]


def quaternions_of(rotations):
    return np.roll(np.atleast_2d(rotations.as_quat()), 1, axis=1)


def test_angles_are_those_of_scipy_relative_to_the_model_file():
    angles = np.random.default_rng(3).uniform(-1.2, 1.2, (40, 3))
    reference = Rotation.from_euler("XYZ", [0.4, -0.9, 2.0])
    rotations = Rotation.from_euler("ZYX", angles) * reference
    found = compute_yaw_pitch_roll(quaternions_of(rotations), np.roll(reference.as_quat(), 1))
    assert found == pytest.approx(angles, abs=1e-12)


def test_whole_turns_are_restored_and_missing_samples_stay_missing():
    yaw = np.linspace(0.0, 9.0, 60)
    values = quaternions_of(Rotation.from_euler("z", yaw[:, None]))
    # The same orientation has two quaternions.
    values[::2] *= -1.0
    values[7] = np.nan
    channels = dict(zip(QUATERNION, values.T, strict=True)) | {"q.arm": yaw}
    converted = convert_quaternions(channels, "hull", UPRIGHT, "log.csv: run 1")
    assert set(converted) == {*ANGLES, "q.arm"}
    expected = np.where(np.arange(60) == 7, np.nan, yaw)
    assert converted["q.hull.yaw"] == pytest.approx(expected, abs=1e-12, nan_ok=True)


@pytest.mark.parametrize(
    ("quaternion", "message"),
    [
        ([2.0, 0.0, 0.0, 0.0], "sample 2.*length 1, found one of length 2"),
        (quaternions_of(Rotation.from_euler("y", [1.5]))[0], "pitch of 86 degrees"),
    ],
)
def test_orientations_without_angles_are_refused(quaternion, message):
    values = np.array([UPRIGHT, quaternion])
    channels = dict(zip(QUATERNION, values.T, strict=True))
    with pytest.raises(InputError, match=message):
        convert_quaternions(channels, "hull", UPRIGHT, "log.csv: run 1")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (POSITION + QUATERNION, ["hull"]),
        (POSITION + ANGLES, ["hull"]),
        (QUATERNION, ["hull"]),  # a ball joint
        (ANGLES, []),  # hinges of a head, for example
        (QUATERNION[:3], []),
    ],
)
def test_bases_are_found_by_their_whole_pose(names, expected):
    assert find_recorded_bases(names) == expected
