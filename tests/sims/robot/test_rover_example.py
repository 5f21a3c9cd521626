"""Tests of examples/rover: rolling wheels without MuJoCo, and the diagnosis of a bearing."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.diagnosis.explain import explain
from tests.example_logs import rover

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "rover"


def read_angles(poses):
    return Rotation.from_quat(np.roll(poses[:, 3:7], -1, axis=1)).as_euler("ZYX")


def test_the_log_is_that_of_the_script(tmp_path):
    assert rover.write_log(tmp_path).read_bytes() == (EXAMPLE / "log.csv").read_bytes()


def test_wheels_roll_without_slip():
    """The pose is the integral of the wheels' speeds, by the kinematics of a differential drive."""
    times, _, rows = rover.drive(1)
    turned = rows[-1, 7:] * rover.RADIUS
    yaw = np.unwrap(read_angles(rows)[:, 0])
    assert yaw[-1] == pytest.approx((turned[1] - turned[0]) / rover.TRACK, abs=1e-9)
    forward = np.gradient(rows[:, :2], times, axis=0)
    speed = np.gradient(rows[:, 7:], times, axis=0).sum(axis=1) * rover.RADIUS / 2
    directions = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    np.testing.assert_allclose((forward * directions).sum(axis=1)[5:-5], speed[5:-5], atol=2e-4)


def test_it_moves_as_mujoco_moves_the_model_with_a_dragging_bearing():
    """Contacts of MuJoCo creep, so that wheels slip by millimetres in three seconds."""
    model = mujoco.MjModel.from_xml_path(str(EXAMPLE / "rover.xml"))
    model.dof_damping[model.joint("left").dofadr[0]] = rover.DAMPING[0]
    _, commands, rows = rover.drive(2)
    data = mujoco.MjData(model)
    data.qpos[:] = rows[0]
    poses = []
    for command in commands:
        poses.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(model, data, nstep=5)
    poses = np.array(poses)
    np.testing.assert_allclose(poses[:, :3], rows[:, :3], atol=2e-3)
    np.testing.assert_allclose(poses[:, 7:], rows[:, 7:], atol=1.5e-2)
    np.testing.assert_allclose(read_angles(poses), read_angles(rows), atol=5e-3)


@pytest.mark.long
def test_the_dragging_bearing_is_found():
    answer = explain(EXAMPLE / "log.csv").answer
    assert [cause.effect for cause in answer.causes] == ["drag.linear@left"]
    (coefficient,) = answer.causes[0].coefficients.values()
    assert coefficient.value == pytest.approx(0.01, rel=0.02)
