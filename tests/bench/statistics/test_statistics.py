"""Tests of ERT, runtime distributions, paired tests, ranks and break-even against values computed
by hand or with another method.
"""

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.statistics.error_curves import RunRowTable
from bench.benchmark.statistics.expected_running_time import (
    ThresholdEffort,
    build_ert_table,
    compute_effort,
    compute_hitting_times,
    compute_solved_fraction,
)
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.statistics.training_amortisation import (
    TuningCost,
    build_break_even_table,
    compute_break_even_targets,
    compute_tuning_costs,
    find_cheapest_tuners,
)
from bench.benchmark.statistics.tuner_ranking import compute_nemenyi_p_values, compute_problem_ranks
from tests.bench.statistics.test_error_table import runs_of, statuses_of


def curves_of(errors, budget=4, failed=(), seconds=None):
    """Build curves from `errors`: {tuner: {(target, seed): errors after 0..k simulations}}."""
    runs = pd.concat(
        [runs_of(c, tuner=t, metric="param_error") for t, c in errors.items()], ignore_index=True
    )
    if seconds is not None:
        runs["tuner_seconds"] = np.where(runs["k"] == 0, np.nan, seconds)
    statuses = statuses_of(runs)
    statuses.loc[statuses["run"].isin(failed), "status"] = "crashed"
    rows = RunRowTable(runs, statuses, budget)
    return rows if seconds is not None else rows.build_curves("param_error")


def test_a_threshold_is_reached_when_the_error_stays_below_it_and_not_at_the_first_touch():
    curves = curves_of(
        {
            "a": {
                (0, 0): [1, 0.05, 0.5, 0.04, 0.03],
                (1, 0): [1, 0.05],
                (2, 0): [0.1],
                (3, 0): [1, 1, 1],
            }
        }
    )
    assert compute_hitting_times(curves, 0.1).tolist() == [3, 1, 0, np.inf]
    assert compute_hitting_times(curves, 0.01).tolist() == [np.inf] * 4
    assert compute_hitting_times(curves, 2.0).tolist() == [0] * 4


def test_ert_is_all_simulations_over_successes_and_a_failed_run_costs_its_budget():
    errors = {
        "a": {
            (0, 0): [1, 0.05],
            (1, 0): [1, 1, 0.05, 0.05, 0.05],
            (2, 0): [1, 1, 1],
            (3, 0): [0.01],
        }
    }
    curves = curves_of(errors, failed=["a/in-3/0"])
    spent = compute_effort(curves, 0.1, 4)
    assert spent.simulations.tolist() == [1, 2, 2, 4]
    assert spent.successes.tolist() == [1, 1, 0, 0], (
        "what a failed run would deliver counts for nothing"
    )
    assert spent.compute_ert() == pytest.approx(9 / 2)
    table = build_ert_table(curves, (0.1, 1e-6), 4).set_index("threshold")
    assert table.loc[0.1, ["ert", "successes", "runs", "failures"]].tolist() == [4.5, 2, 4, 1]
    assert table.loc[1e-6, "ert"] == np.inf
    assert table.loc[0.1, "low"] <= 4.5 <= table.loc[0.1, "high"]


def test_interval_of_ert_covers():
    rng = np.random.default_rng(0)
    inside = 0
    for i in range(200):
        times = rng.geometric(0.1, size=40)  # number of simulations until success; the ERT is 10
        spent = ThresholdEffort(times.astype(float), np.zeros(40), np.ones(40, dtype=int), 40)
        low, high = np.percentile(spent.compute_ert(rng.integers(40, size=(300, 40))), [2.5, 97.5])
        inside += low <= 10 <= high
        if i == 0:
            assert spent.compute_ert(np.arange(40)[None])[0] == pytest.approx(times.mean())
    assert 0.88 <= inside / 200 <= 0.99


def test_runtime_distribution_counts_pairs_of_run_and_threshold():
    curves = curves_of({"a": {(0, 0): [1, 0.5, 0.05], (1, 0): [0.3, 0.3]}})
    share = compute_solved_fraction(curves, np.array([0.6, 0.1]), np.array([0, 1, 2, 4]))
    assert share.tolist() == [0.25, 0.5, 0.75, 0.75]


