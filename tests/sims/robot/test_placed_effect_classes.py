"""Tests of effects at places: names, units and ranges; scales of joints; the state of one joint;
readings between steps.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims import effects
from sims.core.simulator import InputError
from sims.robot.dynamics.effect_forces import compute_time_dependent_forces, make_snapshot
from sims.robot.dynamics.joint_scales import compute_joint_scales
from sims.robot.dynamics.sensor_sampling import sample_readings
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator
from sims.robot.robot_system import make_robot_system
from tests.sims.robot.sample_arms import ARM

RAIL = """
<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom size="0.1" mass="3"/>
      <body name="pole" pos="0 0 0">
        <joint name="hinge" axis="0 1 0" armature="0.01"/>
        <inertial pos="0 0 0.5" mass="0.4" diaginertia="0.01 0.01 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="rail"/>
    <position name="hold" joint="hinge" kp="5"/>
  </actuator>
</mujoco>
"""


def make_robot(text, **given):
    spec = mujoco.MjSpec.from_string(text)
    return RobotModel(Path("robot.xml"), "mjcf", spec, digest=text, **given)


@pytest.fixture(scope="module")
def rail():
    return make_robot_system(make_robot(RAIL, aliases={"plate": "cart"}))


@pytest.fixture(scope="module")
def arm():
    return make_robot_system(make_robot(ARM))


def numbers(effect):
    """Return names, units, ranges and minimum values of the effect's coefficients."""
    return [(c.name, c.units[0], c.plausible[0], c.least) for c in effect.coefficients]


def test_names_are_those_of_the_model(arm):
    there = effects.list_effects_for(arm)
    joints, bodies = ("shoulder", "elbow", "spin"), ("upper", "fore", "wheel")
    wanted = {
        "friction.coulomb": (*joints, "*"),
        "force.ripple": joints,
        "mass.offset": (*bodies, "*"),
        "actuator.stiffness": ("m_shoulder",),
        "actuator.damping": ("m_shoulder", "m_spin", "*"),
        "input.delay": ("m_shoulder", "m_elbow", "m_spin", "*"),
        "friction.load": (*joints, "*"),
        "friction.direction": joints,
        "friction.load_direction": joints,
        "friction.position": joints,
        "supply.braking": ("m_shoulder", "m_elbow", "m_spin", "*"),
        "supply.sag": ("m_shoulder", "m_elbow", "m_spin", "*", ""),
        "joint.coupling": ("elbow", "spin"),
        "input.power": ("m_elbow",),
        "input.rate": ("m_shoulder", "m_elbow", "m_spin", "*"),
        "sensor.eccentricity": ("q.shoulder", "q.elbow", "q.spin"),
        "sensor.slip": ("q.shoulder", "q.elbow", "q.spin"),
        "state.limit": joints,
        "servo.deadband": ("m_shoulder",),
        "servo.derivative": ("m_shoulder",),
        "servo.profile": ("m_shoulder",),
        "gravity.tilt": ("",),
        "clock.skew": ("",),
        "lift.magnus": (),
        "restitution.speed": (),
        "wind": (),
    }
    for base, places in wanted.items():
        found = {name for name in there if name.partition("@")[0] == base}
        assert found == {f"{base}@{place}" if place else base for place in places}, base
    biased = {one.place for name, one in there.items() if name.startswith("sensor.bias@")}
    assert biased == {c.name for c in arm.channels} | {"*"}
    encoders = there["sensor.bias@*"]
    assert encoders.places == ("q.shoulder", "q.elbow", "q.spin"), "encoders are of one make"


def test_units_are_those_of_the_place(rail):
    at = rail.effect
    assert numbers(at("sensor.bias@q.rail"))[0][1] == "m"
    assert numbers(at("sensor.drift@qd.hinge"))[0][1] == "rad/s/s"
    assert numbers(at("sensor.gain@tau.rail"))[0][1] == "1"
    assert numbers(at("input.bias@push"))[0][1] == "N"
    assert numbers(at("input.bias@hold"))[0][1] == "rad"
    assert numbers(at("drag.linear@rail"))[0][1] == "N*s/m"
    assert numbers(at("drag.linear@hinge"))[0][1] == "N*m*s/rad"
    assert [c.name for c in at("drag.linear@*").coefficients] == [
        "coefficient@rail",
        "coefficient@hinge",
    ]
    assert [unit for _, unit, *_ in numbers(at("friction.coulomb@*"))] == ["N", "N*m"]
    assert len(at("input.delay@*").coefficients) == 1, "what is late is late everywhere"


def test_ranges_take_away_what_the_file_states_and_no_more(arm):
    at = arm.effect
    (name, _, (low, high), least) = numbers(at("friction.coulomb@elbow"))[0]
    assert (name, low, least) == ("coefficient", -0.05, -0.05)
    assert high > 0.1
    assert numbers(at("drag.linear@spin"))[0][2:] == ((0.0, at("drag.linear@spin").coefficients[0]
                                                       .plausible[0][1]), 0.0)  # fmt: skip
    assert numbers(at("input.delay@m_elbow"))[0][2][0] == -0.05, "stamps may lag"
    wide, narrow = (numbers(at(f"force.bias@{joint}"))[0][2] for joint in ("shoulder", "spin"))
    assert wide[1] == -wide[0] > 100 * narrow[1], "a shoulder carries more than a wheel"
    assert numbers(at("mass.scale@fore"))[0][2:] == ((-0.5, 0.5), -0.99)


