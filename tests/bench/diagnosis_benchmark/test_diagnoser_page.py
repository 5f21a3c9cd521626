"""Tests of the comparison page of diagnosers, with the answers in results/reference/diagnosis."""

import re

import numpy as np
import pytest
from scipy.stats import beta

from bench.benchmark.problem.experiment_config import load_experiment
from bench.diagnosis_benchmark.diagnoser_figures import (
    DiagnoserReportData,
    draw_chart_figures,
    draw_confusion_matrices,
)
from bench.diagnosis_benchmark.diagnoser_report import render_page
from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import (
    build_all_tables,
    build_failure_table,
    read_table,
)
from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import render_all_formats
from bench.pages.text_format import format_percent
from tests.browser import Opened
from tests.docs.documentation_pages import ROOT

FOLDER = ROOT / "results/reference/diagnosis"
ORDER = ["simgap", "forward-bic", "forward-chi2", "stlsq", "frols", "ljung-box", "gp", "classifier"]


def answers():
    return read_table(FOLDER, "items")


def shown(rows, order=ORDER, **changes):
    figure, _ = make_panel_grid(1, 1, (2, 2))
    names = ("board", "power", "calibration", "cost", "outcomes", "confusion")
    given = {
        "experiment": load_experiment("diagnosis-full"),
        "folder": "results/a <b>",
        "order": order,
        "rows": rows,
        "tables": build_all_tables(rows, order, read_training_costs(FOLDER)),
        "training": read_training_costs(FOLDER),
        "pictures": dict.fromkeys(names, render_all_formats(figure)),
        "skipped": {"<i>sparse</i>": "no such package"},
        "planned": 654,
        "left_out": rows.iloc[:0],
    }
    return DiagnoserReportData(**{**given, **changes})


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(render_page(shown(answers())), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def opened(browser, page):
    with Opened(browser, page) as one:
        yield one


def wrong_of(rows, diagnoser):
    """Count directly the cases that a diagnoser got wrong."""
    own = rows[rows["diagnoser"] == diagnoser]
    clean, foreign = own["kind"] == "clean", own["kind"] == "foreign"
    named = ~clean & ~foreign & ((own["kind"] == "double") | (own["size"] >= 1))
    bad = (clean & own["alarm"]) | (foreign & (own["outcome"] != "right"))
    return set(own[bad | (named & ~own["found_class"])]["question"])


def grid(one, name):
    cells = one.page.locator(f"#{name} tbody tr").all()
    return [row.locator("td").all_inner_texts() for row in cells]


def test_failures_of_simgap_are_the_first_table(opened):
    rows = answers()
    wrong = wrong_of(rows, "simgap")
    assert wrong
    first = opened.page.locator(".conclusion li").all_inner_texts()[0]
    assert first.startswith(f"simgap fails on {len(wrong)} of ")
    assert (
        opened.page.locator("nav a").all_inner_texts()[0] == "Questions that simgap answers wrongly"
    )
    assert {row[1] for row in grid(opened, "wrong")} <= wrong
    assert opened.text("#wrong .count").startswith(f"{len(wrong)} of ")
    said = opened.page.locator(".conclusion li").all_inner_texts()
    clean = rows[(rows["diagnoser"] == "simgap") & (rows["kind"] == "clean")]
    alarms = int(clean["alarm"].sum())
    top = beta.ppf(0.975, alarms + 1, len(clean) - alarms)  # upper limit of Clopper and Pearson
    counted = f"{alarms} false alarm{'s' * (alarms != 1)}, the rate may be up to"
    assert any(f"{counted} {format_percent(top)}" in text.replace("\xa0", " ") for text in said)


def test_the_view_is_stored_in_the_url(browser, opened, page):
    rows = answers()
    opened.page.locator("#wrong").get_by_label("diagnoser").select_option("gp")
    assert opened.text("#wrong .count").startswith(f"{len(wrong_of(rows, 'gp'))} of ")
    opened.page.locator("#power .legend .key", has_text="stlsq").first.click()
    state = opened.state()
    assert "wrong" in state
    assert "stlsq" in state
    with Opened(browser, page, f"#{state}") as again:
        assert again.text("#wrong .count") == opened.text("#wrong .count")
        key = again.page.locator("#power .legend .key", has_text="stlsq").first
        assert key.get_attribute("aria-pressed") == "false"
    rows = len(answers())
    # Tables omit diagnosers that are switched off.
    assert opened.text("#answers .count") == f"{rows - rows // len(ORDER)} of {rows} rows"
    opened.page.locator("#power .legend .key", has_text="stlsq").first.click()
    assert opened.text("#answers .count") == f"{rows} of {rows} rows"


def test_the_page_has_all_charts_and_tables_without_errors(opened):
    charts = ("board", "shares", "power", "calibration", "sets", "cost")
    for name in charts:
        assert opened.page.locator(f"figure#{name} canvas").count() >= 1, name
    for name in ("numbers", "against", "taken", "prices", "by", "answers"):
        assert grid(opened, name), name
    assert "results/a <b>" in opened.text("#making")
    assert "<i>sparse</i> was not run: no such package" in opened.text("main")
    assert opened.barriers() == []
    assert opened.complaints == []


def test_the_page_works_on_a_phone_and_without_scripts(browser, page):
    with Opened(browser, page, width=400, java_script_enabled=False) as one:
        assert one.overflow() <= 0
        assert one.page.locator("#power img.still").is_visible()
        assert one.page.locator("#confusion-figure img.still").is_visible()
        wrong = wrong_of(answers(), "simgap")
        shown = {row[1] for row in grid(one, "wrong")}
        assert shown <= wrong
        assert f"{len(wrong) - len(shown)} more rows." in one.text("#wrong")


def test_a_better_diagnoser_than_simgap_is_reported():
    """The labels, and so the answers, of simgap and of the Gaussian process are swapped."""
    rows = answers()
    swapped = rows.assign(diagnoser=rows["diagnoser"].replace({"simgap": "gp", "gp": "simgap"}))
    said = re.sub("<[^>]*>", "", render_page(shown(swapped)))
    only = len(wrong_of(rows, "gp") - wrong_of(rows, "simgap"))
    assert only > 50
    assert "gp is better than simgap at “named”: it alone is right on" in said
    assert "No other diagnoser is significantly better" not in said


def test_a_page_without_simgap_does_not_mention_it():
    rows = answers()
    others = rows[rows["diagnoser"] != "simgap"]
    html = render_page(shown(others, ORDER[1:], skipped={}))
    assert "Wrong answers" in html
    assert "simgap fails" not in html


def test_failures_list_the_diagnosers_that_are_right():
    rows = answers()
    frame = build_failure_table(rows, ORDER).set_index(["diagnoser", "question"])
    right_by_one = {name: wrong_of(rows, name) for name in ORDER}
    for question in wrong_of(rows, "simgap"):
        said = frame.loc[("simgap", question), "right_by"]
        right = [name for name in ORDER if question not in right_by_one[name]]
        assert said == (" ".join(right) or "nobody")


def test_the_printed_charts_have_the_numbers_of_the_page():
    data = shown(answers())
    figures = draw_chart_figures(data)
    assert set(figures) == {"board", "power", "calibration", "cost"}
    table = data.tables["table"].set_index(["metric", "diagnoser"])["share"]
    points = [bar[0].get_xydata()[0] for bar in figures["board"].axes[0].containers]
    alarms, named = table["false alarms"], table["the same, up to equivalence"]
    assert points == [pytest.approx(100 * np.array([alarms[k], named[k]])) for k in ORDER]
    lines = figures["power"].axes[1].get_lines()
    power = data.tables["power"].set_index(["diagnoser", "metric"])
    for name, line in zip(ORDER, lines, strict=True):
        own = power.loc[(name, "seen")]
        assert line.get_xydata() == pytest.approx(own[["size", "share"]].to_numpy())


def test_the_confusion_of_families_counts_each_recording_once():
    rows = answers()
    figure = draw_confusion_matrices(rows, ORDER, "title")
    panel = figure.axes[0]
    assert panel.get_title() == "simgap"
    labels = [label.get_text() for label in panel.get_yticklabels()]
    own = rows[rows["diagnoser"] == "simgap"]
    clean = int((own["kind"] == "clean").sum())
    assert f"(clean) {clean}" in labels
    singles = own[(own["kind"] == "single") & (own["size"] >= 1)]
    friction = singles[singles["hidden"].str.startswith("friction.")]
    assert f"friction {len(friction)}" in labels
    shares = panel.images[0].get_array()
    place = labels.index(f"friction {len(friction)}")
    assert shares[place].sum() == pytest.approx(100.0)
    # A diagnosis of another effect of the family counts as that family.
    told = friction["found_class"] | friction["named"].astype(str).str.startswith("friction.")
    told &= (friction["verdict"] != "unknown") & ~friction["named"].astype(str).str.contains(
        "+", regex=False
    )
    assert shares[place, place] == pytest.approx(100 * told.mean())
