"""Tests of writing causes into a robot's own file: the author's text is kept, and the motion is
right.
"""

import difflib
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.extended_simulator import FittedValue
from sims.robot.export.round_trip_check import check_written_files, simulate_test_motion
from sims.robot.export.write_model_file import write_model_files
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import ARM, robot, write_and_check
from tests.sims.robot.test_model_changes import MOVING, number, one

TIMES = np.linspace(0.0, 0.5, 501)
CAUSES = {
    "friction.coulomb@*": {
        "coefficient@elbow": number(0.3, "N*m"),
        "coefficient@shoulder": number(0.1, "N*m"),
    },
    "mass.scale@upper": one(0.1),
    "mass.offset@fore": {"x": number(0.01, "m"), "z": number(-0.02, "m")},
    "input.gain@m_elbow": one(0.1),
    "actuator.stiffness@m_shoulder": one(0.1),
    "actuator.damping@m_spin": one(-0.2),
    "gravity.tilt": {"x": number(0.01), "y": number(0.02)},
    "backlash@m_elbow": one(0.1),
}


def test_an_mjcf_stays_its_authors(tmp_path):
    """Only lines with other values change; each change has a comment before it."""
    arm = robot(tmp_path)
    done = write_model_files(arm, CAUSES, "log.csv")
    before, after = ARM.splitlines(), done.xml.splitlines()
    changes = [line for line in difflib.ndiff(before, after) if line[0] in "-+"]
    gone = [line[2:].strip() for line in changes if line[0] == "-"]
    comments = [line[2:].strip() for line in changes if line.startswith("+ ") and "<!--" in line]
    assert len(gone) == 8
    assert "<!-- the elbow is the one that wears -->" in done.xml
    told = "friction.coulomb@elbow: 0.3 N·m (95 %: 0.27 to 0.33), fitted to log.csv"
    place = next(i for i, line in enumerate(after) if told in line)
    assert 'name="elbow"' in after[place + 1]
    assert 'frictionloss="0.35"' in after[place + 1]
    assert "solreffriction" in after[place + 2]
    assert sum("fitted to log.csv" in line for line in comments) == 8
    assert "backlash@m_elbow: 0.1" in done.xml, "what it cannot hold stands at its top"
    assert 'kp="66"' in done.xml
    assert any("backlash@m_elbow" in line for line in done.notes)
    check_written_files(arm, CAUSES, done)


def test_nothing_found_leaves_the_file(tmp_path):
    """Without causes the text is unchanged, except for a line about its origin."""
    arm = robot(tmp_path)
    text = write_model_files(arm, {}, "log.csv").xml
    assert text is not None
    lines = [line for line in text.splitlines() if "<!-- arm.xml" not in line]
    assert lines == ARM.splitlines()


def test_what_one_writes_a_rollout_moves(tmp_path):
    """The written file moves with the causes, not as the original file."""
    arm = robot(tmp_path)
    done = write_model_files(arm, CAUSES)
    path = tmp_path / "elsewhere" / "extended.xml"
    path.parent.mkdir()
    path.write_text(done.xml)
    motion = simulate_test_motion(mujoco.MjModel.from_xml_path(str(path)))
    np.testing.assert_allclose(motion, simulate_test_motion(done.applied.model), rtol=0, atol=1e-9)
    assert np.abs(motion - simulate_test_motion(arm.compiled)).max() > 1e-2


PARTS = {
    "main.xml": """<?xml version="1.0" encoding="utf-8"?>
<!-- a robot, with windows -->
<mujoco model="parts">
  <compiler angle="radian" meshdir="meshes"/>
  <include file="defaults.xml"/>
  <asset><mesh name="t" file="t.obj"/></asset>
  <worldbody>
    <frame pos="0 0 1">
      <body name="a" childclass="arm">
        <joint/>
        <geom type="mesh" mesh="t"/>
        <include file="fore.xml"/>
      </body>
    </frame>
  </worldbody>
  <actuator>
    <position class="arm" joint="e"/>
    <general joint='e' gainprm="2" biastype="affine" biasprm="1 0 -.1"/>
  </actuator>
</mujoco>
""",
    "defaults.xml": """<mujocoinclude><default><default class="arm">
  <joint axis="0 1 0" damping="0.3 0.1" armature="0.02" range="-2 2"/>
  <position kp="40" dampratio="0.7" ctrlrange="-1 1"/></default></default></mujocoinclude>
""",
    "fore.xml": """<mujocoinclude>
  <body name="b" pos=".3 0 0"><joint name="e"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/></body>
</mujocoinclude>
""",
    "meshes/t.obj": "v 0 0 0\nv .3 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
}


