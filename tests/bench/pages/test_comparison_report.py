"""Tests of the comparison page: conclusions follow the statistics, numbers agree with the tables,
and arbitrary texts are escaped.
"""

import csv
import io
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pandas as pd
import pytest

from bench.benchmark import comparison_printed_figures
from bench.benchmark.comparison_charts import ComparisonView
from bench.benchmark.comparison_report import (
    ComparisonReportData,
    render_page,
)
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics, build_tables
from bench.benchmark.statistics.training_amortisation import build_time_per_target_table
from bench.figures.figure_output import render_all_formats
from bench.pages.text_format import format_number
from tests.bench.figures.sample_comparisons import BUDGET, LABELS, stored
from tests.browser import WIDTHS, Opened

TITLE = "A ball </title><script>alert(1)</script><b>bold</b>"
TRACEBACK = 'Traceback:\n  File "mine.py", line 3, in tune\n    <b>x</b>\nValueError: no & more'


def statuses(of):
    """Return the statuses of the synthetic comparison with two failed runs."""
    frame = of.statuses.copy()
    failed = frame["run"].isin(["random/in-0/0", "random/in-1/0"])
    frame.loc[failed, "status"] = "crashed"
    frame.loc[failed, "reason"] = TRACEBACK
    return frame


def results(whole=None, pictures=None, missing=0):
    whole = whole or stored()
    statistics = ComparisonStatistics(whole)
    if pictures is None:
        pictures = {}
    environment = {"simgap": "0.1", "plugins": ["/a b/mine.py"], "packages": {"numpy": "2.0"}}
    return ComparisonReportData(
        ComparisonView(whole, LABELS, statistics), build_tables(whole, statistics), pictures,
        environment, "results/a b", 'title = "x"\n', missing,
    )  # fmt: skip


def many(targets):
    """Repeat the synthetic comparison on N targets, with ten times smaller errors of tunenet."""
    rng = np.random.default_rng(1)
    whole = stored()
    parts = []
    for tuner, factor in (("random", 1.0), ("tunenet", 0.1)):
        one = whole.runs[whole.runs["run"] == f"{tuner}/in-0/0"]
        for i in range(targets):
            names = {"run": f"{tuner}/in-{i}/0", "target": f"in-{i}"}
            errors = factor * rng.uniform(0.5, 1.5) * 0.7 ** one["k"]
            parts.append(
                one.assign(**names, param_error=errors, param_abs_error=errors, stiff_error=errors)
            )
    runs = pd.concat(parts)
    ends = pd.DataFrame({"run": runs["run"].unique(), "status": "done", "reason": ""})
    ends["tuner"] = ends["run"].str.split("/").str[0]
    return whole._replace(runs=runs, statuses=ends)


def part(held, start, end):
    """Return the part of a page from one text to another, as plain text with its tags."""
    html = unescape(render_page(held)).replace("\xa0", " ")
    return html.partition(start)[2].partition(end)[0]


def best_table(held):
    return part(held, '<div class="conclusion">', "<ul>")


def conclusions(held):
    return re.findall("<li>(.*?)</li>", part(held, '<div class="conclusion">', '<p class="'))


def running_times(held):
    return re.findall("<li>(.*?)</li>", part(held, 'id="reaching"', "<figure"), re.DOTALL)


def warnings(held):
    return part(held, '<p class="warning">', "</p>")


@pytest.fixture(scope="module")
def shown():
    """Comparison that allows each figure, with failed runs and unusual texts."""
    whole = stored()
    whole = whole._replace(
        experiment=replace(whole.experiment, title=TITLE), statuses=statuses(whole)
    )
    # One image is used for all figures, because the tests of figures draw each of them.
    drawn = render_all_formats(comparison_printed_figures.draw_figure(whole, LABELS, "runtime"))
    return results(whole, dict.fromkeys(comparison_printed_figures.list_figure_names(whole), drawn))


@pytest.fixture(scope="module")
def path(shown, tmp_path_factory):
    file = tmp_path_factory.mktemp("comparison") / "report.html"
    file.write_text(render_page(shown), encoding="utf-8")
    return file


@pytest.fixture
def opened(browser, path):
    with Opened(browser, path) as one:
        yield one
        assert one.complaints == []


@pytest.mark.parametrize("width", WIDTHS)
def test_everything_is_there_quietly_and_for_everybody(browser, path, width):
    with Opened(browser, path, width=width) as one:
        figures = one.page.locator("figure").evaluate_all("all => all.map(one => one.id)")
        assert figures == [
            "error", "distance", "misfit", "directions", "spectra", "runtime", "ert", "cost",
            "amortisation",
        ]  # fmt: skip
        assert one.page.locator("canvas").count() == 2 + 2 + 2 + 2 + 2 + 2 + 2 + 3
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []


