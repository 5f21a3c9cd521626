"""Tests that explain finds a missing effect although a drive is off in a part of each run.

Plain MuJoCo makes the motion; its servo has no gains while it is off.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis import explain as explaining
from tests.bench.diagnosis.sample_report_data import summary_text
from tests.bench.diagnosis.simulated_logs import follow, write_log
from tests.bench.diagnosis.verdict_schema import check
from tests.exams.recordings.recording_cases import SHARED

NOISE = 1e-3
ROD = """
<mujoco model="rod">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="rod" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="{damping}" armature="0.008"/>
    <inertial pos="0 0 -0.2" mass="0.25" diaginertia="0.001 0.001 0.0002"/>
  </body></worldbody>
  <actuator><position name="drive" joint="hinge" kp="8" kv="0.3"/></actuator>
</mujoco>
"""
STATED, PLANTED = 0.03, 0.06
LOG = (
    f'model = "rod.xml"\n[channels."q.hinge"]\nunit = "rad"\nnoise = {NOISE}\n'
    '[inputs."u.drive"]\nunit = "rad"\n[runs.3]\nheld_out = true\n'
)
EXTRA = '[extra.enabled]\nunit = "1"\n'
SWITCH = '[actuators.drive]\nenable = "enabled"\n'
CASE = SHARED / "cases" / "torque_switched_off" / "log.csv"


def recorded(folder, description, has_column=True):
    """Write a log of three runs with the drive off for 1.5 s in each; return its path."""
    rng, runs = np.random.default_rng(4), []
    model = mujoco.MjModel.from_xml_string(ROD.format(damping=PLANTED))
    gain, bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
    times = 0.01 * np.arange(301)
    for first in (1.1, 1.3, 1.5):

        def is_on(t, first=first):
            return (t < first - 1e-9) | (t >= first + 1.5 - 1e-9)

        def switch(data, is_on=is_on):
            on = is_on(data.time)
            model.actuator_gainprm[:], model.actuator_biasprm[:] = gain * on, bias * on

        commands = 1.2 * np.sin(rng.uniform(4, 7) * times)
        readings = follow(model, commands, 5, act=switch)
        readings += NOISE * rng.standard_normal(readings.shape)
        runs.append((times, commands, readings, *[is_on(times)] * has_column))
    columns = "u.drive,q.hinge" + ",enabled" * has_column
    return write_log(folder, description, columns, runs, rod=ROD.format(damping=STATED))


@pytest.mark.parametrize("given", ["key", "column", "nothing"])
def test_the_planted_damping_is_found(tmp_path, given):
    description = {"key": LOG + SWITCH, "column": LOG + EXTRA, "nothing": LOG}[given]
    lines = []
    path = recorded(tmp_path, description, has_column=given != "nothing")
    found = explaining.explain(path, say=lines.append)
    (cause,) = found.causes
    assert "drag.linear@hinge" in {cause.effect, *cause.alternatives}
    if cause.effect == "drag.linear@hinge":
        (number,) = cause.coefficients.values()
        assert number.value == pytest.approx(PLANTED - STATED, rel=0.05)
    notes = {
        "key": "actuator drive exerts nothing where enabled is 0: run 1, 1.1 to 2.59 s",
        "column": 'state it in log.toml: [actuators.drive] enable = "enabled"',
        "nothing": "the drives of joint hinge exert no force in some samples, which are excluded",
    }
    assert sum(notes[given] in line for line in lines) == 1
    # The note follows the headline and precedes the first coefficient.
    summary = summary_text(found.story).lower()
    assert summary.index(notes[given].lower()) < summary.index("coefficient")
    found.write(tmp_path / "out")
    (note,) = check((tmp_path / "out" / "verdict.json").read_text())["recording_notes"]
    assert notes[given] in note


@pytest.mark.skipif(not CASE.exists(), reason="the shared cases are not on this machine")
def test_the_shared_case():
    found = explaining.explain(CASE)
    (cause,) = found.causes
    assert (cause.effect, cause.form) == ("friction.coulomb@hinge", "soft")
    (note,) = found.answer.recording_notes
    assert 'state it in log.toml: [actuators.servo] enable = "torque_enable"' in note
