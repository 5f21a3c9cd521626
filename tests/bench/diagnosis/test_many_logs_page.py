"""Tests of the summary page of many logs in a browser: its content and its links to the reports."""

import json
from dataclasses import replace

import pytest

from bench.diagnosis import many_logs
from bench.diagnosis.many_logs import (
    MAX_PANELS,
    BatchPageInput,
    LogResult,
    draw_summary_figure,
    format_log_table,
    make_summary_charts,
    render_summary_page,
)
from tests.bench.figures.figure_readability import unreadable
from tests.browser import WIDTHS, Opened

ODD = "a </b><b>$x$"
EFFECTS = "friction.coulomb@elbow or joint.backlash@elbow"
ERROR = "bad.toml: expected a number, found <i>none</i>"


def cause(value, effect="friction.coulomb@elbow", alternatives=("joint.backlash@elbow",)):
    number = {"value": value, "low": 0.9 * value, "high": 1.2 * value, "unit": "N*m"}
    return {
        "effect": effect,
        "alternatives": list(alternatives),
        "coefficients": {"coefficient": number},
    }


def summary_input(tmp_path, count=4, left=2):
    """Return results of `count` logs with a cause, one without and one failed, and the page input.

    The page input has the folders of the explained logs.
    """
    rows = [
        LogResult(ODD if k == 0 else f"day{k}", "d", "ambiguous", (cause(0.1 * (k + 1)),), 0.9, 1.5)
        for k in range(count)
    ]
    rows += [LogResult("clean", "d", "adequate", (), None, 0.5), LogResult("bad", "d", error=ERROR)]
    folders = {row.log: tmp_path / row.log.replace("/", "_") for row in rows}
    for k, row in enumerate(rows[:count]):
        folders[row.log].mkdir(exist_ok=True)
        held = {"rmse_base": 20.0 + k, "rmse_extended": 3.0, "noise_floor": 2.0, "low": 0.8}
        (folders[row.log] / "verdict.json").write_text(
            json.dumps({"heldout": {**held, "high": 0.95, "gap_closed": 0.9, "unit": "rad"}})
        )
        (folders[row.log] / "report.html").write_text(f"<title>report of log {k}</title>")
    recordings = {row.log: tmp_path / f"{row.log}.csv" for row in rows}
    words = ["simgap", "explain", *map(str, recordings.values()), "--each"]
    return rows, BatchPageInput(tmp_path, folders, recordings, words, left)


def written(tmp_path, count=4, left=2):
    rows, asked = summary_input(tmp_path, count, left)
    file = tmp_path / "report.html"
    file.write_text(render_summary_page(rows, asked), encoding="utf-8")
    return file, rows


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_says_what_was_found_and_leads_to_every_log(browser, tmp_path, width):
    file, rows = written(tmp_path)
    with Opened(browser, file, width=width) as one:
        page, said = one.page, one.text(".conclusion")
        assert "Verdicts: 4 ambiguous, 1 adequate and 1 could not be explained." in said
        assert (
            "(friction.coulomb@elbow or joint.backlash@elbow) in 4 of 6 logs: 0.1 to 0.4 N·m"
            in said
        )
        assert "close 90 % of the held-out gap (median); 90 % in 4 logs" in said.replace(
            "\xa0", " "
        )
        assert "2 logs are not explained yet" in said
        assert ERROR in one.text("#next")
        together = page.locator("#next pre").last.inner_text()
        assert together.count(".csv") == 4
        assert "bad.csv" not in together
        first = page.locator("#each tbody tr").first.locator("td").all_inner_texts()
        # The errors are 20 and 3, and the noise floor is 2.
        assert first[:9] == [
            ODD, "1", "ambiguous", EFFECTS,
            "0.9", "0.8", "0.95", "10", "1.5",
        ]  # fmt: skip
        assert page.locator("#each tbody a").count() == 5
        saved = one.saved(page.locator("#all-numbers").get_by_text("save as CSV").click)
        assert saved == ("logs.csv", format_log_table(rows).encode())
        assert page.locator("canvas").count() == 2
        assert one.overflow() <= 0
        assert one.barriers() == []
        page.locator("#each").get_by_label("verdict").select_option("not explained")
        assert page.locator("#each tbody td").first.inner_text() == "bad"
        assert page.locator("#each tbody a").count() == 0
        page.locator("#each").get_by_label("verdict").select_option("")
        assert one.complaints == []
        with page.expect_navigation():
            page.locator("#each tbody a").first.click()
        assert page.title() == "report of log 0"


