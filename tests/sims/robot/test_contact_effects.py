"""Tests of effects at contacts: the numbers of MuJoCo's contacts, and the files that state them."""

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.recording.recording import Recording, Run
from sims.robot.contact_pairs import add_contact_pairs, find_recorded_contacts
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import write_and_check
from tests.sims.robot.test_model_changes import one

SLIDER = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="{friction}" {floor}/>
    <body pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom {name} type="box" size="0.06 0.06 0.05" mass="1.2" friction="0.1" {box}/>
    </body>
  </worldbody>
  {contact}
  <actuator><motor name="push" joint="x"/><motor name="press" joint="z"/></actuator>
</mujoco>
"""
DEFAULTS = {"friction": 0.8, "floor": "", "box": "", "name": 'name="box"', "contact": ""}
TIMES = np.arange(100) / 100.0
SCENARIO = Scenario(
    TIMES, {"q.x": 0.0, "q.z": 0.01}, {"u.push": 20.0 * np.sin(6.0 * TIMES), "u.press": -3 + TIMES}
)


def slider(folder, **changes):
    path = folder / f"slider{len(list(folder.iterdir()))}.xml"
    path.write_text(SLIDER.format(**DEFAULTS | changes))
    return make_robot_simulator(read_robot(path))


def motion(kind, effect="", *c):
    effects = [effect] if effect else []
    return kind(observe=["q.x", "q.z"], effects=effects).simulate(np.array([c]), SCENARIO)


@pytest.mark.parametrize(
    ("effect", "c", "stated", "other"),
    [
        ("contact.friction", -0.4, {}, {"friction": 0.4}),
        # Without a priority, solref is the mean of both geoms.
        ("contact.softness", -0.25, {}, {"floor": 'solref="0.01 1"'}),
        ("contact.damping", 0.5, {}, {"floor": 'solref="0.02 2"'}),
        (
            "contact.softness",
            1.0,
            {"floor": 'solref="-4000 -80" priority="1"'},
            {"floor": 'solref="-1000 -40" priority="1"'},
        ),
        (
            "contact.damping",
            1.0,
            {"floor": 'solref="-4000 -80" priority="1"'},
            {"floor": 'solref="-1000 -80" priority="1"'},
        ),
        (
            "contact.friction",
            0.2,
            {"contact": '<contact><pair geom1="box" geom2="floor" friction="0.3 0.3"/></contact>'},
            {"contact": '<contact><pair geom1="box" geom2="floor" friction="0.5 0.5"/></contact>'},
        ),
    ],
)
def test_an_effect_is_another_number_of_the_file(effect, c, stated, other, tmp_path):
    """The motion is that of a model file with the other number."""
    found = motion(slider(tmp_path, **stated), f"{effect}@floor/box", c)
    wanted, without = motion(slider(tmp_path, **other)), motion(slider(tmp_path, **stated))
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.abs(found - without).max() > 1e-4


CONTACTS = {
    "priority": {"floor": 'priority="2" solref="0.03 0.5" condim="4"'},
    "mix": {
        "floor": 'solmix="3" solref="0.01 0.7" margin="0.01"',
        "box": 'margin="0.02" gap="0.01"',
    },
    "no weight": {"floor": 'solmix="0" solimp="0.7 0.8"', "box": 'solimp="0.8 0.99 0.002"'},
    "direct": {"floor": 'solref="-900 -30"', "box": 'condim="6"', "friction": "0.05 0.01 0.002"},
}


@pytest.mark.parametrize("case", CONTACTS)
def test_a_pair_has_the_parameters_of_the_contact(case, tmp_path):
    """An element `<pair>` has the parameters that MuJoCo combines from both geoms."""
    robot = slider(tmp_path, **CONTACTS[case]).robot
    contacts = []
    for model in (robot.compiled, add_contact_pairs(robot, ["floor/box"]).compiled):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        contacts.append(data.contact[0])
    own, paired = contacts
    assert own.dim == paired.dim
    for name in ("friction", "solref", "solimp", "includemargin", "solreffriction"):
        np.testing.assert_allclose(getattr(own, name), getattr(paired, name), atol=1e-15)


def test_contacts_of_a_recording_are_candidates(tmp_path):
    """Candidates are offered only where geoms touch in the recorded poses."""
    kind = slider(tmp_path)
    for height, contacts in ((-1e-4, ("floor/box",)), (0.01, ())):
        channels = {"q.x": 0.0 * TIMES, "q.z": height + 0.0 * TIMES}
        run = Run("1", TIMES, channels, {}, {}, {}, False)
        recording = Recording(tmp_path / "log.csv", "slider", "", {}, {}, (run,))
        assert find_recorded_contacts(recording, kind) == contacts
    from sims.effects import get_effect

    for name in ("contact.friction", "contact.softness", "contact.damping"):
        assert not kind.system.placed(get_effect(name))
        placed = kind.with_contacts(("floor/box",)).system.placed(get_effect(name))
        assert [effect.name for effect in placed] == [f"{name}@floor/box"]


ARM_NEXT_TO_BLOCK = """<mujoco model="arm"><worldbody>
<geom name="table" type="plane" size="2 2 0.1"/>
<body name="arm" pos="0 0 0.3"><joint name="swing" axis="0 0 1"/>
<geom name="link" type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"/></body>
<body name="block" pos="{} 0 {}"><joint name="slide" type="slide" axis="1 0 0"/>
<geom name="block" type="box" size="0.1 0.1 {}"/></body></worldbody></mujoco>
"""


@pytest.mark.parametrize(
    ("place", "height", "contacts"),
    [
        (1.5, 0.1, ()),
        (0.6, 0.1, ()),
        (0.6, 0.3, ("block/link", "block/table")),
    ],
    ids=["far", "near and low", "touched"],
)
def test_contacts_that_act_on_no_recorded_joint_are_left_out(tmp_path, place, height, contacts):
    """A block on the table matters only if the arm touches it."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM_NEXT_TO_BLOCK.format(place, height - 1e-4, height))
    run = Run("1", TIMES, {"q.swing": 0.0 * TIMES}, {}, {}, {}, False)
    recording = Recording(tmp_path / "log.csv", "arm", "", {}, {}, (run,))
    found = find_recorded_contacts(recording, make_robot_simulator(read_robot(path)))
    assert sorted("/".join(sorted(pair.split("/"))) for pair in found) == list(contacts)


