from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.pipeline.held_out_gap_closed import compute_held_out_gain


def errors(rmse, runs=6, samples=200, seed=0):
    """Return residuals (R, T, 1) with this total RMS; each run has another RMS."""
    made = (
        np.random.default_rng(seed).normal(size=(runs, samples, 1))
        * np.linspace(0.9, 1.1, runs)[:, None, None]
    )
    return made * rmse / np.sqrt(np.square(made).mean())


def runs_of(observed):
    return SimpleNamespace(
        observed=observed,
        prepared_runs=[None] * len(observed),
        lengths=np.full(len(observed), observed.shape[1]),
    )


def test_the_share_of_the_gap_closed_is_that_of_the_design():
    there = runs_of(np.zeros((6, 200, 1)))
    found = compute_held_out_gain(
        there, errors(0.37), errors(0.045, seed=1), [0], 0.01, np.random.default_rng(0)
    )
    assert (found.base, found.extended, found.floor) == (
        pytest.approx(0.37),
        pytest.approx(0.045),
        0.01,
    )
    assert found.gap_closed == pytest.approx((0.37 - 0.045) / (0.37 - 0.01), rel=1e-12)
    assert round(found.gap_closed, 2) == 0.90
    assert 0.85 < found.low < found.gap_closed < found.high < 0.95


@pytest.mark.parametrize("runs", [1, 2, 5])
def test_the_interval_contains_the_point(runs):
    there = runs_of(np.zeros((runs, 400, 2)))
    for seed in range(8):
        before, after = (
            np.concatenate([errors(size, runs, 400, seed), 9 * errors(1, runs, 400)], 2)
            for size in (0.3, 0.1)
        )
        after = after * np.random.default_rng(seed).uniform(0.6, 1.5, size=(runs, 400, 1))
        found = compute_held_out_gain(there, before, after, [0], 0.02, np.random.default_rng(seed))
        assert found.low <= found.gap_closed <= found.high
        assert found.high - found.low < 0.35
        again = compute_held_out_gain(there, before, after, [0], 0.02, np.random.default_rng(seed))
        assert (again.low, again.high) == (found.low, found.high)


def test_a_gain_below_the_floor_counts_as_all_and_no_gap_as_nothing():
    there = runs_of(np.zeros((3, 100, 1)))
    rng = np.random.default_rng(0)
    assert (
        compute_held_out_gain(
            there, errors(0.3, 3, 100), errors(0.009, 3, 100), [0], 0.01, rng
        ).gap_closed
        == 1.0
    )
    assert (
        compute_held_out_gain(
            there, errors(0.01, 3, 100), errors(0.009, 3, 100), [0], 0.01, rng
        ).gap_closed
        == 0.0
    )
    worse = compute_held_out_gain(there, errors(0.02, 3, 100), errors(0.04, 3, 100), [0], 0.01, rng)
    assert worse.gap_closed == pytest.approx(-2.0)


def three_runs(sizes=(0.1, 0.15, 0.2)):
    """Return a model with these residuals per run; the base model has 0.3 in each."""
    after = np.ones((3, 100, 1)) * np.reshape(sizes, (3, 1, 1))
    return runs_of(np.zeros((3, 100, 1))), np.full((3, 100, 1), 0.3), after


def test_the_gains_interval_is_one_of_95_percent_with_runs_put_back():
    """Of three runs, a resample contains only the worst one with p = 1/27, above 2.5 %."""
    found = compute_held_out_gain(*three_runs(), [0], 0.05, np.random.default_rng(0))
    assert (found.low, found.high) == (
        pytest.approx((0.3 - 0.2) / 0.25),
        pytest.approx((0.3 - 0.1) / 0.25),
    )
    single = runs_of(np.full((1, 100, 1), np.nan))
    single.observed[0, :10] = 0.0  # one block of ten has samples
    found = compute_held_out_gain(
        single, *np.ones((2, 1, 100, 1)) * [[[[0.3]]], [[[0.1]]]], [0], 0.05,
        np.random.default_rng(0),
    )  # fmt: skip
    assert found.gap_closed == pytest.approx(0.8)
    assert np.isnan([found.low, found.high]).all(), "there is nothing to resample"


def test_missing_samples_do_not_count():
    observed = np.zeros((2, 100, 1))
    observed[0, :50] = np.nan
    before = np.full((2, 100, 1), 0.2)
    before[0, :50] = 77.0
    found = compute_held_out_gain(
        runs_of(observed), before, np.full((2, 100, 1), 0.1), [0], 0.02, np.random.default_rng(0)
    )
    assert found.base == pytest.approx(0.2)
    assert found.gap_closed == pytest.approx(0.1 / 0.18)
