"""Tests of linear responses of a robot in contact, against differences of simulated runs."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator

ROLLER = """
<mujoco model="roller">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="wheel" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="spin" axis="0 1 0" damping="0.01"/>
      <geom name="rim" size="0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator><velocity name="drive" joint="spin" kv="0.5"/></actuator>
</mujoco>
"""
TIMES = np.arange(51) / 100.0
START = (np.array([0.0, -2e-4, 0.0]), np.zeros(3))


@pytest.mark.parametrize(
    ("effect", "c"),
    [
        ("mass.scale@wheel", 1e-4),
        ("geom.radius@rim", 1e-5),
        ("contact.friction@floor/rim", -1e-4),
        ("contact.softness@floor/rim", 1e-3),
        ("drag.linear@spin", 1e-5),
    ],
)
def test_the_reaction_of_the_floor_is_part_of_a_response(effect, c, tmp_path):
    """A changed number of the model changes the motion as in a simulation with this number."""
    (tmp_path / "roller.xml").write_text(ROLLER)
    kind = make_robot_simulator(read_robot(tmp_path / "roller.xml")).with_contacts(("floor/rim",))
    simulator = kind(observe=["q.x", "q.z", "q.spin"], effects=[effect])
    scenario = Scenario(TIMES, {"q.z": START[0][1]}, {"u.drive": 3.0 * np.sin(8.0 * TIMES)})
    linear = RunLinearisation(simulator, np.zeros(1), scenario, *START)
    responses, _ = linear.compute_effect_responses([(simulator.effects[0], np.array([c]))])
    without, changed = simulator.simulate(np.array([[0.0], [c]]), scenario)
    wanted = changed - without
    assert np.abs(wanted).max() > 1e-9
    np.testing.assert_allclose(responses[0], wanted, atol=0.05 * np.abs(wanted).max())


def test_the_response_to_a_radius_does_not_depend_on_its_size(tmp_path):
    """A wheel that is larger by 2 % would be pressed 2 mm into the floor.

    The response of 2 % is 2,000 times that of a simulated radius that is larger by 0.001 %.
    """
    (tmp_path / "roller.xml").write_text(ROLLER)
    kind = make_robot_simulator(read_robot(tmp_path / "roller.xml")).with_contacts(("floor/rim",))
    simulator = kind(observe=["q.x", "q.z", "q.spin"], effects=["geom.radius@rim"])
    scenario = Scenario(TIMES, {"q.z": START[0][1]}, {"u.drive": 3.0 * np.sin(8.0 * TIMES)})
    linear = RunLinearisation(simulator, np.zeros(1), scenario, *START)
    responses, _ = linear.compute_effect_responses([(simulator.effects[0], np.array([0.02]))])
    without, changed = simulator.simulate(np.array([[0.0], [1e-5]]), scenario)
    wanted = 2000.0 * (changed - without)
    np.testing.assert_allclose(responses[0], wanted, atol=0.05 * np.abs(wanted).max())
