"""Tests of the result of explain in a notebook: display, queries, figures and files."""

import json
import re
from base64 import b64decode
from html import unescape
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from bench.diagnosis.explanation import Explanation
from bench.diagnosis.report.explanation_figures import DPI
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, FittedValue
from tests.bench.diagnosis.sample_report_data import DRAG, EVIL, TILT, evil, make_report

EXTENDED = ExtendedSimulator(
    name="pendulum_extended",
    system="pendulum",
    engine="batch",
    title="a swing",
    parameters={"inertia": FittedValue(3.4e-3, "kg*m^2", None, None)},
    effects={},
    constants={},
    observe=["q"],
)


def explanation_of(report):
    return Explanation(report.verdict, report, EXTENDED)


@pytest.fixture
def named():
    return explanation_of(make_report())


def test_its_parts_can_be_asked_for(named):
    assert named.verdict == "named"
    assert [cause.effect for cause in named.causes] == ["drag.linear"]
    assert named.answer.simulations == 1412


def test_shown_as_text_it_is_three_lines(named):
    assert repr(named).splitlines() == [
        f"named: {named.story.title}",
        "drag.linear: coefficient 2.20×10⁻⁴ (2.00×10⁻⁴ to 2.40×10⁻⁴) N·m·s/rad",
        "90 % of the gap closed (85 to 94 %) on held-out runs",
    ]
    adequate = explanation_of(make_report("adequate", title="quiet"))
    assert repr(adequate) == "adequate: quiet"


def test_what_cannot_be_distinguished_is_shown_together():
    shown = repr(explanation_of(make_report("ambiguous")))
    assert "drag.linear or friction.coulomb: coefficient" in shown


def test_shown_as_text_it_stays_short_whatever_it_holds():
    many = explanation_of(make_report(causes=[DRAG, TILT] * 20, title="a" * 9000))
    assert len(repr(many)) < 500
    shown = repr(explanation_of(evil()))
    assert len(shown) < 500
    assert "\x1b" not in shown
    assert len(shown.splitlines()) == 3


def test_shown_in_a_notebook_it_is_the_report_in_a_frame(named):
    html = named._repr_html_()
    assert html.startswith("<iframe ")
    assert html.endswith("</iframe>")
    assert html.count("<") == 2, "the report is an attribute, so none of its elements is the cell's"
    # The frame has another origin, so its code cannot access the notebook.
    assert 'sandbox="allow-scripts allow-downloads"' in html
    page = unescape(re.search('srcdoc="([^"]*)"', html)[1])
    assert page.startswith("<!DOCTYPE html>")
    assert "90\xa0% of the gap closed" in page
    pictures = re.findall('src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 3
    assert all(b64decode(picture).startswith(b"\x89PNG") for picture in pictures)


def test_its_report_is_that_of_the_folder_but_for_the_files_next_to_it(named, tmp_path):
    page = unescape(re.search('srcdoc="([^"]*)"', named._repr_html_())[1])
    written = named.write(tmp_path)[-1].read_text(encoding="utf-8")
    # Only the page in the folder contains a command that names a file of the folder.
    command = (
        r"<p>To measure the error [^<]*</p>\n"
        r'<pre class="copied" tabindex="0">simgap score [^<]*</pre>\n'
    )
    assert len(re.findall(command, written)) == 1
    assert re.sub(command, "", written) == page


def test_each_figure_can_be_had_by_name(named):
    assert named.figures == ("overview", "where", "candidates")
    for name in named.figures:
        figure = named.figure(name)
        assert isinstance(figure, Figure)
        assert len(figure.axes) >= 2
    words = [text.get_text() for text in named.figure("where").texts]
    assert "Where the gap is" in words
    bare = explanation_of(make_report("adequate", candidates=[], gap_locations=()))
    assert bare.figures == ("overview",)


def test_an_unknown_figure_lists_those_that_there_are(named):
    expected = "unknown figure 'why'; there are: candidates, overview, where"
    with pytest.raises(InputError, match=re.escape(expected)):
        named.figure("why")


def test_a_figure_looks_alike_shown_and_written(named, tmp_path):
    named.write(tmp_path)
    for name in named.figures:
        shown = named.figure(name)
        shown.savefig(tmp_path / "shown.png", dpi=DPI)
        written, seen = (matplotlib.image.imread(tmp_path / f"{n}.png") for n in (name, "shown"))
        np.testing.assert_array_equal(written, seen[:, :, :3])
        assert (seen[:, :, 3] == 1.0).all(), "the written file has no opacity"


def test_it_is_written_into_a_folder_that_is_made(named, tmp_path):
    folder = tmp_path / "new" / "one"
    paths = named.write(str(folder), pdf=True)
    names = [f"{n}{e}" for n in named.figures for e in (".png", ".pdf")]
    assert paths[-1].read_bytes().decode("utf-8").startswith("<!DOCTYPE html>")
    assert [p.name for p in paths] == ["verdict.json", "extended.toml", *names, "report.html"]
    assert sorted(folder.iterdir()) == sorted(paths), "nothing else is left there"
    assert json.loads(paths[0].read_text()) == named.answer.to_document()
    again = named.write(folder, pdf=True)
    assert again == paths


def test_without_being_asked_it_writes_no_pdf(named, tmp_path):
    paths = named.write(tmp_path)
    assert {path.name for path in paths if path.stem in named.figures} == {
        f"{name}.png" for name in named.figures
    }
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert b"application/pdf" not in paths[-1].read_bytes()


@pytest.mark.slow
def test_all_is_written_or_nothing(named, tmp_path, monkeypatch):
    def full(path, content):
        if "report" in path.name:
            raise OSError(28, "No space left on device")
        return write_bytes(path, content)

    write_bytes = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\)"):
        named.write(tmp_path / "out")
    assert not any((tmp_path / "out").iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: cannot be written"):
        named.write(tmp_path / "file")


def test_what_a_text_says_is_never_markup_of_the_cell():
    html = explanation_of(evil())._repr_html_()
    assert EVIL not in html
    assert EVIL not in unescape(html)
