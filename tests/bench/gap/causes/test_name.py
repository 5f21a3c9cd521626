"""The share of the gap that a model closes on the fitted runs."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.gap.causes.name import closed

SIGMA = 0.1


def share(before, after, structure=True, own=np.nan):
    """Of a base model that leaves `before` and a model that leaves `after` everywhere, with a
    noise of 0.1; half of the samples are missing, where anything may stand.
    """
    seen = np.arange(10).reshape(1, 10, 1) % 2 == 0

    def residual(left):
        return np.where(seen, left, 77.0)

    search = SimpleNamespace(
        base=SimpleNamespace(fit=before), noise=SimpleNamespace(sigma=np.array([SIGMA])),
        residual=residual, seen=seen,
    )  # fmt: skip
    model = SimpleNamespace(fit=after, likelihood=SimpleNamespace(sigma=np.array([own])))
    return closed(search, model, SimpleNamespace(structure=structure))


def test_the_gap_is_what_lies_above_the_noise():
    assert share(0.5, 0.2) == pytest.approx((5 - 2) / (5 - 1))
    assert share(0.5, 0.5) == pytest.approx(0.0)
    assert share(0.5, 0.7) == pytest.approx((5 - 7) / (5 - 1)), "worse than nothing"


def test_nobody_closes_more_than_the_gap_and_of_none_nothing():
    assert share(0.5, 0.05) == pytest.approx(1.0)
    assert share(0.1, 0.05) == share(0.09, 0.09) == 0.0


def test_what_is_left_without_structure_is_noise_and_may_be_more_than_was_estimated():
    assert share(0.5, 0.2, structure=False, own=0.2) == pytest.approx(1.0)
    assert share(0.5, 0.2, structure=True, own=0.2) == pytest.approx(0.75)
    assert share(0.5, 0.2, structure=False, own=0.01) == pytest.approx(0.75), "no less than stated"