def test_a_file_may_state_less_than_nothing():
    pushes = make_robot_system(make_robot(ARM.replace('damping="0.1"', 'damping="-0.5"')))
    (_, _, (low, high), least) = numbers(pushes.effect("drag.linear@elbow"))[0]
    assert (low, least, high) == (0.0, 0.0, 1.0), "there is nothing to take away"


def test_a_place_that_does_not_exist_lists_those_that_do(rail):
    with pytest.raises(InputError, match=r"unknown place .*'wrist'; there are: \*, hinge, rail"):
        rail.effect("friction.coulomb@wrist")
    with pytest.raises(InputError, match=r"needs a place; there are: friction.coulomb@\*"):
        rail.effect("friction.coulomb")
    with pytest.raises(InputError, match=r"cannot have effect lift\.magnus"):
        rail.effect("lift.magnus@rail")
    with pytest.raises(InputError, match=r"unknown effect 'friction\.glue'"):
        rail.effect("friction.glue@rail")
    assert rail.effect("mass.scale@plate").name == "mass.scale@cart", "a link on a fixed joint"


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("damping@elbow", ["drag.linear@elbow"]),
        ("frictionloss@*", [f"friction.coulomb@{j}" for j in ("shoulder", "elbow", "spin")]),
        ("mass@fore", ["mass.scale@fore"]),
        ("gravity", ["gravity.scale"]),
        ("kp@m_shoulder", ["actuator.stiffness@m_shoulder"]),
    ],
)
def test_free_parameters_are_not_causes(word, names):
    kind = make_robot_simulator(make_robot(ARM), [word])
    assert [p.name for p in kind.parameters] == names
    there = effects.list_effects_for(kind.system)
    assert not there.keys() & {*names, f"{names[0].partition('@')[0]}@*"}
    # A file may still name it: the extended simulator of a log for which it was not free.
    assert kind.system.effect(names[0]).name == names[0]


def test_a_payload_is_not_proposed_on_a_body_whose_mass_is_free():
    kind = make_robot_simulator(make_robot(ARM), ["mass@fore"])
    usual = effects.list_effects_for(make_robot_simulator(make_robot(ARM)).system)
    assert {"payload@fore", "payload@upper"} <= usual.keys()
    there = effects.list_effects_for(kind.system)
    assert "payload@fore" not in there
    assert {"payload@upper", "mass.offset@fore"} <= there.keys()
    # A file may still name it, with a payload that was found when the mass was not free.
    assert len(kind(effects=["payload@fore"]).parameters) == 1 + 4


def test_a_family_contains_its_members_and_what_they_contain(arm):
    stribeck, family = arm.effect("friction.stribeck@elbow"), arm.effect("friction.coulomb@*")
    assert stribeck.contains == ("friction.coulomb@elbow",)
    assert set(family.contains) == {f"friction.coulomb@{j}" for j in ("shoulder", "elbow", "spin")}
    (first, c), *others = family().parts(np.arange(3.0)[:, None, None])
    assert (type(first).name, c.item()) == ("friction.coulomb@shoulder", 0.0)
    assert [type(one).place for one, _ in others] == ["elbow", "spin"]


def test_scales_are_what_gravity_pulls_with_and_what_turns(rail):
    sizes = compute_joint_scales(rail.robot)
    # For each joint alone: the cart with the pole on it, the pole about its hinge.
    np.testing.assert_allclose(sizes.inertia, [3.4, 0.01 + 0.01 + 0.4 * 0.5**2], rtol=1e-9)
    weight = 0.4 * 9.81 * 0.5
    assert 0.9 * weight < sizes.force[1] <= weight
    assert sizes.force[0] == pytest.approx(5.0 * 3.4), "without weight, what accelerates it"
    small = RAIL.replace('mass="3"', 'mass="1e-5"').replace('mass="0.4"', 'mass="1e-9"')
    assert compute_joint_scales(make_robot(small)).force.min() == 1e-4


def test_an_effect_sees_its_joint_alone(rail):
    x, v = np.array([[0.1, 0.2], [0.3, 0.4]]), np.array([[1.0, -2.0], [-3.0, 4.0]])
    inputs = {"u.push": np.full((2, 1), 7.0), "u.hold": np.full((2, 1), 0.5)}
    moment = make_snapshot(rail(), np.full((2, 1), 0.25), x, v, inputs, np.stack([-3 * x, 2 * x]))
    hinge = moment.get_joint_snapshot(1)
    np.testing.assert_array_equal(hinge.primary, [[0.2], [0.4]])
    np.testing.assert_array_equal(hinge.speed, [[2.0], [4.0]])
    np.testing.assert_allclose(hinge.load, [[0.2], [0.4]])
    np.testing.assert_allclose(hinge.sides, [[[-0.6], [-1.2]], [[0.4], [0.8]]])
    assert set(hinge.inputs) == {"u.hold"}
    assert (hinge.system.kind, moment.get_joint_snapshot(0).system.kind) == ("rotary", "linear")
    np.testing.assert_array_equal(hinge.along_primary(np.array([[5.0], [6.0]])), [[5.0], [6.0]])


