"""Tests of each automatic repair of a URDF with a minimal model, and of its note."""

import itertools

import mujoco
import numpy as np
import pytest

from sims.robot.parsing.read_model_file import NO_ACTUATORS_NOTE, read_robot
from tests.sims.robot.sample_urdfs import TETRAHEDRON, ball, joint, link, mesh, one, robot

FUSED = "links on fixed joints are merged into their parent links: base of world"


@pytest.fixture
def read_repaired(write):
    """Return a function that reads a text and returns the robot and its non-default notes."""

    def read_it(text):
        robot = read_robot(write(text, "robot.urdf"))
        return robot, [note for note in robot.notes if note not in (FUSED, NO_ACTUATORS_NOTE)]

    return read_it


def moments(robot, name="arm"):
    return sorted(robot.compiled.body(name).inertia)


def test_nothing_is_reported_where_nothing_is_repaired(read_repaired):
    robot, notes = read_repaired(one())
    assert notes == []
    assert robot.joints[0].range == (-1, 1)


def test_a_point_mass(read_repaired):
    robot, notes = read_repaired(one(inertia=""))
    assert notes == ["a mass and no moments of inertia, so it is a point mass (1e-09 kg·m²): arm"]
    assert moments(robot) == pytest.approx([1e-9] * 3)
    assert robot.bodies[0].mass == 1


def test_moments_that_are_not_positive_become_the_nearest(read_repaired):
    tensor = '<inertia ixx="0.5" iyy="0.5" izz="-0.1" ixy="0" ixz="0" iyz="0"/>'
    robot, notes = read_repaired(one(inertia=tensor))
    assert notes == [
        "principal moments that are not positive; the nearest that a body can have are taken "
        "(kg·m²): arm -0.1, 0.5, 0.5 -> 1e-09, 0.5, 0.5"
    ]
    assert moments(robot) == pytest.approx([1e-9, 0.5, 0.5])


def test_moments_that_no_body_has_become_the_nearest(read_repaired):
    tensor = '<inertia ixx="0.1" iyy="0.2" izz="0.36" ixy="0" ixz="0" iyz="0"/>'
    robot, notes = read_repaired(one(inertia=tensor))
    assert notes == [
        "no body has principal moments A + B < C; the nearest are taken (kg·m²): "
        "arm 0.1, 0.2, 0.36 -> 0.12, 0.22, 0.34"
    ]
    assert moments(robot) == pytest.approx([0.12, 0.22, 0.34])


def test_who_asks_for_balanced_inertia_gets_that_of_mujoco(read_repaired):
    tensor = '<inertia ixx="0.1" iyy="0.2" izz="0.36" ixy="0" ixz="0" iyz="0"/>'
    asked = '<mujoco><compiler balanceinertia="true"/></mujoco><link'
    robot, notes = read_repaired(one(inertia=tensor).replace("<link", asked, 1))
    assert notes == []
    assert moments(robot) == pytest.approx([0.22] * 3)


def test_links_without_a_mass_between_links_that_have_one(read_repaired):
    robot, notes = read_repaired(robot_text(link("base", None), link("yaw", None), link("arm")))
    assert notes == ["move without a mass; given 1e-06 kg and moments of 1e-09 kg·m²: yaw"]
    assert {body.name: body.mass for body in robot.bodies} == {"yaw": 1e-6, "arm": 1}


def robot_text(*links):
    """Return a robot text of links in a chain."""
    names = [text.split('"')[1] for text in links]
    pairs = itertools.pairwise(names)
    return robot(*links, *(joint(f"to_{b}", a, b) for a, b in pairs))


def test_a_last_link_without_a_mass_is_said_to_mean_little(read_repaired):
    _, notes = read_repaired(robot_text(link("base", None), link("arm"), link("tip", None)))
    assert notes == [
        "move without a mass, and carry no other bodies, so their joints have little effect; given "
        "1e-06 kg and moments of 1e-09 kg·m²: tip"
    ]


def test_a_mass_that_follows_from_shapes_is_said(read_repaired):
    robot, notes = read_repaired(one(mass=None, shape=ball(0.1)))
    assert notes == [
        "no mass stated; it follows from the collision shapes at 1000 kg/m^3, as MuJoCo does: arm"
    ]
    assert robot.bodies[0].mass == pytest.approx(4.18879, abs=1e-5)


def test_chains_of_fixed_links_are_aliases(read_repaired):
    fixed = [joint("f1", "arm", "wrist", "fixed", ""), joint("f2", "wrist", "tip", "fixed", "")]
    base = [joint("f0", "base", "foot", "fixed", ""), joint("j", "foot", "arm")]
    names = ("base", "foot", "arm", "wrist", "tip")
    robot_, _ = read_repaired(robot(*map(link, names), *fixed, *base))
    assert robot_.aliases == {"base": "world", "foot": "world", "wrist": "arm", "tip": "arm"}
    assert robot_.body("tip").mass == 3
    assert robot_.notes[-2] == (
        "links on fixed joints are merged into their parent links: base, foot of world; "
        "wrist, tip of arm"
    )


