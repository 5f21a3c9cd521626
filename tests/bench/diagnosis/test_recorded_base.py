"""Tests of recordings of flying robots, whose pose is measured by motion capture.

Plain MuJoCo simulates the free joint with a controller; explain sees commands and noisy poses.
"""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.diagnosis.explain import explain
from sims.core.simulator import InputError
from tests.command_output import run_command
from tests.example_logs import drone
from tests.exams.robot_files import write_robot_recording

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "drone"

QUADROTOR = """<mujoco model="quadrotor">
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint name="base"/>
      <inertial pos="0.001 0 0" mass="0.6" diaginertia="0.004 0.0045 0.007"/>
      <site name="rotor1" pos="0.12 0.12 0"/>
      <site name="rotor2" pos="-0.12 0.12 0"/>
      <site name="rotor3" pos="-0.12 -0.12 0"/>
      <site name="rotor4" pos="0.12 -0.12 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="m1" site="rotor1" gear="0 0 1 0 0 0.02"/>
    <motor name="m2" site="rotor2" gear="0 0 1 0 0 -0.02"/>
    <motor name="m3" site="rotor3" gear="0 0 1 0 0 0.02"/>
    <motor name="m4" site="rotor4" gear="0 0 1 0 0 -0.02"/>
  </actuator>
</mujoco>
"""
MASS, INERTIA, ARM, TORQUE_RATIO = 0.6, np.array([0.004, 0.0045, 0.007]), 0.12, 0.02
"""Mass (kg), moments of inertia (kg m^2), distances of the rotors (m), torque by thrust (m)."""
RATE = 100
POSITION_NOISE, QUATERNION_NOISE = 3e-4, 5e-4
SIGNS = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]])
"""Contribution of each rotor to thrust, and to the torques about x, y and z."""


def fly(change, seed, seconds):
    """Return times (T,), thrusts (T, 4) in N, and poses (T, 7) of a controlled flight."""
    model = mujoco.MjModel.from_xml_string(QUADROTOR)
    change(model)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    times = np.arange(round(seconds * RATE) + 1) / RATE
    frequencies = 2 * np.pi * rng.uniform((0.2, 0.5, 1.0), (0.5, 1.0, 2.0), (4, 3))
    waves = np.sin(frequencies[..., None] * times) * np.array([0.6, 0.3, 0.15])[:, None]
    targets = np.array([0.5, 0.5, 0.3, 0.6])[:, None] * waves.sum(axis=1)
    mixer = np.linalg.inv(SIGNS * np.array([1.0, ARM, ARM, TORQUE_RATIO])[:, None])
    thrusts, poses = [], []
    for target in targets.T:
        yaw, pitch, roll = Rotation.from_quat(np.roll(data.qpos[3:7], -1)).as_euler("ZYX")
        acceleration = 6.0 * (target[:3] - data.qpos[:3] + [0, 0, 1]) - 4.5 * data.qvel[:3]
        ahead = acceleration[0] * np.cos(yaw) + acceleration[1] * np.sin(yaw)
        aside = acceleration[0] * np.sin(yaw) - acceleration[1] * np.cos(yaw)
        tilt = np.clip(np.array([aside, ahead]) / 9.81, -0.5, 0.5)
        errors = np.array([tilt[0] - roll, tilt[1] - pitch, target[3] - yaw])
        torques = INERTIA * ([150, 150, 20] * errors - [20, 20, 6] * data.qvel[3:6])
        lift = MASS * (9.81 + acceleration[2]) / (np.cos(pitch) * np.cos(roll))
        command = np.clip(mixer @ [lift, *torques], 0.0, 4.0)
        thrusts.append([float(f"{value:.9g}") for value in command])
        poses.append(data.qpos.copy())
        data.ctrl[:] = thrusts[-1]
        mujoco.mj_step(model, data, nstep=round(1 / RATE / model.opt.timestep))
    return times, np.array(thrusts), np.array(poses)