def test_a_force_at_a_joint_pushes_that_joint(rail):
    moment = make_snapshot(rail(), np.zeros((1, 1)), np.array([[0.1, 0.2]]), np.ones((1, 2)), {},
                       np.zeros((2, 1, 2)))  # fmt: skip
    ripple = rail.effect("force.ripple@hinge")()
    c = np.array([0.0, 0.7, 0.5])[:, None, None]
    expected = [[0.0, 0.7 * np.cos(2 * np.pi * 0.2 / 0.5)]]
    np.testing.assert_allclose(ripple.force(c, moment), expected, rtol=1e-12)


def test_a_force_of_time_is_that_of_the_middle_of_each_step(rail):
    """The force is separate for each batch element, acts along its joint only, and is zero
    elsewhere.
    """
    shake, bias = rail.effect("force.periodic@hinge")(), rail.effect("force.bias@rail")()
    shaken = np.array([[0.0, 0.3], [0.0, 0.0], [0.0, 2.0]])[:, :, None]
    pushed = np.array([[4.0, 0.0]])[:, :, None]
    begins = np.arange(5) * 0.01
    forces = compute_time_dependent_forces(rail(), ((shake, shaken), (bias, pushed)), begins, 2, 2)
    expected = np.zeros((2, 5, 2))
    expected[0, :, 0] = 4.0
    expected[1, :, 1] = 0.3 * np.sin(4 * np.pi * (begins + 0.005))
    np.testing.assert_allclose(forces, expected, rtol=0, atol=1e-12)


STEP = 0.02


def cubic(t):
    return 1.0 + 2.0 * t - 3.0 * t**2 + 40.0 * t**3


def test_a_cubic_is_read_exactly_and_ends_of_steps_to_the_bit():
    ends = STEP * np.arange(6)
    values, slopes = cubic(ends)[None], (2.0 - 6.0 * ends + 120.0 * ends**2)[None]
    between = np.array([0.0, 0.003, 0.02, 0.0555, 0.0999, 0.1])
    seen = sample_readings(values, slopes, STEP, between, ())
    np.testing.assert_allclose(seen[0], cubic(between), rtol=0, atol=1e-14)
    assert (seen[0, 0], seen[0, 2], seen[0, 5]) == (values[0, 0], values[0, 1], values[0, 5])
    near = sample_readings(
        values, slopes, STEP, ends + 1e-9 * STEP * np.array([0, 1, -1, 1, -1, 0]), ()
    )
    np.testing.assert_array_equal(near[0], values[0])
    linear = sample_readings(values, None, STEP, np.array([0.005]), ())
    assert linear[0, 0] == pytest.approx(0.75 * values[0, 0] + 0.25 * values[0, 1])


def test_sensors_follow_each_other_in_the_elements_where_they_act(arm):
    ends = STEP * np.arange(11)
    values = np.repeat(cubic(ends)[None], 3, axis=0)
    slopes = np.repeat((2.0 - 6.0 * ends + 120.0 * ends**2)[None], 3, axis=0)
    late, gain, drift = (
        arm.effect(f"sensor.{name}@q.elbow")() for name in ("delay", "gain", "drift")
    )
    times = np.array([0.0, 0.0333, 0.1, 0.19])
    column = lambda *c: np.array(c)[None, :, None]  # noqa: E731
    sensors = (
        (late, column(0.013, 0.0, 0.0)),
        (gain, column(0.5, 0.5, 0.0)),
        (drift, column(0.0, 2.0, 0.0)),
    )
    seen = sample_readings(values, slopes, STEP, times, sensors)
    shifted = np.maximum(times - 0.013, 0.0)
    np.testing.assert_allclose(seen[0], 1.5 * cubic(shifted), rtol=0, atol=1e-13)
    np.testing.assert_allclose(seen[1], 1.5 * cubic(times) + 2.0 * times, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(seen[2], sample_readings(values, slopes, STEP, times, ())[2])


def test_an_encoder_of_a_robot_slips_on_the_clock_of_the_stamps(arm):
    slip = arm.effect("sensor.slip@q.elbow")()
    times = STEP * np.arange(6)
    lanes = np.array([[0.0, 0.2], [1.0, 1.0]])[:, :, None]
    still = np.full((2, 6), 0.3)
    seen = sample_readings(still, np.zeros((2, 6)), STEP, times, ((slip, lanes),), 1.0 - 2.5 * STEP)
    np.testing.assert_allclose(seen[1], [0.3] * 3 + [0.5] * 3, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(seen[0], still[0])
    with pytest.raises(InputError, match="place"):
        arm.effect("sensor.slip@qd.elbow")
