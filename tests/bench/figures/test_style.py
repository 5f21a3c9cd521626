"""Tests of the figure style: notebook state is kept, colours have one source, files are whole."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import bench
from bench.benchmark.comparison_printed_figures import draw_figure, list_figure_names
from bench.benchmark.statistics.tuner_ranking import compute_nemenyi_p_values
from bench.diagnosis.report import explanation_figures
from bench.figures import figure_output, loss_figure, style
from bench.figures.ball_track_figure import draw_track_figure
from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import render_all_formats, render_png, write_figure
from bench.figures.figure_settings import pdf_figures
from bench.figures.recording_figure import draw_recording_figure
from bench.logs.ball_heights_from_film import BallHeights
from bench.logs.recording_loading import load_recording
from bench.suite.multi_problem_report import draw_critical_difference_figure
from sims.core.simulator import InputError
from sims.vision.ball_tracker import BallTrack
from tests.bench.diagnosis.report_tables import swing, table
from tests.bench.diagnosis.sample_report_data import make_report
from tests.bench.figures.sample_comparisons import LABELS, stored

ROOT = Path(bench.__file__).parents[1]
SOURCES = [path for room in ("bench", "methods", "sims") for path in (ROOT / room).rglob("*.py")]


def swinging(folder):
    return table(folder, [swing(np.arange(90) / 60) for _ in range(3)])


def ranks():
    rng = np.random.default_rng(0)
    scores = pd.DataFrame(rng.uniform(size=(6, 4)), columns=list("abcd"))
    return scores.rank(axis=1)


def rank():
    friedman, p_values = compute_nemenyi_p_values(ranks())
    return draw_critical_difference_figure(ranks(), p_values, friedman)


def loss():
    return loss_figure.draw_loss_figure(
        "t", [loss_figure.LossRow(0, "clean", e, 1.0 / e, 2.0 / e) for e in range(1, 9)]
    )


def tracked():
    t = np.arange(30) / 30
    ball = np.full(30, 5.0)
    scene = np.zeros((60, 40, 3), dtype=np.uint8)
    track = BallTrack(t, 20.0 + 0 * t, 10 + 30 * t**2, ball, 0.1, (40, 60), (), scene, {3: scene})
    return draw_track_figure(
        track, BallHeights(1 - t**2, 0.03, "somehow"), slice(2, 28), "film.mp4"
    )


@pytest.fixture
def notebook(monkeypatch):
    """Set a user's backend, setting and open figure; return a function that reads this state."""
    before = matplotlib.get_backend()
    pyplot.switch_backend("svg")
    matplotlib.rcParams["lines.linewidth"] = 3.25
    pyplot.figure(num=7)

    def state():
        return matplotlib.get_backend(), dict(matplotlib.rcParams), pyplot.get_fignums()

    yield state
    pyplot.close("all")
    matplotlib.rcdefaults()
    pyplot.switch_backend(before)


@pytest.mark.slow
def test_drawing_leaves_backend_settings_and_open_figures_alone(notebook, tmp_path):
    before = notebook()
    assert before[2] == [7]
    drawn = [draw_figure(stored(), LABELS, name) for name in list_figure_names(stored())]
    drawn += [
        explanation_figures.draw_figure(make_report(), name)
        for name in explanation_figures.list_figure_names(make_report())
    ]
    drawn += [rank(), loss(), tracked(), draw_recording_figure(*load_recording(swinging(tmp_path)))]
    for i, one in enumerate(drawn):
        assert isinstance(one, Figure)
        write_figure(one, tmp_path / str(i), dpi=40)
    explanation_figures.render_figures(make_report())
    assert notebook() == before


def test_no_source_chooses_a_backend_or_leaves_figures_with_pyplot():
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"matplotlib\.use\(|import pyplot|switch_backend", text), path


def test_colours_are_named_in_one_place():
    for path in SOURCES:
        if path != Path(style.__file__):
            assert not re.search(r"[\"']#[0-9A-Fa-f]{6}[\"']", path.read_text()), path


def test_a_notebook_can_show_a_figure_that_pyplot_does_not_know():
    drawn, _ = make_panel_grid(1, 2, (4, 3))
    assert drawn._repr_png_().startswith(b"\x89PNG")


def test_files_are_whole_and_the_same_whenever_they_are_made(tmp_path):
    with pdf_figures():
        paths = write_figure(loss(), tmp_path / "new" / "figures" / "loss")
        again = write_figure(loss(), tmp_path / "loss")
    assert [path.name for path in paths] == ["loss.png", "loss.pdf"]
    assert sorted((tmp_path / "new" / "figures").iterdir()) == sorted(paths)
    assert [p.read_bytes() for p in again] == [p.read_bytes() for p in paths]
    assert paths[0].read_bytes() == render_png(loss())


def test_a_pdf_is_made_only_where_one_is_asked_for(tmp_path, monkeypatch):
    rendered = []
    plain = figure_output.render_pdf
    monkeypatch.setattr(
        figure_output, "render_pdf", lambda figure: rendered.append(figure) or plain(figure)
    )
    assert [path.name for path in write_figure(loss(), tmp_path / "loss")] == ["loss.png"]
    assert render_all_formats(loss()).pdf is None
    with pdf_figures(False):
        assert render_all_formats(loss()).pdf is None
    assert rendered == [], "what nobody asks for costs nothing"
    with pdf_figures(), pdf_figures(False):
        assert render_all_formats(loss()).pdf.startswith(b"%PDF")
    assert render_all_formats(loss()).pdf is None


def test_of_png_and_pdf_neither_is_left_without_the_other(tmp_path, monkeypatch):
    def full(self, content):
        if ".pdf" in self.name:
            raise OSError(28, "No space left on device")
        return original(self, content)

    original = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", full)
    with (
        pdf_figures(),
        pytest.raises(InputError, match=r"cannot be written \(No space left on device\)"),
    ):
        write_figure(loss(), tmp_path / "loss")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: cannot be written"):
        write_figure(loss(), tmp_path / "file" / "loss")


def test_a_tuner_has_its_colour_in_the_diagram_of_ranks_too():
    figure = rank()
    dots = {tuple(dot) for one in figure.axes[0].collections for dot in one.get_facecolors()}
    assert {to_hex(dot).upper() for dot in dots} == {style.get_colour(place) for place in range(4)}
    assert {to_hex(text.get_color()).upper() for text in figure.axes[0].texts} == {
        style.NEUTRAL_MARK
    }
