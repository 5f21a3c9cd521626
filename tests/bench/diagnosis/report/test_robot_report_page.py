"""Tests of the page and the figures of a robot."""

import io
from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.report.candidate_ranking import build_candidate_table, rank_candidates
from bench.diagnosis.report.explanation_figures import (
    draw_figure,
    get_extreme_pose,
    list_figure_names,
)
from bench.diagnosis.report.explanation_page import render_report
from bench.diagnosis.report.joint_figure import list_joint_rows
from bench.diagnosis.report.run_selection import select_worst_run
from bench.figures import robot_figure as drawing
from bench.pages.page_table import INITIAL_ROWS
from tests.bench.diagnosis.report.test_explanation_page import Reader, cells, make_rendered_figure
from tests.bench.diagnosis.robot_report_data import (
    CHANGE,
    EVERYWHERE,
    HEAVY,
    WRISTS,
    cause,
    make_robot_report,
    number,
)
from tests.bench.diagnosis.sample_report_data import EVIL, make_report
from tests.bench.figures.figure_robots import ARM6

ALL = ("robot", "overview", "where", "candidates")
FIGURES = {name: make_rendered_figure(name) for name in ALL}


@pytest.fixture(autouse=True)
def schematic(monkeypatch):
    """Draw the robot as links, since rendering has its own tests."""
    monkeypatch.setattr(drawing, "render_robot", lambda *_: None)


@pytest.fixture(scope="module")
def overview():
    return draw_figure(make_robot_report(), "overview")


def image(drawn):
    from matplotlib.image import imread

    file = io.BytesIO()
    drawn.savefig(file, format="png", dpi=60)
    file.seek(0)
    return imread(file)[:, :, :3]


def test_a_robot_has_a_picture_of_itself_and_others_have_none():
    assert list_figure_names(make_robot_report()) == ALL
    assert "robot" not in list_figure_names(make_report())


def test_each_joint_has_a_row_and_each_quantity_a_column(overview):
    assert len(overview.axes) == 3 * 6
    drawn = draw_figure(make_robot_report(joints=("shoulder", "elbow")), "overview")
    assert len(drawn.axes) == 3 * 2
    edge = image(drawn)
    assert np.concatenate([edge[0], edge[-1], edge[:, 0], edge[:, -1]]).min() == 1.0


def test_rows_are_on_one_scale_and_say_how_large_the_residual_is(overview):
    rows = [overview.axes[3 * i : 3 * i + 3] for i in range(6)]
    limits = {row[1].get_ylim() for row in rows}
    assert len(limits) == 1
    sizes = [row[1].texts[0].get_text() for row in rows]
    before = [float(size.split(" → ")[0]) for size in sizes]
    assert int(np.argmax(before)) == ARM6.index("elbow")
    after = [float(size.split(" → ")[1]) for size in sizes]
    assert after == pytest.approx([1.0] * 6, abs=0.15)


def named(drawn):
    """Return the names of the highlighted rows."""
    texts = [text for axis in drawn.axes[::3] for text in axis.texts]
    return [
        t.get_text()[2:] for t in texts if t.get_text()[0] == "▸" and t.get_color() == "#0072B2"
    ]


def test_the_joint_that_the_verdict_names_stands_out(overview):
    assert named(overview) == ["elbow"]
    late = cause("input.delay@m_wrist_2", {"coefficient": number(0.05, "s")})
    drawn = draw_figure(make_robot_report(causes=[HEAVY, late]), "overview")
    assert named(drawn) == ["elbow", "wrist_2"]


def test_of_very_many_joints_the_worst_are_shown(monkeypatch):
    from bench.diagnosis.report import joint_figure

    monkeypatch.setattr(joint_figure, "MAX_JOINTS", 3)
    drawn = draw_figure(make_robot_report(), "overview")
    shown = {text.get_text().lstrip("▸ ") for axis in drawn.axes[::3] for text in axis.texts} & set(
        ARM6
    )
    assert shown == {"shoulder_lift", "elbow", "wrist_1"}
    assert "the worst 3 of 6" in drawn.get_suptitle()


