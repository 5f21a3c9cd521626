"""Tests of the text summary of causes at places of a robot."""

from dataclasses import replace

import pytest

from bench.diagnosis.report.candidate_ranking import (
    MAX_SHOWN_CANDIDATES,
    rank_candidates,
    select_shown_candidates,
)
from bench.diagnosis.report.cause_and_value_text import (
    format_effect,
    format_effect_name,
    format_effect_set,
    format_missing_causes,
    is_parameter_error,
    shorten_effect_name,
    strip_place,
)
from bench.diagnosis.report.diagnosed_places import list_place_marks
from bench.diagnosis.report.report_data import ChannelInfo
from bench.diagnosis.report.summary_text import (
    format_headline,
    format_summary,
)
from bench.diagnosis.verdict import Cause
from tests.bench.diagnosis.robot_report_data import (
    COULOMB,
    EVERYWHERE,
    HEAVY,
    WRISTS,
    cause,
    make_robot_report,
    number,
)
from tests.bench.diagnosis.sample_report_data import gain_text, make_report, summary_text
from tests.bench.figures.figure_robots import ARM6


@pytest.mark.parametrize(
    ("effect", "text"),
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
def test_a_cause_is_said_with_its_place(effect, text):
    assert format_effect(effect) == text


def test_in_lists_a_place_stands_without_its_kind():
    assert shorten_effect_name("mass.scale@forearm") == "wrong mass at forearm"
    assert shorten_effect_name("friction.coulomb@*") == "Coulomb friction at every joint"
    assert (
        shorten_effect_name("gravity.tilt")
        == format_effect_name("gravity.tilt")
        == "tilt of gravity"
    )


WRIST = [f"friction.coulomb@wrist_{i}" for i in (1, 2, 3)]


@pytest.mark.parametrize(
    ("names", "text"),
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
def test_sets_are_said_as_people_say_them(names, text):
    assert format_effect_set(names) == text


def test_all_of_a_set_are_joined_by_and():
    text = "Coulomb friction at each of the joints wrist_1, wrist_2 and wrist_3"
    assert format_effect_set(WRIST, "and") == text


def test_a_long_set_says_how_many_more_there_are():
    names = "drag.linear force.bias force.ripple friction.load spring.linear spring.cubic wind"
    several = [f"{name}@joint_{i}" for i, name in enumerate(names.split())]
    assert format_effect_set(several).endswith(" at joint joint_4 or one of 2 others")
    assert format_effect_set(several[:6]).endswith("a cubic spring at joint joint_5")


@pytest.mark.parametrize(
    ("causes", "text"),
    [
        ([COULOMB], "The simulation lacks Coulomb friction at joint elbow: a constant friction "
                "opposes motion."),
        ([HEAVY], "The mass of body elbow_link is 12 % larger than the model file states."),
        ([COULOMB, HEAVY], "The simulation lacks Coulomb friction at joint elbow, and has a wrong "
                       "mass of body elbow_link."),
        ([EVERYWHERE], "The simulation lacks Coulomb friction at every joint: "
                       "a constant friction opposes motion."),
        ([cause("friction.coulomb@elbow", {"coefficient": number(-0.2)})],
         "The simulation has too much Coulomb friction at joint elbow."),
        ([cause("inertia.armature@elbow", {"coefficient": number(-0.0213, "kg*m^2")})],
         "The armature of joint elbow is 0.021 kg·m² smaller than the model file states."),
        ([cause("mass.offset@forearm", {n: number(v, "m") for n, v in
                                        zip("xyz", (0.03, 0.0, -0.04), strict=True)})],
         "The centre of mass of body forearm is 0.05 m from where the model file has it."),
        ([cause("actuator.stiffness@m_elbow", {"coefficient": number(-0.25, "1")})],
         "The stiffness of actuator m_elbow is 25 % smaller than the model file states."),
        ([cause("mass.scale@*", {"coefficient@a": number(0.1, "1")},
                description="it weighs otherwise")],
         "The simulation has a wrong mass of every body: it weighs otherwise."),
    ],
)  # fmt: skip
def test_a_headline_says_what_is_lacking_or_wrong_and_where(causes, text):
    assert format_headline(make_robot_report(causes=causes)) == text


def test_a_headline_of_a_set_names_all_of_it():
    assert format_headline(make_robot_report("ambiguous", [WRISTS])) == (
        "The simulation lacks Coulomb friction at any of the joints wrist_1, wrist_2 or wrist_3: "
        "these data do not show which."
    )
    mixed = cause("friction.coulomb@elbow", alternatives=["mass.scale@elbow_link"])
    assert format_headline(make_robot_report("ambiguous", [mixed])) == (
        "The simulation either lacks Coulomb friction at joint elbow or has a wrong mass of "
        "body elbow_link: these data do not show which."
    )


def test_a_further_effect_is_missing_although_a_number_is_wrong():
    text = format_headline(make_robot_report("partial", [HEAVY]))
    assert text.startswith(
        "The mass of body elbow_link is 12 % larger than the model file states, "
    )
    assert text.endswith("and the simulation lacks something else that no known cause explains.")
    both = format_headline(make_robot_report("partial", [COULOMB, HEAVY]))
    report = gain_text(make_robot_report("partial", [COULOMB, HEAVY]))
    assert "opposes motion; the mass of body elbow_link is 12 % larger than" in report
    assert both.endswith("elbow_link, and lacks something else that no known cause explains.")


def numerics(name, value, unit, description):
    """Return a cause in the numerics of the model file, whose number has no interval."""
    coefficient = {"value": value, "unit": unit, "low": None, "high": None}
    return cause(f"numerics.{name}", {"coefficient": coefficient}, description=description)


SHORTER = numerics("step", 0.0005, "s", "a time step of 0.0005 s follows the robot's motion")
OTHER = numerics("integrator", 1.0, "1", "integrator = RK4 follows the robot's motion")


def test_a_wrong_step_of_a_robot_is_reported_with_its_correction():
    report = make_robot_report(causes=[SHORTER])
    assert format_headline(report) == (
        "The time step of the model file is too long: a time step of 0.0005 s follows the "
        "robot's motion."
    )
    text = " ".join(format_summary(report))
    assert "Too long a time step (numerics.step): time step 5×10⁻⁴ s; p" in text
    both = make_robot_report(causes=[OTHER, COULOMB])
    assert format_headline(both) == (
        "The simulation lacks Coulomb friction at joint elbow, and has an unsuitable integrator."
    )
    assert "(numerics.integrator): p = 1×10⁻⁹." in " ".join(format_summary(both))
    assert not list_place_marks(report)


def test_another_integrator_is_not_called_inaccurate():
    description = "integrator = Euler explains the recording, the model file has RK4"
    coarser = numerics("integrator", 0.0, "1", description)
    assert format_headline(make_robot_report(causes=[coarser])) == (
        "The integrator of the model file does not reproduce the recording: integrator = Euler "
        "explains the recording, the model file has RK4."
    )


def test_unknown_and_adequate_count_causes_and_not_their_places():
    unknown = format_headline(make_robot_report("unknown", causes=()))
    assert "none of the 16 known causes explains it at any place" in unknown
    clean = gain_text(make_robot_report("adequate", causes=()))
    assert "16 possible causes were tested at every place and none improves" in clean


def test_what_is_wrong_and_what_is_lacking():
    assert is_parameter_error("mass.scale@a")
    assert is_parameter_error("numerics.step")
    assert not is_parameter_error("friction.coulomb@a")
    assert not is_parameter_error("actuator.limit@m_elbow")


def test_causes_without_places_are_listed_as_ever():
    report = make_report("ambiguous").verdict.causes
    assert format_missing_causes(report) == "lacks linear drag or Coulomb friction"
    sure = replace(report[0], effect="wind", alternatives=())
    assert (
        format_missing_causes([sure, *report]) == "lacks wind, and linear drag or Coulomb friction"
    )


def test_the_account_says_numbers_at_their_places():
    text = summary_text(make_robot_report(causes=[EVERYWHERE]))
    assert "0.300 (0.280 to 0.320) N·m at shoulder_pan, " in text
    text = summary_text(make_robot_report("ambiguous", [WRISTS]))
    assert "Each closes 90 % of the gap" in text
    assert (
        "Coulomb friction at joint wrist_2 or wrist_3 would explain the data equally well" in text
    )


def test_what_an_effect_does_is_said_without_its_place():
    assert strip_place("the sensor has a constant offset (at channel q.elbow)") == (
        "the sensor has a constant offset"
    )
    assert strip_place("it pulls (as a spring) back") == "it pulls (as a spring) back"


def test_of_many_channels_the_worst_of_each_kind_is_said():
    report = make_robot_report("adequate", causes=())
    assert gain_text(report).count(" of its noise") == 2
    few = replace(
        report,
        channels=(
            *make_report().channels,
            *(ChannelInfo(f"x{i}", "m", 1.0, True, 0.0) for i in range(10)),
        ),
    )
    assert gain_text(few).count("in x") == 10
    assert "Correcting it closes" in gain_text(make_robot_report(causes=[HEAVY]))


def test_marks_are_the_places_that_the_verdict_names():
    (mark,) = list_place_marks(make_robot_report())
    assert (mark.kind, mark.name, mark.says) == ("joint", "elbow", "Coulomb friction: 0.31 N·m")
    assert mark.is_certain
    wrists = list_place_marks(make_robot_report("ambiguous", [WRISTS]))
    assert [mark.name for mark in wrists] == ["wrist_1", "wrist_2", "wrist_3"]
    assert not any(mark.is_certain for mark in wrists)
    (heavy,) = list_place_marks(make_robot_report(causes=[HEAVY]))
    assert (heavy.kind, heavy.says) == ("body", "wrong mass: +12 %")


def test_a_family_marks_each_of_its_places():
    assert [mark.name for mark in list_place_marks(make_robot_report(causes=[EVERYWHERE]))] == list(
        ARM6
    )
    late = cause("input.delay@*", {"coefficient": number(0.05, "s")})
    found = list_place_marks(make_robot_report(causes=[late]))
    assert [mark.name for mark in found] == [f"m_{joint}" for joint in ARM6]
    assert not list_place_marks(make_report())
    either = cause("friction.coulomb@elbow", alternatives=["friction.coulomb@*"])
    there = list_place_marks(make_robot_report("ambiguous", [either]))
    assert [mark.says for mark in there if mark.name == "elbow"] == ["Coulomb friction: 0.31 N·m"]


def test_candidates_of_one_effect_are_one_entry_where_it_explains_most():
    report = make_robot_report()
    there = rank_candidates(report)
    effects = [entry.best.effect for entry in there]
    assert effects[0] == "friction.coulomb@elbow"
    assert len({effect.partition("@")[0] for effect in effects}) == len(effects)
    elsewhere = [c.effect for c in there[0].elsewhere]
    assert set(elsewhere) == {f"friction.coulomb@{j}" for j in (*ARM6, "*") if j != "elbow"}
    scores = [c.score for c in there[0].elsewhere]
    assert scores == sorted(scores, reverse=True)
    total = sum(1 + len(entry.elsewhere) for entry in there)
    assert total == len(report.verdict.candidates) > 80


@pytest.mark.parametrize(
    ("family_score", "head"), [(100.0, "drag.linear@elbow"), (300.0, "drag.linear@*")]
)
def test_a_family_stands_for_its_effect_only_where_it_explains_much_more(family_score, head):
    report = make_robot_report(causes=())
    scores = {"drag.linear@*": family_score, "drag.linear@elbow": 95.0, "gravity.tilt": 1.0}
    rows = [{**report.verdict.candidates[0].to_document(), "effect": n, "score": s}
            for n, s in scores.items()]  # fmt: skip
    ranked = rank_candidates(make_robot_report(causes=(), candidates=rows))
    assert [entry.best.effect for entry in ranked] == [head, "gravity.tilt"]


def test_every_cause_stands_for_itself_among_the_candidates():
    both = [COULOMB, cause("friction.coulomb@wrist_3")]
    shown = [c.effect for c in select_shown_candidates(make_robot_report(causes=both))]
    assert {"friction.coulomb@elbow", "friction.coulomb@wrist_3"} <= set(shown)
    assert len(shown) == MAX_SHOWN_CANDIDATES


def test_without_places_each_candidate_is_an_entry():
    report = make_report()
    assert [entry.best for entry in rank_candidates(report)] == list(report.verdict.candidates)
    assert isinstance(report.verdict.causes[0], Cause)
