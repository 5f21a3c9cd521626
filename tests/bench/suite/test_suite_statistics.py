"""Statistics, headline, guide and page of a suite on given error curves."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from bench.suite.suite_report import (
    build_headline,
    describe_losses,
    describe_tests,
    join_segments,
    render_suite_page,
)
from bench.suite.suite_statistics import COUNTED, FREE, SuiteTables, build_guide, choose_segments
from tests.bench.suite.synthetic_suite import BUDGET, make_suite, power_law

CELLS = [f"problem-{number}" for number in range(8)]
EARLY, LATE = power_law(0.01, 0.1), power_law(0.5, 2.0)  # they cross after about 8 simulations
NEVER = power_law(0.9, 0.01)


def make_tables(names=("early", "late", "never"), training=None, **changes):
    curves = dict(zip(names, (EARLY, LATE, NEVER), strict=True))
    return SuiteTables(make_suite(dict.fromkeys(CELLS, curves), training=training, **changes))


@pytest.mark.parametrize("names", [("early", "late", "never"), ("alpha", "beta", "gamma")])
def test_headline_follows_from_the_ranks(names):
    tables = make_tables(names)
    assert build_headline(tables) == f"Use {names[0]} up to 3 simulations, then {names[1]}."
    for k, best in ((1, names[0]), (3, names[0]), (10, names[1]), (100, names[1])):
        rows = tables.ranks[(tables.ranks["simulations"] == k) & (tables.ranks["training"] == FREE)]
        assert rows.iloc[0][["tuner", "mean_rank", "low", "high"]].tolist() == [best, 1, 1, 1]


def test_headline_names_the_best_untrained_method_too():
    tables = make_tables(training={"early": 400})
    assert build_headline(tables) == (
        "If you can train on your simulator beforehand, use early up to 3 simulations, then late. "
        "Without training, use late."
    )


def test_a_method_with_fewer_targets_is_ranked_on_the_common_ones():
    tables = make_tables()
    assert tables.build_tables()["ranks_common_targets"].empty
    # Method "never" is better than all others on the first target, and did not run on the rest.
    suite = tables.suite
    runs = suite.runs
    errors = suite.errors.copy()
    errors[((runs["tuner"] == "never") & (runs["target"] == "in-000")).to_numpy()] = 1e-5
    is_left_out = (runs["tuner"] == "never") & (runs["target"] != "in-000")
    partial = SuiteTables(replace(suite, errors=errors).select(~is_left_out))
    assert "never" not in partial.complete_tuners
    assert set(partial.ranks["tuner"]) == {"early", "late"}
    common = partial.build_tables()["ranks_common_targets"]
    first = common[(common["training"] == FREE) & (common["mean_rank"] == 1.0)]
    assert set(first["tuner"]) == {"never"}
    assert set(common["cells"]) == {len(CELLS)}
    assert "ran on some of the targets only" in render_suite_page(partial)
    assert "ran on some of the targets only" not in render_suite_page(tables)


def test_the_headline_does_not_change_method_for_a_small_difference():
    means = pd.DataFrame(
        {1: [1.2, 1.0, 3.0], 3: [1.0, 1.6, 3.0], 10: [1.4, 2.0, 1.0], 30: [2.0, 3.0, 1.0]},
        index=["a", "b", "c"],
    )
    assert choose_segments(means) == [("a", 10), ("c", 30)]
    assert join_segments(choose_segments(means)) == "a up to 10 simulations, then c"
    assert join_segments([("a", 1), ("b", 3), ("c", 30)]) == (
        "a up to 1 simulation, b up to 3 simulations, then c"
    )
    assert join_segments([("a", 30)]) == "a"


def test_counted_training_delays_a_trained_method():
    tables = make_tables(training={"early": 200})  # 20 simulations for each of ten targets
    free, counted = (tables.get_medians(30, training) for training in (FREE, COUNTED))
    expected = np.median(np.log(EARLY[10] * (1 + 0.01 * np.arange(4))))
    assert counted["early"].tolist() == pytest.approx([expected] * len(CELLS))
    assert counted["late"].tolist() == free["late"].tolist()
    before = tables.get_medians(10, COUNTED)["early"]
    assert np.exp(before).tolist() == pytest.approx([np.sqrt(1.01 * 1.02)] * len(CELLS))


def test_an_estimate_without_simulations_has_to_be_trained_first():
    """A regressor is right before it simulates; counted, it has the start's error until then."""
    at_once = np.where(np.arange(BUDGET + 1) >= 0, 0.001, 1.0)
    curves = {"regressor": at_once, "late": LATE}
    suite = make_suite(dict.fromkeys(CELLS, curves), training={"regressor": 200}, targets=1)
    tables = SuiteTables(suite)
    for k, expected in ((10, 1.0), (30, 0.001)):
        counted = np.exp(tables.get_medians(k, COUNTED)["regressor"])
        assert counted.tolist() == pytest.approx([expected] * len(CELLS))
    assert np.exp(tables.get_medians(1)["regressor"]).iloc[0] == pytest.approx(0.001)


