"""Tests of 95 % intervals over targets: widths agree with a normal distribution or with SciPy."""

import numpy as np
import pytest
from scipy.stats import bootstrap

from bench.benchmark.statistics.bootstrap import (
    compute_bootstrap_interval,
    compute_percentile_interval,
    compute_resampled_means,
    compute_resampled_medians,
)
from bench.benchmark.statistics.error_curves import build_error_table
from bench.benchmark.statistics.expected_running_time import build_ert_table
from bench.core.random_streams import make_rng
from tests.bench.statistics.test_error_table import at, runs_of, statuses_of
from tests.bench.statistics.test_statistics import curves_of


def test_the_tables_interval_is_as_wide_as_95_percent_of_a_normal_distribution():
    values = np.random.default_rng(4).normal(3.0, 2.0, size=(500, 6))
    low, high = compute_bootstrap_interval(values, compute_resampled_means, "width", resamples=4000)
    ratio = (high - low) / (2 * 1.96 * values.std(axis=0, ddof=1) / np.sqrt(500))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.03)
    assert (np.abs(ratio - 1.0) < 0.1).all()


@pytest.mark.parametrize("targets", [2, 7, 60, 301])
@pytest.mark.parametrize(
    ("own", "plain"), [(compute_resampled_means, np.mean), (compute_resampled_medians, np.median)]
)
def test_intervals_are_those_of_scipy_from_the_same_draws(targets, own, plain):
    values = np.exp(3 * np.random.default_rng(targets).normal(size=(targets, 3)))
    # One column has equal values, as for errors that end at rounding.
    values[: targets // 2 + 1, 0] = 1e-9
    stream = make_rng("bootstrap", "a", "b")
    expected = bootstrap(
        (values,), plain, n_resamples=200, method="percentile", vectorized=True, rng=stream
    ).confidence_interval
    found = compute_bootstrap_interval(values, own, "a", "b", resamples=200)
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_seeds_of_one_target_are_no_further_evidence():
    errors = dict(enumerate(np.random.default_rng(5).exponential(size=9)))
    lines = []
    for seeds in (1, 6):
        runs = runs_of({(t, s): [1.0, e] for t, e in errors.items() for s in range(seeds)})
        lines.append(at(build_error_table(runs, statuses_of(runs), 1), 1))
    assert (lines[0]["low"], lines[0]["high"]) == (lines[1]["low"], lines[1]["high"])
    assert lines[0]["low"] < lines[0]["mean"] < lines[0]["high"]
    assert lines[0]["mean"] == pytest.approx(np.mean(list(errors.values())))


def geometric(tuners, targets=120):
    """Build equal curves for all tuners with geometric times until the threshold is reached."""
    times = np.random.default_rng(6).geometric(0.1, size=targets).clip(max=60)
    errors = {(f"{i:03d}", 0): [1.0] * t + [0.01] for i, t in enumerate(times)}
    return times, curves_of(dict.fromkeys(tuners, errors), budget=60)


def test_the_interval_of_an_ert_is_as_wide_as_that_of_a_mean():
    times, curves = geometric("a")
    line = build_ert_table(curves, (0.1,), 60).iloc[0]
    half = 1.96 * times.std(ddof=1) / np.sqrt(len(times))
    assert line["ert"] == pytest.approx(times.mean())
    assert line["high"] - line["low"] == pytest.approx(2 * half, rel=0.1)
    assert line["low"] == pytest.approx(times.mean() - half, abs=0.2 * half)


def test_tuners_that_share_targets_share_the_draws():
    _, curves = geometric("ab")
    first, second = build_ert_table(curves, (0.1,), 60).to_dict("records")
    assert (first["low"], first["high"]) == (second["low"], second["high"])


def test_the_percentiles_are_order_statistics_also_where_some_are_infinite():
    values = np.random.default_rng(7).permutation(1000).astype(float)
    assert compute_percentile_interval(values) == (24.0, 975.0)
    values[values > 900] = np.inf
    assert compute_percentile_interval(values) == (24.0, np.inf)
