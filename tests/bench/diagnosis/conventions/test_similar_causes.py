"""Causes that look like another convention of a log: explain must search for them, not refuse."""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

ARM = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="link">
  <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.8"/>
</body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator>
</mujoco>"""
STEP, INTERVAL, GAIN = 0.002, 0.01, 20.0
OFFSET = 0.03
"""Offset of the encoder, rad."""
LEAD = 0.04
"""Kd / kp of a servo whose D term acts on the error, s."""
SIDEWAYS = 0.03
"""Distance of the centre of mass from the link, m."""


def explain_log(folder, lead=0.0, offset=0.0, sideways=0.0):
    """Record three runs in plain MuJoCo, and explain them with the model file."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.body_ipos[1, 0] += sideways
    rng, times, runs = np.random.default_rng(5), INTERVAL * np.arange(300), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, 2)
        commands = 0.6 * np.sin(2.0 * times + phases[0]) + 0.25 * np.sin(5.1 * times + phases[1])

        def push(data, commands=commands):
            now, before = (
                commands[int(max(data.time - late, 0.0) / INTERVAL + 1e-6)] for late in (0.0, STEP)
            )
            data.qfrc_applied[0] = GAIN * lead * (now - before) / STEP

        readings = offset + follow(model, commands, 5, start=commands[0], act=push)
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    description = describe({"u.servo": "rad", "q.hinge": "rad"}, 0.001)
    return explain(write_log(folder, description, "u.servo,q.hinge", runs, arm=ARM)).answer


@pytest.mark.parametrize(
    ("change", "effect", "value"),
    [
        # It looked like another zero of position and command, 0.57 rad away.
        ({"offset": OFFSET}, "sensor.bias@q.hinge", OFFSET),
        # It looked like commands with late time stamps.
        ({"lead": LEAD}, "servo.derivative@servo", LEAD),
    ],
)
def test_an_encoder_offset_and_a_d_term_are_causes(tmp_path, change, effect, value):
    (cause,) = explain_log(tmp_path, **change).causes
    assert cause.effect == effect
    assert cause.coefficients["coefficient"].value == pytest.approx(value, rel=0.02)


def test_a_centre_of_mass_off_the_link_is_not_another_zero_of_the_joint(tmp_path):
    """A link that hangs askew looks like one whose joint is counted from another angle."""
    (cause,) = explain_log(tmp_path, sideways=SIDEWAYS).causes
    assert "mass.offset@link" in (cause.effect, *cause.alternatives)
