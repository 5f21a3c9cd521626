import re
import shlex
from base64 import b64decode
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.identifiability import ParameterIdentifiability
from bench.diagnosis.pipeline.report_data_builder import _read_track_figure
from bench.diagnosis.report.explanation_page import render_report
from bench.diagnosis.report.residual_analysis import compute_channel_errors
from bench.figures.figure_output import FigureFiles
from bench.pages.page_table import INITIAL_ROWS
from tests.bench.diagnosis.report.test_summary_text import VERDICTS
from tests.bench.diagnosis.sample_report_data import DRAG, EVIL, HELD_OUT, TILT, evil, make_report

VOID = {"meta", "img", "br", "link", "input", "line", "circle"}
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"/>'


def make_rendered_figure(name):
    """Return placeholder bytes for a rendered figure."""
    return FigureFiles(b"\x89PNG\r\n\x1a\n", SVG + name.encode(), b"%PDF-" + name.encode())


class Reader(HTMLParser):
    """Parser that checks the nesting of elements and collects tags, attributes and texts."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.texts, self.headline = [], [], [], [], ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & {*self.open}:
            self.texts.append(data)
        if "h1" in self.open:
            self.headline += data

    @property
    def text(self):
        return " ".join(" ".join(self.texts).replace("\xa0", " ").split())


FIGURES = {name: make_rendered_figure(name) for name in ("overview", "where", "candidates")}


def render_page(report, folder=None):
    """Return the HTML of a page with placeholders for its figures."""
    return render_report(report, FIGURES, folder)


def read_page(report):
    """Return the visible text of a page."""
    return Reader(render_page(report)).text


def find_rows(text):
    """Return the HTML of the cells of each row of the tables, without headings."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", text, re.DOTALL)
    return [found for row in rows if (found := re.findall(r"<td[^>]*>(.*?)</td>", row))]


def cells(text, first):
    """Return the cells of the first table row that begins with this text."""
    return next(
        [unescape(c).replace("\xa0", " ") for c in row]
        for row in find_rows(text)
        if row[0] == first
    )


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_makes_a_sound_page_that_begins_with_its_headline(verdict):
    from bench.diagnosis.report.summary_text import format_headline

    report = make_report(verdict)
    html = render_page(report)
    reader = Reader(html)
    assert html.startswith("<!DOCTYPE html>\n<html lang=")
    assert reader.headline == format_headline(report)
    assert reader.tags.count("title") == reader.tags.count("h1") == 1
    assert reader.tags.index("h1") < reader.tags.index("h2") < reader.tags.index("img")
    assert re.findall(r"<h2[^>]*>([^<]*)", html)[:2] == [
        "What to do next",
        "Measured and simulated",
    ]
    assert f"{verdict}:" in reader.text
    assert not re.search(r"\bnan\b|None|\binf\b", reader.text)


def test_it_needs_no_network():
    html = render_page(make_report())
    reader = Reader(html)
    assert not set(reader.tags) & {"link", "iframe", "object", "base", "form"}
    assert reader.tags.count("script") == 2
    own = re.sub(r"<script.*?</script>|base64,[^\"]*", "", html, flags=re.DOTALL)
    assert not re.search(r"https?:|//[a-z]|@import|url\(", own)
    assert all(
        value.startswith(("data:image/svg+xml;base64,", "data:application/pdf;base64,", "#"))
        for _, name, value in reader.attributes
        if name in ("src", "href")
    )


def test_texts_from_files_and_plugins_are_escaped():
    html = render_page(evil())
    reader = Reader(html)
    assert html.count("<script") == html.count("</script") == reader.tags.count("script") == 2
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;") > 20
    assert "\x1b" not in html
    assert "\x00" not in html
    assert reader.headline.startswith(f"The simulation lacks {EVIL} or {EVIL}")


def test_attributes_cannot_be_escaped_from():
    quote = '" onerror="alert(1)'
    report = make_report()
    named = replace(
        report, parameters=tuple(replace(p, name=quote) for p in report.parameters), title=quote
    )
    named = replace(named, channels=tuple(replace(c, name=quote) for c in report.channels))
    assert not [a for a in Reader(render_page(named)).attributes if a[1].startswith("on")]


