from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from tests.bench.diagnosis.search.search_models import held_out, model, search_of

BASE, A, B, BOTH = model(), model("a"), model("b"), model("a", "b")


def test_excess_is_the_residual_above_the_noise():
    trial = HeldOutValidation(*held_out({(): 3.0}))
    assert trial.compute_excess_residual(()) == pytest.approx(2.0)
    assert trial.compute_excess_residual((), np.array([1.5])) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("left", "stands"),
    [
        ({(): 5.0, ("a",): 3.0, ("b",): 3.0, ("a", "b"): 1.0}, ("a", "b")),
        ({(): 5.0, ("a",): 1.0, ("b",): 3.0, ("a", "b"): 1.1}, ("a",)),
        # Far above the noise, a gain below a tenth does not count, so neither effect helps.
        ({(): 5.0, ("a",): 4.9, ("b",): 4.8, ("a", "b"): 4.7}, ()),
        # A model without held-out results is not considered.
        ({(): 5.0, ("b",): 3.0, ("a", "b"): 1.0}, ("a", "b")),
    ],
)
def test_effects_that_do_not_help_go(left, stands):
    trial = HeldOutValidation(*held_out(left))
    assert trial.drop_unhelpful_effects(search_of(BASE, A, B, BOTH), BOTH).effects == stands


@pytest.mark.parametrize(
    ("fitted", "left", "stays"),
    [
        # No held-out run comes near the limit, so the fitted runs decide.
        ({(): 3.2, ("a",): 0.0}, {(): 1.02, ("a",): 1.03}, True),
        # The held-out runs contradict the effect.
        ({(): 3.2, ("a",): 0.0}, {(): 1.02, ("a",): 1.12}, False),
        # The fitted runs do not decide clearly.
        ({(): 3.2, ("a",): 2.0}, {(): 1.02, ("a",): 1.03}, False),
        ({(): 0.3, ("a",): 0.0}, {(): 1.02, ("a",): 1.03}, False),
        # The held-out residual is large and unexplained.
        ({(): 3.2, ("a",): 0.0}, {(): 2.02, ("a",): 2.03}, False),
    ],
)
def test_what_held_out_runs_hardly_show_is_decided_by_the_fitted_ones(fitted, left, stays):
    trial = HeldOutValidation(*held_out(left))
    search = search_of(BASE, A, excess=fitted)
    assert trial.drop_unhelpful_effects(search, A).effects == (("a",) if stays else ())


@pytest.mark.parametrize(("structure", "missed"), [(True, True), (False, False)])
def test_the_residual_is_noise_where_it_has_no_structure(structure, missed):
    trial = HeldOutValidation(*held_out({(): 9.0, ("a",): 2.0}))
    loud = model("a")
    loud.likelihood.sigma[:] = 2.0
    assert trial.has_unexplained_gap(loud, SimpleNamespace(has_structure=structure)) is missed


A_B, A_C, A_B_C, B_C = model("a", "b"), model("a", "c"), model("a", "b", "c"), model("b", "c")


@pytest.mark.parametrize(
    ("fitted", "unseen", "stands"),
    [
        # Two further effects leave six tenths of both residuals; one of them alone gains nothing.
        ({"a": 9.0, "ab": 8.9, "abc": 5.4}, {"a": 9.0, "ab": 8.9, "abc": 5.4}, "abc"),
        # Only the residual of the fitted runs decreases.
        ({"a": 9.0, "ab": 8.9, "abc": 5.4}, {"a": 9.0, "ab": 8.9, "abc": 8.0}, "a"),
        # Only the residual of the held-out runs decreases.
        ({"a": 9.0, "ab": 8.9, "abc": 8.0}, {"a": 9.0, "ab": 8.9, "abc": 5.4}, "a"),
        # The gain is enough for one effect but not for two.
        ({"a": 9.0, "ab": 8.9, "abc": 7.0}, {"a": 9.0, "ab": 8.9, "abc": 7.0}, "a"),
        ({"a": 9.0, "ab": 7.0, "abc": 6.9}, {"a": 9.0, "ab": 7.0, "abc": 6.9}, "ab"),
        # One of the two effects does not help on held-out runs, so it is removed.
        ({"a": 9.0, "ab": 5.6, "abc": 5.0}, {"a": 9.0, "ab": 5.1, "abc": 5.05}, "ab"),
        # The effects already found are not exchanged for others.
        ({"a": 9.0, "bc": 1.0}, {"a": 9.0, "bc": 1.0}, "a"),
    ],
)
def test_a_larger_model_is_taken_that_held_out_runs_confirm(fitted, unseen, stands):
    """The parameters give the excess by effects; for all other models it is large."""
    models = [BASE, A, B, model("c"), A_B, A_C, B_C, A_B_C]
    left = {m.effects: fitted.get("".join(m.effects), 20.0) for m in models}
    there = {m.effects: 1.0 + unseen.get("".join(m.effects), 20.0) for m in models}
    trial = _Measured(*held_out(there))
    assert (
        "".join(trial.find_better_extension(search_of(*models, excess=left), A).effects) == stands
    )


class _Measured(HeldOutValidation):
    """Validation in which all models have been evaluated."""

    def evaluate_models(self, models):
        assert {m.effects for m in models} <= self.held_out_fits.keys()
