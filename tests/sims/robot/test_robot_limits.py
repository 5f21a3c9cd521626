"""Tests of the ranges of a robot's coefficients: they end at physical limits and scale with the
robot.
"""

import re

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.parameter_bounds import (
    MAX_RANGE_FACTOR_MODEL_FILE,
    bound_of,
    compute_coefficient_bounds,
    is_unusual,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.robot.dynamics.joint_scales import coefficient_scales, compute_joint_scales
from sims.robot.places.centre_of_mass_limits import compute_centre_of_mass_limits
from sims.robot.places.observable_axes import observable_axes
from sims.robot.robot_simulator import make_robot_simulator
from tests.bench.diagnosis.explained_samples import recorded
from tests.sims.robot.sample_arms import ARM, robot

TIMES = np.linspace(0.0, 0.2, 21)
YAW = """<mujoco><worldbody><body name="column">
  <joint name="yaw" axis="0 0 1" damping="0.3" armature="0.02"/>
  <inertial pos="0 0 0.05" mass="2" diaginertia="0.01 0.01 0.008"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.04"/>
  <body name="upper" pos="0 0 0.1">
    <joint name="pitch" axis="0 1 0" frictionloss="0.2"/>
    <inertial pos="0.15 0 0" mass="1.5" diaginertia="0.002 0.015 0.015"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
    <body name="last" pos="0.3 0 0">
      <joint name="roll" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </body>
</body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def yaw(tmp_path_factory):
    return robot(tmp_path_factory.mktemp("yaw"), YAW)


@pytest.fixture(scope="module")
def bounds(yaw):
    kind = make_robot_simulator(yaw)
    simulator = kind(observe=["q.yaw", "q.pitch"])
    made = recorded(simulator, np.zeros(0), [{}], TIMES)
    there = RunEvaluator(kind, made, made.runs, None)
    return lambda name: compute_coefficient_bounds(there, name)


@pytest.mark.parametrize(
    ("name", "lower_limit"),
    [
        ("drag.linear@yaw", -0.3),
        ("inertia.armature@yaw", -0.02),
        ("friction.coulomb@pitch", -0.2),
        ("friction.coulomb@yaw", 0.0),
        ("mass.scale@upper", -0.99),
        ("inertia.scale@upper", -0.99),
        ("sensor.gain@q.yaw", -0.8),
    ],
)
def test_no_total_is_negative(bounds, name, lower_limit):
    ((low, high),) = bounds(name)
    assert low == pytest.approx(lower_limit)
    assert high > 3.0


def test_a_fit_may_exceed_the_usual_damping_two_hundred_times(bounds):
    ((_, high),) = bounds("drag.linear@yaw")
    assert high >= 60.0


def test_members_of_a_family_have_limits_of_their_own(bounds):
    lows = [low for low, _ in bounds("friction.coulomb@*")]
    assert lows == pytest.approx([0.0, -0.2, 0.0])


def test_a_centre_of_mass_stays_within_its_link(yaw, bounds):
    x, y, z = bounds("mass.offset@upper")
    # The link reaches from the hinge at -0.15 m to the next joint at 0.15 m.
    assert -0.25 < x[0] < -0.15
    assert 0.15 < x[1] < 0.25
    assert max(*np.abs(y), *np.abs(z)) < 0.15
    assert np.all(compute_centre_of_mass_limits(yaw, "upper")[:, 0] < 0.0)
    # Without geoms and children it counts as long as its parent link.
    assert np.abs(compute_centre_of_mass_limits(yaw, "last")).max() < 0.4


def test_a_link_without_geoms_is_as_large_as_its_inertia_needs(tmp_path):
    """A uniform rod of 0.4 m about its middle, whose centre of mass is stated at 0.02 m."""
    mass, length = 0.3, 0.4
    moment = mass * length**2 / 12.0
    inertia = f'mass="{mass}" diaginertia="1e-9 {moment} {moment}"'
    rod = re.sub(
        r'<inertial pos="0 0 0" mass="1e-6".*/>', f'<inertial pos="0.02 0 0" {inertia}/>', YAW
    )
    low, high = compute_centre_of_mass_limits(robot(tmp_path, rod), "last").T
    # The box of the link is the rod and a margin of a tenth of its length at each end.
    assert low[0] == pytest.approx(-0.6 * length, abs=1e-4)
    assert high[0] == pytest.approx(0.6 * length, abs=1e-4)
    # A thin rod may be a quarter of its length thick.
    assert high[1:] == pytest.approx(0.35 * length, abs=1e-4)


def test_an_offset_along_the_only_axis_of_rotation_is_fixed(yaw, bounds):
    assert observable_axes(yaw, "column") == (0, 1)
    assert bounds("mass.offset@column")[2] == (0.0, 0.0)
    assert observable_axes(yaw, "upper") == (0, 1, 2)


def test_parallel_hinges_hide_one_axis_of_all_their_links(tmp_path):
    planar = robot(tmp_path, ARM)
    assert observable_axes(planar, "fore") == (0, 2)
    # The wheel turns about a second direction.
    assert observable_axes(planar, "wheel") == (0, 1, 2)


def test_an_axis_that_is_fixed_cannot_be_seen_in_any_motion(yaw, tmp_path):
    moved = robot(tmp_path, YAW.replace('pos="0 0 0.05"', 'pos="0 0 0.09"'))
    rng = np.random.default_rng(0)
    for _ in range(5):
        position, rate = rng.uniform(-1, 1, 3), rng.uniform(-3, 3, 3)
        found = []
        for one in (yaw, moved):
            data = mujoco.MjData(one.compiled)
            data.qpos[:], data.qvel[:] = position, rate
            mujoco.mj_forward(one.compiled, data)
            found.append(data.qacc[:2].copy())
        np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.parametrize("kind", ["slide", "free"])
def test_axes_of_what_slides_or_floats(tmp_path, kind):
    text = f"""<mujoco><worldbody><body name="box"><joint name="j" type="{kind}"/>
      <geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>"""
    assert observable_axes(robot(tmp_path, text), "box") == (() if kind == "slide" else (0, 1, 2))


def test_a_link_without_inertia_does_not_shrink_the_ranges_of_its_joint(yaw, tmp_path):
    model = YAW.replace("1 0 0", "0 1 0")
    light = robot(tmp_path, model)
    assert compute_joint_scales(light).inertia[2] < 1e-7
    assert coefficient_scales(light).inertia[2] > 1e-4
    assert coefficient_scales(light).force[2] > 1e-3
    np.testing.assert_array_equal(
        coefficient_scales(light).inertia[:2], compute_joint_scales(light).inertia[:2]
    )
    system = make_robot_simulator(yaw).system
    ((low, high),) = system.effect("inertia.armature@roll").coefficients[0].plausible[:1]
    assert (low, high > 1e-4) == (0.0, True)
    # Also as a free parameter: with bounds of 1e-8 kg m^2 it could only end at a bound.
    (free,) = make_robot_simulator(yaw, ["armature@roll"]).system.parameters
    assert free.bounds[1] > 4e-4


def test_a_light_joint_may_have_as_much_damping_as_its_servo(tmp_path):
    # The weight of the last link moves the joint with 5e-9 N·m/rad; the servo damps it with
    # gear**2 * kv.
    servo = '<actuator><position name="s" joint="roll" kp="2000" kv="50" gear="2"/></actuator>'
    driven = robot(tmp_path, YAW.replace("</worldbody>", f"</worldbody>{servo}"))
    effect = make_robot_simulator(driven).system.effect("drag.linear@roll")
    assert effect.coefficients[0].plausible[0] == (0.0, pytest.approx(4 * 50.0))
    undriven = make_robot_simulator(robot(tmp_path, YAW)).system.effect("drag.linear@roll")
    assert undriven.coefficients[0].plausible[0][1] < 0.1


def test_bounds_far_apart_are_not_met_by_numbers_near_zero():
    assert bound_of(-0.00099, -0.001, MAX_RANGE_FACTOR_MODEL_FILE) is None
    assert bound_of(-0.001, -0.001, MAX_RANGE_FACTOR_MODEL_FILE) == "low"
    assert bound_of(MAX_RANGE_FACTOR_MODEL_FILE, -0.001, MAX_RANGE_FACTOR_MODEL_FILE) == "high"


@pytest.mark.parametrize(("value", "unusual"), [(0.5, False), (0.6, False), (0.61, True)])
def test_a_value_beyond_the_plausible_range_is_unusual(value, unusual):
    assert is_unusual(value, -0.3, 0.6) is unusual
