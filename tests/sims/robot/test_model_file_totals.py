"""Tests of the resulting model file value given for each coefficient of a robot."""

import mujoco
import numpy as np
import pytest

from sims.extended_simulator import FittedValue
from sims.robot.export.apply_causes import apply_causes
from sims.robot.export.model_file_totals import compute_file_totals
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import robot

ARM = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body name="upper">
    <joint name="lift" type="slide" axis="0 0 1" damping="0.3" frictionloss="0.2"/>
    <inertial pos="0.1 0 0" mass="2" diaginertia="0.01 0.02 0.03"/>
    <body name="fore" pos="0.3 0 0">
      <joint name="elbow" axis="0 1 0" damping="0.1 0.02 0" stiffness="0.5" armature="0.01"/>
      <inertial pos="0.15 0 0.01" mass="0.8" diaginertia="0.002 0.008 0.009"/>
    </body></body></worldbody>
  <actuator><position name="m_lift" joint="lift" kp="60" kv="3"/>
    <position name="m_elbow" joint="elbow" kp="20" kv="1" forcelimited="true" forcerange="-4 4"/>
  </actuator></mujoco>"""


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    return make_robot_simulator(robot(tmp_path_factory.mktemp("arm"), ARM)).system


@pytest.mark.parametrize(
    ("effect", "values", "expected"),
    [
        ("friction.coulomb@lift", [-0.05], [(0.2, 0.15, "N")]),
        # No total is negative, whatever the coefficient.
        ("friction.coulomb@lift", [-0.5], [(0.2, 0.0, "N")]),
        ("drag.linear@elbow", [0.2], [(0.1, 0.3, "N*m*s/rad")]),
        ("drag.quadratic@elbow", [0.01], [(0.02, 0.03, "N*m*s^2/rad^2")]),
        ("spring.linear@elbow", [0.1], [(0.5, 0.6, "N*m/rad")]),
        ("inertia.armature@elbow", [0.005], [(0.01, 0.015, "kg*m^2")]),
        ("mass.scale@fore", [0.25], [(0.8, 1.0, "kg")]),
        ("inertia.scale@fore", [0.1], [(0.009, 0.0099, "kg*m^2")]),
        (
            "mass.offset@fore",
            [0.01, 0.0, -0.02],
            [(0.15, 0.16, "m"), (0.0, 0.0, "m"), (0.01, -0.01, "m")],
        ),
        ("actuator.stiffness@m_lift", [0.5], [(60.0, 90.0, "N/m")]),
        ("actuator.damping@m_elbow", [-0.4], [(1.0, 0.6, "N*m*s/rad")]),
        ("actuator.limit@m_elbow", [3.0], [(4.0, 3.0, "N*m")]),
        ("gravity.scale", [-0.999], [(9.81, 0.00981, "m/s^2")]),
        ("gravity.tilt", [0.1, 0.0], [(0.0, 0.981, "m/s^2"), (0.0, 0.0, "m/s^2")]),
    ],
)
def test_stated_and_total(system, effect, values, expected):
    (found,) = compute_file_totals(system.robot, [(system.effect(effect), values)])
    for one, (stated, total, unit) in zip(found, expected, strict=True):
        assert (one.stated, one.total) == pytest.approx((stated, total))
        assert one.unit == unit


@pytest.mark.parametrize("effect", ["sensor.bias@q.elbow", "input.delay@m_elbow"])
def test_what_the_file_does_not_state_has_no_total(system, effect):
    assert compute_file_totals(system.robot, [(system.effect(effect), [0.1])]) == [[None]]


def test_an_actuator_without_limit_has_no_total(system):
    assert compute_file_totals(system.robot, [(system.effect("actuator.limit@m_lift"), [1.0])]) == [
        [None]
    ]


def test_the_total_is_what_the_extended_file_compiles_to(system):
    names = {"mass.scale@fore": 0.25, "inertia.scale@fore": -0.3}
    fitted = [(system.effect(name), [value]) for name, value in names.items()]
    ((mass,), (inertia,)) = compute_file_totals(system.robot, fitted)
    causes = {n: {"coefficient": FittedValue(value, "1", 0.2, 0.3)} for n, value in names.items()}
    model = apply_causes(system.robot, causes).model
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "fore")
    assert np.isclose(model.body_mass[number], mass.total)
    # A larger mass has a larger inertia: the file states the result of both.
    assert np.isclose(model.body_inertia[number].max(), inertia.total)
    assert np.isclose(inertia.total, 0.009 * 1.25 * 0.7)
