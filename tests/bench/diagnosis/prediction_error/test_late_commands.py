"""Tests of explain on servos whose commands jump and act late, and on sensors that read late.

Plain MuJoCo makes the motion; the commands are delayed or filtered before they reach it, and the
readings are delayed afterwards.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis import explain as explaining
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log
from tests.exams.robots.robot_cases import RobotQuestion

NOISE, STEP, INTERVAL = 5e-4, 0.002, 0.01
ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1">
      <inertial pos="0.12 0 0" mass="0.9" diaginertia="0.002 0.006 0.006"/>
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.02" range="-2 2"/>
      <body name="hand" pos="0.25 0 0">
        <inertial pos="0.02 0 0" mass="0.1" diaginertia="0.0001 0.0002 0.0002"/>
        <joint name="wrist" axis="0 1 0" damping="0.01" armature="0.001" range="-2 2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="s1" joint="shoulder" kp="60" kv="4"/>
    <position name="s2" joint="wrist" kp="3" kv="0.3"/>
  </actuator>
</mujoco>
"""
UNITS = dict.fromkeys(("u.s1", "u.s2", "q.shoulder", "q.wrist"), "rad")


def filter_command(command, lag):
    """Return a command (S,) after a first-order lag in seconds, exact for constant steps."""
    applied, state = np.empty_like(command), command[0]
    for i, value in enumerate(command):
        # The mean over the step transfers the same momentum as the filtered command.
        decay = np.exp(-STEP / lag)
        applied[i] = value + (state - value) * (1 - decay) * lag / STEP
        state = value + (state - value) * decay
    return applied


def delay_command(command, delay):
    """Return a command (S,) that comes later by a delay in seconds."""
    steps = round(delay / STEP)
    return np.concatenate([np.full(steps, command[0]), command[:-steps]])


def apply_as_commanded(command, _):
    """Return a command that acts at once."""
    return command


def write_recording(folder, change_command, size, reading_delay=0.0, late_joints=()):
    """Write a log of four runs of 2.5 s with commands that jump.

    Args:
        folder: folder of the log and the model file.
        change_command: function that returns the applied command of s2.
        size: delay or lag of the command in seconds.
        reading_delay: delay of the readings in seconds; before it, the initial state is read.
        late_joints: indices of the joints whose readings are late.
    """
    rng, runs = np.random.default_rng(8), []
    model = mujoco.MjModel.from_xml_string(ARM)
    steps, per_sample = round(2.5 / STEP), round(INTERVAL / STEP)
    for _ in range(4):
        changes = rng.uniform(-1.0, 1.0, (6, 2)) * [0.3, 0.8]
        commands = np.repeat(changes, round(0.5 / STEP), axis=0)[:steps]
        applied = commands.copy()
        applied[:, 1] = change_command(commands[:, 1], size)
        positions = follow(model, applied, 1, start=commands[0])
        for joint in late_joints:
            positions[:, joint] = delay_command(positions[:, joint], reading_delay)
        readings = positions[::per_sample]
        readings += NOISE * rng.standard_normal(readings.shape)
        runs.append((STEP * np.arange(steps)[::per_sample], commands[::per_sample], readings))
    description = describe(UNITS, NOISE, "[runs.4]\nheld_out = true\n")
    return write_log(folder, description, ",".join(UNITS), runs, arm=ARM)


@pytest.mark.parametrize(
    ("effect", "change_command", "size"),
    [
        ("input.lag@s2", filter_command, 0.052),
        ("input.delay@s2", delay_command, 0.06),
        pytest.param("input.delay@s2", delay_command, 0.15, marks=pytest.mark.slow),
    ],
)
def test_commands_that_jump_and_act_late_are_found(tmp_path, effect, change_command, size):
    found = explaining.explain(write_recording(tmp_path, change_command, size))
    assert [cause.effect for cause in found.causes] == [effect]
    (number,) = found.causes[0].coefficients.values()
    assert number.value == pytest.approx(size, rel=0.02)


def test_a_sensor_that_reads_late_is_not_taken_for_a_late_command(tmp_path):
    """A filter does not follow late readings, so a regression scores them low."""
    path = write_recording(tmp_path, apply_as_commanded, 0.0, 0.08, (1,))
    found = explaining.explain(path)
    assert [cause.effect for cause in found.causes] == ["sensor.delay@q.wrist"]
    (number,) = found.causes[0].coefficients.values()
    assert number.value == pytest.approx(0.08, rel=0.02)


@pytest.mark.slow
def test_a_short_delay_of_all_commands_and_of_all_readings_are_equivalent(tmp_path):
    path = write_recording(tmp_path, apply_as_commanded, 0.0, 0.01, (0, 1))
    found = explaining.explain(path)
    (cause,) = found.causes
    assert {cause.effect, *cause.alternatives} == {"input.delay@*", "sensor.delay@*"}


@pytest.mark.slow
def test_a_lag_that_the_regression_takes_for_a_delay_is_found_without_further_effects(
    tmp_path, monkeypatch
):
    """Effects that are added to the delay would only imitate its difference from the lag."""
    monkeypatch.setattr(
        "bench.diagnosis.prediction_error.prediction_error_search.add_to_model",
        lambda *_: pytest.fail("effects were added to the delay"),
    )
    case = RobotQuestion("double", "arm2-servo", "any", 1).draw()
    found = explaining.explain(case.write(tmp_path))
    assert {cause.effect for cause in found.causes} == {"input.lag@m_elbow", "friction.load@elbow"}
    for cause in found.causes:
        (number,) = cause.coefficients.values()
        assert number.value == pytest.approx(*case.effects[cause.effect], rel=0.05)
