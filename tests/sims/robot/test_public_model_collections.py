"""Tests with public model files: all of PyBullet, some of gymnasium and example-robot-data, and the
SO-101.
"""

import importlib.util
import os
import re
import sysconfig
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.robot.parsing.read_model_file import read_robot

ENDINGS = (".urdf", ".xml", ".mjcf")
ROBOTS = Path(__file__).parents[4] / "shared" / "robots"
"""Folder of robots with their logs, on machines that have it."""

REFUSED = {
    "none of its N joints moves": 1051,
    "global coordinates no longer supported": 2,
    "bad format in attribute": 2,
    "attribute 'rpy' has too much data": 1,
    "attribute 'scale' has too much data": 1,
    "$(optenv": 1,
    "joint 'left_hip_y' not found in tendon": 1,
    "plane size(3) must be positive": 1,
    "required attribute missing": 1,
    "invalid keyword": 1,
    "material 'geom' not found": 1,
    "Schema violation": 1,
}
"""Numbers of refused files of PyBullet 3.2.7, by the start of the reason: single links without a
joint, MJCFs of 2014, and values that cannot be read.
"""


def shipped_by_pybullet():
    data = pytest.importorskip("pybullet_data").getDataPath()
    return [path for path in sorted(Path(data).rglob("*")) if path.suffix in ENDINGS]


def test_all_that_pybullet_ships_is_read_or_refused_in_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    paths = shipped_by_pybullet()
    causes, read_ones, clean = Counter(), 0, 0
    for path in paths:
        try:
            robot = read_robot(path)
        except InputError as error:
            message = str(error)
            assert message.startswith(str(path))
            assert "\n" not in message
            cause = re.sub(r"its \d+", "its N", message.split(": ", 1)[1])
            causes[next((begin for begin in REFUSED if cause.startswith(begin)), cause)] += 1
            continue
        read_ones, clean = read_ones + 1, clean + (not robot.notes)
        assert robot.joints
        assert all(body.mass >= 0 for body in robot.bodies)
        assert all(note == note.strip() and "\n" not in note for note in robot.notes)
        assert np.isfinite(robot.compiled.body_inertia).all()
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == []
    assert len(paths) > 1100
    assert dict(causes) == REFUSED
    assert (read_ones, clean) == (57, 4)


@pytest.mark.parametrize(
    ("name", "joints", "mass", "actuators"),
    [
        ("inverted_pendulum", 2, 15.489, 1),
        ("reacher", 4, 0.07845, 2),
        ("hopper", 6, 15.82, 3),
        ("pusher_v5", 11, 13.673, 7),
    ],
)
def test_gymnasiums(name, joints, mass, actuators):
    found = importlib.util.find_spec("gymnasium")
    if found is None:
        pytest.skip("gymnasium is not installed")
    robot = read_robot(Path(found.origin).parent / "envs/mujoco/assets" / f"{name}.xml")
    assert len(robot.joints) == joints
    assert len(robot.actuators) == actuators
    assert sum(body.mass for body in robot.bodies) == pytest.approx(mass, rel=1e-3)


def described(name):
    """Read a file of example-robot-data."""
    folder = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix/share/example-robot-data/robots"
    if not (folder / name).is_file():
        pytest.skip(f"example-robot-data is not installed: no {name}")
    return read_robot(folder / name)


@pytest.mark.parametrize(
    ("name", "masses", "efforts"),
    [
        (
            "ur_description/urdf/ur5_robot.urdf",
            [3.7, 8.393, 2.275, 1.219, 1.219, 0.1879],
            [150, 150, 150, 28, 28, 28],
        ),
        (
            "double_pendulum_description/urdf/double_pendulum.urdf",
            [0.26703, 0.33238],
            [None, None],
        ),
    ],
)
def test_arms_that_are_known(name, masses, efforts):
    robot = described(name)
    assert [body.mass for body in robot.bodies] == pytest.approx(masses, rel=1e-6)
    assert [joint.effort for joint in robot.joints] == efforts


def test_a_panda():
    robot = described("panda_description/urdf/panda.urdf")
    assert len(robot.joints) == 9
    assert robot.compiled.neq == 1  # the second finger mimics the first
    assert robot.body("panda_hand").name == "panda_link7"
    assert [joint.effort for joint in robot.joints] == [87] * 4 + [12] * 3 + [100] * 2


def test_an_so101_without_its_meshes():
    path = Path(os.environ.get("SIMGAP_ROBOTS", ROBOTS)) / "so101" / "so101.urdf"
    if not path.is_file():
        pytest.skip(f"no robots: {path} is missing (set SIMGAP_ROBOTS)")
    robot = read_robot(path)
    assert [joint.name for joint in robot.joints] == [
        "shoulder_pan",
        "shoulder_lift",
        "elbow_flex",
        "wrist_flex",
        "wrist_roll",
        "gripper",
    ]
    assert all(joint.effort == 10 for joint in robot.joints)
    assert sum(body.mass for body in robot.bodies) == pytest.approx(0.485, abs=1e-3)
