"""Which elastic and slack transmissions are simulated, and when they are fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.prediction_error import elasticity_and_backlash_fits as series_fits
from bench.diagnosis.prediction_error.elasticity_and_backlash_fits import (
    SMALLER_SERIES_SHARES,
    add_series_effect,
    fit_series_effects,
    simulate_series_effects,
)
from bench.diagnosis.prediction_error.simulated_fits import RatedStart, compute_likely_cost
from bench.diagnosis.search.candidate_directions import list_probes

BASE_COST = 1000.0


@pytest.fixture
def simulated(example_arm, monkeypatch):
    """Return the coefficients of all simulated starts by effect.

    The wrong selection has moved the largest missing force from the first to the second joint.
    """
    monkeypatch.setattr(series_fits, "select_lowest_of_each", lambda _, starts: starts)
    context = SimpleNamespace(
        evaluator=example_arm,
        filters=SimpleNamespace(
            base=SimpleNamespace(joints_by_loss=[0, 1]), reference=example_arm.get_nominal_theta()
        ),
        columns=SimpleNamespace(probes=lambda names: list_probes(example_arm, (), names)),
    )
    selected = SimpleNamespace(followed=SimpleNamespace(joints_by_loss=[1, 0]))
    coefficients = {}
    for start in simulate_series_effects(context, selected):
        (name,) = start.effects
        slots = example_arm.coefficient_slices[name]
        coefficients.setdefault(name, []).append(start.theta[slots])
    return coefficients


def test_joints_are_those_without_and_with_the_selected_effects(simulated):
    assert set(simulated) == {
        f"joint.{law}@{joint}"
        for law in ("flexibility", "backlash")
        for joint in ("shoulder", "elbow")
    }


def test_smaller_gaps_than_those_of_the_probes_are_simulated(example_arm, simulated):
    name = "joint.backlash@elbow"
    probed = [probe.coefficients[0] for probe in list_probes(example_arm, (), [name])]
    gaps = sorted(float(coefficients[0]) for coefficients in simulated[name])
    assert gaps[:2] == pytest.approx([share * min(probed) for share in SMALLER_SERIES_SHARES])
    np.testing.assert_allclose(gaps[2:], sorted(probed))


def test_a_likely_effect_leaves_noise_and_a_share_of_the_discrepancy():
    def compute(base_cost, samples):
        recorded = np.ones((1, samples, 1), dtype=bool)
        runs = SimpleNamespace(recorded=recorded)
        context = SimpleNamespace(
            filters=SimpleNamespace(base=SimpleNamespace(runs=runs)),
            search=SimpleNamespace(base_model=SimpleNamespace(fit=SimpleNamespace(cost=base_cost))),
        )
        return compute_likely_cost(context)

    assert compute(3000.0, 1000) == pytest.approx(1600.0)
    assert compute(900.0, 1000) == 1000.0


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        (0.3 * BASE_COST, ["joint.backlash@elbow"]),
        (np.inf, ["joint.backlash@elbow", "joint.backlash@shoulder"]),
    ],
)
def test_early_only_effects_that_remove_most_of_the_residual_are_fitted(
    monkeypatch, limit, expected
):
    """Effects that were fitted before are left out."""
    costs = {
        "joint.backlash@elbow": 0.2, "joint.backlash@shoulder": 0.4, "joint.flexibility@elbow": 0.1
    }  # fmt: skip
    starts = [
        RatedStart(share * BASE_COST, FitStart((name,), np.zeros(1), np.zeros((1, 2))))
        for name, share in costs.items()
    ]
    fitted = []

    def fit_all(started):
        fitted.extend(name for start in started for name in start.effects)
        return [SimpleNamespace(fit=SimpleNamespace(make_start=lambda: None))]

    monkeypatch.setattr(series_fits, "select_likeliest", lambda *models: models[0])
    monkeypatch.setattr(series_fits, "fit_by_simulation", lambda *_: None)
    search = SimpleNamespace(
        base_model=SimpleNamespace(fit=SimpleNamespace(cost=BASE_COST)),
        models={frozenset(["joint.flexibility@elbow"]): None},
        fit_all=fit_all,
    )
    fit_series_effects(SimpleNamespace(search=search), starts, limit)
    assert fitted == expected


@pytest.mark.parametrize("has_series", [False, True])
def test_a_transmission_is_added_at_the_joint_where_the_best_model_lacks_a_force(
    example_arm, monkeypatch, has_series
):
    """As for an elastic elbow with ripple at the shoulder, which is found first."""
    monkeypatch.setattr(series_fits, "select_lowest_of_each", lambda _, starts: starts)
    monkeypatch.setattr(series_fits, "remove_idle_effects", lambda _, model: model)
    monkeypatch.setattr(series_fits, "select_likeliest", lambda *models: models[-1])
    theta = example_arm.get_nominal_theta()
    theta[example_arm.coefficient_slices["friction.coulomb@shoulder"]] = 0.3
    first = "joint.backlash@elbow" if has_series else "friction.coulomb@shoulder"
    start = FitStart((first,), theta, example_arm.initial_state_guesses)
    best = SimpleNamespace(
        effects=(first,), fit=SimpleNamespace(cost=BASE_COST, make_start=lambda: start)
    )
    added = []

    def fit_added(_, simulated, limit):
        added.extend(simulated)
        assert limit == BASE_COST
        return SimpleNamespace(effects=("added",))

    monkeypatch.setattr(series_fits, "fit_series_effects", fit_added)
    context = SimpleNamespace(
        evaluator=example_arm,
        filters=SimpleNamespace(get_filter=lambda _: SimpleNamespace(joints_by_loss=[1, 0])),
        columns=SimpleNamespace(probes=lambda names: list_probes(example_arm, (), names)),
    )
    chosen = add_series_effect(context, best)
    if has_series:
        assert (chosen, added) == (best, [])
        return
    assert chosen.effects == ("added",)
    laws = {f"joint.{law}@elbow" for law in ("flexibility", "backlash")}
    assert {tuple(start.effects) for start in added} == {(first, law) for law in laws}
    for one in added:
        assert one.theta[example_arm.coefficient_slices[first]] == 0.3
        assert one.theta[example_arm.coefficient_slices[one.effects[1]]][0] > 0.0