def test_without_a_script_its_tables_lead_and_its_figures_stand(browser, tmp_path):
    file, _ = written(tmp_path)
    with Opened(browser, file, java_script_enabled=False) as one:
        assert one.page.locator("img.still").count() == 2
        assert one.page.locator("img.still").first.is_visible()
        one.page.locator("#each tbody a").nth(1).click()
        assert one.page.title() == "report of log 1"


def test_logs_beyond_what_an_axis_holds_have_numbers(browser, tmp_path):
    file, _ = written(tmp_path, count=45)
    with Opened(browser, file) as one:
        assert one.text("#each .count") == "47 of 47 rows"
        one.page.locator("#found").scroll_into_view_if_needed()
        box = one.page.locator("#found .u-over").bounding_box()
        one.page.mouse.move(box["x"] + box["width"] * 44.5 / 47, box["y"] + 5)
        one.page.locator("#found .tip").wait_for()
        tip = one.text("#found .tip")
        assert "log, by its number: 45" in tip
        assert "4.5 (4.05 to 5.4)" in tip
        assert one.complaints == []


def test_nothing_explained_yet_is_a_page_too(tmp_path):
    _, asked = summary_input(tmp_path)
    html = render_summary_page([], asked)
    assert "0 logs, each explained separately" in html
    assert "<strong>none yet</strong>" in html
    assert "<figure" not in html


def test_no_number_next_to_a_chart_is_cut_off(browser, tmp_path):
    small = [
        LogResult(f"day{k}", "d", "named", (cause(-1.2345e-6 * (1 + 0.01 * k)),)) for k in range(3)
    ]
    _, asked = summary_input(tmp_path)
    folders = {row.log: tmp_path / row.log for row in small}
    asked = replace(asked, folders=folders, recordings=folders)
    file = tmp_path / "small.html"
    file.write_text(render_summary_page(small, asked), encoding="utf-8")
    # A mark in the first column of pixels would be cut off by the edge of the canvas.
    column = """() => {
        const canvas = document.querySelector("#found canvas");
        const data = canvas.getContext("2d").getImageData(0, 0, 1, canvas.height).data;
        return data.filter((_, i) => i % 4 == 3).reduce((sum, one) => sum + one, 0);
    }"""
    with Opened(browser, file) as one:
        one.page.locator("#found").scroll_into_view_if_needed()
        one.page.locator("#found canvas").first.wait_for()
        assert one.page.evaluate(column) == 0


LONG = "friction.load_quadratic@left_arm_shoulder_lift_joint"
OTHERS = ("friction.load_direction@left_arm_shoulder_lift_joint", "joint.backlash@left_arm_elbow")


@pytest.mark.parametrize("count", [1, 3, 12])
def test_the_printed_figures_show_names_in_full(tmp_path, count):
    rows = [
        LogResult(f"recording_of_the_left_arm_on_tuesday_{k}", "d", "ambiguous", (
            cause(0.1 * (k + 1), LONG, OTHERS), cause(0.2, "friction.coulomb@wrist_1", ())
        ))
        for k in range(count)
    ]  # fmt: skip
    logs = many_logs.build_log_table(rows, {row.log: tmp_path / row.log for row in rows})
    logs["before"], logs["after"] = 12.0, 1.2
    charts = make_summary_charts(logs, many_logs.build_number_table(rows))
    for panels in (charts.numbers[:MAX_PANELS], charts.held_out):
        drawn = draw_summary_figure(panels, charts.tables, "Each log.")
        assert unreadable(drawn) == []
        names = [label.get_text().replace("\n", "") for label in drawn.axes[0].get_yticklabels()]
        assert names == list(logs["log"]) or not charts.has_names


def test_a_number_at_a_place_is_named_by_it_in_full():
    joint = "left_arm_shoulder_lift_joint_of_the_upper_body"
    known = {"value": 1.0, "low": 0.9, "high": 1.1, "unit": "N*m"}
    found = {"effect": "friction.coulomb@*", "alternatives": [], "coefficients": {}}
    found["coefficients"][f"coefficient@{joint}"] = known
    (what,) = many_logs.build_number_table([LogResult("day", "d", "named", (found,))])["what"]
    assert what == f"friction.coulomb@*: at {joint} [N·m]"
