"""Tests of explain on servos with a filter, for any filter state at the start of a run.

Plain MuJoCo makes the motion, from a model file with another damping at the elbow.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis import explain as explaining
from bench.diagnosis.score_extended import score_model
from bench.logs.filter_settling import leave_out_settling
from bench.logs.recording_joining import load_joined
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log
from tests.exams.recordings.recording_cases import SHARED

NOISE = 5e-4
ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1">
      <inertial pos="0.12 0 0" mass="0.9" diaginertia="0.002 0.006 0.006"/>
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.02" range="-2 2"/>
      <body name="fore" pos="0.25 0 0">
        <inertial pos="0.1 0 0" mass="0.4" diaginertia="0.001 0.002 0.002"/>
        <joint name="elbow" axis="0 1 0" damping="{damping}" armature="0.01" range="-2 2"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
SERVOS = (
    '<position name="s1" joint="shoulder" kp="60" kv="4" timeconst="0.04"/>'
    '<general name="s2" joint="elbow" gear="2" dyntype="filter" dynprm="0.04" '
    'gainprm="8" biastype="affine" biasprm="0 -8 -0.4" forcerange="-40 40"/>'
)
STATED, PLANTED = 0.1, 0.9
UNITS = dict.fromkeys(("u.s1", "u.s2", "q.shoulder", "q.elbow"), "rad")
LOG = describe(UNITS, NOISE, "[runs.3]\nheld_out = true\n")
CASE = SHARED / "cases" / "filtered_servo" / "log.csv"


def recorded(folder, initial_activation, seconds=2.5):
    """Write a log of three runs; return its path.

    Args:
        folder: folder of the log and of the known model file.
        initial_activation: ``zero`` for activations as MuJoCo resets them; ``moving`` for a log
            that is cut out of a motion.
    """
    rng, runs = np.random.default_rng(5), []
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=PLANTED, actuators=SERVOS))
    before = 70 if initial_activation == "moving" else 0
    times = 0.01 * np.arange(round(100 * seconds) + before + 1)
    for _ in range(3):
        rates, phases = rng.uniform(4, 8, 2), rng.uniform(1, 2, 2)
        commands = np.array([0.4, 0.9]) * np.sin(times[:, None] * rates + phases)
        readings = follow(model, commands, 5, start=commands[0] / np.array([1.0, 2.0]))
        readings += NOISE * rng.standard_normal(readings.shape)
        runs.append((times[before:], commands[before:], readings[before:]))
    known = ARM.format(damping=STATED, actuators=SERVOS)
    return write_log(folder, LOG, ",".join(UNITS), runs, arm=known)


@pytest.mark.parametrize("initial_activation", ["zero", "moving"])
def test_a_planted_damping_is_found_behind_filtered_servos(tmp_path, initial_activation):
    path = recorded(tmp_path, initial_activation)
    lines = []
    found = explaining.explain(path, say=lines.append)
    (cause,) = found.causes
    assert {cause.effect, *cause.alternatives} == {"drag.linear@elbow", "actuator.damping@s2"}
    (number,) = cause.coefficients.values()
    # The servo's damping acts on the joint multiplied by the square of its gear.
    change = (PLANTED - STATED) / (1.0 if cause.effect.startswith("drag") else 0.4 * 2.0**2)
    assert number.value == pytest.approx(change, rel=0.03)
    (line,) = [line for line in lines if "are left out" in line]
    assert "the first 0.4 s" in line
    assert "the filters of s1, s2 settle" in line
    assert '[runs.NAME.initial] "act.s1"' in line


def test_the_true_model_has_no_gap_however_its_filters_begin(tmp_path):
    path = recorded(tmp_path, "zero")
    (tmp_path / "truth.xml").write_text(ARM.format(damping=PLANTED, actuators=SERVOS))
    assert score_model(tmp_path / "truth.xml", path)["normalised_rmse"] < 1.1


def test_runs_with_stated_activations_stay_whole(tmp_path):
    path = recorded(tmp_path, "zero")
    stated = "".join(f'[runs.{r}.initial]\n"act.s1" = 0.0\n"act.s2" = 0.0\n' for r in (1, 2, 3))
    (tmp_path / "log.toml").write_text(LOG + stated)
    recording, kind = load_joined([path])
    same, note = leave_out_settling(recording, kind)
    assert note == ""
    assert same == recording
    (tmp_path / "truth.xml").write_text(ARM.format(damping=PLANTED, actuators=SERVOS))
    assert score_model(tmp_path / "truth.xml", path)["normalised_rmse"] < 1.1


def test_a_run_that_is_too_short_to_lose_its_beginning_stays_whole(tmp_path):
    recording, kind = load_joined([recorded(tmp_path, "zero", seconds=0.7)])
    same, note = leave_out_settling(recording, kind)
    assert note == ""
    assert [run.times.size for run in same.runs] == [run.times.size for run in recording.runs]


@pytest.mark.skipif(not CASE.exists(), reason="the shared cases are not on this machine")
def test_the_shared_case():
    found = explaining.explain(CASE)
    (cause,) = found.causes
    assert {cause.effect, *cause.alternatives} == {"drag.linear@elbow", "actuator.damping@m_elbow"}
    assert found.verdict in ("named", "ambiguous")