def test_the_first_screen_says_who_wins_and_shows_it(opened):
    assert opened.text("h1") == TITLE
    bottom = "document.querySelector('#error canvas').getBoundingClientRect().bottom"
    assert opened.page.evaluate(bottom) < 1000
    rows = opened.page.locator(".conclusion tbody tr").all_inner_texts()
    assert [row.split()[:2] for row in rows] == [[k, "tunenet"] for k in ("1", "3", "10", "12")]
    few, failed = opened.text("p.warning").replace("\xa0", " ").split(". ", 1)
    assert few == "3 targets cannot decide between 2 tuners: at least 6 are needed (--targets 6)"
    assert failed == "2 of 12 runs failed (17 %): reasons."


def test_the_headline_says_who_is_worse_by_how_much_and_on_how_many_targets():
    held = results(many(12))
    (said,) = conclusions(held)
    ratio = format_number(held.tables["ranking"]["error_ratio"].iloc[-1], 2)
    assert said == (
        "Targets in the training range (12 targets), after 12 simulations: "
        f"worse than the best: random {ratio}x the error (larger on 12 of 12 targets)."
    )
    assert "Wilcoxon's signed-rank test against the best, Holm-corrected for 1 comparison." in part(
        held, 'id="ranking"', "</section>"
    )


def test_too_few_targets_are_said_in_one_sentence_and_the_best_is_named_all_the_same():
    held = results(many(4))
    (said,), few = conclusions(held), warnings(held)
    assert said.endswith("after 12 simulations: not decided: random.")
    assert few.startswith("4 targets cannot decide between 2 tuners")
    assert "at least 6 are needed (--targets 6)." in few
    assert best_table(held).count("<strong>tunenet</strong>") == 4


def test_equal_tuners_are_best_together():
    same = many(12)
    values = same.runs[same.runs["tuner"] == "random"]["stiff_error"].to_numpy()
    same.runs.loc[same.runs["tuner"] == "tunenet", "stiff_error"] = values
    held = results(same)
    assert best_table(held).count("<strong>random</strong> and <strong>tunenet</strong>") == 4
    (equal,) = conclusions(held)
    assert equal.endswith("after 12 simulations: no tuner is worse.")


def test_the_median_of_the_headline_is_that_of_the_table():
    whole = results(many(12))
    table = whole.tables["table"]
    line = table[(table["metric"] == "stiff_error") & (table["tuner"] == "tunenet")]
    median = line[line["simulations"] == BUDGET]["median"].item()
    assert f"<strong>tunenet</strong> ({median:.2g})" in best_table(whole)
    exact = many(12)
    exact.runs.loc[exact.runs["tuner"] == "tunenet", "stiff_error"] = 1e-13
    assert "<strong>tunenet</strong> (at most 0.001)" in best_table(results(exact))
    (soon,) = running_times(whole)
    ert = whole.tables["ert"]
    ert = ert[
        (ert["threshold"] == whole.view.statistics.reference_level) & (ert["tuner"] == "tunenet")
    ]
    assert f": tunenet {format_number(ert['ert'].item())} (95" in soon
    assert "training 800)" in soon


def test_a_tuner_whose_runs_all_crashed_is_last_and_marked_everywhere():
    whole = many(12)
    crashed = whole.statuses["tuner"] == "tunenet"  # tunenet has the smallest errors
    whole.statuses.loc[crashed, "status"] = "crashed"
    held = results(whole)
    assert held.view.statistics.order == ["random", "tunenet"]
    assert "tunenet" not in best_table(held)
    assert "all runs failed: tunenet." in conclusions(held)[0]
    assert list(dict.fromkeys(held.tables["table"]["tuner"])) == ["random", "tunenet"]
    drawn = comparison_printed_figures.draw_figure(whole, LABELS, "error")
    labels = [text.get_text() for text in drawn.legends[0].get_texts()]
    assert labels == ["random", "tunenet\nall runs failed"]


def test_targets_that_were_drawn_again_are_said():
    held = replace(results(), environment={"redrawn_targets": 2, "target_draws": 11})
    said = (
        "2 of 6 targets were drawn again because their own simulation diverged (11 draws in all)."
    )
    assert said in part(held, "<body>", "</body>")


def test_what_is_missing_or_failed_is_said():
    assert warnings(results(many(6))) == ""
    unfinished = warnings(results(many(6), missing=3))
    assert unfinished == "Not finished: 3 planned runs are still missing."


