"""Tests of paired comparisons: pairing by target, the deciding metric, and failures."""

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.statistics.error_curves import build_error_table, select_primary_metric
from bench.benchmark.statistics.expected_running_time import compute_effort
from bench.benchmark.statistics.paired_tests import compare_all_pairs, correct_holm
from tests.bench.statistics.test_error_table import at, runs_of, statuses_of
from tests.bench.statistics.test_statistics import curves_of


def test_a_target_that_one_of_two_has_not_met_does_not_count_for_the_pair():
    errors = {(i, 0): [1.0, 0.2] for i in range(8)}
    fewer = {(i, 0): [1.0, 0.1 if i < 2 else 0.4] for i in range(6)}
    line = compare_all_pairs(curves_of({"a": errors, "b": fewer})).iloc[0]
    assert line["targets"] == 6
    assert line["a_better"] == pytest.approx(4 / 6)
    assert line["error_ratio"] == pytest.approx(0.5)


def test_a_target_counts_with_the_mean_of_its_seeds():
    errors = {(i, s): [1.0, (0.2, 0.4)[s]] for i in range(8) for s in range(2)}
    once = {(i, 0): [1.0, 0.25] for i in range(8)}
    line = compare_all_pairs(curves_of({"a": errors, "b": once})).iloc[0]
    assert (line["targets"], line["a_better"], line["effect"]) == (8, 0.0, -1.0)
    assert line["error_ratio"] == pytest.approx(0.3 / 0.25)


def test_targets_are_those_of_their_names_in_whichever_order_their_runs_ended():
    errors = {(i, 0): [1.0] * (i + 1) + [0.01] for i in range(4)}
    backwards = dict(reversed(errors.items()))
    curves = curves_of({"a": errors, "b": backwards}, budget=5)
    spent = [
        compute_effort(curves.select(tuner=tuner), 0.1, 5).simulations.tolist() for tuner in "ab"
    ]
    assert spent == [[1, 2, 3, 4]] * 2
    line = compare_all_pairs(curves).iloc[0]
    assert (line["a_better"], line["effect"], line["p_value"]) == (0.5, 0.0, 1.0)


def test_true_parameters_decide_then_held_out_runs_then_fitted_runs():
    runs = pd.DataFrame({"param_error": [0.1, 0.2], "heldout_error": 0.3, "obs_error": 0.4})
    for metric, in_widths in (
        ("param_error", True),
        ("heldout_error", False),
        ("obs_error", False),
    ):
        found = select_primary_metric(runs)
        assert (found.metric, found.in_widths) == (metric, in_widths)
        runs[metric] = np.nan


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_the_correction_for_several_tests_is_that_of_statsmodels(count):
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    p = np.random.default_rng(count).uniform(size=count) ** 4
    p[count // 2 :] = p[: (count + 1) // 2]  # equal p-values
    expected = multitest.multipletests(p, method="holm")[1] if count else []
    np.testing.assert_array_equal(correct_holm(p), expected)


@pytest.mark.parametrize(
    ("status", "failed"),
    [("crashed", 1), ("timeout", 1), ("diverged", 1), ("done", 0), ("converged", 0)],
)
def test_a_run_that_crashed_timed_out_or_diverged_has_failed(status, failed):
    """A failed run is counted and stays in the mean, but its final value is infinite."""
    runs = runs_of({(0, 0): [0.8, 0.4], (1, 0): [0.4, 0.2]}, metric="param_error")
    statuses = statuses_of(runs, **{"a_in-0_0": status})
    line = at(build_error_table(runs, statuses, 1), 1, "param_error")
    assert (line["runs"], line["failures"]) == (2, failed)
    assert line["mean"] == pytest.approx(0.3)
    from bench.benchmark.statistics.error_curves import RunRowTable

    final = (
        RunRowTable(runs, statuses, 1).build_curves("param_error").compute_final_values().tolist()
    )
    assert final == [np.inf if failed else 0.4, 0.2]
