"""Tests of refused model files: one line names file, place and cause; nothing is printed or
written.
"""

import os

import pytest

from bench.logs.recording_loading import get_simulator_class
from sims.core.simulator import InputError
from sims.robot.parsing import xml_files
from sims.robot.parsing.read_model_file import read_robot
from tests.sims.robot.sample_urdfs import joint, link, mesh, one, robot

BODY = '<worldbody><body name="b"><joint name="j"/><geom size="1"/></body></worldbody>'


def mjcf(inside="", body=BODY):
    return f"<mujoco>\n{inside}{body}</mujoco>"


ASSET = '<asset><mesh name="m" file="no.stl"/></asset>'
OF_MESH = (
    '<worldbody><body name="b"><joint/><geom type="mesh" mesh="m"/>'
    '<body name="c"/></body></worldbody>'
)
CASES = {
    # XML
    "": (":1: not well-formed XML: no element found; a robot's model file is MJCF or URDF"),
    "<mujoco>\n<worldbody>\n</mujoco>": (
        ":3: not well-formed XML: mismatched tag; a robot's model file is MJCF or URDF"
    ),
    '\n<!DOCTYPE x [<!ENTITY a "b">]>\n<mujoco>&a;</mujoco>': (
        ":2: document types and entities are not read; remove them"
    ),
    "<!DOCTYPE mujoco>\n<mujoco/>": ":1: document types and entities are not read; remove them",
    "<sdf/>": ": expected <mujoco> or <robot>, found <sdf>",
    "<mujoco>" * 500: ":1: elements more than 400 deep",
    '<?xml version="1.0" encoding="klingon"?><mujoco/>': (": not XML: unknown encoding: klingon"),
    # MJCF
    mjcf(body=""): ": it has no movable joint",
    mjcf('<include file="no.xml"/>'): ":2: the included file no.xml is absent",
    mjcf("<include/>"): ":2: an include states no file",
    mjcf('<include file="robot.xml"/>'): (
        ":2: robot.xml is included already: MuJoCo takes each file once"
    ),
    mjcf('<compiler coordinate="global"/>'): ":2: global coordinates no longer supported",
    mjcf("<wheel/>"): ":2: Schema violation: unrecognized element; Element 'wheel'",
    mjcf('\n\n<option timestep="often"/>'): ":4: bad format in attribute 'timestep'",
    mjcf('<option timestep="-1"/>'): ": option timestep: expected 1e-09 to 1 s, found -1",
    mjcf(body=BODY.replace("</world", '<body name="b"/></world')): ":2: repeated name 'b' in body",
    mjcf(ASSET, OF_MESH): (
        ": mesh no.stl is absent, and the mass of body b would follow from it; repair the mesh, or "
        "state the body's <inertial>"
    ),
    mjcf(
        '<asset><model name="m" file="no.xml"/></asset>'
    ): ":2: the attached model no.xml is absent",
    mjcf('<worldbody><replicate count="200000"/></worldbody>'): (
        ':2: count="200000" is too much: at most 100000 in all'
    ),
    mjcf('<asset><hfield name="h" nrow="100000" ncol="9" size="1 1 1 1"/></asset>'): (
        ':2: nrow="100000" is too much: at most 10000 in all'
    ),
    mjcf('<size nuser_body="1000000"/>'): ':2: nuser_body="1000000" is too much',
    mjcf('<size memory="900G"/>'): ": engine error: Could not allocate memory",
    mjcf(
        body=BODY.replace("<geom", '<inertial pos="0 0 0" mass="inf" diaginertia="1 1 1"/><geom')
    ): (": mass of b: expected numbers within ±1e+15, found inf"),
    mjcf(body=BODY.replace("<joint", '<joint damping="1e300"')): (
        ": damping of j: expected numbers within ±1e+15, found 1e+300"
    ),
    mjcf('\n\n<tendon><fixed><joint\njoint="no" coef="1"/></fixed></tendon>'): (
        ":4: joint 'no' not found in tendon 0"
    ),
    # URDF
    robot(link("a")): ": none of its 0 joints moves",
    robot(link("a"), link("b"), joint("j", "a", "b", "fixed")): ": none of its 1 joints moves",
    robot("<link/>"): ":1: a link without a name",
    robot(link("a"), link("a")): ":1: two links are called 'a'",
    robot(link("a"), joint("j", "a", "b")): ":1: joint j: there is no link 'b'",
    robot(link("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'): (
        ":1: joint j states no child link"
    ),
    robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")): (
        ":1: link b has two parent joints; a closed loop needs an MJCF"
    ),
    robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "b", "a")): (
        ":1: link a is its own parent"
    ),
    one(mass=-1): ":1: link arm: its mass is -1 kg",
    one(mass="heavy"): ":1: link arm: its mass is nan kg",
    one(inertia='<inertia ixx="big"/>'): ":1: link arm: its inertia is not made of numbers",
    one(mass=None, shape=mesh("no.stl")): (
        ":1: mesh no.stl is absent, and the mass of link arm would follow from it; put it there, "
        "or state the link's <inertial>"
    ),
    one('<origin xyz="${x} 0 0"/>'): ":1: ${x} 0 0 is a macro; run xacro, and give the result",
    robot("<xacro:arm/>"): ":1: <xacro:arm> is a macro; run xacro, and give the result",
    one('\n<origin xyz="0, 0, 0"/>'): ":2: bad format in attribute 'xyz'; Element 'origin'",
    one().replace("<link", '<mujoco>\n<option timestop="1"/></mujoco><link', 1): (
        ":2: Schema violation: unrecognized attribute: 'timestop'; Element 'option'"
    ),
    one("", "rotary"): (
        ":1: joint j: unknown type 'rotary'; there are: continuous, fixed, floating, planar, "
        "prismatic, revolute, spherical"
    ),
}