def test_figures_are_embedded_with_alternatives_that_say_what_they_show():
    html = render_page(make_report())
    pattern = r'src="data:image/svg.xml;base64,([^"]+)" data-file="(\w+)" alt="([^"]+)"'
    found = re.findall(pattern, html)
    data = [(name, b64decode(part)) for part, name, _ in found]
    assert data == [(name, figure.svg) for name, figure in FIGURES.items()]
    papers = re.findall(r'href="data:application/pdf;base64,([^"]+)"', html)
    assert [b64decode(paper) for paper in papers] == [figure.pdf for figure in FIGURES.values()]
    without = {name: figure._replace(pdf=None, svg=None) for name, figure in FIGURES.items()}
    html = render_report(make_report(), without)
    assert not re.search("data:(application/pdf|image/svg.xml);", html)
    shown = re.findall(r'src="data:image/png;base64,([^"]+)" data-file="(\w+)"', html)
    assert [(b64decode(data), name) for data, name in shown] == [
        (figure.png, name) for name, figure in FIGURES.items()
    ]
    overview, where, candidates = (alt for _, _, alt in found)
    assert "q and qd" in overview
    assert "linear drag" in overview
    assert "phase last third 16" in where
    assert "linear drag 812" in candidates


def test_numbers_are_those_of_the_report_data():
    report = make_report(causes=[DRAG, TILT])
    html = render_page(report)
    text = Reader(html).text
    assert "Together they close 90 % of the gap (85 to 94 %)" in text
    assert "90 % of the gap closed (85 to 94 %)" in text
    for value in ("0.37 rad", "0.045 rad", "0.01 rad"):
        assert value in text
    widths = [float(w) for w in re.findall(r"width:([\d.]+)%", html)]
    assert widths == pytest.approx([100, 100 * 0.045 / 0.37, 100 * 0.01 / 0.37], abs=0.05)
    assert cells(html, "run") == ["run", "4", "800", "13.2", "1.1"]
    assert cells(html, "linear drag")[:2] == ["linear drag", "drag.linear"]
    assert cells(html, "linear drag")[2:6] == ["812", "1×10⁻⁹", "0.9", "found"]
    assert cells(html, "linear drag")[6] == "Motion is resisted in proportion to speed."
    assert cells(html, "Coulomb friction")[2:6] == ["807", "1×10⁻⁷", "0.89", "not needed"]
    assert cells(html, "correction of gravity")[4] == "–"
    assert "2.20×10⁻⁴ (2.00×10⁻⁴ to 2.40×10⁻⁴) N·m·s/rad" in text
    assert "0.0310 (0.0280 to 0.0340)" in text
    assert "0.00351 (0.00345 to 0.00357) kg·m²" in cells(html, "inertia")
    assert "+5.4 %, had absorbed part of the gap" in cells(html, "inertia")
    assert cells(html, "restitution")[1] == "0.7, nominal: these data do not depend on it"
    assert "1,412 simulations of system pendulum on engine batch, 2.1 s" in text


def test_errors_of_channels_are_recomputed_from_the_runs():
    report = make_report()
    row = cells(render_page(report), "qd")
    assert row[:3] == ["qd", "0.05 rad/s", "estimated, steps of 0.002"]
    for column, side in ((3, report.fitting), (5, report.held_out)):
        for i, simulated in enumerate((side.before, side.after)):
            left = (side.observed - simulated)[:, :, 1]
            assert row[column + i] == f"{np.sqrt(np.nanmean(left**2)):.3g} rad/s"
    empty = replace(report.fitting, observed=np.full_like(report.fitting.observed, np.nan))
    assert np.isnan(compute_channel_errors(empty)).all()


def test_sets_that_cannot_be_distinguished_come_with_reason_and_experiment():
    text = read_page(make_report("ambiguous"))
    assert (
        "linear drag (score 812, held-out gain 0.9) and Coulomb friction "
        "(score 807, held-out gain 0.89)" in text
    )
    assert text.count("Release it from 1.5 rad instead of 0.5 rad") >= 2
    assert text.index("What to do next") < text.rindex("Release it from 1.5 rad")
    drag = cells(render_page(make_report("ambiguous")), "linear drag")
    assert drag[5:7] == ["found, but not distinguishable", "linear drag or Coulomb friction"]


