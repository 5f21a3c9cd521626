import io
import os
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from bench.figures import offscreen_rendering
from bench.figures import robot_figure as robot
from bench.figures.camera_view import choose_projection, make_posed_data
from bench.figures.figure_output import render_png
from bench.figures.robot_figure import (
    PlaceMark,
    arrange_labels,
    compute_link_segments,
    draw_robot_figure,
    locate_place,
    round_down_length,
)
from tests.bench.figures.figure_robots import ARM6, POSE6, arm2, arm6

MARKS = (
    PlaceMark("joint", "elbow", "linear drag"),
    PlaceMark("actuator", "m_elbow", "an input delay"),
    *(PlaceMark("joint", f"wrist_{i}", "Coulomb friction", is_certain=False) for i in (1, 2, 3)),
)


def pixels(figure):
    from matplotlib.image import imread

    return imread(io.BytesIO(render_png(figure, 80)))[:, :, :3]


def texts(figure):
    return [text.get_text() for text in figure.axes[0].texts]


@pytest.fixture
def schematic(monkeypatch):
    monkeypatch.setattr(robot, "render_robot", lambda *_: None)


@pytest.fixture(scope="module")
def picture():
    """Rendered image of the arm; tests that need it are skipped on machines without OpenGL."""
    made = arm6()
    data = make_posed_data(made, POSE6)
    image = offscreen_rendering.render_robot(
        made.compiled, data.qpos, choose_projection(made, data)
    )
    if image is None:
        pytest.skip("this machine has no GL to render with")
    return image


def test_marked_places_are_named_with_what_is_there_and_the_other_joints_by_name(schematic):
    said = texts(draw_robot_figure(arm6(), POSE6, MARKS))
    assert "elbow\nlinear drag" in said
    assert "actuator m_elbow\nan input delay" in said
    assert {"wrist_1\nCoulomb friction", "shoulder_pan", "shoulder_lift"} <= set(said)
    assert sum("wrist" in text for text in said) == 3


def test_a_ring_is_whole_where_the_place_is_sure_and_dashed_where_it_is_not(schematic):
    rings = draw_robot_figure(arm6(), POSE6, MARKS).axes[0].collections
    assert len(rings) == len(MARKS)
    assert [ring.get_linestyle()[0][1] is None for ring in rings] == [True, True, *[False] * 3]


def test_a_ring_stands_at_its_joint(schematic):
    made = arm2()
    figure = draw_robot_figure(made, {"shoulder": 0.6, "elbow": 0.8}, [PlaceMark("joint", "elbow")])
    data = make_posed_data(made, {"shoulder": 0.6, "elbow": 0.8})
    there = choose_projection(made, data).project(data.xanchor[1:2])[0]
    (ring,) = figure.axes[0].collections
    assert ring.get_offsets()[0].tolist() == pytest.approx(there.tolist(), abs=1e-12)


def test_labels_do_not_cover_each_other(schematic):
    long = PlaceMark("body", "upper", "a name as long as any that robots' files have")
    cases = ((arm6(), POSE6, MARKS), (arm6(shapes=False), {}, MARKS), (arm2(), {}, (long,)))
    for made, pose, marks in cases:
        figure = draw_robot_figure(made, pose, marks)
        draw = FigureCanvasAgg(figure).get_renderer()
        # The position of a text is known only after drawing.
        figure.draw(draw)
        # Compare the texts without their arrows, which may cross other texts.
        boxes = [Text.get_window_extent(text, draw) for text in figure.axes[0].texts]
        for i, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:i])
            assert box.x0 >= 0
            assert box.x1 <= figure.bbox.width
            assert box.y0 >= 0
            assert box.y1 <= figure.bbox.height


def test_middles_of_labels_keep_apart_and_in_the_column():
    sizes = [0.2, 0.1, 0.3, 0.1]
    middles = arrange_labels([0.0, 0.0, 0.0, -0.9], sizes, -1.0, 1.0)
    for (upper, size), (lower, below) in pairwise(zip(middles, sizes, strict=True)):
        assert upper - lower >= (size + below) / 2 - 1e-12
    assert middles[-1] - 0.05 >= -1.0
    assert arrange_labels([0.5, -0.5], [0.1, 0.1], -1, 1) == pytest.approx([0.5, -0.5])


def test_places_of_every_kind():
    made = arm2()
    data = make_posed_data(made, {"shoulder": 0.3})
    elbow = data.xanchor[1]
    assert locate_place(made, data, "actuator", "m_elbow") == pytest.approx(elbow)
    assert locate_place(made, data, "channel", "tau.elbow") == pytest.approx(elbow)
    assert locate_place(made, data, "channel", "s.shake.y") == pytest.approx(data.site_xpos[0])
    middle = elbow + 0.175 * np.array([np.cos(0.3), 0, -np.sin(0.3)])
    assert locate_place(made, data, "body", "forearm") == pytest.approx(middle, abs=1e-9)
    for kind in ("joint", "actuator", "body", "channel"):
        assert locate_place(made, data, kind, "nowhere") is None


