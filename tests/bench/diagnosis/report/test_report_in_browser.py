"""Tests of the explanation page in a browser.

Each control has its documented effect, and every number equals that of the verdict and of the
report data.
"""

import io
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from bench.diagnosis.report.explanation_figures import render_figures
from bench.diagnosis.report.explanation_page import render_report
from bench.figures import robot_figure as drawing
from bench.figures.figure_settings import pdf_figures
from bench.pages.html_page import make_iframe
from bench.pages.text_format import format_number
from tests.bench.diagnosis.report.test_explanation_page import make_rendered_figure
from tests.bench.diagnosis.robot_report_data import CHANGE, WRISTS, make_robot_report
from tests.bench.diagnosis.sample_report_data import EVIL, evil, make_report
from tests.browser import WIDTHS, Opened


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write pages of a simple system and of a robot, with their report data and figures."""
    folder = tmp_path_factory.mktemp("pages")
    made = {}
    with pytest.MonkeyPatch.context() as patch:
        # Draw the robot as links, since rendering has its own tests.
        patch.setattr(drawing, "render_robot", lambda *_: None)
        for name, told in (
            ("simple", make_report("ambiguous")),
            ("robot", make_robot_report("ambiguous", [WRISTS], changes=(CHANGE,))),
        ):
            with pdf_figures(name == "robot"):
                figures = render_figures(told)
            path = folder / f"{name}.html"
            path.write_text(render_report(told, figures, folder), encoding="utf-8")
            made[name] = SimpleNamespace(path=path, story=told, figures=figures)
    return made


@pytest.fixture
def simple(browser, written):
    with Opened(browser, written["simple"].path) as one:
        yield one
        assert one.complaints == []


@pytest.fixture
def robot(browser, written):
    with Opened(browser, written["robot"].path) as one:
        yield one
        assert one.complaints == []


def heads(opened, figure="motion"):
    return opened.page.locator(f"#{figure} .panel h4").all_inner_texts()


def table(opened, selector, button):
    """Return file name and content of the CSV that a button saves."""
    name, content = opened.saved(
        opened.page.locator(selector).get_by_role("button", name=button).click
    )
    return name, pd.read_csv(io.BytesIO(content), dtype={"run": str, "set": str})


def strays(frame, verdict):
    """Return the candidates for which a table differs from verdict.json."""
    said = {c["effect"]: c for c in json.loads(json.dumps(verdict.to_document()))["candidates"]}
    wrong = sorted(set(said) ^ set(frame["effect"]))
    for row in frame.to_dict("records"):
        for key in ("score", "p_value", "heldout_gain"):
            shown = None if pd.isna(row[key]) else row[key]
            if row["effect"] in said and shown != said[row["effect"]][key]:
                wrong.append(f"{row['effect']}: {key}")
    return wrong


@pytest.mark.parametrize(("width", "scheme"), [(WIDTHS[0], "light"), (WIDTHS[1], "dark")])
@pytest.mark.parametrize("name", ["simple", "robot"])
def test_nothing_is_complained_of_and_nothing_is_in_the_way(browser, written, name, width, scheme):
    with Opened(browser, written[name].path, width=width, color_scheme=scheme) as one:
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []


def test_what_to_do_next_comes_first_after_the_verdict(simple, robot, written):
    for opened in (simple, robot):
        sections = opened.page.locator("main > section").evaluate_all("all => all.map(s => s.id)")
        assert [name for name in sections if name][:2] == ["next", "run"]
    folder = written["simple"].path.parent
    simple.context.grant_permissions(["clipboard-read", "clipboard-write"])
    score = simple.page.locator(".copying", has_text="simgap score")
    score.get_by_role("button", name="copy").click()
    score.get_by_role("button", name="copied").wait_for()
    said = f"simgap score {folder}/extended.toml OTHER.csv"
    assert simple.page.evaluate("navigator.clipboard.readText()") == said
    assert "frictionloss" in robot.text("#next pre.changes")


def test_candidates_are_those_of_the_verdict_and_can_be_sorted_and_filtered(simple, robot, written):
    for opened, name in ((simple, "simple"), (robot, "robot")):
        file, frame = table(opened, "#candidates-table", "save as CSV")
        assert file == "candidates.csv"
        assert strays(frame, written[name].story.verdict) == []
    # A changed number and a missing row are detected.
    frame.loc[3, "score"] += 1e-9
    assert strays(frame.iloc[:-1], written["robot"].story.verdict) == [
        frame["effect"].iloc[-1],
        f"{frame['effect'][3]}: score",
    ]

    rows = simple.page.locator("#candidates-table tbody tr")
    assert rows.locator("td:first-child").all_inner_texts()[:2] == [
        "linear drag",
        "Coulomb friction",
    ]
    assert rows.locator("td:nth-child(7)").all_inner_texts()[:3] == [
        "linear drag or Coulomb friction",
        "linear drag or Coulomb friction",
        "",
    ]
    simple.page.locator("#candidates-table th button").nth(3).click()
    assert rows.first.locator("td").nth(3).inner_text() == format_number(1e-9, 2)
    simple.page.locator("#candidates-table").get_by_label("standing").select_option("not needed")
    assert rows.count() == len(written["simple"].story.verdict.candidates) - 2
    assert "candidates-table.standing=not needed" in simple.state()
    joints = robot.page.locator("#candidates-table").get_by_label("joint ")
    joints.last.select_option("wrist_1")
    robot.page.locator("#candidates-table").get_by_label("shown").select_option("")
    names = robot.page.locator("#candidates-table tbody td:nth-child(2)").all_inner_texts()
    assert len(names) == 5 + 4 + 3 + 2
    assert all("wrist_1" in name for name in names)


def test_the_runs_are_chosen_worst_first_and_the_view_is_kept(browser, simple, written):
    told = written["simple"].story
    pick = simple.page.locator("#motion").get_by_label("run")
    options = pick.locator("option").all_inner_texts()
    assert next(text.split(",")[0].split(":")[0] for text in options) == "held 2"
    gaps = [float(re.search(r"RMS residual ([\d.]+) σ", text)[1]) for text in options]
    assert gaps[1:] == sorted(gaps[1:], reverse=True)
    side = told.held_out
    sigma = np.array([c.sigma for c in told.channels])
    gap = np.sqrt(np.nanmean(np.square((side.observed - side.before)[1] / sigma)))
    assert gaps[0] == pytest.approx(gap, rel=0.05)
    before = simple.page.locator("#motion canvas").first.screenshot()
    pick.select_option(index=len(options) - 1)
    assert simple.page.locator("#motion canvas").first.screenshot() != before
    simple.page.locator("#motion .switches .key").first.click()
    assert heads(simple) == ["qd", "qd: residual"]
    with Opened(
        browser, written["simple"].path, f"#{simple.page.evaluate('location.hash.slice(1)')}"
    ) as again:
        assert again.page.locator("#motion").get_by_label("run").input_value() == options[-1]
        assert heads(again) == ["qd", "qd: residual"]


def test_the_samples_are_the_recordings_and_residuals_are_in_noises(simple, written):
    told = written["simple"].story
    file, frame = table(simple, "#motion .files", "numbers as CSV")
    assert file == "motion.csv"
    for side in (told.fitting, told.held_out):
        for r, run in enumerate(side.names):
            for c, channel in enumerate(told.channels):
                rows = frame[(frame["run"] == run) & (frame["channel"] == channel.name)]
                close = {"atol": channel.sigma / 150, "equal_nan": True}
                assert np.allclose(rows["t"], side.times[r])
                for column, values in (
                    ("measured", side.observed),
                    ("before", side.before),
                    ("after", side.after),
                ):
                    assert np.allclose(rows[column], values[r, :, c], rtol=0, **close)
                left = (side.observed - side.after)[r, :, c] / channel.sigma
                assert np.allclose(rows["residual_after"], left, rtol=0, atol=6e-3, equal_nan=True)
    # The comparison is strict enough to detect an error of sigma / 50.
    assert not np.allclose(
        rows["measured"] + channel.sigma / 50, side.observed[r, :, c], rtol=0, **close
    )


def test_at_the_cursor_stands_all_of_that_moment_in_units_and_in_noises(simple, written):
    told = written["simple"].story
    panel = simple.page.locator("#motion .u-over").nth(1)
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    simple.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"])
    said = simple.text("#motion .tip:visible")
    row = round(100 * float(re.search(r"time \[s\]: ([\d.]+)", said)[1]))
    assert 180 < row < 220
    side, sigma = told.held_out, told.channels[0].sigma
    measured, before, after = (a[1, row, 0] for a in (side.observed, side.before, side.after))
    digits = {"measured": measured, "before": before, "after": after}
    for name, value in digits.items():
        shown = re.search(rf"\n {name} ([−\d.]+) rad", said)[1]
        assert float(shown.replace("−", "-")) == pytest.approx(value, abs=1e-3)
    noises, units = re.search(
        r"residual before ([−\d.]+) σ \(([−\d.×⁰-⁹⁻¹²³]+) rad\)", said
    ).groups()
    assert float(noises.replace("−", "-")) == pytest.approx((measured - before) / sigma, rel=0.01)
    assert float(units.replace("−", "-")) == pytest.approx(measured - before, rel=0.01)


def test_before_and_after_are_switched_off_in_every_figure(simple):
    follows = simple.page.locator("#follows .key", has_text="simulated after")
    simple.page.locator("#motion .key", has_text="simulated after").click()
    assert follows.get_attribute("aria-pressed") == "false"
    assert simple.state() == "off=simulated%20after" or "simulated after" in simple.state()
    assert len(heads(simple, "follows")) == 4
    simple.page.locator("#follows .switches .key", has_text="qd against time").click()
    # The figure is drawn anew after the click. The page forbids the evaluation of strings.
    expect = pytest.importorskip("playwright.sync_api").expect
    expect(simple.page.locator("#follows .panel h4")).not_to_have_count(4)
    assert len(heads(simple, "follows")) in (3, 5)


def test_a_joint_lights_up_in_its_curves_its_picture_and_the_tables(robot):
    page = robot.page
    page.locator("aside li", has_text="wrist_2").hover()
    assert page.locator("#robot .spot.lit").evaluate_all("a => a.map(s => s.dataset.lights)") == [
        "wrist_2"
    ]
    page.locator("#motion .switches .key", has_text="wrist_2").click()
    page.locator("#motion .switches .key", has_text="wrist_2").hover()
    lit = page.locator("#motion .panel.lit h4").all_inner_texts()
    shown = [head for head in heads(robot) if "wrist_2" in head]
    assert lit == shown
    page.locator("#candidates-table").get_by_label("shown").select_option("")
    page.locator("#candidates-table").get_by_label("search").fill("wrist_3")
    page.locator("#candidates-table tbody tr", has_text="@wrist_3").first.hover()
    assert page.locator("#robot .spot.lit").get_attribute("data-lights") == "wrist_3"
    # Marks of joints follow the picture, from the base to the tip of the arm, and stay inside it.
    places = page.locator("#robot .spot").evaluate_all(
        "a => a.map(s => [s.style.left, s.style.top])"
    )
    shares = np.array([[float(text.rstrip("%")) for text in pair] for pair in places])
    assert shares.shape == (6, 2)
    assert ((shares > 0) & (shares < 100)).all()


def test_of_a_robot_with_many_channels_the_worst_joints_are_on_at_first(robot):
    pressed = robot.page.locator("#motion .switches").first.locator(".key[aria-pressed=true]")
    names = [text.strip() for text in pressed.all_inner_texts()]
    assert len(names) == 4
    assert "elbow" in names
    quantities = robot.page.locator("#motion .switches").nth(1)
    quantities.locator(".key", has_text="torque").click()
    assert heads(robot) == [head for name in names for head in (f"q.{name}", f"q.{name}: residual")]


def test_every_figure_is_saved_with_its_numbers(robot, written):
    for place, name, tables in (
        ("#robot", "robot", []),
        ("#motion", "overview", ["numbers as CSV"]),
        ("#where-picture", "where", ["numbers as CSV (where)", "numbers as CSV (follows)"]),
        ("#candidates-picture", "candidates", ["numbers as CSV (candidates)"]),
    ):
        files = robot.page.locator(f"{place} .files")
        texts = files.locator("a, button").all_inner_texts()
        assert texts == ["PDF", "SVG", "PNG", *tables]
        figure = written["robot"].figures[name]
        saved = robot.saved(files.get_by_role("button", name="SVG").click)
        assert saved == (f"{name}.svg", figure.svg)
        assert robot.saved(files.get_by_role("link").click) == (f"{name}.pdf", figure.pdf)
    file, frame = table(robot, "#where-picture .files", "where")
    assert file == "where.csv"
    told = written["robot"].story.gap_locations
    assert list(frame["before"]) == [place.before for place in told]


def test_a_page_without_vector_graphics_saves_the_png_that_it_shows(simple, written):
    files = simple.page.locator("#candidates-picture .files")
    texts = files.locator("a, button").all_inner_texts()
    assert texts == ["PNG", "numbers as CSV (candidates)"]
    png = written["simple"].figures["candidates"].png
    assert simple.saved(files.get_by_role("button", name="PNG").click) == ("candidates.png", png)


def test_on_paper_and_without_a_script_figures_are_printed_ones(browser, simple, written):
    simple.page.emulate_media(media="print")
    for place in ("#motion", "#where-picture", "#candidates-picture"):
        assert simple.page.locator(f"{place} img.still").is_visible()
    assert not simple.page.locator("canvas:visible, button:not(th button):visible").count()
    assert "95 % of the sensor's noise lies in the grey band" in simple.text(
        "#motion figcaption"
    ).replace("\xa0", " ")
    with Opened(browser, written["robot"].path, java_script_enabled=False) as one:
        for place in ("#robot", "#motion", "#where-picture", "#candidates-picture"):
            assert one.page.locator(f"{place} img.still").is_visible()
        assert not one.page.locator("#follows").is_visible()
        assert one.page.locator("#candidates-table tbody tr").count() > 5
        assert one.page.locator("pre.changes ins").is_visible()


def test_texts_from_files_stay_texts(browser, tmp_path):
    told = replace(evil(), title=EVIL)
    path = tmp_path / "evil.html"
    path.write_text(
        render_report(told, {"overview": make_rendered_figure("overview")}, tmp_path / EVIL),
        encoding="utf-8",
    )
    with Opened(browser, path) as one:
        one.page.on("dialog", lambda _: one.complaints.append("a dialog"))
        assert one.text("header p") == EVIL
        assert one.page.evaluate("document.scripts.length") == 2
        assert EVIL in heads(one)[0]
        assert one.complaints == []


def test_in_a_notebooks_frame_the_page_works_without_an_address(browser, written, tmp_path):
    cell = tmp_path / "cell.html"
    html = make_iframe(written["simple"].path.read_text(encoding="utf-8"))
    cell.write_text(f"<!DOCTYPE html><html lang=en><title>x</title><main>{html}</main>")
    with Opened(browser, cell) as one:
        frame = one.page.frame_locator("iframe")
        frame.locator("#motion .switches .key").first.click()
        assert frame.locator("#motion .panel h4").all_inner_texts() == ["qd", "qd: residual"]
        assert one.complaints == []