def test_pairs_agree_with_scipy_and_holm_is_worked_out_by_hand():
    from scipy.stats import wilcoxon

    rng = np.random.default_rng(3)
    base = rng.exponential(size=15)
    columns = {"a": base * 0.3, "b": base * rng.uniform(0.5, 2.0, 15), "c": base}
    curves = curves_of(
        {t: {(f"{i:02d}", 0): [1.0, e] for i, e in enumerate(v)} for t, v in columns.items()}
    )
    table = compare_all_pairs(curves).set_index(["a", "b"])
    expected = {
        k: wilcoxon(np.log(columns[k[0]]) - np.log(columns[k[1]])).pvalue for k in table.index
    }
    for key, p in expected.items():
        assert table.loc[key, "p_value"] == pytest.approx(p)
    ordered = sorted(expected, key=expected.get)
    holm, worst = {}, 0.0
    for i, key in enumerate(ordered):
        worst = holm[key] = max(worst, min(1.0, (3 - i) * expected[key]))
    for key in expected:
        assert table.loc[key, "p_holm"] == pytest.approx(holm[key])
    assert table.loc[("a", "c"), ["a_better", "effect"]].tolist() == [1.0, 1.0]
    assert table.loc[("a", "c"), "error_ratio"] == pytest.approx(0.3)
    assert set(table["targets"]) == {15}


def test_failed_runs_lose_their_target_and_equal_tuners_are_equal():
    errors = {(i, 0): [1.0, 0.2] for i in range(8)}
    curves = curves_of({"a": errors, "b": errors}, failed=[f"a/in-{i}/0" for i in range(4)])
    line = compare_all_pairs(curves).iloc[0]
    assert (line["a_better"], line["effect"]) == (0.25, -1.0)
    line = compare_all_pairs(curves_of({"a": errors, "b": errors})).iloc[0]
    assert (line["a_better"], line["effect"], line["p_holm"]) == (0.5, 0.0, 1.0)


def test_false_alarms_of_paired_tests_stay_at_their_level():
    rng = np.random.default_rng(5)
    alarms = 0
    for _ in range(60):
        errors = {t: {(f"{i:02d}", 0): [1.0, rng.exponential()] for i in range(12)} for t in "abcd"}
        alarms += bool((compare_all_pairs(curves_of(errors))["p_holm"] < 0.05).any())
    assert alarms <= 8, "5 % of families; 9 of 60 would be more than three sigma"


def test_ranks_need_five_problems_and_friedman_sees_a_clear_order():
    frames = []
    for i in range(6):
        errors = {
            t: {(j, 0): [1.0, e * (1 + 0.01 * j)] for j in range(3)}
            for t, e in zip("abc", (0.1, 0.2, 0.3), strict=True)
        }
        curves = curves_of(errors)
        curves.keys["experiment"] = f"e{i}"
        frames.append(compute_problem_ranks(curves))
    ranked = pd.concat(frames)
    assert ranked.to_numpy().tolist() == [[1, 2, 3]] * 6
    p, table = compute_nemenyi_p_values(ranked)
    assert p == pytest.approx(np.exp(-6.0)), "chi squared of 12 with two degrees of freedom"
    assert table.loc["a", "c"] == pytest.approx(0.0015, abs=5e-4)
    with pytest.raises(ValueError, match="5 problems"):
        compute_nemenyi_p_values(ranked.iloc[:4])


def price(ert, fit=0.0, seconds=0.0, fit_seconds=0.0, simulation_seconds=0.0, n=10):
    spent = ThresholdEffort(
        np.full(n, float(ert)), np.full(n, float(seconds)), np.ones(n, dtype=int), n
    )
    return TuningCost(spent, fit, fit_seconds, simulation_seconds)


def test_break_even_is_training_over_what_a_target_saves():
    learned, search = price(2, fit=800), price(10)
    assert compute_break_even_targets(learned, search) == 100
    assert compute_break_even_targets(price(12, fit=800), search) == np.inf, "it never pays"
    nothing = TuningCost(
        ThresholdEffort(np.full(10, 50.0), np.zeros(10), np.zeros(10, dtype=int), 10)
    )
    assert compute_break_even_targets(learned, nothing) == 0, "the search never gets there"
    lines = build_break_even_table(
        "e", "in", 0.1, {"net": learned, "grid": search, "other": price(3, fit=10)}
    )
    assert lines[["learned", "search"]].to_numpy().tolist() == [["net", "grid"], ["other", "grid"]]
    assert lines["targets"].tolist() == [100, pytest.approx(10 / 7)]
    assert lines["low"].tolist() == lines["targets"].tolist(), "equal targets leave no doubt"


