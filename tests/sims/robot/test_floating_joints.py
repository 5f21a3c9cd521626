"""Tests of bodies with free or ball joints: initial states of runs, and linearisation of their
motion.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sims import effects as library
from sims.core.simulator import InputError, Scenario
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.floating_joints import FloatingJoints
from sims.robot.integrator_settings import IntegratorSettings
from tests.sims.robot.test_robot_motion import kind_of
from tests.sims.robot.test_tangent_propagation import probes

SATELLITE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0" integrator="RK4"/>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint name="base"/>
      <inertial pos="0 0 0" mass="5" diaginertia="0.2 0.25 0.3"/>
      <body name="panel" pos="0.3 0 0">
        <joint name="boom" type="hinge" axis="0 0.6 0.8" damping="0.02"/>
        <inertial pos="0.25 0 0" mass="1" diaginertia="0.002 0.03 0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m_boom" joint="boom"/></actuator>
</mujoco>
"""
BALL = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="ball" pos="0 0 1">
      <joint name="socket" type="ball" damping="0.02"/>
      <inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.01"/>
      <body name="tip" pos="0 0 -0.4">
        <joint name="wrist" axis="0 1 0" damping="0.02"/>
        <inertial pos="0 0 -0.1" mass="0.4" diaginertia="0.002 0.002 0.0005"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="m_wrist" joint="wrist" kp="8" kv="0.4"/></actuator>
</mujoco>
"""
TIMES = np.arange(0, 1.0, 0.01)
SPUN = {"qd.base.wx": 0.4, "qd.base.wz": -0.3, "q.base.qw": 2.0, "q.base.qy": 0.5}
HANGING = {"q.socket.qw": 0.9, "q.socket.qx": 0.3, "qd.socket.wy": 0.5}


def moving(text, channel, command, begins):
    kind = kind_of(text)
    effects = list(library.list_effects_for(kind.system).values())
    simulator = kind(observe=[channel], effects=effects)
    inputs = {command: 0.4 * np.sin(5.0 * TIMES)}
    return simulator, Scenario(TIMES, begins, inputs)


CASES = {
    "free": (SATELLITE, "q.boom", "u.m_boom", SPUN),
    "ball": (BALL, "q.wrist", "u.m_wrist", HANGING),
}


@pytest.mark.parametrize("name", CASES)
def test_the_tangent_goes_through_what_floats(name):
    simulator, scenario = moving(*CASES[name])
    added, thetas = probes(simulator)
    still = simulator.simulate_batch(np.zeros((1, thetas.shape[1])), [scenario])[0]
    changed = simulator.simulate_batch(thetas, [scenario] * len(thetas)) - still
    about = RunLinearisation(
        simulator, np.zeros(thetas.shape[1]), scenario, np.zeros(1), np.zeros(1)
    )
    np.testing.assert_allclose(about.observed, still, atol=1e-12)
    seen = about.compute_effect_responses(added)[0]
    size = np.sqrt(np.square(changed).sum(axis=(1, 2)))
    counted = size > 1e-3 * size.max()
    assert counted.sum() > 12, "most of them move something"
    apart = np.sqrt(np.square(seen - changed).sum(axis=(1, 2)))[counted] / size[counted]
    names = [added[i][0].name for i in np.flatnonzero(counted)[np.argsort(-apart)[:3]]]
    assert apart.max() < 0.1, (names, np.sort(apart)[-3:])
    assert np.median(apart) < 0.01


def test_a_run_begins_as_the_recording_states_it():
    """Without external torque the pose of a spinning rigid body changes, and its momentum is
    conserved.
    """
    simulator, scenario = moving(SATELLITE, "q.boom", "u.m_boom", SPUN)
    here = simulator.simulate(np.zeros((1, len(simulator.parameters))), scenario)[0, :, 0]
    at_rest = Scenario(TIMES, {}, scenario.inputs)
    there = simulator.simulate(np.zeros((1, len(simulator.parameters))), at_rest)[0, :, 0]
    assert np.abs(here - there).max() > 0.01, "a hull that spins swings its boom"


def test_a_free_body_that_a_sensor_shows_keeps_the_spin_it_was_given():
    sensor = "<sensor><framequat name='att' objtype='body' objname='hull'/></sensor>"
    text = SATELLITE.replace("</actuator>", f"</actuator>{sensor}")
    text = text.replace('diaginertia="0.2 0.25 0.3"', 'diaginertia="2e3 2e3 2e3"')
    kind = kind_of(text).with_integrator_settings(IntegratorSettings(0.002, "RK4"))
    names = [f"s.att.{axis}" for axis in "wxyz"]
    simulator = kind(observe=names)
    begins = {"qd.base.wx": 0.4, "qd.base.wz": -0.3, "q.base.qw": 0.8, "q.base.qy": 0.6}
    seen = simulator.simulate(np.zeros((1, 0)), Scenario(TIMES, begins, {}))[0]
    first = Rotation.from_quat([0.0, 0.6, 0.0, 0.8])
    # a heavy ball turns uniformly about its spin, which is given in body axes
    turned = first * Rotation.from_rotvec(TIMES[:, None] * np.array([0.4, 0.0, -0.3]))
    apart = turned.inv() * Rotation.from_quat(seen[:, [1, 2, 3, 0]])
    assert apart.magnitude().max() < 2e-4


def test_a_move_and_the_way_back_agree():
    floating = FloatingJoints.from_robot(kind_of(SATELLITE).robot)
    rng = np.random.default_rng(0)
    pose = rng.normal(size=(5, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    for number in range(6):
        moves = floating.compute_displacement(floating.displace_coordinate(pose, number, 0.3), pose)
        np.testing.assert_allclose(moves, 0.3 * np.eye(6)[[number] * 5], atol=1e-12)


def test_an_invalid_turn_is_refused():
    simulator, scenario = moving(SATELLITE, "q.boom", "u.m_boom", {"q.base.qw": 0.0})
    with pytest.raises(InputError, match=r"q\.base\.qw, .*: expected a quaternion, found zeros"):
        simulator.simulate(np.zeros((1, len(simulator.parameters))), scenario)
