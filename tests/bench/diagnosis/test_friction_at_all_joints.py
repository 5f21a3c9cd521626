"""An arm whose file lacks the friction of all joints, and has one more wrong number.

Robots are often like this. Recordings are made in plain MuJoCo.
"""

import mujoco
import numpy as np
import pytest

from bench.api.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

JOINTS = ("base", "shoulder", "elbow")
ARM = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body><joint name="base" axis="0 0 1"/>
  <geom type="capsule" size="0.04" fromto="0 0 0 0 0 0.3" mass="3"/>
  <body pos="0 0 0.3"><joint name="shoulder" axis="0 1 0"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="2"/>
    <body pos="0.4 0 0"><joint name="elbow" axis="0 1 0"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1"/>
</body></body></body></worldbody>
<actuator>
  <position name="m_base" joint="base" kp="300" kv="10"/>
  <position name="m_shoulder" joint="shoulder" kp="300" kv="10"/>
  <position name="m_elbow" joint="elbow" kp="150" kv="4"/>
</actuator>
</mujoco>"""
FRICTION = np.array([0.8, 1.1, 0.4])
DAMPING = np.array([0.9, 1.3, 0.5])


@pytest.fixture(scope="module")
def explained(tmp_path_factory):
    spec = mujoco.MjSpec.from_string(ARM)
    for joint, friction, damping in zip(spec.joints, FRICTION, DAMPING, strict=True):
        joint.damping = [damping, 0.0, 0.0]
        joint.frictionloss = friction
        # Nearly rigid friction, in which joints stick.
        joint.solref_friction = [0.001, 1.0]
        joint.solimp_friction = [0.99, 0.9999, 0.001, 0.5, 2.0]
    servo = spec.actuators[2]
    servo.gainprm[0] *= 1.15
    servo.biasprm[1] *= 1.15
    model, rng = spec.compile(), np.random.default_rng(5)
    times, runs = 0.01 * np.arange(500), []
    for _ in range(4):
        rates, phases = rng.uniform(1.0, 5.0, (2, 3)), rng.uniform(0.0, 6.0, (2, 3))
        commands = 0.25 * np.sin(times[:, None, None] * rates + phases).sum(axis=1)
        readings = follow(model, commands, 5, start=commands[0])
        runs.append((times, commands, readings + rng.normal(0.0, 1e-4, readings.shape)))
    units = {f"u.m_{joint}": "rad" for joint in JOINTS} | {f"q.{joint}": "rad" for joint in JOINTS}
    folder = tmp_path_factory.mktemp("friction")
    log = write_log(folder, describe(units, 1e-4), ",".join(units), runs, arm=ARM)
    return explain(log)


def list_values(explained, effect):
    (cause,) = [cause for cause in explained.causes if cause.effect == effect]
    return np.array([fitted.value for fitted in cause.coefficients.values()])


@pytest.mark.slow
def test_friction_damping_and_a_servo_are_found_together(explained):
    found = [{cause.effect, *cause.alternatives} for cause in explained.causes]
    expected = [
        {"friction.coulomb@*"},
        # The damping of a servo is the same force as that of its joint.
        {"drag.linear@*", "actuator.damping@*"},
        {"actuator.stiffness@m_elbow"},
    ]
    assert sorted(found, key=sorted) == sorted(expected, key=sorted)
    assert list_values(explained, "friction.coulomb@*") == pytest.approx(FRICTION, rel=0.03)
    assert list_values(explained, "actuator.stiffness@m_elbow") == pytest.approx(0.15, rel=0.05)
