"""Tests of the texts in the figure of candidate causes."""

from collections import Counter
from dataclasses import replace

import pytest

from bench.api.explain import explain
from bench.diagnosis.report.candidates_figure import draw_candidates_figure
from bench.diagnosis.report.cause_and_value_text import format_p_value
from bench.diagnosis.report.explanation_figures import draw_figure
from tests.bench.diagnosis.explained_samples import recording
from tests.bench.diagnosis.robot_report_data import candidates, make_robot_report
from tests.bench.diagnosis.sample_report_data import make_report
from tests.bench.figures.figure_readability import unreadable

LONG = (
    "left_arm_shoulder_pan_joint",
    "left_arm_shoulder_lift_joint_of_the_upper_body",
    "elbow",
    "wrist_1",
    "wrist_2",
    "wrist_3",
)


def row(effect, score, p_value=1e-30, share=None):
    return {"effect": effect, "score": score, "p_value": p_value, "heldout_gain": share}


def report_of(*rows, intervals=None, **changes):
    made = make_report(candidates=list(rows), **changes)
    return replace(made, share_intervals=intervals or {})


DRAG = {"drag.linear": (0.85, 0.97)}


def words(drawn):
    """Return all texts of a figure, including panels and ticks."""
    texts = [text.get_text() for text in drawn.texts]
    for axes in drawn.axes:
        texts += [text.get_text() for text in axes.texts]
        texts += [label.get_text() for label in axes.get_yticklabels()]
    return texts


def labels(drawn):
    return [label.get_text() for label in drawn.axes[0].get_yticklabels()]


FRICTION = ("friction.load_quadratic", "friction.load_direction", "friction.warming")
CASES = {
    "one candidate": report_of(row("drag.linear", 300.0, share=0.93), intervals=DRAG),
    "long names": report_of(*(row(name, 200.0, share=0.9) for name in FRICTION)),
    "a robot": make_robot_report(),
    "a robot with long names": make_robot_report(candidates=candidates(LONG)),
    "worse than nothing": report_of(
        row("drag.linear", 9.0, share=-4.0), intervals={"drag.linear": (-9.0, -1.0)}
    ),
    "no held-out runs": report_of(row("drag.linear", 300.0), held_out=None, heldout=None),
    "nothing found": make_report("adequate"),
}


@pytest.mark.parametrize("case", CASES)
def test_no_text_is_shortened_cut_or_covered(case):
    assert unreadable(draw_figure(CASES[case], "candidates")) == []


def test_a_place_stands_in_full_with_its_effect():
    one = "friction.load_quadratic@left_arm_shoulder_lift_joint_of_the_upper_body"
    drawn = draw_candidates_figure(make_robot_report(causes=(), candidates=[row(one, 300.0)]))
    (name,) = labels(drawn)
    assert name.replace("\n", " ").replace("_ ", "_") == (
        "friction that increases with load and its square "
        "at left_arm_shoulder_lift_joint_of_the_upper_body"
    )


def test_a_p_value_is_printed_once_where_it_distinguishes_nothing():
    rows = [row(f"my.effect_{i}", 400.0 - i, p_value=10.0 ** -(20 + i)) for i in range(12)]
    texts = words(draw_candidates_figure(report_of(*rows)))
    assert sum(text.count("p <") for text in texts) == 1
    assert any("p < 10⁻¹² for all shown" in text for text in texts)
    most = Counter(texts).most_common(1)
    assert most[0][1] == 1, "no text stands twice"


def test_p_values_near_the_threshold_are_next_to_their_bars_and_others_are_white():
    rows = (
        row("drag.linear", 300.0),
        row("drag.quadratic", 20.0, p_value=0.012),
        row("wind", 3.0, p_value=0.7),
    )
    drawn = draw_candidates_figure(report_of(*rows))
    assert f"20  ({format_p_value(0.012)})" in words(drawn)
    assert any("p ≥ 0.7 for white bars" in text for text in words(drawn))
    colours = [bar.get_facecolor() for bar in drawn.axes[-1].patches]
    assert colours[2] == (1.0, 1.0, 1.0, 1.0)
    assert len(set(colours)) == 3


def test_each_candidate_says_how_much_it_closes_with_the_interval():
    drawn = draw_candidates_figure(
        report_of(
            row("drag.linear", 300.0, share=0.93), row("wind", 3.0, share=0.2), intervals=DRAG
        )
    )
    texts = words(drawn)
    assert "93 % (85 to 97)" in texts
    assert "20 %" in texts
    whiskers = [line for line in drawn.axes[0].lines if list(line.get_xdata()) == [0.85, 0.97]]
    assert len(whiskers) == 1
    assert any("held out: 2 runs, 800 samples of 2 channels" in text for text in texts)


def test_few_shares_are_written_next_to_the_scores():
    others = [row(f"my.effect_{i}", 40.0 - i) for i in range(3)]
    drawn = draw_candidates_figure(
        report_of(row("drag.linear", 300.0, share=0.93), *others, intervals=DRAG)
    )
    assert len(drawn.axes) == 1, "most rows of a panel of shares would be empty"
    texts = words(drawn)
    assert "300, closes 93 % of the gap (95 %: 85 to 97)" in texts
    assert any("Without a share of the gap: not simulated" in text for text in texts)
    assert unreadable(drawn) == []


def test_a_cause_stands_out_without_colour():
    drawn = draw_candidates_figure(report_of(row("drag.linear", 300.0), row("wind", 3.0)))
    cause, other = drawn.axes[0].get_yticklabels()
    assert (cause.get_text(), cause.get_fontweight()) == ("▸ linear drag", "bold")
    assert (other.get_text(), other.get_fontweight()) == ("wind", "normal")


def test_explain_gives_each_measured_share_its_interval():
    swing = recording(
        effects=["drag.linear=1e-3"], noise=["q=0.003", "qd=0.02"], runs=5, seconds=1.0, rate=60.0
    )
    made = explain(swing, jobs=1).story
    measured = {
        c.effect: c.heldout_gain for c in made.verdict.candidates if c.heldout_gain is not None
    }
    assert len(measured) > 2
    assert set(made.share_intervals) == set(measured)
    for effect, (low, high) in made.share_intervals.items():
        assert low <= measured[effect] <= high
    low, high = made.share_intervals["drag.linear"]
    assert 0.8 < low < high <= 1.0