def test_expected_running_time():
    times = make_tables(targets=1).running_times
    late = times[(times["cell"] == CELLS[0]) & (times["tuner"] == "late")]
    # 0.5 / k^2 is below 0.1 from k = 3, below 0.01 from 8, below 0.001 from 23.
    assert late["ert"].tolist() == [3, 8, 23]
    assert late["successes"].tolist() == [1, 1, 1]
    never = times[(times["cell"] == CELLS[0]) & (times["tuner"] == "never")]
    assert np.isinf(never["ert"]).all()


def test_best_against_each_other_by_holm():
    rows = make_tables().pairs
    last = rows[(rows["simulations"] == BUDGET) & (rows["training"] == FREE)]
    assert set(last["best"]) == {"late"}
    # Eight wins of eight: p = 2 / 2^8, times two comparisons.
    assert last["p_holm"].tolist() == pytest.approx([2 / 128, 2 / 128])
    assert last["best_better"].tolist() == [1, 1]
    assert list(describe_tests(make_tables()))[-1] == (
        "After 100: late is significantly better than 2 of 2 others."
    )


def test_guide_depends_on_the_property_of_the_problem():
    few = {"early": EARLY, "late": LATE}
    swapped = {"early": LATE, "late": EARLY}
    noisy = CELLS[:3]
    curves = {cell: swapped if cell in noisy else few for cell in CELLS}
    cells = {cell: {"tags": "noisy"} for cell in noisy}
    guide = build_guide(SuiteTables(make_suite(curves, cells=cells)))
    last = guide[guide["simulations"] == BUDGET].set_index(["property", "value"])
    assert last.at[("noise", "noisy"), "best"] == "early"
    assert last.at[("noise", "low-noise"), "best"] == "late"
    assert last.at[("all problems", ""), "best"] == "late"
    assert last.at[("noise", "noisy"), "cells"] == 3


def test_guide_follows_from_the_profile():
    tables = make_tables(training={"early": 400})
    profile = tables.profile
    for row in build_guide(tables).itertuples():
        if row.property != "all problems":
            same = (profile["property"] == row.property) & (profile["value"] == row.value)
            rows = profile[same & (profile["simulations"] == row.simulations)]
            ranks = rows.set_index("tuner")["mean_rank"]
            assert ranks[row.best] == ranks.min()
            assert ranks[row.best_untrained] == ranks.drop("early").min()


def test_losses_of_the_reference_methods():
    curves = {cell: {"hybrid": LATE, "tunenet": NEVER, "random": LATE * 2} for cell in CELLS}
    curves[CELLS[2]] = {"hybrid": LATE * 10, "tunenet": NEVER, "random": LATE}
    lines = list(describe_losses(SuiteTables(make_suite(curves))))
    worse = "is worse by a factor of 3 in"
    assert (
        lines[0] == f"hybrid {worse} 1 of 8 cells after 10 simulations: {CELLS[2]} (random, 10×)."
    )
    assert lines[2].startswith(f"tunenet {worse} 8 of 8 cells after 10 simulations: ")


def test_coverage_counts_targets_and_the_fewest_seeds_of_each_cell():
    suite = make_suite({cell: {"early": EARLY, "late": LATE} for cell in CELLS}, targets=5)
    # A second seed of "late" on all targets of one cell, and on one target of another.
    runs = suite.runs
    is_second = (runs["tuner"] == "late") & (
        (runs["cell"] == CELLS[0]) | ((runs["cell"] == CELLS[1]) & (runs["target"] == "in-002"))
    )
    second = runs[is_second].assign(seed=1)
    suite = replace(
        suite,
        runs=pd.concat([runs, second], ignore_index=True),
        errors=np.concatenate([suite.errors, suite.errors[is_second]]),
    )
    coverage = SuiteTables(suite).coverage.set_index("tuner")
    assert coverage.loc["late"].to_dict() == {
        "cells": 8, "min_targets": 5, "max_targets": 5, "seeds_1": 7, "seeds_2": 1,
    }  # fmt: skip
    assert coverage.at["early", "seeds_1"] == 8


def test_failed_and_missing_runs_are_visible():
    curves = {cell: {"early": EARLY, "late": LATE} for cell in CELLS}
    curves[CELLS[0]]["broken"] = np.full(BUDGET + 1, np.inf)
    short = np.where(np.arange(BUDGET + 1) > 30, np.nan, EARLY)
    for cell in CELLS:
        curves[cell]["short"] = short
    tables = SuiteTables(make_suite(curves))
    assert tables.complete_tuners == ["early", "late"]
    assert tables.get_ranks(10).at[CELLS[0], "broken"] == 4
    assert tables.get_ranks(100)["short"].isna().all()
    assert tables.get_ranks(10)["short"].notna().all()
    page = render_suite_page(tables)
    assert 'class="rank-4 failed"' in page
    assert (
        f'<a href="#cell-{CELLS[0]}" title="broken on {CELLS[0]}: median error inf, 4 failed'
        in page
    )


def test_every_cell_of_the_page_leads_to_its_curves():
    tables = make_tables()
    page = render_suite_page(tables)
    assert build_headline(tables) in page
    for cell in CELLS:
        assert f'<div id="cell-{cell}">' in page
        assert f'id="cell-{cell}-curves"' in page
        assert page.count(f'href="#cell-{cell}"') >= 1 + 3 * 3
