"""Causes at places of a robot, as the account says them."""

from dataclasses import replace

import pytest

from bench.gap.report.account import account, following, headline, hiding
from bench.gap.report.places import lacks, marks, of_set, without_place
from bench.gap.report.ranking import MOST_CANDIDATES, entries, ranked, short_name
from bench.gap.report.story import Shown
from bench.gap.report.words import is_wrong, name_of, noun
from bench.gap.verdict import Cause
from tests.bench.figures.robots import ARM6
from tests.bench.gap.robot_stories import (
    EVERYWHERE,
    HEAVY,
    RUB,
    WRISTS,
    cause,
    number,
    robot_story,
)
from tests.bench.gap.stories import story


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        ("friction.coulomb@elbow", "Coulomb friction at joint elbow"),
        ("input.delay@m_elbow", "an input delay at actuator m_elbow"),
        ("mass.scale@forearm", "a wrong mass of body forearm"),
        ("inertia.armature@elbow", "a wrong armature of joint elbow"),
        ("sensor.bias@q.elbow", "a sensor bias in channel q.elbow"),
        ("friction.coulomb@*", "Coulomb friction at every joint"),
        ("mass.scale@*", "a wrong mass of every body"),
        ("gravity.tilt", "a tilt of gravity"),
        ("friction.coulomb", "Coulomb friction"),
        ("friction.coulomb@a + input.gain@b",
         "Coulomb friction at joint a and an input gain at actuator b"),
        ("my.plugin@elbow", "my.plugin@elbow"),
    ],
)  # fmt: skip
def test_a_cause_is_said_with_its_place(effect, said):
    assert noun(effect) == said


def test_in_lists_a_place_stands_without_its_kind():
    assert short_name("mass.scale@forearm") == "wrong mass at forearm"
    assert short_name("friction.coulomb@*") == "Coulomb friction at every joint"
    assert short_name("gravity.tilt") == name_of("gravity.tilt") == "tilt of gravity"


WRIST = [f"friction.coulomb@wrist_{i}" for i in (1, 2, 3)]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (WRIST, "Coulomb friction at any of the joints wrist_1, wrist_2 or wrist_3"),
        (WRIST[:2], "Coulomb friction at joint wrist_1 or wrist_2"),
        (["drag.linear@a", "friction.coulomb@a"], "linear drag or Coulomb friction at joint a"),
        (
            [*WRIST, "input.bias@m_elbow"],
            "Coulomb friction at any of the joints wrist_1, wrist_2 or wrist_3, "
            "or an input bias at actuator m_elbow",
        ),
        (["friction.coulomb@*", "friction.coulomb@a"],
         "Coulomb friction at joint a or at every joint"),
        ([*WRIST, "friction.coulomb@*"],
         "Coulomb friction at any of the joints wrist_1, wrist_2 or wrist_3 or at every joint"),
        (["drag.linear", "friction.coulomb"], "linear drag or Coulomb friction"),
    ],
)  # fmt: skip
def test_sets_are_said_as_people_say_them(names, said):
    assert of_set(names) == said


def test_all_of_a_set_are_joined_by_and():
    said = "Coulomb friction at each of the joints wrist_1, wrist_2 and wrist_3"
    assert of_set(WRIST, "and") == said


def test_a_long_set_says_how_many_more_there_are():
    names = "drag.linear force.bias force.ripple friction.load spring.linear spring.cubic wind"
    several = [f"{name}@joint_{i}" for i, name in enumerate(names.split())]
    assert of_set(several).endswith(" at joint joint_4 or one of 2 others")
    assert of_set(several[:6]).endswith("a cubic spring at joint joint_5")