@pytest.mark.parametrize("text", CASES, ids=range(len(CASES)))
def test_refused_in_one_line(write, text, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    path = write(text)
    with pytest.raises(InputError) as caught:
        read_robot(path)
    message = str(caught.value)
    assert message.startswith(f"{path}{CASES[text]}")
    assert "\n" not in message
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == ["robot.xml"]


def test_files_that_are_not_there_or_none(tmp_path):
    with pytest.raises(InputError, match=r"no\.xml: no such file"):
        read_robot(tmp_path / "no.xml")
    with pytest.raises(InputError, match="not a file"):
        read_robot(tmp_path)


def test_a_file_that_is_too_large(write, monkeypatch):
    monkeypatch.setattr(xml_files, "MAX_MODEL_BYTES", 100)
    path = write(mjcf("<!--" + "x" * 100 + "-->"))
    with pytest.raises(InputError, match=r"bytes; a file of a model has at most 100"):
        read_robot(path)


def test_what_is_included_counts(write, monkeypatch):
    monkeypatch.setattr(xml_files, "MAX_MODEL_BYTES", 150)
    write("<mujoco><!--" + "x" * 100 + "--></mujoco>", "more.xml")
    path = write('<mujoco><include file="more.xml"/></mujoco>')
    with pytest.raises(InputError, match="with what it includes it has more than 150 bytes"):
        read_robot(path)


def test_faults_in_an_included_file_are_where_they_are(write):
    path = write('<mujoco>\n<include file="parts/more.xml"/></mujoco>')
    more = write(
        '<mujoco>\n\n<worldbody>\n<body pos="a b"/></worldbody></mujoco>', "parts/more.xml"
    )
    with pytest.raises(InputError) as caught:
        read_robot(path)
    assert str(caught.value).startswith(f"{more}:4: bad format in attribute 'pos'")


def test_what_mujoco_warns_of_is_a_note(write, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    robot = read_robot(write(mjcf('<compiler settotalmass="2"/>')))
    (warning,) = [note for note in robot.notes if "actuators" not in note]
    assert warning.startswith("MuJoCo warns: ")
    assert "settotalmass" in warning
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == ["robot.xml"]


def test_messages_name_the_file_that_is_wrong(write, tmp_path):
    """Tables of a recording stand in its description, not in the model file."""
    description, path = tmp_path / "swing.toml", write(mjcf())
    with pytest.raises(InputError) as caught:
        read_robot(path, engine={"timestep": "often"}, description=description)
    assert str(caught.value).startswith(f"{description}: engine.timestep: expected a number")
    with pytest.raises(InputError) as caught:
        read_robot(path, actuators={"m": {"joint": "k"}}, description=description)
    assert str(caught.value).startswith(f"{description}: ")
    with pytest.raises(InputError) as caught:
        read_robot(tmp_path / "robt.xml", description=description)
    assert str(caught.value) == (
        f"{tmp_path / 'robt.xml'}: no such file; expected the model that {description} states; "
        "did you mean robot.xml?"
    )
    with pytest.raises(InputError, match="correct or remove it"):
        read_robot(write(mjcf("<wheel/>")))
    write(mjcf())
    description.write_text('model = "robot.xml"\n[engine]\ntimestep = "often"\n')
    with pytest.raises(InputError, match=r"swing\.toml: engine\.timestep: expected a number"):
        get_simulator_class(tmp_path / "swing.csv")