def test_files_of_a_file_are_found_from_anywhere(tmp_path):
    """Unchanged includes stay includes, meshes are found, line ends are kept, and classes and
    unnamed elements are supported.
    """
    home = tmp_path / "home"
    for name, text in PARTS.items():
        path = home / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.replace("\n", "\r\n").encode())
    arm = read_robot(home / "main.xml")
    causes = {
        "drag.quadratic@e": one(0.05),
        "inertia.armature@joint0": one(0.01),
        "mass.scale@a": one(0.2),
        "input.bias@actuator0": one(0.02),
    }
    done = write_and_check(arm, causes)
    assert not done.notes
    assert 'file="defaults.xml"' not in done.xml
    assert str(home / "defaults.xml") in done.xml
    assert 'class="arm">' not in done.xml.replace('childclass="arm">', "")
    assert "start of fore.xml" in done.xml
    assert 'damping="0.3 0.15' in done.xml
    assert done.xml.count("\r\n") == done.xml.count("\n")


REPEATED = """
<mujoco><worldbody><replicate count="2" offset="0 .2 0"><body name="a">
  <joint name="j" axis="0 1 0" damping="0.1"/><geom size=".05" pos=".3 0 0"/></body></replicate>
</worldbody></mujoco>
"""


def test_where_elements_are_repeated_mujoco_writes(tmp_path):
    """Only one of the elements that a repeated element stands for changes, with its comment."""
    arm = robot(tmp_path, REPEATED)
    causes = {"drag.linear@j1": one(0.123456789012345)}
    done = write_and_check(arm, causes)
    (line,) = done.notes
    assert "<replicate>" in line
    before, _, _ = done.xml.partition('name="j1"')
    assert "drag.linear@j1" in before.splitlines()[-2]


def test_what_moves_along_is_stated(tmp_path):
    """A damping ratio becomes the damping that it gave before, with a comment."""
    arm = robot(tmp_path, MOVING)
    done = write_and_check(arm, {"mass.scale@b": one(0.2)})
    assert not done.notes
    assert "dampratio" not in done.xml
    assert 'springdamper="0 0"' in done.xml
    # The inertial that the compiler ignored, the spring and the servo.
    assert done.xml.count("unchanged: without this line") == 3


def test_another_motion_is_a_fault_of_the_program(tmp_path):
    """A file that does not match the model is not written; the error names the field."""
    arm = robot(tmp_path)
    done = write_model_files(arm, CAUSES)
    wrong = replace(done, xml=done.xml.replace('frictionloss="0.35"', 'frictionloss="0.35001"'))
    with pytest.raises(RuntimeError, match="dof_frictionloss"):
        check_written_files(arm, CAUSES, wrong)


def test_two_hyphens_end_no_comment(tmp_path):
    """A recording may have any name."""
    arm = robot(tmp_path)
    write_and_check(arm, {"drag.linear@elbow": one(0.1)}, "a--b-->-")


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="fore">
    <inertial><origin xyz="0.1 0 0" rpy="0.3 0 0"/><mass value="1.2"/>
      <inertia ixx="0.01" ixy="0.001" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial>
  </link>
  <link name="tool">
    <inertial><mass value="0.3"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>
  </link>
  <!-- the elbow -->
  <joint name="elbow" type="continuous">
    <parent link="base"/><child link="fore"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <dynamics damping="0.2"/>
  </joint>
  <joint name="weld" type="fixed">
    <parent link="fore"/><child link="tool"/><origin xyz="0.2 0 0" rpy="0 0.5 1.0"/>
  </joint>
