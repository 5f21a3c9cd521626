"""Tests of commands that are copies of the measurement: found, named, and corrected if possible."""

import mujoco
import numpy as np
import pytest

from bench.logs.quality.servo_checks import find_copied_commands
from bench.logs.recording_loading import load_recording
from tests.bench.diagnosis.simulated_logs import follow, write_log
from tests.command_output import run_command

ARM = """<mujoco model="arm"><option timestep="0.002"/><worldbody>
<body><joint name="hip" axis="0 1 0" damping="0.1" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
<body pos="0.3 0 0"><joint name="knee" axis="0 1 0" damping="0.1" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/></body></body></worldbody>
<actuator><position name="m_hip" joint="hip" kp="80" kv="6"/>
<position name="m_knee" joint="knee" kp="60" kv="5"/></actuator></mujoco>"""
TOML = """model = "arm.xml"
[time]
column = "t"
unit = "s"
[runs.a]
file = "a.csv"
[runs.b]
file = "b.csv"
[channels."q.hip"]
column = "hip_pos"
unit = "rad"
[channels."q.knee"]
column = "knee_pos"
unit = "rad"
[inputs."u.m_hip"]
column = "hip_cmd"
unit = "rad"
[inputs."u.m_knee"]
column = "knee_act"
unit = "rad"
"""


def written(folder, with_commands=True, noise=0.0):
    """Write raw logs whose column `knee_act` is the measured position of the knee."""
    rng, times = np.random.default_rng(4), 0.01 * np.arange(300)
    names = ["hip_pos", "knee_pos", "hip_cmd", "knee_act", *["knee_cmd"] * with_commands]
    model = mujoco.MjModel.from_xml_string(ARM)
    for name in "ab":
        commands = 0.5 * np.sin(np.outer(times, [3.0, 4.0]) + rng.uniform(0, 6, 2))
        q = follow(model, commands, 5) + 1e-4 * rng.standard_normal(commands.shape)
        copy = q[:, 1] + noise * rng.standard_normal(times.size)
        columns = [times, q, commands[:, 0], copy, *[commands[:, 1]] * with_commands]
        write_log(folder, "", ",".join(names), [columns], name, arm=ARM)
    (folder / "log.toml").write_text(TOML)
    return folder / "log.toml"


def test_a_copy_is_found_and_the_unused_command_is_offered(tmp_path):
    log = written(tmp_path)
    message = " ".join(
        run_command("explain", log, "--out", tmp_path / "out", "--jobs", "1", code=2).err.split()
    )
    assert "command u.m_knee equals q.knee digit for digit: it is a copy of the" in message
    assert '[inputs."u.m_knee"] column = "knee_cmd"' in message
    assert not (tmp_path / "out").exists()
    fixed = tmp_path / "fixed.toml"
    arguments = ["inspect", str(log), "--fix", str(fixed), "--out", str(tmp_path / "look")]
    run_command(*arguments)
    recording, kind = load_recording(fixed)
    assert list(find_copied_commands(recording, kind)) == []
    assert np.ptp(recording.runs[0].inputs["u.m_knee"]) > 0.9


def test_without_another_column_the_command_must_be_named(tmp_path):
    log = written(tmp_path, with_commands=False)
    arguments = ["inspect", str(log), "--out", str(tmp_path / "look")]
    message = " ".join(
        run_command(*arguments, "--fix", tmp_path / "fixed.toml", code=2).err.split()
    )
    assert "no column of the log can be the command u.m_knee; record it, or write its" in message
    assert not (tmp_path / "fixed.toml").exists()


@pytest.mark.parametrize("noise", [1e-6, 1e-3])
def test_a_command_that_is_close_to_the_measurement_is_no_copy(tmp_path, noise):
    recording, kind = load_recording(written(tmp_path, noise=noise))
    assert list(find_copied_commands(recording, kind)) == []
