"""Tests that no text in the figures of an explanation is shortened, cut off or covered."""

from dataclasses import replace

import pytest

from bench.diagnosis.report.explanation_figures import draw_figure, list_figure_names
from bench.figures.label_text import break_name, count_max_lines, measure_text_width, shorten_name
from tests.bench.diagnosis.robot_report_data import cause, make_robot_report
from tests.bench.diagnosis.sample_report_data import evil, make_report
from tests.bench.figures.figure_readability import unreadable

LONG = (
    "left_arm_shoulder_pan_joint_with_a_long_name",
    "left_arm_shoulder_lift_joint",
    "elbow",
    "wrist_1_of_the_very_long_kinematic_chain_of_the_robot",
    "wrist_2",
    "wrist_3",
)


def long_robot():
    """Return a six-joint robot with long names and a residual that follows one velocity."""
    told = make_robot_report(joints=LONG, at="elbow")
    profiles = tuple(
        replace(p, channel=f"q.{LONG[0]}", variable=f"velocity of {LONG[0]}") for p in told.profiles
    )
    return replace(told, profiles=profiles)


@pytest.mark.parametrize("make", [make_report, make_robot_report, long_robot])
@pytest.mark.parametrize("name", ["overview", "where"])
def test_no_text_is_shortened_cut_or_covered(make, name):
    assert unreadable(draw_figure(make(), name)) == []


def test_the_labels_of_a_robot_say_what_is_there_in_full():
    warms = cause(
        "friction.warming@elbow", description="a cold joint has more friction (at joint elbow)"
    )
    drawn = draw_figure(make_robot_report(causes=(warms,)), "robot")
    assert unreadable(drawn) == []
    words = " ".join(text.get_text() for axes in drawn.axes for text in axes.texts)
    assert "friction that decreases as the joint warms" in words.replace("\n", " ")


def test_what_is_too_long_for_any_figure_is_shortened_and_stays_inside():
    told = evil()
    for name in list_figure_names(told):
        faults = unreadable(draw_figure(told, name))
        assert [fault for fault in faults if not fault.startswith("shortened")] == []


def test_names_are_broken_behind_underscores_and_units_are_not():
    assert break_name("left_arm_shoulder_pan [rad/s]", 14) == "left_arm_\nshoulder_pan\n[rad/s]"
    assert break_name("x" * 25, 10) == "\n".join(["x" * 10, "x" * 10, "x" * 5])
    assert break_name("elbow", 10) == "elbow"
    assert break_name("dry friction: 0.31 N", 16) == "dry friction:\n0.31 N"
    assert count_max_lines(["elbow", "left_\narm"]) == 2


def test_a_long_quantity_of_a_joint_is_called_by_its_kind():
    assert shorten_name("velocity of left_arm_elbow_flex_joint", 26) == "velocity"
    assert shorten_name("u.left_arm_elbow_flex_joint_motor", 26) == "u"
    assert shorten_name("velocity of elbow", 26) == "velocity of elbow"


def test_the_width_of_a_text_is_that_of_its_longest_line():
    one = measure_text_width(["elbow"], 9)
    assert measure_text_width(["elbow\nel", "bow"], 9) == one
    assert measure_text_width(["elbow"], 18) == pytest.approx(2 * one)
    assert measure_text_width(["elbow"], 9, "bold") > one
    assert measure_text_width([], 9) == 0.0
