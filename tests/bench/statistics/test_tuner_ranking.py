"""Tests of the ranking rule: medians with a floor, ties, failures, and tests against the best."""

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.comparison_charts import find_coinciding_curves
from bench.benchmark.statistics.error_curves import RunCurves
from bench.benchmark.statistics.tuner_ranking import (
    compute_min_targets,
    list_ranking_points,
    rank_after_budget,
    rank_tuners,
)

FLOOR = 1e-3


def curves_of(errors, failed=(), kind="in"):
    """Build curves from {tuner: (targets, K + 1) errors}, one seed; all runs of `failed` failed."""
    rows = [
        ("e", tuner, kind, f"{kind}-{i:03d}", tuner in failed, line)
        for tuner, lines in errors.items()
        for i, line in enumerate(np.asarray(lines))
    ]
    keys = pd.DataFrame(
        [row[:4] for row in rows], columns=["experiment", "tuner", "range", "target"]
    )
    values = np.array([row[5] for row in rows], dtype=float)
    used = np.full(len(rows), values.shape[1] - 1)
    return RunCurves(keys, values, used, np.array([row[4] for row in rows]))


def constant(errors, budget=20):
    """Return curves that are 1 at the start and equal `errors` from the first simulation on."""
    return np.column_stack([np.ones(len(errors)), np.tile(np.array(errors)[:, None], budget)])


def last(curves, budget=20):
    ranking = rank_tuners(curves, budget, FLOOR)
    return ranking[ranking["simulations"] == budget].set_index("tuner")


def test_errors_below_the_floor_count_as_equal_and_share_a_rank():
    n = 10
    tiny, small, large = np.full(n, 1e-12), np.full(n, 9e-4), np.full(n, 7e-3)
    found = last(curves_of({"a": constant(large), "b": constant(small), "c": constant(tiny)}))
    assert list(found.index[-1:]) == ["a"]
    assert found["rank"].to_dict() == {"b": 1, "c": 1, "a": 3}
    assert found["verdict"].to_dict() == {"b": "best", "c": "equal", "a": "worse"}
    assert found.loc["a", "error_ratio"] == pytest.approx(7.0)
    assert found.loc["a", ["targets_worse", "targets"]].tolist() == [10, 10]
    assert found.loc["b", "median"] == pytest.approx(FLOOR)


def test_the_best_is_tested_against_each_other_tuner_and_not_all_pairs():
    rng = np.random.default_rng(0)
    n, others = 10, 9
    errors = {"best": constant(rng.uniform(0.9, 1.1, n) * 0.01)}
    for i in range(others):
        errors[f"t{i}"] = constant(rng.uniform(0.9, 1.1, n) * 0.1)
    found = last(curves_of(errors))
    assert found.loc["best", "verdict"] == "best"
    worst = found.drop(index="best")
    # Corrected for all 45 pairs, p would be 45 * 2 / 2^10 = 0.088, which is not significant.
    assert worst["p_holm"].max() == pytest.approx(others * 2 / 2**10)
    assert set(worst["verdict"]) == {"worse"}


def test_targets_that_are_needed_are_the_first_that_can_decide():
    assert compute_min_targets(1) == 6
    assert compute_min_targets(9) == 9
    for others in (1, 3, 9):
        needed = compute_min_targets(others)
        for n, verdict in ((needed, "worse"), (needed - 1, "not decided")):
            spread = np.linspace(1.0, 1.5, n)
            errors = {"best": constant(0.01 * spread)}
            errors |= {f"t{i}": constant((0.1 + 0.01 * i) * spread**2) for i in range(others)}
            assert last(curves_of(errors)).loc["t0", "verdict"] == verdict


def test_a_tuner_whose_runs_all_failed_comes_last_and_is_never_best():
    n = 8
    good, bad = constant(np.full(n, 1e-6)), constant(np.full(n, 0.5))
    curves = curves_of({"failing": good, "working": bad}, failed=("failing",))
    found = last(curves)
    assert list(found.index) == ["working", "failing"]
    assert found["verdict"].to_dict() == {"working": "best", "failing": "failed"}
    assert found.loc["failing", "failures"] == n
    assert found.loc["failing", "median"] == np.inf
    assert rank_after_budget(curves, 20, FLOOR) == ["working", "failing"]
    both = last(curves_of({"a": good, "b": bad}, failed=("a", "b")))
    assert set(both["verdict"]) == {"failed"}


def test_equal_tuners_stand_in_the_order_in_which_they_got_there():
    n, budget = 8, 20
    late, soon = np.ones((n, budget + 1)), np.ones((n, budget + 1))
    late[:, 15:], soon[:, 2:] = 1e-9, 1e-9
    curves = curves_of({"late": late, "soon": soon})
    assert rank_after_budget(curves, budget, FLOOR) == ["soon", "late"]
    ranking = rank_tuners(curves, budget, FLOOR)
    assert list_ranking_points(budget) == [1, 3, 10, 20] == sorted(set(ranking["simulations"]))
    after = ranking.set_index(["simulations", "tuner"])["verdict"]
    assert after[3, "late"] == "worse"
    assert after[20, "late"] == "equal"


def test_the_best_of_equal_tuners_is_rarely_called_worse():
    """If all are equal, a given tuner is called worse than the best in at most 5 % of cases."""
    rng = np.random.default_rng(1)
    repeats, tuners, targets = 100, 6, 12
    excluded = 0
    for _ in range(repeats):
        logs = rng.normal(size=(tuners, targets)) + rng.normal(size=targets)
        errors = {f"t{i}": constant(np.exp(log), budget=1) for i, log in enumerate(logs)}
        excluded += last(curves_of(errors), budget=1).loc["t0", "verdict"] == "worse"
    # The expected value is 5 % of 100 = 5, with a standard deviation of 2.2.
    assert excluded <= 5 + 2 * 2.2


def test_a_covered_curve_is_listed_up_to_where_it_coincides():
    points = [0, 1, 2, 3, 5]
    below = pd.Series([1, 0.1, 0.01, 0.009, 0.008], index=points)
    above = pd.Series([1, 0.1, 0.01, 1e-4, 1e-6], index=points)
    flat = pd.Series([1, 1, 1, 0.5, 0.4], index=points)
    drawn = {"tunenet": [below], "search": [flat], "hybrid": [above]}
    assert find_coinciding_curves(drawn) == {"tunenet": "same as hybrid up to 2"}
    # In the second panel, the curves differ after one simulation.
    drawn = {"tunenet": [below, below], "hybrid": [above, above * [1, 1, 2, 1, 1]]}
    assert find_coinciding_curves(drawn) == {"tunenet": "same as hybrid up to 1"}
    assert find_coinciding_curves({"tunenet": [below], "hybrid": [below]}) == {
        "tunenet": "same as hybrid"
    }
    # All curves have the same start, so a coincidence there is not reported.
    assert find_coinciding_curves({"search": [flat], "other": [flat * [1, 1, 1, 0.1, 0.1]]}) == {}