</robot>
"""


def test_a_urdf_says_what_it_can(tmp_path):
    """Links on fixed joints change with their body; other causes are noted and are in the MJCF
    only.
    """
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    arm = read_robot(path)
    causes = {
        "drag.linear@elbow": one(0.1),
        "friction.coulomb@elbow": one(0.05),
        "mass.scale@fore": one(0.2),
        "mass.offset@fore": {"x": number(0.01, "m"), "y": number(0.02, "m")},
        "inertia.armature@elbow": one(0.01),
        "inertia.scale@fore": one(0.1),
    }
    done = write_and_check(arm, causes)
    assert '<dynamics damping="0.30000000000000004" friction="0.05"/>' in done.urdf
    assert "<!-- the elbow -->" in done.urdf
    unsaid = {line.partition(":")[0] for line in done.notes if "not in the URDF" in line}
    assert unsaid == {"inertia.armature@elbow", "inertia.scale@fore"}
    stiff = "a URDF cannot state that dry friction is stiff"
    assert stiff in done.urdf
    soft = write_model_files(arm.with_friction_form("soft"), causes, "log.csv")
    assert 'friction="0.05"' in soft.urdf
    assert stiff not in soft.urdf
    assert "inertia.armature@elbow" in done.xml
    wrong = replace(done, urdf=done.urdf.replace('friction="0.05"', 'friction="0.06"'))
    with pytest.raises(RuntimeError, match="dof_frictionloss"):
        check_written_files(arm, causes, wrong)


MASSLESS = """<robot name="arm">
  <link name="base"/>
  <link name="fore"INERTIAL
  <link name="tip"><inertial><mass value="0"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>
  <link name="tool">
    <inertial><origin xyz="0.05 0 0.02" rpy="0.3 0 0"/><mass value="0.3"/>
      <inertia ixx="0.001" ixy="0.0001" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial>
  </link>
  <joint name="elbow" type="continuous">
    <parent link="base"/><child link="fore"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="frame" type="fixed">
    <parent link="fore"/><child link="tip"/><origin xyz="0.1 0 0" rpy="0 0 0.4"/>
  </joint>
  <joint name="weld" type="fixed">
    <parent link="tip"/><child link="tool"/><origin xyz="0.2 0 0" rpy="0 0.5 1.0"/>
  </joint>
</robot>
"""


@pytest.mark.parametrize("inertial", ["/>", '><inertial><mass value="0"/></inertial></link>'])
def test_a_urdf_says_what_massless_links_carry(tmp_path, inertial):
    """If the mass of a body is on a link behind fixed joints, that link is changed."""
    path = tmp_path / "arm.urdf"
    path.write_text(MASSLESS.replace("INERTIAL", inertial))
    arm = read_robot(path)
    causes = {
        "mass.scale@fore": one(0.2),
        "mass.offset@fore": {"x": number(0.01, "m"), "z": number(0.02, "m")},
        "inertia.scale@fore": one(0.1),
    }
    done = write_and_check(arm, causes)
    assert not [line for line in done.notes if "not in the URDF" in line]
    assert '<mass value="0.36"/>' in done.urdf
    changed = done.urdf.partition('<link name="tool">')[2].partition("</link>")[0]
    assert changed.count("fitted to log.csv") == done.urdf.count("fitted to log.csv") == 3


def test_a_urdf_body_without_any_inertial_is_said(tmp_path):
    """A mass computed from shapes has no number in the file."""
    shape = '><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'
    path = tmp_path / "arm.urdf"
    path.write_text(MASSLESS.replace("INERTIAL", shape))
    arm = read_robot(path)
    causes = {"mass.scale@fore": one(0.2)}
    done = write_and_check(arm, causes)
    (line,) = [line for line in done.notes if "not in the URDF" in line]
    assert "states no inertial" in line


def simulate_elbow(arm, effect, value, command, activation=()):
    """Return the elbow with an effect, without it, and in MuJoCo with the written file.

    Args:
        arm: robot.
        effect: effect on the command of the elbow.
        value: its coefficient, s.
        command: command at each step.
        activation: initial activation of filters in the written file.
    """
    simulator = make_robot_simulator(arm)(observe=["q.elbow"], effects=[effect])
    scenario = Scenario(times=TIMES, inputs={"u.m_elbow": command})
    shown, direct = simulator.simulate_batch(np.array([[value], [0.0]]), [scenario] * 2)
    done = write_model_files(arm, {effect: {"coefficient": number(value, "s")}})
    model = mujoco.MjModel.from_xml_string(done.xml)
    data, positions = mujoco.MjData(model), []
    data.act[:] = activation
    for u in command:
        positions.append(data.qpos[1])
        data.ctrl[1] = u
        mujoco.mj_step(model, data)
    return shown[:, 0], direct[:, 0], np.array(positions)


def test_a_delay_is_that_of_the_simulator(tmp_path):
    """In both, a control delayed by a fraction of a step is the mean over the step."""
    command = np.where(TIMES > 0.05, np.sin(9.0 * TIMES), 0.0)
    shown, _, written = simulate_elbow(robot(tmp_path), "input.delay@m_elbow", 0.0123, command)
    np.testing.assert_allclose(shown, written, rtol=0, atol=1e-9)
    assert np.ptp(written) > 0.1


NAMELESS = """<mujoco>
  <worldbody>
    <body>
      <joint name="hip" axis="0 1 0"/>
      <geom size="0.05" pos="0.3 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="hip" gear="3" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_an_actuator_without_a_name_keeps_none(tmp_path):
    """An unnamed actuator, read under the name of its joint, stays unnamed in the file."""
    path = tmp_path / "leg.xml"
    path.write_text(NAMELESS)
    arm = read_robot(path)
    causes = {f"input.lag@{arm.actuators[0].name}": {"coefficient": number(0.05, "s")}}
    done = write_and_check(arm, causes)
    (line,) = done.notes
    assert line.startswith("input.lag")
    (actuator,) = [line for line in done.xml.splitlines() if "<general" in line]
    assert 'dyntype="filterexact" dynprm="0.05"' in actuator
    assert "name=" not in actuator
    assert 'gear="3" ctrllimited="true" ctrlrange="-1 1"' in actuator