@pytest.mark.parametrize(
    ("causes", "said"),
    [
        ([RUB], "The simulation lacks Coulomb friction at joint elbow: a constant friction "
                "opposes motion."),
        ([HEAVY], "The mass of body elbow_link is 12 % larger than the model file says."),
        ([RUB, HEAVY], "The simulation lacks Coulomb friction at joint elbow, and has a wrong "
                       "mass of body elbow_link."),
        ([EVERYWHERE], "The simulation lacks Coulomb friction at every joint: "
                       "a constant friction opposes motion."),
        ([cause("friction.coulomb@elbow", {"coefficient": number(-0.2)})],
         "The simulation has too much Coulomb friction at joint elbow."),
        ([cause("inertia.armature@elbow", {"coefficient": number(-0.0213, "kg*m^2")})],
         "The armature of joint elbow is 0.021 kg·m² smaller than the model file says."),
        ([cause("mass.offset@forearm", {n: number(v, "m") for n, v in
                                        zip("xyz", (0.03, 0.0, -0.04), strict=True)})],
         "The centre of mass of body forearm is 0.05 m from where the model file has it."),
        ([cause("actuator.stiffness@m_elbow", {"coefficient": number(-0.25, "1")})],
         "The stiffness of actuator m_elbow is 25 % smaller than the model file says."),
        ([cause("mass.scale@*", {"coefficient@a": number(0.1, "1")}, says="it weighs otherwise")],
         "The simulation has a wrong mass of every body: it weighs otherwise."),
    ],
)  # fmt: skip
def test_a_headline_says_what_is_lacking_or_wrong_and_where(causes, said):
    assert headline(robot_story(causes=causes)) == said


def test_a_headline_of_a_set_names_all_of_it():
    assert headline(robot_story("ambiguous", [WRISTS])) == (
        "The simulation lacks Coulomb friction at any of the joints wrist_1, wrist_2 or wrist_3: "
        "these data cannot tell which."
    )
    mixed = cause("friction.coulomb@elbow", alternatives=["mass.scale@elbow_link"])
    assert headline(robot_story("ambiguous", [mixed])) == (
        "The simulation either lacks Coulomb friction at joint elbow or has a wrong mass of "
        "body elbow_link: these data cannot tell which."
    )


def test_what_else_remains_is_lacking_although_a_number_is_wrong():
    said = headline(robot_story("partial", [HEAVY]))
    assert said.startswith("The mass of body elbow_link is 12 % larger than the model file says, ")
    assert said.endswith("and the simulation lacks something else that no known cause explains.")
    both = headline(robot_story("partial", [RUB, HEAVY]))
    told = " ".join(following(robot_story("partial", [RUB, HEAVY])))
    assert "opposes motion; the mass of body elbow_link is 12 % larger than" in told
    assert both.endswith("elbow_link, and lacks something else that no known cause explains.")


SHORTER = cause(
    "numerics.step",
    {"coefficient": {"value": 0.0005, "unit": "s", "low": None, "high": None}},
    says="a time step of 0.0005 s follows the robot's motion",
)
OTHER = cause(
    "numerics.integrator",
    {"coefficient": {"value": 1.0, "unit": "1", "low": None, "high": None}},
    says="integrator = RK4 follows the robot's motion",
)


def test_how_a_robot_is_stepped_is_wrong_and_what_mends_it_is_said():
    told = robot_story(causes=[SHORTER])
    assert headline(told) == (
        "The time step of the model file is too long: a time step of 0.0005 s follows the "
        "robot's motion."
    )
    text = " ".join(account(told))
    assert "Too long a time step (numerics.step): time step 5×10⁻⁴ s; p" in text
    both = robot_story(causes=[OTHER, RUB])
    assert headline(both) == (
        "The simulation lacks Coulomb friction at joint elbow, and has an integrator that does "
        "not follow the motion."
    )
    assert "(numerics.integrator): p = 1×10⁻⁹." in " ".join(account(both))
    assert not marks(told)


def test_unknown_and_adequate_count_causes_and_not_their_places():
    unknown = headline(robot_story("unknown", causes=()))
    assert "none of the 16 known causes explains it at any place" in unknown
    clean = " ".join(following(robot_story("adequate", causes=())))
    assert "16 possible causes were looked for at every place and none stands out" in clean


def test_what_is_wrong_and_what_is_lacking():
    assert is_wrong("mass.scale@a")
    assert is_wrong("numerics.step")
    assert not is_wrong("friction.coulomb@a")
    assert not is_wrong("actuator.limit@m_elbow")


def test_causes_without_places_are_listed_as_ever():
    told = story("ambiguous").verdict.causes
    assert lacks(told) == "lacks linear drag or Coulomb friction"
    sure = replace(told[0], effect="wind", alternatives=())
    assert lacks([sure, *told]) == "lacks wind, and linear drag or Coulomb friction"