def test_who_wins_changes_where_the_costs_cross():
    quick, frugal = price(100, seconds=0.001), price(10, seconds=1.0)
    held = {
        "quick": quick,
        "frugal": frugal,
        "never": TuningCost(ThresholdEffort(np.ones(3), np.ones(3), np.zeros(3, dtype=int), 3)),
    }
    (a, b, first), (c, d, second) = find_cheapest_tuners(held, 100)
    assert (first, second) == ("quick", "frugal")
    assert b < 0.999 / 90 < c, "100 c + 0.001 = 10 c + 1"
    learned = price(10, fit=1000, fit_seconds=51.0, simulation_seconds=0.001)
    assert learned.compute_seconds_per_target(np.array([0.0, 1.0]), 100).tolist() == pytest.approx(
        [0.5, 20.5]
    )
    assert (a, d) == pytest.approx((1e-6, 1e3))


def test_tuner_seconds_are_those_up_to_the_threshold():
    rows = curves_of({"a": {(0, 0): [1, 0.5, 0.05, 0.05, 0.05], (1, 0): [1, 1, 1]}}, seconds=0.25)
    spent = rows.build_cumulative_seconds("tuner_seconds")
    assert spent[0].tolist() == [0, 0.25, 0.5, 0.75, 1.0]
    held = compute_tuning_costs(
        rows.build_curves("param_error"), 0.1, 4, spent, spent * 2, {"a": (7.0, 3.0)}
    )
    assert held["a"].effort.compute_tuner_seconds() == pytest.approx(0.5 + 0.5)
    assert held["a"].simulation_seconds == pytest.approx(0.5)
    assert (held["a"].fit_simulations, held["a"].fit_seconds) == (7.0, 3.0)


@pytest.mark.slow
def test_a_million_rows_are_read_for_the_table_within_five_seconds(tmp_path):
    import time

    from bench.benchmark.comparison_study import Comparison
    from bench.benchmark.statistics.comparison_statistics import REQUIRED_RUN_COLUMNS
    from bench.benchmark.statistics.error_curves import build_error_table
    from bench.benchmark.storage.result_folder import read_comparison
    from bench.core.plugin_registries import load_plugins
    from tests.conftest import PLUGINS
    from tests.sample_experiments import spring_experiment

    load_plugins([PLUGINS / "spring.py"])
    folder = tmp_path / "out"
    labels = list("abcdefghij")
    entries = {label: {"tuner": "random"} for label in labels}
    experiment = spring_experiment(
        targets=200, seeds=5, budget=99, ranges=["in"], tuners=entries, noise={"x": 0.1}
    )
    comparison = Comparison.begin(prepare_study(experiment, [], folder))
    comparison.results.run_sink.delete_segments()
    runs, k = 10_000, np.arange(100)
    tuners = np.repeat(labels, 1000)
    targets = np.tile([f"in-{i:03d}" for i in range(200)], 50)
    seeds = np.arange(runs) // 200 % 5
    names = np.array([f"{t}/{on}/{s}/0" for t, on, s in zip(tuners, targets, seeds, strict=True)])
    rng = np.random.default_rng(0)
    # No time is recorded before the first simulation.
    start = np.tile(np.where(k == 0, np.nan, 0.0), runs)
    numbers = {
        name: rng.exponential(size=runs * 100) + (start if after else 0.0)
        for after, group in (
            (True, ["loss", "tuner_seconds", "simulator_seconds"]),
            (True, ["proposal_rate", "proposal_decay"]),
            (False, ["recommendation_rate", "recommendation_decay", "param_error", "obs_error"]),
            (False, ["obs_error_x", "obs_error_x_in_noise"]),
        )
        for name in group
    }
    pd.DataFrame({
        "run": np.repeat(names, 100), "experiment": experiment.name,
        "tuner": np.repeat(tuners, 100), "simulator": "spring",
        "target": np.repeat(targets, 100), "seed": np.repeat(seeds, 100), "range": "in",
        "k": np.tile(k, runs), "outside": 0.0, "true_rate": 2.0, "true_decay": 0.5,
        "heldout_error": np.nan, "heldout_error_x": np.nan, **numbers,
    }).to_parquet(folder / "runs.parquet")  # fmt: skip
    pd.DataFrame({
        "run": names, "tuner": tuners, "simulator": "spring", "target": targets, "seed": seeds,
        "status": "done", "reason": "", "simulations": 99, "seconds": 1.0,
    }).to_csv(folder / "status.csv", index=False)  # fmt: skip
    pd.DataFrame({"tuner": [], "seed": [], "simulations": [], "seconds": []}).to_csv(
        folder / "training.csv", index=False
    )
    started = time.process_time()
    stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
    lines = build_error_table(stored.runs, stored.statuses, 99, stored.costs)
    assert time.process_time() - started <= 5.0
    assert len(stored.runs) == 1_000_000
    assert len(lines) == 10 * 2 * 9
    assert "proposal_rate" not in stored.runs