def test_a_lag_settled_at_its_first_command_is_that_of_the_simulator(tmp_path):
    """If MuJoCo's filter begins at the first command, the motion is close to the simulator's."""
    command = 0.3 + np.sin(9.0 * TIMES)
    shown, direct, written = simulate_elbow(
        robot(tmp_path), "input.lag@m_elbow", 0.05, command, command[0]
    )
    # The simulator uses the mean over each step, MuJoCo the value at its start: half a step
    # difference.
    effect = abs(shown[-1] - direct[-1])
    assert effect > 0.1
    assert abs(written[-1] - shown[-1]) < 0.02 * effect


def test_actuators_of_a_recording_are_written_into_the_file(tmp_path):
    """The author's text has no element for them, so MuJoCo writes the model."""
    path = tmp_path / "leg.xml"
    actuator = NAMELESS[NAMELESS.index("  <actuator>") : NAMELESS.index("</mujoco>")]
    path.write_text(NAMELESS.replace(actuator, ""))
    added = {"m_hip": {"joint": "hip", "kind": "position", "kp": 4.0, "kv": 0.5}}
    leg = read_robot(path, actuators=added)
    causes = {"actuator.stiffness@m_hip": one(0.5)}
    done = write_and_check(leg, causes)
    model = mujoco.MjModel.from_xml_string(done.xml)
    assert model.actuator_gainprm[0, 0] == pytest.approx(6.0)
    assert any("its actuators are the recording's" in line for line in done.notes)


def test_compensated_gravity_is_written_as_such(tmp_path):
    arm = robot(tmp_path)
    causes = {"gravity.scale": {"coefficient": FittedValue(-0.999, "1", -1.001, -0.997)}}
    done = write_and_check(arm, causes)
    assert done.xml.count('gravcomp="1"') == 3
    model = mujoco.MjModel.from_xml_string(done.xml)
    assert model.opt.gravity.tolist() == [0.0, 0.0, -9.81]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # Gravity compensation cancels the weight.
    np.testing.assert_allclose(data.qfrc_gravcomp, data.qfrc_bias, rtol=1e-9, atol=1e-12)
    assert np.abs(data.qfrc_bias).max() > 1.0
    assert any("gravity is compensated" in line for line in done.notes)


def test_a_gravity_that_is_only_weaker_is_scaled(tmp_path):
    causes = {"gravity.scale": {"coefficient": FittedValue(-0.9, "1", -0.91, -0.89)}}
    done = write_model_files(robot(tmp_path), causes, "log.csv")
    assert "gravcomp" not in done.xml
    assert mujoco.MjModel.from_xml_string(done.xml).opt.gravity[2] == pytest.approx(-0.981)