def test_the_account_says_numbers_at_their_places():
    text = " ".join(" ".join(account(robot_story(causes=[EVERYWHERE]))).split())
    assert "0.300 (0.280 to 0.320) N·m at shoulder_pan, " in text
    text = " ".join(" ".join(account(robot_story("ambiguous", [WRISTS]))).split())
    assert "Each closes 90 % of the gap" in text
    assert "Coulomb friction at joint wrist_2 or wrist_3 instead would do as well" in text


def test_what_an_effect_does_is_said_without_its_place():
    assert without_place("the sensor's zero is off (at channel q.elbow)") == (
        "the sensor's zero is off"
    )
    assert without_place("it pulls (as a spring) back") == "it pulls (as a spring) back"


def test_of_many_channels_the_worst_of_each_kind_is_said():
    told = robot_story("adequate", causes=())
    assert hiding(told).count(" of its noise") == 2
    few = replace(
        told,
        channels=(*story().channels, *(Shown(f"x{i}", "m", 1.0, True, 0.0) for i in range(10))),
    )
    assert hiding(few).count("in x") == 10
    assert "To correct it closes" in " ".join(following(robot_story(causes=[HEAVY])))


def test_marks_are_the_places_that_the_verdict_names():
    (mark,) = marks(robot_story())
    assert (mark.kind, mark.name, mark.says) == ("joint", "elbow", "Coulomb friction: 0.31 N·m")
    assert mark.sure
    wrists = marks(robot_story("ambiguous", [WRISTS]))
    assert [mark.name for mark in wrists] == ["wrist_1", "wrist_2", "wrist_3"]
    assert not any(mark.sure for mark in wrists)
    (heavy,) = marks(robot_story(causes=[HEAVY]))
    assert (heavy.kind, heavy.says) == ("body", "wrong mass: +12 %")


def test_a_family_marks_each_of_its_places():
    assert [mark.name for mark in marks(robot_story(causes=[EVERYWHERE]))] == list(ARM6)
    late = cause("input.delay@*", {"coefficient": number(0.05, "s")})
    found = marks(robot_story(causes=[late]))
    assert [mark.name for mark in found] == [f"m_{joint}" for joint in ARM6]
    assert not marks(story())
    either = cause("friction.coulomb@elbow", alternatives=["friction.coulomb@*"])
    there = marks(robot_story("ambiguous", [either]))
    assert [mark.says for mark in there if mark.name == "elbow"] == ["Coulomb friction: 0.31 N·m"]


def test_candidates_of_one_effect_are_one_entry_where_it_explains_most():
    told = robot_story()
    there = entries(told)
    effects = [entry.best.effect for entry in there]
    assert effects[0] == "friction.coulomb@elbow"
    assert len({effect.partition("@")[0] for effect in effects}) == len(effects)
    elsewhere = [c.effect for c in there[0].elsewhere]
    assert set(elsewhere) == {f"friction.coulomb@{j}" for j in (*ARM6, "*") if j != "elbow"}
    scores = [c.score for c in there[0].elsewhere]
    assert scores == sorted(scores, reverse=True)
    total = sum(1 + len(entry.elsewhere) for entry in there)
    assert total == len(told.verdict.candidates) > 80


def test_a_family_stands_for_its_effect_only_where_it_explains_much_more():
    told = robot_story(causes=())
    scores = {"drag.linear@*": 100.0, "drag.linear@elbow": 95.0, "gravity.tilt": 1.0}
    rows = [{**told.verdict.candidates[0].document(), "effect": n, "score": s}
            for n, s in scores.items()]  # fmt: skip
    heads = [entry.best.effect for entry in entries(robot_story(causes=(), candidates=rows))]
    assert heads == ["drag.linear@elbow", "gravity.tilt"]
    rows[0]["score"] = 300.0
    heads = [entry.best.effect for entry in entries(robot_story(causes=(), candidates=rows))]
    assert heads == ["drag.linear@*", "gravity.tilt"]


def test_every_cause_stands_for_itself_among_the_candidates():
    both = [RUB, cause("friction.coulomb@wrist_3")]
    shown = [c.effect for c in ranked(robot_story(causes=both))]
    assert {"friction.coulomb@elbow", "friction.coulomb@wrist_3"} <= set(shown)
    assert len(shown) == MOST_CANDIDATES


def test_without_places_each_candidate_is_an_entry():
    told = story()
    assert [entry.best for entry in entries(told)] == list(told.verdict.candidates)
    assert isinstance(told.verdict.causes[0], Cause)