def test_a_channel_that_is_no_joint_has_a_row_of_its_own():
    told = make_robot_report()
    channels = (*told.channels[:-1], replace(told.channels[-1], name="s.shake.x"))
    rows = list_joint_rows(replace(told, channels=channels))
    assert [row.name for row in rows] == [*ARM6, "s.shake.x"]
    assert set(rows[0].channels) == {"q", "tau"}
    assert set(rows[-1].channels) == {"q"}


def test_the_robot_stands_as_far_from_the_beginning_as_the_run_goes():
    told = make_robot_report()
    stands = get_extreme_pose(told, select_worst_run(told))
    assert set(stands) == set(ARM6)
    seen = told.held_out.observed[0, :, :6]
    far = np.linalg.norm(seen - seen[0], axis=1)
    assert list(stands.values()) == pytest.approx(seen[np.argmax(far)])
    assert "elbow\nCoulomb friction: 0.31 N·m" in [
        text.get_text() for text in draw_figure(told, "robot").axes[0].texts
    ]


def test_nothing_is_marked_where_nothing_is_found():
    drawn = draw_figure(make_robot_report("adequate", causes=()), "robot")
    assert not drawn.axes[0].collections


def test_many_candidates_are_one_row_an_effect_at_first():
    told = make_robot_report()
    html = render_report(told, FIGURES)
    at_first = [entry.best for entry in rank_candidates(told)]
    assert len(at_first) < len(told.verdict.candidates) / 3
    body = html.partition('id="candidates-table"')[2].partition("</table>")[0]
    assert body.count("<tr") == min(len(at_first), INITIAL_ROWS) + 1
    assert cells(html, "Coulomb friction")[1:4] == ["friction.coulomb@elbow", "900", "1×10⁻⁹"]
    assert cells(html, "Coulomb friction")[5:7] == ["found", "elbow"]
    frame = build_candidate_table(told)
    assert list(frame["effect"]) == [
        c.effect for c in sorted(told.verdict.candidates, key=lambda c: -c.score)
    ]
    joints = dict(zip(frame["effect"], frame["joint"], strict=True))
    assert joints["friction.coulomb@wrist_1"] == joints["sensor.gain@q.wrist_1"] == "wrist_1"
    assert joints["input.gain@m_elbow"] == joints["mass.scale@elbow_link"] == "elbow"
    assert joints["gravity.tilt"] == joints["friction.coulomb@*"] == ""


def test_the_lines_of_the_model_file_to_change():
    html = render_report(
        make_robot_report(changes=(CHANGE,), unwritable_causes=("a delay has no place in MJCF",)),
        {},
    )
    reader = Reader(html)
    assert "Changes of the model file (already made in extended.xml)" in reader.text
    assert '− <joint name="elbow" axis="0 1 0"/>' in reader.text
    assert '+ <joint name="elbow" axis="0 1 0" frictionloss="0.31"/>' in reader.text
    assert "A delay has no place in MJCF." in reader.text
    assert "Changes of the model file" not in render_report(make_robot_report(), {})


def test_texts_of_the_model_file_are_escaped():
    evil = replace(CHANGE, element=EVIL, before=EVIL, after=EVIL, comment=EVIL)
    html = render_report(make_robot_report(changes=(evil,), unwritable_causes=(EVIL,)), {})
    assert html.count("<script") == 2
    assert html.count("&lt;script&gt;") == 5


def test_a_set_of_places_is_one_sentence():
    text = Reader(render_report(make_robot_report("ambiguous", [WRISTS]), FIGURES)).text
    assert (
        "These data cannot distinguish: Coulomb friction at each of the joints wrist_1, wrist_2 "
        "and wrist_3. Each of them explains these runs equally well." in text
    )


def test_the_robot_comes_first_and_has_an_alternative_text():
    html = render_report(make_robot_report(causes=[EVERYWHERE]), FIGURES)
    first = html.index("<img")
    alternative = html[first : html.index(">", first)]
    assert "The robot; marked: joint shoulder_pan (Coulomb friction: 0.3 N·m)" in alternative
    assert "(channels in rad and N·m)" in Reader(html).text
