"""Tests of drives that also act on the previous joint, and of drives that share one battery:
torques, places, and the written file.

`tests.exams.robots.test_reference_world` compares their motion with that of an independent one.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims import effects as library
from sims.core.simulator import InputError, Scenario
from sims.robot.coupled_drives import list_coupling_places
from sims.robot.export.apply_causes import apply_causes
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import ARM, write_and_check
from tests.sims.robot.sample_arms import robot as arm
from tests.sims.robot.test_series_joints import moved, number

C, KP, KV = 0.4, 30.0, 2.0
TABLE = """
<mujoco>
  <option timestep="0.001" integrator="RK4" gravity="0 0 0"/>
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
HINGE = 'name="along" type="slide"', 'name="along" type="hinge"'
SECOND_MOTOR = '<motor name="n" joint="along"/>'
TIMES = np.arange(101) / 100.0
BOTH = ("q.along", "q.across")


def robot_of(actuator, old="", new=""):
    """Return the robot with an actuator, and with another text of its file."""
    text = TABLE.format(actuator=actuator).replace(old, new)
    return RobotModel(Path("t.xml"), "mjcf", mujoco.MjSpec.from_string(text))


def table(*given):
    return make_robot_simulator(robot_of(*given))


def held(u):
    return Scenario(TIMES, {}, {"u.m": np.full(TIMES.size, u)})


def test_a_coupled_servo_keeps_the_command_range_that_it_inherits_from_its_joint():
    """A tendon has no range to inherit: MuJoCo does not compile the actuator unchanged."""
    inherits = SERVO.replace("/>", ' inheritrange="0.5"/>')
    limited = table(inherits, 'name="across"', 'name="across" range="-0.2 0.2"')
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
    robot = robot_of(MOTOR, *HINGE)
    assert list_coupling_places(robot) == (), "metres are no share of an angle"


def test_a_battery_is_there_where_several_drives_of_one_kind_are():
    def there(*given):
        found = library.list_effects_for(table(*given).system)
        return [name for name in found if name.startswith("supply.sag")]

    assert there(MOTOR) == ["supply.sag@m"]
    assert there(MOTOR + SECOND_MOTOR) == [
        "supply.sag@m",
        "supply.sag@n",
        "supply.sag@*",
        "supply.sag",
    ]
    assert "supply.sag" not in there(MOTOR + SECOND_MOTOR, *HINGE), "1/N is no 1/(N m)"


CAUSES = {
    "joint.coupling@elbow": {"coefficient": number(-0.3)},
    "joint.flexibility@shoulder": {"compliance": number(0.01), "damping": number(0.05)},
    "input.gain@m_elbow": {"coefficient": number(0.1)},
    "mass.scale@fore": {"coefficient": number(0.1)},
}


@pytest.mark.parametrize("names", [["joint.coupling@elbow"], list(CAUSES)])
def test_a_file_holds_a_tendon_and_moves_as_the_simulator_does(names, tmp_path):
    robot, causes = arm(tmp_path), {name: CAUSES[name] for name in names}
    done = write_and_check(robot, causes)
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