def test_after_is_not_shown_where_nothing_was_found():
    for verdict in ("adequate", "unknown", "unidentifiable"):
        html = render_page(make_report(verdict))
        assert "RMS after" not in html
        assert 'class="bar after"' not in html


def test_it_says_what_remains():
    assert "The noise of qd is estimated from the data, not stated." in read_page(make_report())
    text = read_page(make_report(lack_of_fit=()))
    assert re.search(r"the residual of the held-out runs is 1 times the noise", text)


def test_what_is_open_is_not_called_settled():
    assert "Structure that no known cause explains: the residual" in read_page(
        make_report("unknown")
    )
    assert "Structure that no known cause" in read_page(make_report("partial", lack_of_fit=()))
    assert "Nothing significant" in read_page(make_report("adequate"))


def test_gaps_in_what_is_known_do_not_break_the_page():
    bare = make_report(
        "unidentifiable",
        heldout=None,
        held_out=None,
        candidates=[],
        gap_locations=(),
        profiles=(),
        parameters={},
        why=(),
    )
    reader = Reader(render_report(bare, {}))
    assert "No candidate was tested." in reader.text
    assert "img" not in reader.tags
    nothing = {
        **HELD_OUT,
        "rmse_base": None,
        "rmse_extended": None,
        "gap_closed": None,
        "low": None,
        "high": None,
    }
    assert "tuned simulation – rad" in Reader(render_report(make_report(heldout=nothing), {})).text


def test_many_runs_are_cut_to_the_worst():
    report = make_report()
    many = replace(
        report,
        gap_locations=tuple(
            replace(report.gap_locations[0], label=f"r{i}", before=float(i)) for i in range(1, 500)
        ),
    )
    html = render_report(many, {})
    assert f"{499 - INITIAL_ROWS} more rows." in html
    assert cells(html, "run")[1:4] == ["r499", "800", "499"]
    assert f"<td>r{500 - INITIAL_ROWS}<" in html
    assert f"<td>r{499 - INITIAL_ROWS}<" not in html


def test_commands_name_the_recording_and_the_folder_as_a_shell_takes_them():
    report = replace(make_report("ambiguous"), path=Path("my logs/it's <b>.csv"))
    html = render_page(report, Path("out dir"))
    said = [unescape(text) for text in re.findall(r'<pre class="copied"[^>]*>([^<]*)', html)]
    assert [shlex.split(text) for text in said] == [
        ["simgap", "design", "my logs/it's <b>.csv", "--out", "next.csv"],
        ["simgap", "explain", "my logs/it's <b>.csv", "next.csv"],
        ["simgap", "score", "out dir/extended.toml", "OTHER.csv"],
    ]
    # A page without a folder has no extended.toml to refer to.
    assert "extended.toml" not in render_page(report)
    unknown = read_page(make_report("unknown"))
    assert "--plugin my_effect.py" in unknown
    assert "--check" in read_page(make_report("unidentifiable"))
    assert "--thorough" not in unknown, "nothing stands that could be added to"
    partial = make_report("partial")
    assert partial.held_out is not None
    assert "explain swing.csv --thorough" in read_page(partial).replace(
        str(partial.path), "swing.csv"
    )
    for more in ({"thorough": True}, {"held_out": None}):
        assert "--thorough" not in read_page(replace(partial, **more))


