"""Tests of mean ranks, Kendall's tau and its p-value against values computed by hand."""

import numpy as np
import pytest

from bench.benchmark.statistics.tuner_ranking import (
    compute_kendall_tau,
    compute_mean_ranks,
    compute_rank_agreement,
)

EASY = np.array([[1.0, 2.0, 3.0, 4.0]]) * np.linspace(1, 2, 12)[:, None]
"""Twelve targets on which four tuners have the same order."""


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # Of the 6 pairs of (1 2 3 4), one is reversed in (1 2 4 3): (5 - 1) / 6.
        ([1, 2, 3, 4], [1, 2, 4, 3], 4 / 6),
        ([1, 2, 3, 4], [4, 3, 2, 1], -1.0),
        # The pair that is tied in the second ranking counts for neither: (5 - 0) / sqrt(6 * 5).
        ([1, 2, 3, 4], [1, 2, 3.5, 3.5], 5 / np.sqrt(30)),
    ],
)
def test_tau_is_that_of_the_pairs(first, second, expected):
    assert compute_kendall_tau(np.array(first, float), np.array(second, float)) == pytest.approx(
        expected
    )


def test_ranks_are_means_over_targets_and_a_failure_is_last():
    errors = np.array([[0.1, 0.2, np.nan], [0.3, 0.2, 0.1]])
    assert compute_mean_ranks(errors) == pytest.approx([2.0, 2.0, 2.0])
    assert compute_mean_ranks(errors[:1]) == pytest.approx([1.0, 2.0, 3.0])


def test_errors_that_differ_by_rounding_share_a_rank():
    assert compute_mean_ranks(np.array([[0.1, 0.1 * (1 + 1e-14), 0.3]])) == pytest.approx(
        [1.5, 1.5, 3.0]
    )


def test_the_same_order_agrees_and_the_exchange_finds_nothing():
    alike = compute_rank_agreement(EASY, 7 * EASY, "same")
    assert (alike.tau, alike.low, alike.high, alike.halves) == pytest.approx((1.0, 1.0, 1.0, 1.0))
    assert alike.p_value == 1.0


def test_a_reversed_order_is_significant():
    turned = compute_rank_agreement(EASY, EASY[:, ::-1], "turned")
    assert turned.tau == pytest.approx(-1.0)
    # Of 2^12 exchanges, only all and none change mean ranks as much: p is about 2 / 4096.
    assert turned.p_value < 0.005
    assert turned.halves == pytest.approx(1.0), "the first condition agrees with itself"


@pytest.mark.slow
def test_a_random_order_is_not_significant():
    rng = np.random.default_rng(3)
    p_values = [
        compute_rank_agreement(*rng.lognormal(size=(2, 8, 5)), "chance", str(i)).p_value
        for i in range(20)
    ]
    assert np.mean(np.array(p_values) < 0.05) <= 0.15, "about one in twenty"
    assert min(p_values) < 0.5 < max(p_values)