def write_flights(folder, change, seed=0, seconds=2.0):
    """Write three flights, of which the last is held out, and return the path of the table."""
    noise = np.array([POSITION_NOISE] * 3 + [QUATERNION_NOISE] * 4)
    rng, runs = np.random.default_rng(seed + 100), {}
    for number, name in enumerate(("1", "2", "3")):
        times, thrusts, poses = fly(change, 10 * seed + number, seconds)
        runs[name] = (name == "3", times, thrusts, poses + noise * rng.standard_normal(poses.shape))
    channels = {f"q.base.{axis}": ("m", POSITION_NOISE) for axis in "xyz"}
    channels |= {f"q.base.q{entry}": ("1", QUATERNION_NOISE) for entry in "wxyz"}
    inputs = {f"u.m{i}": "N" for i in (1, 2, 3, 4)}
    return write_robot_recording(
        folder, "log", inputs, channels, runs, ("quadrotor.xml", QUADROTOR)
    )


def keep(_):
    """Change nothing."""


def add_load(model):
    model.body_mass[1] += 0.09
    mujoco.mj_setConst(model, mujoco.MjData(model))


def shift_centre_of_mass(model):
    model.body_ipos[1, 0] += 0.01
    mujoco.mj_setConst(model, mujoco.MjData(model))


def test_a_flight_that_the_model_predicts_is_adequate(tmp_path):
    assert explain(write_flights(tmp_path, keep), jobs=1).answer.verdict == "adequate"


@pytest.mark.long
def test_the_weak_rotor_of_the_example_is_named_and_written_into_the_file(tmp_path):
    log, out = EXAMPLE / "log.csv", tmp_path / "mine"
    run_command("explain", log, "--out", out, "--jobs", "1")
    verdict = json.loads((out / "verdict.json").read_text())
    (cause,) = verdict["causes"]
    assert verdict["verdict"] == "named"
    assert (cause["effect"], cause["alternatives"]) == ("input.gain@m3", [])
    number = cause["coefficients"]["coefficient"]["value"]
    assert number == pytest.approx(drone.EFFICIENCY[2] - 1.0, abs=1e-3)
    model = mujoco.MjModel.from_xml_path(str(out / "extended.xml"))
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_FREE]
    thrusts = model.actuator_gear[:, 2] * model.actuator_gainprm[:, 0]
    assert thrusts == pytest.approx([1.0, 1.0, 1.0 + number, 1.0], abs=1e-4)
    # Both files predict the held-out flight down to the noise.
    for name in ("extended.toml", "extended.xml"):
        run_command("score", out / name, log, "--held-out")


@pytest.mark.slow
def test_a_load_is_named_rather_than_several_commands(tmp_path):
    answer = explain(write_flights(tmp_path, add_load), jobs=1).answer
    assert answer.verdict == "named"
    (cause,) = answer.causes
    assert cause.effect == "payload@hull"
    assert cause.coefficients["mass"].value == pytest.approx(0.09, rel=1e-2)


@pytest.mark.slow
def test_an_unstable_flight_is_explained_in_short_pieces(tmp_path):
    notes = []
    log = write_flights(tmp_path, shift_centre_of_mass, seconds=2.5)
    answer = explain(log, jobs=1, say=notes.append).answer
    assert any("cut into pieces" in note for note in notes)
    (cause,) = answer.causes
    assert cause.effect == "mass.offset@hull"
    assert cause.coefficients["x"].value == pytest.approx(0.01, rel=0.02)


def test_the_log_of_the_example_is_what_its_script_writes(tmp_path):
    written = drone.write_log(tmp_path).read_text().splitlines()
    stored = (EXAMPLE / "log.csv").read_text().splitlines()
    assert written[0] == stored[0]
    tables = [
        np.array([row.split(",") for row in rows[1:]], dtype=float) for rows in (written, stored)
    ]
    assert tables[0] == pytest.approx(tables[1], abs=2e-5)


def test_an_incomplete_pose_is_refused(tmp_path):
    log = write_flights(tmp_path, keep)
    description = log.with_suffix(".toml")
    text = description.read_text().replace('"q.base.qz"', '"q.base.yaw"')
    description.write_text(text)
    log.write_text(log.read_text().replace("q.base.qz", "q.base.yaw"))
    with pytest.raises(InputError, match=r"q\.base"):
        explain(log, jobs=1)
