"""Tests of drives that also act on the previous joint, and of drives that share one battery: closed
forms, places, and the written file.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims import effects as library
from sims.core.simulator import InputError, Scenario
from sims.robot.coupled_drives import list_coupling_places
from sims.robot.export.apply_causes import apply_causes
from sims.robot.export.round_trip_check import check_written_files
from sims.robot.export.write_model_file import write_model_files
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import ARM
from tests.sims.robot.sample_arms import robot as arm
from tests.sims.robot.test_series_joints import moved, number

CART, TOOL = 1.5, 0.5  # kg
C, KP, KV = 0.4, 30.0, 2.0
TABLE = """
<mujoco>
  <option timestep="0.001" integrator="{integrator}" gravity="0 0 0"/>
  <worldbody>
    <body name="cart">
      <joint name="along" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1.5" diaginertia="1 1 1"/>
      <body name="tool">
        <joint name="across" type="slide" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.5" diaginertia="1 1 1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    {actuator}
  </actuator>
</mujoco>
"""
MOTOR = '<motor name="m" joint="across" gear="2" forcerange="-3 3"/>'
SERVO = f'<position name="m" joint="across" kp="{KP}" kv="{KV}"/>'
SECOND_MOTOR = '<motor name="n" joint="along"/>'
TIMES = np.arange(101) / 100.0
BOTH = ("q.along", "q.across")


def table(actuator, integrator="RK4"):
    text = TABLE.format(actuator=actuator, integrator=integrator)
    return make_robot_simulator(RobotModel(Path("t.xml"), "mjcf", mujoco.MjSpec.from_string(text)))


def held(u):
    return Scenario(TIMES, {}, {"u.m": np.full(TIMES.size, u)})


def test_a_coupled_motor_pushes_both_joints_by_its_gear():
    """p'' = c U / (m + M) and q'' = U / m, with U limited; the reported torques agree."""
    observe = (*BOTH, "tau.along", "tau.across")
    for u, force in ((0.5, 1.0), (9.0, 6.0)):
        seen = moved(table(MOTOR), ["joint.coupling@across"], [C], held(u), observe)
        way = 0.5 * force * TIMES**2
        np.testing.assert_allclose(seen[:, 0], C * way / (CART + TOOL), atol=1e-9)
        np.testing.assert_allclose(seen[:, 1], way / TOOL, atol=1e-9)
        np.testing.assert_allclose(seen[:, 2:], [[C * force, force]] * TIMES.size, atol=1e-9)


@pytest.mark.parametrize(("integrator", "close"), [("RK4", 1e-9), ("implicitfast", 1e-3)])
def test_a_coupled_servo_follows_the_sum_that_its_shaft_turns(integrator, close):
    """l = q + c p moves like a mass of 1 / (1 / m + c^2 / (m + M)) with kp and kv."""
    observe = (*BOTH, "tau.along", "tau.across")
    kind = table(SERVO, integrator)
    seen = moved(kind, ["joint.coupling@across"], [C], held(0.1), observe)
    mass = 1.0 / (1.0 / TOOL + C**2 / (CART + TOOL))
    decay = 0.5 * KV / mass
    rate = np.sqrt(KP / mass - decay**2)
    left = np.exp(-decay * TIMES) * (np.cos(rate * TIMES) + decay / rate * np.sin(rate * TIMES))
    both = 0.1 * (1.0 - left)
    np.testing.assert_allclose(seen[:, 1], both * mass / TOOL, atol=close)
    np.testing.assert_allclose(seen[:, 0], C * both * mass / (CART + TOOL), atol=close)
    np.testing.assert_allclose(seen[:, 2], C * seen[:, 3], atol=1e-12)
    alone = moved(kind, ["joint.coupling@across"], [0.0], held(0.1), observe)
    assert np.abs(alone[:, 0]).max() == 0.0
    assert np.abs(alone[:, 1] - seen[:, 1]).max() > 3e-3


def test_a_coupled_servo_keeps_the_command_range_that_it_inherits_from_its_joint():
    """A tendon has no range to inherit: MuJoCo does not compile the actuator unchanged."""
    inherits = SERVO.replace("/>", ' inheritrange="0.5"/>')
    text = TABLE.format(actuator=inherits, integrator="RK4")
    text = text.replace('name="across"', 'name="across" range="-0.2 0.2"')
    limited = make_robot_simulator(
        RobotModel(Path("t.xml"), "mjcf", mujoco.MjSpec.from_string(text))
    )
    clipped = moved(limited, ["joint.coupling@across"], [C], held(0.15), BOTH)
    expected = moved(table(SERVO), ["joint.coupling@across"], [C], held(0.1), BOTH)
    np.testing.assert_allclose(clipped, expected, atol=1e-9)


def test_what_drives_say_between_samples_is_theirs_at_both_joints():
    """Each reported torque is that of the command at its sample time."""
    times = np.arange(50) / 100.0
    run = Scenario(times, {}, {"u.m": np.sin(20.0 * times)})
    seen = moved(table(MOTOR), ["joint.coupling@across"], [C], run, ("tau.along", "tau.across"))
    np.testing.assert_allclose(seen[:, 1], 2.0 * np.sin(20.0 * times), atol=1e-9)
    np.testing.assert_allclose(seen[:, 0], C * seen[:, 1], atol=1e-12)


def test_it_is_at_driven_joints_behind_one_of_their_kind():
    kind = table(MOTOR + SECOND_MOTOR)
    there = {
        name for name in library.list_effects_for(kind.system) if name.startswith("joint.coupling")
    }
    assert there == {"joint.coupling@across"}, "nothing is before the first one"
    with pytest.raises(InputError, match="there are: across"):
        kind.system.effect("joint.coupling@along")
    turned = TABLE.format(actuator=MOTOR, integrator="RK4").replace(
        'name="along" type="slide"', 'name="along" type="hinge"'
    )
    robot = RobotModel(Path("t.xml"), "mjcf", mujoco.MjSpec.from_string(turned))
    assert list_coupling_places(robot) == (), "metres are no share of an angle"


@pytest.mark.parametrize("u", [(4.0, 1.0), (-4.0, 1.0), (40.0, -20.0)])
def test_one_battery_gives_each_drive_what_all_together_leave(u):
    """F_i = U_i (1 - c (|F_1| + |F_2|)), and the sum stays below 1 / c."""
    kind, c = table(MOTOR.replace('forcerange="-3 3"', "") + SECOND_MOTOR), 0.1
    first, second = (np.full(TIMES.size, one) for one in u)
    run = Scenario(TIMES, {}, {"u.m": first, "u.n": second})
    seen = moved(kind, ["supply.sag"], [c], run, ("q.across", "q.along"))
    forces = 2.0 * seen[-1] / TIMES[-1] ** 2 * [TOOL, CART + TOOL]
    wanted = np.array([2.0, 1.0]) * u
    np.testing.assert_allclose(forces, wanted * (1 - c * np.abs(forces).sum()), rtol=1e-9)
    assert np.abs(forces).sum() < 1 / c
    apart = moved(kind, ["supply.sag@m"], [c], run, ("q.across", "q.along"))
    assert apart[-1, 1] == pytest.approx(u[1] / (CART + TOOL) / 2 * TIMES[-1] ** 2)


def test_a_battery_is_there_where_several_drives_of_one_kind_are():
    def there(actuators, text=TABLE):
        text = text.format(actuator=actuators, integrator="RK4")
        robot = RobotModel(Path("t.xml"), "mjcf", mujoco.MjSpec.from_string(text))
        found = library.list_effects_for(make_robot_simulator(robot).system)
        return [name for name in found if name.startswith("supply.sag")]

    assert there(MOTOR) == ["supply.sag@m"]
    assert there(MOTOR + SECOND_MOTOR) == [
        "supply.sag@m",
        "supply.sag@n",
        "supply.sag@*",
        "supply.sag",
    ]
    turned = TABLE.replace('name="along" type="slide"', 'name="along" type="hinge"')
    assert "supply.sag" not in there(MOTOR + SECOND_MOTOR, turned), "1/N is no 1/(N m)"


CAUSES = {
    "joint.coupling@elbow": {"coefficient": number(-0.3)},
    "joint.flexibility@shoulder": {"compliance": number(0.01), "damping": number(0.05)},
    "input.gain@m_elbow": {"coefficient": number(0.1)},
    "mass.scale@fore": {"coefficient": number(0.1)},
}


@pytest.mark.parametrize("names", [["joint.coupling@elbow"], list(CAUSES)])
def test_a_file_holds_a_tendon_and_moves_as_the_simulator_does(names, tmp_path):
    robot, causes = arm(tmp_path), {name: CAUSES[name] for name in names}
    done = write_model_files(robot, causes, "log.csv")
    check_written_files(robot, causes, done)
    assert "the elbow is the one that wears" in done.xml, "it stays its author's"
    (tmp_path / "extended.xml").write_text(done.xml)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "extended.xml"))
    assert model.wrap_prm.tolist() == [1.0, -0.3]
    times = np.arange(200) * 0.001
    command = 0.8 * np.sin(9.0 * times)
    # As a user steps the file: each control is constant over a step.
    data, path = mujoco.MjData(model), []
    for u in command:
        path.append([data.joint(name).qpos[0] for name in ("shoulder", "elbow", "spin")])
        data.actuator("m_elbow").ctrl[:] = u
        mujoco.mj_step(model, data)
    run = Scenario(times, {}, {"u.m_elbow": command})
    numbers = [one.value for name in names for one in causes[name].values()]
    kind = make_robot_simulator(robot)
    seen = moved(kind, names, numbers, run, ("q.shoulder", "q.elbow", "q.spin"))
    plain = moved(kind, names[1:], numbers[1:], run, ("q.shoulder", "q.elbow", "q.spin"))
    path = np.array(path)
    if len(names) == 1:
        np.testing.assert_allclose(seen, path, atol=1e-12)
    assert np.abs(seen - plain).max() > 1e-2


def test_a_constant_force_is_no_bias_of_a_drive_that_is_coupled(tmp_path):
    """It would also push the previous joint, so the file reports that it cannot represent it."""
    text = ARM.replace('stiffness="0.5"\n               springref="10"', "")
    text = text.replace('forcelimited="true" forcerange="-1 4"', "")
    robot = arm(tmp_path, text)
    push = {"force.bias@elbow": {"coefficient": number(0.2)}}
    assert [one.name for one in apply_causes(robot, push).held] == ["force.bias@elbow"]
    both = {"joint.coupling@elbow": {"coefficient": number(0.3)}, **push}
    assert [one.name for one in apply_causes(robot, both).held] == ["joint.coupling@elbow"]