@pytest.mark.parametrize("effort", ["0", "-1", "inf"])
def test_an_effort_that_is_no_limit(read_repaired, effort):
    robot, notes = read_repaired(one(f'<limit lower="-1" upper="1" effort="{effort}"/>'))
    assert robot.joints[0].effort is None
    assert notes == ["an effort limit that is not positive is read as none: j"]


@pytest.mark.parametrize(("lower", "upper"), [("0", "0"), ("1", "-1")])
def test_limits_that_leave_no_room(read_repaired, lower, upper):
    robot, notes = read_repaired(one(f'<limit lower="{lower}" upper="{upper}" effort="3"/>'))
    assert robot.joints[0].range is None
    assert robot.joints[0].effort == 3
    assert notes == [
        "effort limits clamp what actuators exert (N·m or N): j 3",
        "a lower limit not below the upper is read as none: j",
    ]


def test_a_continuous_joint_has_no_limits(read_repaired):
    robot, notes = read_repaired(one('<limit lower="-1" upper="1" velocity="2"/>', "continuous"))
    assert (robot.joints[0].kind, robot.joints[0].range, notes) == ("hinge", None, [])


def test_mimics_follow(read_repaired):
    mimic = '<mimic joint="j" multiplier="-2" offset="0.5"/>'
    follower = joint("k", "arm", "tip", "revolute", mimic)
    robot_, notes = read_repaired(
        robot(link("base", None), link("arm"), link("tip"), joint("j", "base", "arm"), follower)
    )
    assert notes == ["mimic joints follow as stiffly as MuJoCo allows: k = -2 j + 0.5"]
    assert robot_.compiled.neq == 1
    assert list(robot_.compiled.eq_data[0][:2]) == [0.5, -2]


def test_mimics_follow_rigidly(read_repaired):
    """A torque at one joint moves both joints equally; MuJoCo's default equality gives 0.2 mrad
    difference.
    """
    follower = joint("k", "arm", "tip", "revolute", '<mimic joint="j"/>')
    tied, _ = read_repaired(
        robot(link("base", None), link("arm"), link("tip"), joint("j", "base", "arm"), follower)
    )
    model = tied.compiled
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    rows = []
    for step in range(300):
        data.qfrc_applied[0] = 5.0 * np.sin(0.05 * step)
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    first, second = np.array(rows).T
    assert np.abs(first).max() > 0.02
    assert np.abs(first - second).max() < 1e-6


def test_a_mimic_of_nothing_is_left_out(read_repaired):
    robot, notes = read_repaired(one('<mimic joint="ghost"/>'))
    assert notes == ["mimics of joints that do not move, or are not there: j (ghost)"]
    assert robot.compiled.neq == 0


def test_joints_without_a_name_and_joints_of_one_name(read_repaired):
    parts = [link("base", None), link("a"), link("b"), link("c")]
    joints = [joint("j", "base", "a"), joint("j", "a", "b"), joint("", "b", "c")]
    robot_, notes = read_repaired(robot(*parts, *joints))
    assert [joint.name for joint in robot_.joints] == ["j", "j_", "joint_c"]
    assert notes == [
        "called j_ here: another joint j",
        "called joint_c here: a joint without a name",
    ]


def test_names_that_would_divide_a_place(read_repaired):
    text = one().replace('"arm"', '"arm@2"').replace('name="j"', 'name="j,k=1"')
    robot, notes = read_repaired(text)
    assert [joint.name for joint in robot.joints] == ["j_k_1"]
    assert [body.name for body in robot.bodies] == ["arm_2"]
    assert notes == ["renamed, since places are written with @=,*: arm@2 -> arm_2, j,k=1 -> j_k_1"]


def test_names_with_other_characters_stay(read_repaired):
    robot, _ = read_repaired(one().replace('"arm"', '"left/arm.2 a"'))
    assert robot.bodies[0].name == "left/arm.2 a"


def test_what_is_not_read_is_said(read_repaired):
    _, notes = read_repaired(one().replace("</robot>", "<gazebo/><transmission/><gazebo/></robot>"))
    assert notes == ["ignored, since MuJoCo has no equivalent: <gazebo>, <transmission>"]


def test_what_is_stated_twice(read_repaired):
    robot, notes = read_repaired(one('<axis xyz="0 1 0"/>'))
    assert notes == ["stated twice, the first is read: <axis> of joint j"]
    assert list(robot.compiled.jnt_axis[0]) == [1, 0, 0]


