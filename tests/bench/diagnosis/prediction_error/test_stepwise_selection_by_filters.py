"""Tests of sets of effects that grow one by one while filters with them lack a force."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.prediction_error import stepwise_selection_by_filters as forward_selection
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet


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
    compared = forward_selection.try_one_more_effect(context, _follow((), 0.0, 1.0))
    assert compared[0].names == ("b",)
    assert set(tried) == set(expected)
    # A filter that is hardly likelier has the same extensions; one that is much likelier has not.
    count = len(tried)
    assert forward_selection.try_one_more_effect(context, _follow((), 5.0, 1.0)) is compared
    assert len(tried) == count
    forward_selection.try_one_more_effect(context, _follow((), 100.0, 1.0))
    assert len(tried) > count


@pytest.mark.parametrize(
    ("remaining_forces", "expected_size"),
    [
        # The second effect replaces the force at one of two joints, the third at the other.
        ([[1.0, 0.05], [0.02, 0.05], [0.01, 0.05]], 4),
        # The second effect replaces nothing, but the third one does.
        ([[0.9, 0.8], [0.9, 0.1], [0.1, 0.1]], 4),
        # The second and the third effect replace nothing, so no fourth one is added.
        ([[0.9, 0.8], [0.8, 0.7], [0.1, 0.1]], 3),
    ],
)
def test_a_set_grows_while_effects_replace_missing_forces(
    monkeypatch, remaining_forces, expected_size
):
    missing = np.ones(2, dtype=bool)
    forces = [np.ones(2), *(np.array(force) for force in remaining_forces)]
    sets = [
        FilteredSet(SimpleNamespace(force=force, missing_forces=missing), tuple("abcd"[: i + 1]))
        for i, force in enumerate(forces)
    ]
    monkeypatch.setattr(
        forward_selection,
        "_list_larger_that_pay",
        lambda _, current: [sets[len(current.names)]],
    )
    monkeypatch.setattr(forward_selection, "make_filtered_start", lambda *_: None)
    monkeypatch.setattr(forward_selection, "select_lowest_of_each", lambda *_: [])
    assert len(forward_selection._grow_set(None, sets[0]).names) == expected_size


@pytest.mark.parametrize(("remaining_force", "is_grown"), [(0.5, True), (0.8, False)])
def test_nothing_is_added_to_an_effect_that_replaces_no_missing_force(
    monkeypatch, remaining_force, is_grown
):
    """The library then lacks the cause, and each further effect takes several filters."""
    base = SimpleNamespace(effects=(), fit=SimpleNamespace(cost=2.0))
    model = SimpleNamespace(effects=("a",), fit=SimpleNamespace(cost=1.0))
    largest, grown = _follow(("a",), 50.0, remaining_force), []
    context = SimpleNamespace(
        evaluator=SimpleNamespace(search_control=SimpleNamespace(is_over=lambda: False)),
        search=SimpleNamespace(base_model=base),
        filters=SimpleNamespace(
            empty_set=_follow((), 0.0, 1.0), act_where_forces_are_missing=lambda _: True
        ),
    )
    for name, value in {
        "_list_larger_that_pay": lambda *_: [largest],
        "_select_nearly_as_likely": lambda *_: [largest],
        "_fit_all_servos": lambda *_: base,
        "_grow_set": lambda _, current: grown.append(current) or current,
        "select_likeliest": lambda *models: models[-1],
        "fit_filtered": lambda *_: model,
        "is_explained": lambda *_: False,
        "check_filter": lambda *_: None,
        "check_fit": lambda *_: None,
        "remove_idle_effects": lambda _, best: best,
    }.items():
        monkeypatch.setattr(forward_selection, name, value)
    forward_selection.select_in_model(context)
    assert grown == ([largest] if is_grown else [])
