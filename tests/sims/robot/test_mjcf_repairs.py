"""Tests of the automatic repairs of an MJCF, and of the folder of its included files."""

import pytest

from sims.robot.parsing.read_model_file import NO_ACTUATORS_NOTE, read_robot

INERTIAL = '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>'
MESH = '<mesh name="m" file="no.stl" scale="2 2 2"/>'


def mjcf(asset="", inside=INERTIAL, geom='type="mesh" mesh="m"'):
    return f"""<mujoco><compiler meshdir="parts"/><asset>{asset}</asset><worldbody>
      <body name="b">{inside}<joint name="j"/><geom {geom}/></body></worldbody></mujoco>"""


ABSENT = "shapes left out, and their contacts, since their file is absent: no.stl"
SEEN = "visual elements left out, since the file is absent: no.stl"
CASES = {
    "touching": (mjcf(MESH), ABSENT, 2),
    "seen": (mjcf(MESH, geom='type="mesh" mesh="m" contype="0" conaffinity="0"'), SEEN, 2),
    "massless": (
        mjcf(MESH, '<geom size="0.1"/>', 'type="mesh" mesh="m" mass="0"'),
        ABSENT,
        4.18879,
    ),
    "of another group": (
        mjcf(MESH, '<geom size="0.1"/>', 'type="mesh" mesh="m" group="3"').replace(
            "meshdir", 'inertiagrouprange="0 2" meshdir'
        ),
        ABSENT,
        4.18879,
    ),
    "fitted": (mjcf(MESH, geom='type="box" mesh="m"'), ABSENT, 2),
    "by its file's name": (mjcf('<mesh file="m.stl"/>'), ABSENT.replace("no", "m"), 2),
}


@pytest.mark.parametrize(("text", "note", "mass"), CASES.values(), ids=CASES)
def test_absent_meshes_are_left_out_where_masses_are_stated(write, text, note, mass):
    robot = read_robot(write(text))
    assert robot.notes == (note, NO_ACTUATORS_NOTE)
    assert robot.compiled.nmesh == 0
    assert robot.bodies[0].mass == pytest.approx(mass, abs=1e-5)


def test_an_absent_mesh_of_stated_mass_is_replaced_by_a_sphere(write):
    part = '<body name="c" pos="0 0 3"><geom type="mesh" mesh="m" mass="0.5" pos="0 0 1"/></body>'
    text = mjcf(MESH, INERTIAL, 'size="0.1" mass="0"').replace("</body>", part + "</body>")
    robot = read_robot(write(text))
    assert robot.notes == (
        "shapes replaced by spheres of their stated mass, since their file is absent: c 0.5 kg; "
        "state <inertial> to place the mass exactly",
        NO_ACTUATORS_NOTE,
    )
    model = robot.compiled
    assert model.body("c").mass == pytest.approx(0.5)
    assert model.body("c").ipos == pytest.approx([0, 0, 1])
    # A sphere of 0.5 kg and 1000 kg/m^3 has a radius of 49.2 mm and the inertia 2/5 m r^2.
    assert model.body("c").inertia == pytest.approx([4.849e-4] * 3, rel=1e-3)
    assert model.geom_contype[model.geom_bodyid == model.body("c").id] == 0


def test_absent_pictures_and_height_fields_are_left_out(write):
    assets = (
        '<texture name="t" type="2d" file="t.png"/><texture name="s" type="skybox" file="s.png"/>'
        '<material name="k" texture="t"/><hfield name="h" file="h.png" size="1 1 1 1"/>'
    )
    text = mjcf(assets, geom='size="0.1" material="k"')
    ground = '<geom type="hfield" hfield="h"/><body name="b">'
    robot = read_robot(write(text.replace('<body name="b">', ground)))
    assert robot.notes == (
        "shapes left out, and their contacts, since their file is absent: h.png",
        "visual elements left out, since the file is absent: t.png, s.png",
        NO_ACTUATORS_NOTE,
    )
    assert robot.compiled.ngeom == 1


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def test_a_mesh_is_kept_whose_name_ends_that_of_an_absent_one(write):
    assets = '<mesh name="m" file="art.obj"/><mesh name="n" file="part.obj"/>'
    path = write(mjcf(assets, '<geom type="mesh" mesh="m"/>', 'type="mesh" mesh="n" mass="0"'))
    write(TETRAHEDRON, "parts/art.obj")
    robot = read_robot(path)
    assert robot.notes == (ABSENT.replace("no.stl", "part.obj"), NO_ACTUATORS_NOTE)
    assert robot.compiled.nmesh == 1
    assert robot.bodies[0].mass == pytest.approx(1000 / 6)


def test_meshes_that_are_there_are_kept(write):
    path = write(mjcf('<mesh name="m" file="part.obj"/>', ""))
    write(TETRAHEDRON, "parts/part.obj")
    robot = read_robot(path)
    assert robot.notes == (NO_ACTUATORS_NOTE,)
    assert robot.bodies[0].mass == pytest.approx(1000 / 6)
    assert robot.spec.copy().compile().nmesh == 1
    write(TETRAHEDRON.replace("v 0 0 1", "v 0 0 2"), "parts/part.obj")
    assert read_robot(path).digest != robot.digest