def test_what_is_only_seen_need_not_exist(read_repaired):
    seen = '<visual><geometry><mesh filename="no.dae"/></geometry></visual>'
    assert read_repaired(one(shape=seen))[1] == []


def test_shapes_whose_mesh_is_absent_or_of_another_format(read_repaired):
    robot, notes = read_repaired(
        one(shape=mesh("a/no.stl") + mesh("package://p/no.dae") + ball(0.1))
    )
    assert notes == [
        "shapes left out, and their contacts, since their mesh is absent: no.stl",
        "shapes left out, and their contacts, since their mesh is of a format that MuJoCo does not "
        "read (.dae): no.dae",
    ]
    assert robot.compiled.ngeom == 1


def test_a_mesh_that_mujoco_refuses(read_repaired, write):
    write(TETRAHEDRON.replace("v 1 0 0", "v nan 0 0"), "bad.obj")
    robot, (note,) = read_repaired(one(shape=mesh("bad.obj")))
    assert note.startswith(
        "shapes left out, and their contacts, since their file is refused by MuJoCo (vertex"
    )
    assert note.endswith("): bad.obj")
    assert robot.compiled.ngeom == 0


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("meshes/part.obj", "meshes/part.obj"),
        ("package://tool/meshes/part.obj", "../meshes/part.obj"),
        ("package://tool/meshes/part.obj", "../../tool/meshes/part.obj"),
        ("model://tool/part.obj", "part.obj"),
        ("elsewhere/part.obj", "part.obj"),
    ],
)
def test_meshes_are_found(write, name, place):
    path = write(one(shape=mesh(name)), "tool/urdf/robot.urdf")
    write(TETRAHEDRON, f"tool/urdf/{place}")
    robot = read_robot(path)
    assert robot.notes == (FUSED, NO_ACTUATORS_NOTE)
    assert robot.compiled.nmesh == 1
    assert robot.spec.copy().compile().nmesh == 1


def test_a_folder_of_meshes(write):
    text = one(shape=mesh("part.obj"))
    block = '<mujoco><compiler meshdir="parts"/></mujoco><link'
    path = write(text.replace("<link", block, 1))
    write(TETRAHEDRON, "parts/part.obj")
    assert read_robot(path).compiled.nmesh == 1


def test_meshes_enter_the_digest(write):
    path = write(one(shape=mesh("part.obj")))
    write(TETRAHEDRON, "part.obj")
    before = read_robot(path).digest
    write(TETRAHEDRON.replace("v 0 0 1", "v 0 0 2"), "part.obj")
    assert read_robot(path).digest != before


def test_the_base_does_not_collide_with_its_children(read_repaired):
    parts = [link("base", None, shape=ball(0.5)), link("arm", shape=ball(0.5))]
    robot_, notes = read_repaired(robot(*parts, joint("j", "base", "arm")))
    assert notes == ["no contacts between the fixed base and the bodies attached to it: arm"]
    assert robot_.compiled.nexclude == 1


def test_parts_that_overlap_do_not_collide(read_repaired):
    robot_, notes = read_repaired(
        robot_text(
            link("base", None),
            link("a", shape=ball(0.5)),
            link("b"),
            link("c", shape=ball(0.5, (0, 0, 0.3))),
            link("d", shape=ball(0.5, (0, 0, 5))),
        )
    )
    assert notes == ["no contacts between parts that overlap at the zero position: a and c"]
    assert robot_.compiled.nexclude == 1


@pytest.mark.parametrize(
    ("kind", "kinds"),
    [("floating", ["free"]), ("planar", ["slide", "slide", "hinge"]), ("spherical", ["ball"])],
)
def test_joints_of_several_coordinates(read_repaired, kind, kinds):
    robot, notes = read_repaired(one('<limit lower="-1" upper="1" effort="1"/>', kind))
    assert [joint.kind for joint in robot.joints] == kinds
    assert len({joint.name for joint in robot.joints}) == len(kinds)
    assert all(joint.range is None for joint in robot.joints)
    assert all("without a name" in note for note in notes)


def test_blank_lines_and_zeros_around_the_file_are_let_pass(write, tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_bytes(b'\n\n<?xml version="1.0"?>' + one().encode() + b"\n\0")
    assert len(read_robot(path).joints) == 1


def test_a_joint_may_have_a_parent_world_that_is_no_link(read_repaired):
    robot_, notes = read_repaired(
        robot(
            link("base"),
            link("arm"),
            joint("f", "world", "base", "fixed", ""),
            joint("j", "base", "arm"),
        )
    )
    assert "the link world, which the file does not state, is the fixed world" in notes
    assert [body.name for body in robot_.bodies] == ["arm"]
    assert robot_.aliases["base"] == "world"