def test_limits_follow_from_the_file(tmp_path):
    """Friction is not negative, and no time constant is less than two steps."""
    system = slider(tmp_path).system
    (friction,) = system.effect("contact.friction@floor/box").coefficients
    (softness,) = system.effect("contact.softness@floor/box").coefficients
    assert (friction.least, softness.least) == (-0.8, pytest.approx(-0.8))
    assert (friction.unit("rotary"), softness.most) == ("1", None)


def test_an_unknown_geom_is_refused(tmp_path):
    """The message names the geoms of the file."""
    with pytest.raises(InputError, match=r"geom of .*'bos'.*box"):
        slider(tmp_path).system.effect("contact.friction@floor/bos")


CAUSES = {"contact.friction@floor/box": one(-0.4), "contact.softness@floor/box": one(-0.3)}


@pytest.mark.parametrize(
    "stated", [{}, {"contact": '<contact><pair geom1="box" geom2="floor"/></contact>'}]
)
def test_a_file_states_the_contact(stated, tmp_path):
    """The author's text gets an element `<pair>`, or other numbers in the one that it has."""
    robot = slider(tmp_path, **stated).robot
    done = write_and_check(robot, CAUSES)
    model = mujoco.MjModel.from_xml_string(done.xml)
    assert model.npair == 1
    friction = 1.0 if stated else 0.8
    np.testing.assert_allclose(model.pair_friction[0, :2], friction - 0.4)
    np.testing.assert_allclose(model.pair_solref[0], (0.014, 1.0))
    assert "contact.friction@floor/box: -0.4" in done.xml
    assert "fitted to log.csv" in done.xml


def test_unnamed_geoms_get_a_name_in_the_file(tmp_path):
    """MuJoCo writes the file, since its text has no names for the pair."""
    robot = slider(tmp_path, name="").robot
    causes = {"contact.friction@floor/geom1": one(-0.4)}
    done = write_and_check(robot, causes)
    assert mujoco.MjModel.from_xml_string(done.xml).pair_friction[0, 0] == pytest.approx(0.4)
    assert any("has no name in its text" in note for note in done.notes)
