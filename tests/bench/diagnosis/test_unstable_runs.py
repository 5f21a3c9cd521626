"""Tests that explain answers for torque-driven arms whose motion is unstable without feedback.

Plain MuJoCo makes the motion: a controller holds an arm near its upright pose, and the log has the
torques. A simulation with these torques amplifies any error of its first state.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis import explain as explaining
from tests.exams.robot_files import write_robot_recording

NOISE = 5e-4
STATED, PLANTED = 0.1, 0.5
JOINTS = ("lower", "middle", "upper")
PD_GAINS = np.array([[150.0, 60.0, 15.0], [20.0, 6.0, 1.0]])


def arm(damping):
    """Return the MJCF text of an upright chain of three links with a damping in its middle."""
    bodies, ends = "", ""
    for name in JOINTS:
        bodies += (
            f'<body name="{name}" pos="0 0 {0.4 * bool(bodies)}"><joint name="{name}" axis="0 1 0" '
            f'damping="{damping if name == "middle" else STATED}" armature="0.02"/>'
            '<inertial pos="0 0 0.2" mass="1.2" diaginertia="0.02 0.02 0.002"/>'
        )
        ends += "</body>"
    motors = "".join(f'<motor name="m_{name}" joint="{name}"/>' for name in JOINTS)
    return (
        '<mujoco model="chain"><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{bodies}{ends}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def write_log(folder, damping):
    """Write three runs of the arm with a damping, and the file that states `STATED`."""
    model, rng = mujoco.MjModel.from_xml_string(arm(damping)), np.random.default_rng(7)
    times, runs = 0.01 * np.arange(301), {}
    for run in ("1", "2", "3"):
        data = mujoco.MjData(model)
        phases, rates = rng.uniform(0, 6.3, (3, 2)), rng.uniform(2, 9, (3, 2))
        commands, readings = np.zeros((301, 3)), np.zeros((301, 3))
        for k, t in enumerate(times):
            wanted = 0.2 * np.sin(rates * t + phases).sum(1)
            torque = PD_GAINS[0] * (wanted - data.qpos) - PD_GAINS[1] * data.qvel
            commands[k] = [float(f"{value:.9g}") for value in torque]
            readings[k] = data.qpos + NOISE * rng.standard_normal(3)
            data.ctrl[:] = commands[k]
            mujoco.mj_step(model, data, 5)
        runs[run] = (run == "3", times, commands, readings)
    return write_robot_recording(
        folder,
        "log",
        {f"u.m_{name}": "N*m" for name in JOINTS},
        {f"q.{name}": ("rad", NOISE) for name in JOINTS},
        runs,
        ("arm.xml", arm(STATED)),
    )


def test_a_planted_damping_is_found_in_pieces(tmp_path):
    lines = []
    found = explaining.explain(write_log(tmp_path, PLANTED), say=lines.append)
    assert (found.verdict, [cause.effect for cause in found.causes]) == (
        "named",
        ["drag.linear@middle"],
    )
    (number,) = found.causes[0].coefficients.values()
    assert number.value == pytest.approx(PLANTED - STATED, rel=0.05)
    assert any("cut into pieces of" in line for line in lines)


def test_nothing_is_missing_where_nothing_was_planted(tmp_path):
    path = write_log(tmp_path, STATED)
    assert explaining.explain(path).verdict == "adequate"