@pytest.mark.parametrize("name", ["table", "ert", "pairs", "who_wins", "break_even"])
def test_a_table_is_saved_as_it_is_next_to_the_page(opened, shown, name):
    grids = {"table": "numbers", "ert": "times", "pairs": "against", "who_wins": "winners"}
    grid = opened.page.locator(f"#{grids.get(name, 'even')}")
    saved = opened.saved(grid.get_by_role("button", name="save as CSV").click)
    assert saved == (f"{name}.csv", shown.tables[name].to_csv(index=False).encode())


def test_a_chart_has_the_numbers_of_the_table(opened, shown):
    button = opened.page.locator("#error").get_by_role("button", name="numbers as CSV")
    _, content = opened.saved(button.click)
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    table = shown.tables["table"].set_index(["tuner", "range", "metric", "simulations"])
    compared = 0
    for row in rows:
        key = (row["tuner"], row["range"], row["metric"], int(row["simulations"]))
        if key in table.index:
            for column in ("median", "low", "high"):
                assert float(row[column]) == pytest.approx(table.loc[key, column], rel=1e-6)
            compared += 1
    # two tuners, two ranges, seven checkpoints
    assert compared == 2 * 2 * 7


def test_a_tuner_that_is_switched_off_is_gone_from_tables_too(opened):
    opened.page.locator("#error .key[data-name=random]").click()
    off = opened.page.locator(".key[data-name=random][aria-pressed=false]").count()
    assert off == opened.page.locator(".key[data-name=random]").count() > 5
    cells = opened.page.locator("#numbers tbody td:first-child").all_inner_texts()
    assert set(cells) == {"tunenet"}


def test_errors_to_be_reached_are_chosen(opened, shown):
    before = opened.page.locator("#cost canvas").first.screenshot()
    pick = opened.page.locator("#cost").get_by_label("error reached")
    # An error level that no tuner reached has no curves.
    prices = shown.view.statistics.tuning_costs
    reached = [v for v in prices if not build_time_per_target_table(prices[v]).empty]
    levels = [f"{format_number(v)} [training widths]" for v in reached]
    assert sorted(pick.locator("option").all_inner_texts()) == sorted(levels)
    assert (
        pick.input_value()
        == f"{format_number(shown.view.statistics.reference_level)} [training widths]"
    )
    pick.select_option(levels[0] if levels[0] != pick.input_value() else levels[1])
    assert opened.page.locator("#cost canvas").first.screenshot() != before


def test_the_legend_says_whose_runs_failed(opened):
    key = opened.page.locator("#error .key[data-name=random]")
    assert key.inner_text().split("\n")[-1] == "2 of 6 runs failed"
    assert opened.page.locator("#error .key[data-name=tunenet]").inner_text().strip() == "tunenet"


def test_failures_stand_with_their_tracebacks(opened):
    fold = opened.page.locator("#failures details")
    assert fold.count() == 1
    assert (
        fold.locator("summary").inner_text() == "random: crashed in 2 runs — ValueError: no & more"
    )
    fold.locator("summary").click()
    assert fold.locator("pre").inner_text() == TRACEBACK
    assert opened.page.locator("#failures b").count() == 0


def test_the_command_makes_it_again(opened, shown):
    assert (
        shown.format_rerun_command()
        == "simgap compare 'results/a b/experiment.toml' --plugin '/a b/mine.py'"
    )
    assert opened.text("#making pre") == shown.format_rerun_command()
    opened.page.get_by_text("experiment.toml: the exact").click()
    assert opened.page.locator("#making details pre").first.inner_text() == 'title = "x"'


def test_without_a_script_and_on_paper_figures_stand(browser, path):
    with Opened(browser, path, java_script_enabled=False) as one:
        stills = one.page.locator("img.still")
        assert [image.is_visible() for image in stills.all()] == [True] * 8
        assert one.page.locator("#numbers tbody tr").count() == 2
    with Opened(browser, path) as one:
        one.page.emulate_media(media="print")
        assert one.page.locator("img.still:visible").count() == 8
        assert one.page.locator("canvas:visible").count() == 0


def test_a_comparison_of_one_tuner_without_a_run_that_reached_anything_has_a_page():
    whole = many(3)
    alone = whole.runs[whole.runs["tuner"] == "random"].assign(stiff_error=5.0, param_error=5.0)
    kept = whole.statuses[whole.statuses["tuner"] == "random"]
    held = results(whole._replace(runs=alone, statuses=kept, costs={}, spectra=None))
    html = render_page(held)
    assert running_times(held) == []
    assert "<strong>random</strong> (5)" in best_table(held)
    assert 'id="against"' not in html