def test_inertias_that_mujoco_refuses(write):
    inertial = '<inertial pos="0 0 0" mass="2" diaginertia="0.1 0.2 0.36"/>'
    robot = read_robot(write(mjcf(inside=inertial, geom='size="0.1"')))
    assert robot.notes == (
        "no body has principal moments A + B < C; the nearest are taken (kg·m²): "
        "b 0.1, 0.2, 0.36 -> 0.12, 0.22, 0.34",
        NO_ACTUATORS_NOTE,
    )
    assert sorted(robot.compiled.body_inertia[1]) == pytest.approx([0.12, 0.22, 0.34])


def test_names_that_are_missing(write):
    text = """<mujoco><worldbody><body><joint/><geom size="1"/>
      <body name="joint1"><joint name="joint1"/><joint axis="0 1 0"/><geom size="1"/></body>
      </body></worldbody>
      <actuator><motor joint="joint1"/></actuator>
      <sensor><jointpos joint="joint1"/></sensor></mujoco>"""
    robot = read_robot(write(text))
    assert [joint.name for joint in robot.joints] == ["joint0", "joint1", "joint2"]
    assert [body.name for body in robot.bodies] == ["body1", "joint1"]
    assert [actuator.name for actuator in robot.actuators] == ["actuator0"]
    assert [row.name for row in robot.sensors] == ["sensor0"]
    assert robot.notes == tuple(
        f"without a name in the file, called here: {names}"
        for names in ("joint0, joint2", "actuator0", "body1", "sensor0")
    )
    assert robot.spec.copy().compile().joint("joint2").id == 2


def test_names_that_would_divide_a_place_are_changed_wherever_they_stand(write):
    text = """<mujoco><worldbody>
      <body name="a"><joint name="x@1"/><geom size="1"/></body></worldbody>
      <actuator><motor name="x_1" joint="x@1"/></actuator></mujoco>"""
    robot = read_robot(write(text))
    assert robot.joints[0].name == "x_1_"  # another part is called x_1
    assert robot.actuators[0].joint == "x_1_"
    assert robot.notes == ("renamed, since places are written with @=,*: x@1 -> x_1_",)


def test_fused_bodies_are_aliases(write):
    text = """<mujoco><compiler fusestatic="true"/><worldbody>
      <body name="table"><body name="arm"><joint name="j"/><geom size="1" mass="1"/>
        <body name="hand"><geom size="1" mass="2"/><body name="tip"><geom size="1" mass="4"/>
        </body></body></body></body></worldbody></mujoco>"""
    robot = read_robot(write(text))
    assert robot.aliases == {"table": "world", "hand": "arm", "tip": "arm"}
    assert robot.body("tip").mass == 7


def test_includes_are_followed_from_the_models_folder(write):
    write('<mujoco><include file="b.xml"/><option timestep="0.01"/></mujoco>', "parts/a.xml")
    more = write('<mujoco><worldbody><body name="x"><joint/><geom size="1"/></body></worldbody>'
                 "</mujoco>", "b.xml")  # fmt: skip
    path = write('<mujoco><include file="parts/a.xml"/></mujoco>')
    robot = read_robot(path)
    assert [body.name for body in robot.bodies] == ["x"]
    assert robot.compiled.opt.timestep == 0.01
    more.write_text(more.read_text().replace('size="1"', 'size="2"'))
    assert read_robot(path).digest != robot.digest


def test_a_mesh_that_mujoco_refuses(write):
    path = write(mjcf('<mesh name="m" file="bad.obj"/><mesh name="n" file="bad.stl"/>'))
    write(
        "v 0 0 0\nv 1 0 0\nv nan 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n",
        "parts/bad.obj",
    )
    write("", "parts/bad.stl")
    robot = read_robot(path)
    assert robot.compiled.nmesh == 0
    note, _ = robot.notes
    assert note.startswith("shapes left out, and their contacts, since their file is refused by ")
    assert note.endswith("is not finite): bad.obj")


def test_a_picture_that_mujoco_refuses(write):
    assets = '<texture name="t" type="2d" file="t.png"/><material name="k" texture="t"/>'
    path = write(mjcf(assets, geom='size="0.1" material="k"').replace("meshdir", "assetdir"))
    write("no picture", "parts/t.png")
    robot = read_robot(path)
    note, _ = robot.notes
    assert note.startswith(
        "visual elements left out, since the file is refused by MuJoCo (error decoding"
    )
    assert robot.compiled.ngeom == 1


def test_attached_models_are_read_from_the_models_folder(write, monkeypatch):
    hand = '<mujoco><worldbody><body name="hand">{}<geom size="1" mass="3"/></body>'
    hand = f"{hand}</worldbody></mujoco>"
    write(hand.format('<joint name="wrist"/>'), "hands/hand.xml")
    path = write(
        '<mujoco><asset><model name="m" file="hands/hand.xml"/></asset><worldbody><body name="arm">'
        '<joint name="elbow"/><geom size="1"/><attach model="m" body="hand" prefix="left/"/></body>'
        "</worldbody></mujoco>"
    )
    monkeypatch.chdir("/")
    robot = read_robot(path)
    assert [joint.name for joint in robot.joints] == ["elbow", "left/wrist"]
    assert robot.body("left/hand").mass == 3
    write(hand.format(""), "hands/hand.xml")
    assert read_robot(path).digest != robot.digest