def test_what_the_recording_can_fix_comes_before_any_verdict():
    numbers = (
        ParameterIdentifiability("inertia", True, "kg*m^2", 1e-5, 0.001, 0.01, "identifiable", ()),
        ParameterIdentifiability(
            "<b>mass", True, "kg", np.inf, 0.1, 1.0, "not identifiable", (("inertia", 0.998),)
        ),
        ParameterIdentifiability(
            "drag.linear", False, "1", 1e-4, 0.0, 1.0, "identifiable", (("drag.quadratic", 1),)
        ),
        ParameterIdentifiability("drag.quadratic", False, "1", 0.1, 0.0, 1.0, "weak", ()),
        ParameterIdentifiability(
            "sensor.drift", False, "1", np.inf, 0.0, 1.0, "not identifiable", ()
        ),
    )
    text = render_page(make_report("named", identifiability=numbers))
    said = Reader(text).text.partition(" Terms ")[2]
    assert (
        "Of 3 causes, each considered alone, this recording can identify 1 well, 1 roughly and"
        in said
    )
    assert "All 3 causes with their intervals" in said
    assert cells(text, "sensor")[-1] == "sensor drift"
    assert cells(text, "<code>inertia</code>")[1:3] == ["identifiable", "±1×10⁻⁵ kg·m²"]
    assert "&lt;b&gt;mass" in text
    assert "not identifiable – 0.1 to 1 inertia (1.00)" in said
    assert "drag.linear named by the verdict ±1×10⁻⁴ 0 to 1 drag.quadratic (1.00)" in said
    assert said.index("What the recording identifies") < said.index("Where the gap is")


@pytest.mark.parametrize("verdict", ["named", "ambiguous", "unknown"])
def test_what_can_be_fixed_does_not_contradict_the_headline(verdict):
    """The named cause may be "not identifiable" about the base model; its own fit decides."""
    names = ["drag.linear", "friction.coulomb", "sensor.lag"]
    numbers = [
        ParameterIdentifiability(n, False, "1", np.inf, 0.0, 1.0, "not identifiable", ())
        for n in names
    ]
    report = make_report(verdict, identifiability=tuple(numbers))
    text = render_page(report)
    said = Reader(text).text.partition("Of 3 causes, ")[2].partition("Where the gap is")[0]
    lost = "not visible in these data"
    standings = [cells(text, f"<code>{name}</code>")[1] for name in names]
    if verdict == "unknown":
        assert standings == [lost] * 3
        assert "Found:" not in said
        return
    alike = "explains the data as well as a named cause"
    expected = {"named": ["named by the verdict", lost, lost], "ambiguous": [alike, alike, lost]}
    assert standings == expected[verdict]
    assert "Found: linear drag (drag.linear)." in said


def test_causes_at_places_are_a_matrix_of_effects_by_places():
    names = ["friction.coulomb@a", "friction.coulomb@b", "drag.linear@a", "drag.linear@b"]
    words = ["identifiable", "weak", "not identifiable", "identifiable"]
    pairs = zip(names, words, strict=True)
    numbers = tuple(
        ParameterIdentifiability(n, False, "N", 0.1, 0.0, 1.0, word, ()) for n, word in pairs
    )
    cause = {**DRAG, "effect": "friction.coulomb@b"}
    text = render_page(make_report("named", identifiability=numbers, causes=[cause]))
    signs = {row[0]: [re.sub("<[^>]*>", "", cell) for cell in row[1:]] for row in find_rows(text)}
    assert signs["Coulomb friction <code>friction.coulomb</code>"] == ["●", "★"]
    assert signs["linear drag <code>drag.linear</code>"] == ["○", "●"]


def test_where_nobody_knows_there_is_no_word_of_it():
    assert "What the recording identifies" not in read_page(make_report("named"))


def test_the_track_of_a_film_is_drawn_next_to_the_curves(tmp_path):
    png = b"\x89PNG\r\n\x1a\n-a track"
    html = render_page(make_report(track=png))
    found = re.search(r'src="data:image/png;base64,([^"]+)" alt="The scene of the film', html)
    assert b64decode(found[1]) == png
    assert "data:image/png" not in render_page(make_report())

    def track(extra):
        recording = SimpleNamespace(path=tmp_path / "drop.csv", extra=dict.fromkeys(extra, "px"))
        return _read_track_figure(recording)

    tracked = ("u", "v", "radius_px")
    assert track(tracked) == b""
    (tmp_path / "drop.png").write_bytes(png)
    assert track(tracked) == png
    # An image for another recording and a file that is not an image are not embedded.
    assert track(("u", "v")) == b""
    (tmp_path / "drop.png").write_bytes(b"<svg onload=alert(1)>")
    assert track(tracked) == b""
