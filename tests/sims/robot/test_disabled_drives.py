"""Tests that disabled actuators exert no force: the motion is that of MuJoCo without them."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator

ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.02"/>
      <inertial pos="0.12 0 0" mass="0.6" diaginertia="0.002 0.006 0.006"/>
      <body pos="0.25 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.01"/>
        <inertial pos="0.1 0 0" mass="0.3" diaginertia="0.001 0.002 0.002"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
ACTUATORS = {
    "position": '<position name="m" joint="shoulder" kp="40" kv="3" forcerange="-20 20"/>',
    "filtered": '<position name="m" joint="shoulder" kp="40" kv="3" timeconst="0.04"/>',
    "velocity": '<velocity name="m" joint="shoulder" kv="4"/>',
    "motor": '<motor name="m" joint="shoulder" gear="2"/>',
}
ELBOW = '<position name="e" joint="elbow" kp="10" kv="0.5"/>'
TIMES = 0.01 * np.arange(61)
COMMANDS = {"u.m": 0.5 * np.sin(7.0 * TIMES), "u.e": 0.4 * np.cos(5.0 * TIMES)}
OFF = (TIMES > 0.195) & (TIMES < 0.395)


def simulator(kind="position", integrator="implicitfast"):
    text = ARM.format(integrator=integrator, actuators=ACTUATORS[kind] + ELBOW)
    spec = mujoco.MjSpec.from_string(text)
    return make_robot_simulator(RobotModel(Path("arm.xml"), "mjcf", spec, digest=text))


def plain(kind, off=OFF, friction=0.0):
    """Return the angles of a plain MuJoCo loop, with zero gain and bias while the drive is off."""
    model = mujoco.MjSpec.from_string(kind.robot.spec.to_xml()).compile()
    gain, bias = model.actuator_gainprm[0].copy(), model.actuator_biasprm[0].copy()
    model.dof_frictionloss[0] = friction
    data = mujoco.MjData(model)
    if model.na:
        data.act[0] = COMMANDS["u.m"][0]
    angles, torques = [data.qpos.copy()], []
    for k in range(TIMES.size - 1):
        data.ctrl[:] = COMMANDS["u.m"][k], COMMANDS["u.e"][k]
        model.actuator_gainprm[0] = 0.0 if off[k] else gain
        model.actuator_biasprm[0] = 0.0 if off[k] else bias
        for _ in range(5):
            mujoco.mj_step(model, data)
        angles.append(data.qpos.copy())
        torques.append(data.qfrc_actuator.copy())
    return np.array(angles), np.array(torques)


def simulated(kind, off=OFF, observe=("q.shoulder", "q.elbow"), **effects):
    scenario = Scenario(TIMES, {}, COMMANDS, off={"m": off})
    made = kind(observe=list(observe), fixed=effects)
    return made.simulate(np.empty((1, 0)), scenario)[0]


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize("name", ACTUATORS)
def test_the_motion_is_that_without_the_actuator(name, integrator):
    kind = simulator(name, integrator)
    expected, _ = plain(kind)
    assert simulated(kind) == pytest.approx(expected, abs=1e-12)
    assert np.abs(expected - plain(kind, off=np.zeros_like(OFF))[0]).max() > 0.01


def test_elements_of_runs_switch_at_their_own_times_only():
    kind = simulator()
    masks = [OFF, TIMES > 0.3, np.zeros_like(OFF)]
    scenarios = [Scenario(TIMES, {}, COMMANDS, off={"m": mask}) for mask in masks]
    made = kind(observe=["q.shoulder", "q.elbow"])
    lanes = made.simulate_batch(np.empty((3, 0)), scenarios)
    for row, mask in zip(lanes, masks, strict=True):
        assert row == pytest.approx(plain(kind, off=mask)[0], abs=1e-12)
    again = made.simulate(np.empty((1, 0)), Scenario(TIMES, {}, COMMANDS))[0]
    assert again == pytest.approx(plain(kind, off=masks[2])[0], abs=1e-12)


def test_effects_that_are_asked_in_every_step_see_the_drive_off():
    kind = simulator()
    # A dead zone removes the proportional part of an active drive, and changes nothing while the
    # drive is off.
    wide = simulated(kind, off=np.ones_like(OFF), **{"servo.deadband@m": 50.0})
    expected, _ = plain(kind, off=np.ones_like(OFF))
    assert wide == pytest.approx(expected, abs=1e-9)
    # The friction is evaluated per step, and too small to change the motion.
    almost = simulated(kind, **{"friction.load@shoulder": 1e-12})
    assert almost == pytest.approx(plain(kind)[0], abs=1e-6)


def test_the_drive_shows_no_torque_while_it_is_off():
    kind = simulator()
    torque = simulated(kind, observe=["tau.shoulder"])[:, 0]
    on = ~OFF
    on[-1] = True
    inside = OFF & np.roll(OFF, -1) & np.roll(OFF, 1)
    assert np.abs(torque[inside]).max() == 0.0
    assert np.abs(torque[on]).max() > 1.0


def test_a_mask_of_another_length_is_refused():
    with pytest.raises(InputError, match=r"actuator 'm' is off in \(3,\) samples"):
        Scenario(TIMES, {}, COMMANDS, off={"m": np.zeros(3, dtype=bool)})
