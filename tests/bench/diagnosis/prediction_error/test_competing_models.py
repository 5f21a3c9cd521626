"""Which effects are tried in place of another one."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.prediction_error import competing_models, single_effect_fits
from bench.diagnosis.prediction_error.filters_with_effects import (
    FilteredSet,
    list_joint_model_effects,
)
from sims.effects.drag import LinearDrag

JOINT_LAWS = ("drag.linear", "friction.coulomb", "inertia.armature")


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        ("drag.linear@elbow", "elbow"),
        ("input.gain@m_shoulder", "shoulder"),
        # The inertia of a body and the armature of its joint may be one number.
        ("inertia.scale@forearm", "elbow"),
        ("mass.scale@upper_arm", "shoulder"),
    ],
)
def test_laws_of_the_same_joint_compete_with_an_effect(example_arm, effect, joint):
    assert list_joint_model_effects(example_arm, effect) == {f"{law}@{joint}" for law in JOINT_LAWS}


@pytest.mark.parametrize(("lowest_cost", "expected"), [(250.0, [1.25]), (450.0, [])])
def test_a_competing_effect_is_simulated_at_several_coefficients(
    monkeypatch, lowest_cost, expected
):
    """Its best coefficient is a start, unless it leaves 30 % of the squared residual."""

    def simulate(_context, starts):
        factors = [float(start.theta[0]) for start in starts]
        assert factors == [0.5, 0.8, 1.0, 1.25, 2.0]
        return [(lowest_cost, starts[3])]

    monkeypatch.setattr(competing_models, "is_explained", lambda *_: True)
    monkeypatch.setattr(competing_models, "select_lowest_of_each", simulate)
    monkeypatch.setattr(
        single_effect_fits, "compute_coefficient_bounds", lambda *_: [(-np.inf, np.inf)]
    )
    base, best = (SimpleNamespace(fit=SimpleNamespace(cost=cost)) for cost in (1000.0, 100.0))
    context = SimpleNamespace(
        search=SimpleNamespace(base_model=base),
        evaluator=SimpleNamespace(
            get_coefficient_indices=lambda _: [0],
            available_effects={"drag.linear@elbow": LinearDrag()},
        ),
    )
    competing = competing_models._CompetingEffect("drag.linear@elbow", np.ones(1), 1e6)
    start = FitStart(("drag.linear@elbow",), np.ones(1), np.zeros((1, 2)))
    confirmed = competing_models._confirm(context, best, competing, start)
    assert [start.theta[0] for start in (confirmed,) if start] == expected


def _follow(names, log_likelihood, force):
    """Return a filter of a set that lacks a force at one of two joints."""
    followed = SimpleNamespace(
        theta=np.zeros(1),
        log_likelihood=log_likelihood,
        force=np.array([force, 0.0]),
        missing_forces=np.array([force > 0.0, False]),
        has_missing_force=force > 0.0,
    )
    return FilteredSet(followed, names)


@pytest.mark.parametrize(
    ("remaining_force", "expected"), [(0.2, ["b", "a", "c"]), (0.8, ["b", "e", "a", "c", "d"])]
)
def test_effects_that_regression_missed_are_tried_unless_a_force_is_replaced(
    remaining_force, expected
):
    """The three with the largest gains by regression come first; b is the likeliest of them."""
    likelihoods = {"a": 100.0, "b": 5000.0, "c": 50.0, "d": 10.0, "e": 4000.0}
    tried = []

    def follow_with_effects(theta, names, steps=1):
        tried.append(names[-1])
        return _follow(names, likelihoods[names[-1]], remaining_force)

    starts = [SimpleNamespace(theta=np.zeros(1), effects=(name,)) for name in likelihoods]
    search_control = SimpleNamespace(
        begin_stage=lambda *_: None, advance=lambda: None, check_not_stopped=lambda: None
    )
    context = SimpleNamespace(
        evaluator=SimpleNamespace(search_control=search_control),
        proposals=SimpleNamespace(of=lambda _: starts),
        filters=SimpleNamespace(
            follow_with_effects=follow_with_effects,
            improve=lambda larger_set: larger_set,
            penalty=lambda _: 10.0,
            compute_gain=lambda followed: 2.0 * followed.log_likelihood,
        ),
        columns=SimpleNamespace(library=SimpleNamespace(probes=())),
        extended_sets={},
    )
    compared = competing_models.try_one_more_effect(context, _follow((), 0.0, 1.0))
    assert compared[0].names == ("b",)
    assert set(tried) == set(expected)
    # A filter that is hardly likelier has the same extensions; one that is much likelier has not.
    count = len(tried)
    assert competing_models.try_one_more_effect(context, _follow((), 5.0, 1.0)) is compared
    assert len(tried) == count
    competing_models.try_one_more_effect(context, _follow((), 100.0, 1.0))
    assert len(tried) > count
