"""Tests of the gap closed on the fitted runs, and of the search for a larger model."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.search.diagnose import Diagnosis, compute_gap_closed
from tests.bench.diagnosis.search.search_models import model

SIGMA = 0.1


def share(before, after, structure=True, own=np.nan):
    """Return the gap closed for residuals `before` (base model) and `after` at a noise of 0.1.

    Half of the samples are missing and hold an arbitrary value.
    """
    seen = np.arange(10).reshape(1, 10, 1) % 2 == 0

    def residual(left):
        return np.where(seen, left, 77.0)

    search = SimpleNamespace(
        base_model=SimpleNamespace(fit=before), noise=SimpleNamespace(sigma=np.array([SIGMA])),
        compute_residual=residual, observed_mask=seen,
    )  # fmt: skip
    model = SimpleNamespace(fit=after, likelihood=SimpleNamespace(sigma=np.array([own])))
    return compute_gap_closed(search, model, SimpleNamespace(has_structure=structure))


def test_the_gap_is_what_lies_above_the_noise():
    assert share(0.5, 0.2) == pytest.approx((5 - 2) / (5 - 1))
    assert share(0.5, 0.5) == pytest.approx(0.0)
    assert share(0.5, 0.7) == pytest.approx((5 - 7) / (5 - 1)), "worse than nothing"


def test_nobody_closes_more_than_the_gap_and_of_none_nothing():
    assert share(0.5, 0.05) == pytest.approx(1.0)
    assert share(0.1, 0.05) == share(0.09, 0.09) == 0.0


def test_a_residual_without_structure_is_noise_and_may_exceed_the_estimate():
    assert share(0.5, 0.2, structure=False, own=0.2) == pytest.approx(1.0)
    assert share(0.5, 0.2, structure=True, own=0.2) == pytest.approx(0.75)
    assert share(0.5, 0.2, structure=False, own=0.01) == pytest.approx(0.75), "no less than stated"


BASE, FOUND, FULLER, PLAINER = model(), model("a"), model("a", "b", "c"), model("a", "d")


@pytest.mark.parametrize(
    ("found", "fuller", "structure", "held_out", "stands"),
    [
        (FOUND, FULLER, True, True, PLAINER),
        (FOUND, FOUND, True, True, FOUND),
        # Without lack of fit, no larger model is sought.
        (FOUND, FULLER, False, True, FOUND),
        # Without held-out runs, no larger model is accepted.
        (FOUND, FULLER, True, False, FOUND),
        # A base model without causes is not extended.
        (BASE, FULLER, True, True, BASE),
    ],
)
def test_a_fuller_account_is_asked_for_where_causes_stand_and_something_is_left(
    found, fuller, structure, held_out, stands
):
    """The larger model is fitted to convergence and its laws are simplified."""
    measured = []
    watch = SimpleNamespace(search_control=None)
    search = SimpleNamespace(
        evaluator=watch,
        fit_to_convergence=lambda m: m,
        simplify_laws=lambda m: PLAINER if m is FULLER else m,
    )
    diagnosis = Diagnosis(search, None)
    diagnosis._model = found
    if held_out:
        diagnosis._held_out_validation = SimpleNamespace(
            find_better_extension=lambda search, model: fuller, evaluate_models=measured.extend
        )
    taken = diagnosis._accept_larger_model(SimpleNamespace(has_structure=structure))
    assert diagnosis._model is stands
    assert taken is (stands is PLAINER)
    assert measured == ([PLAINER] if taken else [])
