"""Tests of the pages of several comparisons and of a bounce shot."""

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.proportion_interval import compute_proportion_interval
from bench.benchmark.statistics.tuner_ranking import MIN_PROBLEMS_FOR_RANKS
from bench.bounce_shot.hit_rate_table import build_result_table
from bench.bounce_shot.shot_report import render_page
from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import render_all_formats
from bench.suite.multi_problem_report import (
    ComparisonCollection,
    render_multi_problem_page,
)
from tests.bench.figures.sample_comparisons import stored
from tests.browser import WIDTHS, Opened


def drawn():
    figure, _ = make_panel_grid(1, 1, (2, 2))
    return render_all_formats(figure)


def with_third(whole):
    """Add a third tuner with twice the errors of random."""
    third = whole.runs[whole.runs["tuner"] == "random"].copy()
    third["tuner"] = "cma_es"
    third["run"] = third["run"].str.replace("random", "cma_es")
    for name in ("param_error", "param_abs_error", "stiff_error"):
        third[name] = 2 * third[name]
    experiment = load_experiment("ball-crossengine").chosen(budget=whole.experiment.budget)
    runs = pd.concat([whole.runs, third])
    return whole._replace(
        runs=runs, experiment=experiment.with_tuners(["random", "cma_es", "tunenet"])
    )


def page_of(count, tmp_path, drop=None):
    """Render the page of `count` copies of the synthetic comparison, which has two problems."""
    whole = with_third(stored())
    if drop:
        whole = whole._replace(runs=whole.runs[whole.runs["tuner"] != drop])
    one = ComparisonStatistics(whole)
    together = ComparisonCollection([one] * count, one.curves.list_tuners())
    frames = together.build_tables()
    pictures = dict.fromkeys(["runtime-distribution", "critical-difference"], drawn())
    page = render_multi_problem_page(together, frames, pictures, ["simgap", "plot", "a <b>"])
    file = tmp_path / "report.html"
    file.write_text(page, encoding="utf-8")
    return file, frames


@pytest.mark.parametrize("width", WIDTHS)
def test_several_comparisons_have_a_page(browser, tmp_path, width):
    file, frames = page_of(MIN_PROBLEMS_FOR_RANKS, tmp_path)
    with Opened(browser, file, width=width) as one:
        said = one.text(".conclusion").replace("\xa0", " ")
        means = frames["ranks"].drop(columns="problem").mean()
        assert means.idxmin() == "tunenet"
        assert "tunenet has the best mean rank over 10 problems: 1 among 3 tuners" in said
        # With ranks 1, 2, 3 on ten problems, first and last differ, but neighbours do not.
        assert "better than cma_es; no significant difference from random." in said
        saved = one.saved(one.page.locator("#each-rank").get_by_text("save as CSV").click)
        assert saved == ("ranks.csv", frames["ranks"].to_csv(index=False).encode())
        assert one.page.locator("#errors .panel").count() == 1
        one.page.locator("#errors").get_by_label("problem").select_option("ball-crossengine wide")
        assert "Targets anywhere in the bounds (3)" in one.text("#errors .panel h4")
        assert "a <b>" in one.text("#making pre")
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []


def test_too_few_problems_are_no_test(tmp_path):
    file, _ = page_of(1, tmp_path)
    html = file.read_text(encoding="utf-8")
    assert "There are too few problems or tuners for a test of mean ranks" in html


def shots():
    rng = np.random.default_rng(0)
    hits = {"nominal": 0.2, "<i>explain</i>": 1.0, "tunenet": 0.95}
    return pd.DataFrame(
        [
            {
                "shot": f"{ball}-{i}", "ball": ball, "method": method, "hit": rng.uniform() < share,
                "off": rng.normal(), "prediction_error": 0.1, "drop_height": 1.0,
                "restitution": 0.7, "status": "done", "reason": "", "simulations": 5,
                "seconds": 0.1,
            }
            for method, share in hits.items()
            for ball in ("golf", "tennis")
            for i in range(30)
        ]
    )  # fmt: skip


def test_a_bounce_shot_has_a_page(browser, tmp_path):
    rows = shots()
    lines = build_result_table(rows)
    file = tmp_path / "report.html"
    pictures = dict.fromkeys(["success", "off", "shots"], drawn())
    page = render_page(load_experiment("bounce-shot"), "results/shot", lines, rows, pictures)
    file.write_text(page, encoding="utf-8")
    low, high = (round(100 * end, 1) for end in compute_proportion_interval(60, 60))
    assert (low, high) == (94.0, 100.0)
    with Opened(browser, file) as one:
        said = one.text(".conclusion").replace("\xa0", " ")
        assert (
            "<i>explain</i> hits most often: 60 of 60 shots, 100 % (95 % interval 94 % to" in said
        )
        assert "Its interval overlaps with those of tunenet." in said
        assert one.page.locator("#success canvas").count() == 1
        assert one.text("#every-shot .count") == "180 of 180 rows"
        first = one.page.locator("#lines tbody tr").first.locator("td").all_inner_texts()
        assert first[:4] == ["<i>explain</i>", "all", "60", "60"]
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []
