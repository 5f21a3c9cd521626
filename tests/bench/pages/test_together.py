"""The pages of several comparisons, and of a bounce shot."""

import numpy as np
import pandas as pd
import pytest

from bench.across import Part, Together
from bench.analysis.paired import PROBLEMS
from bench.figures.comparison import statistics_of
from bench.figures.style import blank, taken
from bench.pages.comparison.together import together_page
from bench.problem.experiment import load
from bench.shot.page import shot_page
from bench.shot.table import table, wilson
from tests.bench.figures.made import stored
from tests.browser import WIDTHS, Opened


def drawn():
    figure, _ = blank(1, 1, (2, 2))
    return taken(figure)


def with_third(whole):
    """A third tuner beside the two, twice as bad as random."""
    third = whole.runs[whole.runs["tuner"] == "random"].copy()
    third["tuner"] = "cma_es"
    third["run"] = third["run"].str.replace("random", "cma_es")
    for name in ("param_error", "param_abs_error", "stiff_error"):
        third[name] = 2 * third[name]
    experiment = load("ball-crossengine").chosen(budget=whole.experiment.budget)
    runs = pd.concat([whole.runs, third])
    return whole._replace(
        runs=runs, experiment=experiment.with_tuners(["random", "cma_es", "tunenet"])
    )


def page_of(count, tmp_path, drop=None):
    """The page of so many times the invented comparison, each of two problems."""
    whole = with_third(stored())
    if drop:
        whole = whole._replace(runs=whole.runs[whole.runs["tuner"] != drop])
    one = Part(statistics_of(whole), whole.experiment)
    together = Together([one] * count, one.statistics.curves.tuners())
    frames = together.frames()
    pictures = dict.fromkeys(["runtime-distribution", "critical-difference"], drawn())
    several = together.several(frames, pictures, [tmp_path / "a <b>"], tmp_path / "all")
    file = tmp_path / "report.html"
    file.write_text(together_page(several), encoding="utf-8")
    return file, frames


@pytest.mark.parametrize("width", WIDTHS)
def test_several_comparisons_have_a_page(browser, tmp_path, width):
    file, frames = page_of(PROBLEMS, tmp_path)
    with Opened(browser, file, width=width) as one:
        said = one.text(".conclusion")
        means = frames["ranks"].drop(columns="problem").mean()
        assert means.idxmin() == "tunenet"
        assert "tunenet has the best mean rank over 10 problems: 1 among 3 tuners" in said
        # Of ranks 1, 2, 3 on ten problems the first and the last are told apart, neighbours not.
        assert "better than cma_es; not told apart from random." in said
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
    assert "Too few problems or tuners for a test of mean ranks: the order may be chance." in html


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
    lines = table(rows)
    file = tmp_path / "report.html"
    pictures = dict.fromkeys(["success", "off", "shots"], drawn())
    page = shot_page(load("bounce-shot"), "results/shot", lines, rows, pictures)
    file.write_text(page, encoding="utf-8")
    low, high = (round(100 * end, 1) for end in wilson(60, 60))
    assert (low, high) == (94.0, 100.0)
    with Opened(browser, file) as one:
        said = one.text(".conclusion")
        assert "<i>explain</i> hits most: 60 of 60 shots, 100 % (95 % interval 94 % to" in said
        assert "The intervals of tunenet overlap with its own." in said
        assert one.page.locator("#success canvas").count() == 1
        assert one.text("#every-shot .count") == "180 of 180 rows"
        first = one.page.locator("#lines tbody tr").first.locator("td").all_inner_texts()
        assert first[:4] == ["<i>explain</i>", "all", "60", "60"]
        assert one.overflow() <= 0
        assert one.barriers() == []
        assert one.complaints == []
