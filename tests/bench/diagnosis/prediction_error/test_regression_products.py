"""Tests of the inner products of a regression against whole matrices."""

import numpy as np
import pytest

from bench.diagnosis.prediction_error.regression_products import (
    MAX_SMALL_GROUP,
    SAMPLES_PER_BLOCK,
    GramMatrices,
    ResponseProducts,
)

RUNS, SAMPLES, COLUMNS = 3, 2 * SAMPLES_PER_BLOCK + 37, 8


@pytest.fixture
def design():
    """Return responses (R, N, K) in single precision, and innovations (R, N)."""
    rng = np.random.default_rng(3)
    responses = rng.normal(size=(RUNS, SAMPLES, COLUMNS)) * 10.0 ** rng.integers(-1, 2, COLUMNS)
    return responses.astype(np.float32), rng.normal(size=(RUNS, SAMPLES))


def compute_matrices(responses, innovations):
    """Return all products in double precision, computed without blocks."""
    rows = responses.astype(float)
    return GramMatrices(
        np.einsum("rnk,rnl->rkl", rows, rows),
        np.einsum("rnk,rn->rk", rows, innovations),
        np.square(innovations).sum(axis=1),
    )


def assert_equal_products(products, expected):
    """Assert that two objects have the same products, to the accuracy of double precision."""
    columns, groups = np.array([6, 0, 3, 6]), np.array([[0, 1, 5], [2, 2, 7]])
    # Larger groups take another path.
    large_groups = np.array([[7, 0, 1, 5, 3, 2], [2, 2, 7, 4, 6, 0]])
    assert large_groups.shape[1] > MAX_SMALL_GROUP >= groups.shape[1]
    for get in (
        lambda p: p.squares,
        lambda p: p.crosses,
        lambda p: p.totals,
        lambda p: p.select(columns),
        lambda p: p.select_rows(columns),
        lambda p: p.select_rows(np.array([], dtype=np.intp)),
        lambda p: p.sum_within(groups),
        lambda p: p.sum_within(groups[:, :1]),
        lambda p: p.sum_within(large_groups),
    ):
        found, right = get(products), get(expected)
        assert found.shape == right.shape
        np.testing.assert_allclose(
            found, right, rtol=1e-9, atol=1e-12 * np.abs(right).max(initial=1)
        )


def test_products_of_blocks_are_those_of_all_samples(design):
    products = ResponseProducts(list(design[0]), list(design[1]))
    assert_equal_products(products, compute_matrices(*design))
    # Known rows are reused for other columns.
    products.select_rows(np.array([3, 1]))
    assert_equal_products(products, compute_matrices(*design))


def test_a_column_is_added_to_the_innovations(design):
    responses, innovations = design
    changed = compute_matrices(responses, innovations + responses[:, :, 4])
    for products in (
        ResponseProducts(list(responses), list(innovations)),
        compute_matrices(responses, innovations),
    ):
        assert_equal_products(products.add_to_innovations(4), changed)
        # The first products stay as they were.
        assert_equal_products(products, compute_matrices(responses, innovations))
