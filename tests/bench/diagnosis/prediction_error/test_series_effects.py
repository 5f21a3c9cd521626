"""Which elastic and slack transmissions are tried, and when they are fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.prediction_error import single_effect_fits
from bench.diagnosis.prediction_error.regression_columns import list_probes
from bench.diagnosis.prediction_error.single_effect_fits import (
    SMALLER_SERIES_SHARES,
    fit_series_effects,
)

BASE_COST = 1000.0


def try_series_effects(evaluator, monkeypatch, costs, models=(), is_only_likely=False):
    """Return the simulated starts by effect, and the names of the fitted effects.

    The wrong selection has moved the largest missing force from the first to the second joint.
    """
    tried, fitted = {}, []

    def make_theta_with(name, coefficients):
        theta = evaluator.get_nominal_theta()
        theta[evaluator.coefficient_slices[name]] = coefficients
        return theta

    def select_lowest_of_each(_context, starts):
        for start in starts:
            (name,) = start.effects
            tried.setdefault(name, []).append(start.theta[evaluator.coefficient_slices[name]])
        return [
            (costs.get(name, 2.0 * BASE_COST), SimpleNamespace(effects=(name,))) for name in tried
        ]

    def fit_all(starts):
        fitted.extend(name for start in starts for name in start.effects)
        return [SimpleNamespace(fit=SimpleNamespace(make_start=lambda: None))]

    monkeypatch.setattr(single_effect_fits, "select_lowest_of_each", select_lowest_of_each)
    monkeypatch.setattr(single_effect_fits, "select_likeliest", lambda *models: models[0])
    monkeypatch.setattr(single_effect_fits, "fit_by_simulation", lambda *_: None)
    context = SimpleNamespace(
        evaluator=evaluator,
        search=SimpleNamespace(
            base_model=SimpleNamespace(fit=SimpleNamespace(cost=BASE_COST)),
            models={frozenset([name]): None for name in models},
            fit_all=fit_all,
        ),
        filters=SimpleNamespace(
            base=SimpleNamespace(joints_by_loss=[0, 1]), make_theta_with=make_theta_with
        ),
        columns=SimpleNamespace(probes=lambda names: list_probes(evaluator, (), names)),
    )
    selected = SimpleNamespace(followed=SimpleNamespace(joints_by_loss=[1, 0]))
    fit_series_effects(context, selected, is_only_likely)
    return tried, fitted


def test_joints_are_those_without_and_with_the_selected_effects(example_arm, monkeypatch):
    tried, fitted = try_series_effects(example_arm, monkeypatch, {})
    names = {
        f"joint.{law}@{joint}"
        for law in ("flexibility", "backlash")
        for joint in ("shoulder", "elbow")
    }
    assert set(tried) == set(fitted) == names


def test_smaller_gaps_than_those_of_the_probes_are_tried(example_arm, monkeypatch):
    tried, _ = try_series_effects(example_arm, monkeypatch, {})
    (name,) = (name for name in tried if name == "joint.backlash@elbow")
    probed = [probe.coefficients[0] for probe in list_probes(example_arm, (), [name])]
    gaps = sorted(float(coefficients[0]) for coefficients in tried[name])
    assert gaps[:2] == pytest.approx([share * min(probed) for share in SMALLER_SERIES_SHARES])
    np.testing.assert_allclose(gaps[2:], sorted(probed))


@pytest.mark.parametrize(
    ("is_only_likely", "expected"),
    [
        (True, ["joint.backlash@elbow"]),
        (False, ["joint.backlash@elbow", "joint.backlash@shoulder"]),
    ],
)
def test_early_only_effects_that_remove_most_of_the_residual_are_fitted(
    example_arm, monkeypatch, is_only_likely, expected
):
    costs = {"joint.backlash@elbow": 0.2 * BASE_COST, "joint.backlash@shoulder": 0.4 * BASE_COST}
    known = ("joint.flexibility@elbow", "joint.flexibility@shoulder")
    tried, fitted = try_series_effects(example_arm, monkeypatch, costs, known, is_only_likely)
    assert set(tried) == set(costs), "effects that were fitted before are left out"
    assert sorted(fitted) == expected