def test_a_place_that_the_robot_does_not_have_is_left_out(schematic):
    figure = draw_robot_figure(arm2(), {}, [PlaceMark("joint", "nowhere", "linear drag")])
    assert not figure.axes[0].collections
    assert not any("nowhere" in text for text in texts(figure))


def test_links_lead_from_joint_to_joint_and_to_the_end():
    made = arm2()
    data = make_posed_data(made, {})
    ends = compute_link_segments(made, data)
    assert any(np.allclose([a, b], [[0, 0, 0], [0.4, 0, 0]]) for a, b in ends)
    # The capsule of the forearm is longer than its axis of 0.35 m by its radius of 0.03 m.
    assert any(np.allclose([a, b], [[0.4, 0, 0], [0.78, 0, 0]]) for a, b in ends)


def test_the_scale_is_a_round_length_and_as_long_as_it_says(schematic):
    assert [round_down_length(most) for most in (0.17, 0.5, 2.4, 9.9)] == [0.1, 0.5, 2.0, 5.0]
    axis = draw_robot_figure(arm2(), {}).axes[0]
    bar = next(line for line in axis.lines if line.get_linewidth() == 2.2)
    length = float(np.ptp(bar.get_xdata()))
    assert f"{length:g} m" in texts(axis.figure)


def test_without_a_gl_it_is_drawn_without_a_word(monkeypatch, capfd):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    image = pixels(draw_robot_figure(arm6(), POSE6, MARKS))
    assert image.std() > 0.05
    assert capfd.readouterr() == ("", "")


def test_a_gl_that_fails_is_asked_once_and_nothing_of_it_is_seen(monkeypatch, capfd):
    monkeypatch.setattr(offscreen_rendering, "list_gl_backends", lambda: ("osmesa",))
    monkeypatch.setattr(offscreen_rendering, "_failed", set())
    monkeypatch.setattr(
        offscreen_rendering, "_START", "raise SystemExit('no GL' + str(({path!r}, 1)[1]))"
    )
    made = arm2()
    data = make_posed_data(made, {})
    assert (
        offscreen_rendering.render_robot(made.compiled, data.qpos, choose_projection(made, data))
        is None
    )
    monkeypatch.setattr(offscreen_rendering.subprocess, "run", None)
    assert (
        offscreen_rendering.render_robot(made.compiled, data.qpos, choose_projection(made, data))
        is None
    )
    assert capfd.readouterr() == ("", "")


def test_the_kinds_of_gl_that_are_asked(monkeypatch):
    monkeypatch.setattr(offscreen_rendering.sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert offscreen_rendering.list_gl_backends() == ("egl", "osmesa")
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "osmesa")
    assert offscreen_rendering.list_gl_backends()[0] == "osmesa"
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "disable")
    assert offscreen_rendering.list_gl_backends() == ()


def test_a_rendered_robot_stands_where_the_view_says(picture):
    made = arm6()
    data = make_posed_data(made, POSE6)
    there = choose_projection(made, data)
    rows, columns, _ = picture.shape
    assert columns / rows == pytest.approx(there.width / there.height, rel=0.01)
    # The centre of each capsule is inside it: grey, whereas the background is white.
    for x, y in there.project(data.geom_xpos):
        row = int((0.5 - y / there.height) * rows)
        column = int((0.5 + x / there.width) * columns)
        assert picture[row, column].max() < 250
    assert (picture[[0, -1]] == 255).all()


def test_a_rendered_figure_marks_the_same_places(picture):
    figure = draw_robot_figure(arm6(), POSE6, MARKS)
    assert figure.axes[0].images
    assert len(figure.axes[0].collections) == len(MARKS)
    assert set(ARM6) <= {text.split("\n")[0] for text in texts(figure)}


def test_a_file_without_shapes_is_drawn_as_links():
    figure = draw_robot_figure(arm6(shapes=False), {})
    assert not figure.axes[0].images
    assert len(figure.axes[0].lines) > 6


def test_a_picture_is_grey_on_white_whatever_the_colours():
    colours = np.zeros((4, 4, 3))
    colours[:2] = (200.0, 30.0, 30.0)
    image = offscreen_rendering.convert_to_grey(colours, np.arange(16).reshape(4, 4) < 12)
    assert (image[3] == 255).all()
    assert image[:3].min() >= 120
    assert image[:3].max() < 255
    assert image[0, 0, 0] > image[2, 0, 0]
