"""Tests of examples/robot: an arm with its own equations of motion, and a model without its
friction.
"""

import csv
import io
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.core.toml_validation import read_toml
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.example_logs import robot_arm

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "robot"


def rolled(model, initial, torques, rate):
    """Return positions (T, joints) from MuJoCo, with each torque constant until the next sample."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial[:2], initial[2:]
    positions = [data.qpos.copy()]
    for torque in torques[:-1]:
        data.ctrl[:] = torque
        mujoco.mj_step(model, data, round(1 / (rate * model.opt.timestep)))
        positions.append(data.qpos.copy())
    return np.array(positions)


def numbers(table):
    rows = list(csv.reader(io.StringIO(table)))
    return rows[0], np.array(rows[1:], dtype=float)


@pytest.mark.parametrize(("step", "tolerance"), [(0.0002, 1e-8), (0.002, 1e-7)])
def test_without_friction_it_moves_as_mujoco_moves_the_model(step, tolerance):
    model = read_robot(EXAMPLE / "arm2.xml").spec.compile()
    assert model.opt.timestep == 0.002
    model.opt.timestep = step
    initial = np.array([0.4, -0.3, 1.0, -2.0])
    own = robot_arm.Arm().simulate(initial, robot_arm.torques_of(1))
    simulated = rolled(model, initial, robot_arm.torques_of(1), robot_arm.RATE)
    assert np.all(np.ptp(own, axis=0) > 0.8)
    np.testing.assert_allclose(own, simulated, rtol=0, atol=tolerance)


def test_dry_friction_in_mujoco_sticks_as_it_does_there():
    """The model's own step is 2 ms; with MuJoCo's default settings the error is ten times as
    large.
    """
    kind = make_robot_simulator(read_robot(EXAMPLE / "arm2.xml"))
    effect = "friction.coulomb@elbow"
    simulator = kind(observe=["q.shoulder", "q.elbow"], effects=[effect])
    torques = robot_arm.torques_of(1)
    inputs = {"u.m_shoulder": torques[:, 0], "u.m_elbow": torques[:, 1]}
    scenario = Scenario(np.arange(len(torques)) / robot_arm.RATE, {}, inputs)
    simulated = simulator.simulate(np.array([[robot_arm.FRICTION]]), scenario)[0]
    true = robot_arm.Arm(friction=robot_arm.FRICTION).simulate(np.zeros(4), torques)
    assert np.sqrt(np.mean((simulated - true) ** 2)) < 0.9e-4


def test_the_log_is_what_the_script_makes():
    head, made = numbers(robot_arm.table())
    shipped_head, shipped = numbers((EXAMPLE / "log.csv").read_text())
    assert head == shipped_head
    np.testing.assert_allclose(shipped, made, rtol=0, atol=1.5e-5)  # one unit of the last digit


def test_the_log_says_what_the_script_did():
    said = read_toml(EXAMPLE / "log.toml")
    head, rows = numbers((EXAMPLE / "log.csv").read_text())
    assert set(head[2:]) == {*said["channels"], *said["inputs"]}
    assert {channel["noise"] for channel in said["channels"].values()} == {robot_arm.NOISE}
    assert [set(rows[:, 0]), said["runs"]] == [
        set(robot_arm.RUNS),
        {"5": {"held_out": True}, "6": {"held_out": True}},
    ]
