import numpy as np
import pandas as pd
import pytest

from bench.benchmark.statistics.bootstrap import compute_bootstrap_interval, compute_resampled_means
from bench.benchmark.statistics.error_curves import (
    ERROR_TABLE_COLUMNS,
    build_error_table,
    build_summary,
    select_checkpoints,
)


def runs_of(curves, tuner="a", kind="in", metric="param_abs_error"):
    """Build run rows from `curves`: {(target, seed): errors after 0..k simulations}."""
    frames = [
        pd.DataFrame({
            "run": f"{tuner}/{kind}-{target}/{seed}", "experiment": "e", "tuner": tuner,
            "target": f"{kind}-{target}",
            "seed": seed, "range": kind, "k": range(len(errors)), metric: errors,
        })
        for (target, seed), errors in curves.items()
    ]  # fmt: skip
    return pd.concat(frames, ignore_index=True)


def statuses_of(runs, **ends):
    names = runs["run"].unique()
    tuners = [n.split("/")[0] for n in names]
    return pd.DataFrame(
        {
            "run": names,
            "tuner": tuners,
            "status": [ends.get(n.replace("/", "_"), "done") for n in names],
        }
    )


def at(lines, k, metric="param_abs_error"):
    return lines[(lines["simulations"] == k) & (lines["metric"] == metric)].iloc[0]


def test_checkpoints_stop_at_the_budget_and_include_it():
    assert select_checkpoints(100) == [0, 1, 2, 3, 5, 10, 20, 50, 100]
    assert select_checkpoints(7) == [0, 1, 2, 3, 5, 7]
    assert select_checkpoints(1) == [0, 1]


def test_mean_and_median_are_over_targets_after_the_mean_over_seeds():
    runs = runs_of(
        {
            (0, 0): [1.0, 0.1],
            (0, 1): [1.0, 0.3],
            (1, 0): [2.0, 0.5],
            (1, 1): [2.0, 0.7],
            (2, 0): [6.0, 3.0],
        }
    )
    line = at(build_error_table(runs, statuses_of(runs), 1), 1)
    assert line["mean"] == pytest.approx((0.2 + 0.6 + 3.0) / 3)
    assert line["median"] == pytest.approx(0.6)
    assert (line["runs"], line["failures"]) == (5, 0)


def test_early_end_counts_with_its_last_recommendation_and_never_with_a_running_minimum():
    runs = runs_of({(0, 0): [1.0, 0.2, 0.6], (1, 0): [1.0, 0.4, 0.1, 0.05, 0.5, 0.02]})
    lines = build_error_table(runs, statuses_of(runs), 5)
    assert at(lines, 2)["mean"] == pytest.approx((0.6 + 0.1) / 2)
    assert at(lines, 5)["mean"] == pytest.approx((0.6 + 0.02) / 2)


def test_failures_stay_in_the_table():
    runs = runs_of({(0, 0): [0.8], (1, 0): [0.4, 0.2]})
    lines = build_error_table(runs, statuses_of(runs, **{"a_in-0_0": "crashed"}), 1)
    assert (at(lines, 1)["runs"], at(lines, 1)["failures"]) == (2, 1)
    assert at(lines, 1)["mean"] == pytest.approx(0.5)


def test_skipped_tuner_has_a_line():
    runs = runs_of({(0, 0): [0.8, 0.1], (1, 0): [0.4, 0.2]})
    statuses = statuses_of(runs)
    statuses.loc[len(statuses)] = ["sbi", "sbi", "skipped"]
    line = build_error_table(runs, statuses, 1).set_index("tuner").loc["sbi"]
    assert (line["runs"], line["failures"]) == (0, 1)


def test_columns_are_those_of_the_file_format():
    runs = runs_of({(0, 0): [0.8, 0.1], (1, 0): [0.4, 0.2]})
    lines = build_error_table(runs, statuses_of(runs), 1, {"a": (1600.0, 12.5)})
    assert list(lines.columns) == ERROR_TABLE_COLUMNS
    assert (at(lines, 1)["fit_simulations"], at(lines, 1)["fit_seconds"]) == (1600.0, 12.5)
    assert set(lines["metric"]) == {"param_abs_error"}, (
        "no true parameters, no parameter error; no held-out runs, none shown"
    )


def test_bootstrap_interval_matches_the_normal_one_and_covers():
    rng = np.random.default_rng(1)
    values = rng.normal(3.0, 2.0, size=(400, 1))
    low, high = compute_bootstrap_interval(values, compute_resampled_means, "x")
    half = 1.96 * values.std(ddof=1) / np.sqrt(400)
    assert low[0] == pytest.approx(values.mean() - half, abs=0.04)
    assert high[0] == pytest.approx(values.mean() + half, abs=0.04)
    inside = 0
    for i in range(200):
        sample = rng.exponential(1.0, size=(40, 1))
        low, high = compute_bootstrap_interval(
            sample, compute_resampled_means, "c", str(i), resamples=400
        )
        inside += int(low[0] <= 1.0 <= high[0])
    assert 0.86 <= inside / 200 <= 0.98


def test_interval_of_one_target_is_unknown_and_of_equal_ones_is_a_point():
    low, high = compute_bootstrap_interval(np.ones((1, 2)), compute_resampled_means, "x")
    assert np.isnan(low).all()
    assert np.isnan(high).all()
    low, high = compute_bootstrap_interval(np.full((5, 1), 0.25), compute_resampled_means, "x")
    assert (low[0], high[0]) == (0.25, 0.25)


def test_bootstrap_repeats():
    values = np.random.default_rng(0).exponential(size=(30, 3))
    np.testing.assert_array_equal(
        compute_bootstrap_interval(values, compute_resampled_means, "a"),
        compute_bootstrap_interval(values, compute_resampled_means, "a"),
    )


def test_a_summary_has_medians_in_the_order_that_is_asked_for():
    runs = pd.concat([runs_of({(0, 0): [1, 0.5]}), runs_of({(0, 0): [1, 0.1]}, tuner="b")])
    lines = build_error_table(runs, statuses_of(runs), 1)
    medians = build_summary(lines, "param_abs_error", "in", ["b", "skipped", "a"])
    assert list(medians.index) == ["b", "a"]
    assert medians.loc["a", 1] == 0.5
