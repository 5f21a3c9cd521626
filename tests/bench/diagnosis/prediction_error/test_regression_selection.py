"""Tests of the selection of regressors against least squares."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from bench.diagnosis.prediction_error.regression_products import ResponseProducts
from bench.diagnosis.prediction_error.regression_selection import (
    Regression,
    score_by_regression,
)
from bench.diagnosis.search.score_test import DirectionGroup

RUNS, SAMPLES, COLUMNS = 4, 80, 6


def regression_of(rows, target, groups, **more):
    """Return the regression of a target (R, n) on rows (R, n, K)."""
    return Regression(groups, ResponseProducts(list(rows), list(target)), target.size, **more)


@pytest.fixture
def rows():
    return np.random.default_rng(5).normal(size=(RUNS, SAMPLES, COLUMNS))


def singles(positive=False):
    return [DirectionGroup(f"effect{k}", (k,), (positive,)) for k in range(COLUMNS)]


def noise(seed=1):
    return np.random.default_rng(seed).normal(size=(RUNS, SAMPLES))


def test_a_set_is_fitted_by_least_squares(rows):
    target = rows @ np.arange(COLUMNS) + noise()
    groups = singles()
    rss, parts = regression_of(rows, target, groups).solve(groups)
    flat = rows.reshape(-1, COLUMNS)
    expected, residual, *_ = np.linalg.lstsq(flat, target.ravel(), rcond=None)
    np.testing.assert_allclose(np.concatenate(parts), expected, rtol=1e-7, atol=1e-7)
    assert rss == pytest.approx(residual[0], rel=1e-8)


def test_coefficients_that_must_not_be_negative_are_held_at_zero(rows):
    target = rows @ np.array([2.0, -1.0, 0.5, -0.2, 0.0, 0.1]) + noise()
    groups = singles(positive=True)
    rss, parts = regression_of(rows, target, groups).solve(groups)
    flat = rows.reshape(-1, COLUMNS)
    expected = lsq_linear(flat, target.ravel(), bounds=(0.0, np.inf))
    np.testing.assert_allclose(np.concatenate(parts), expected.x, atol=1e-6)
    assert rss == pytest.approx(2.0 * expected.cost, rel=1e-8)


def test_gains_in_addition_to_a_set_are_those_of_fits(rows):
    target = rows @ np.array([1.0, 0.5, 0.0, 0.3, 0.0, 0.0]) + noise()
    groups = singles()
    regression = regression_of(rows, target, groups)
    chosen = [groups[0], groups[1]]
    before, _ = regression.solve(chosen)
    gains = regression.gains(chosen)
    for k in (2, 3, 4, 5):
        after, _ = regression.solve([*chosen, groups[k]])
        assert gains[k] == pytest.approx(regression.compute_log_ratio(before, after), abs=1e-6)
    assert gains[0] == 0.0


def test_what_acts_is_selected_and_nothing_else(rows):
    target = rows @ np.array([0.0, 0.6, 0.0, 0.0, -0.4, 0.0]) + noise()
    found = regression_of(rows, target, singles()).select(6)
    assert sorted(group.effect for group in found) == ["effect1", "effect4"]


def test_noise_selects_nothing_in_most_draws(rows):
    """Under the null hypothesis, less than one of 30 draws exceeds the penalty k log N + 2 log
    M."""
    alarms = sum(bool(regression_of(rows, noise(s), singles()).select(6)) for s in range(60))
    assert alarms <= 2


def test_what_acts_in_one_run_alone_is_not_selected(rows):
    rows[:3, :, 2] = 0.0
    # Columns that do not overlap: the effect of one run changes no other coefficient.
    rows[3, :, 1] = 0.0
    target = rows @ np.array([0.0, 0.6, 3.0, 0.0, 0.0, 0.0]) + noise()
    groups = singles()
    regression = regression_of(rows, target, groups)
    assert regression.gains([])[2] > 100.0
    before = regression._compute_left_out_rss([groups[1]])
    after = regression._compute_left_out_rss([groups[1], groups[2]])
    np.testing.assert_allclose(after, before, rtol=1e-12)
    assert not regression.generalises([groups[1]], [groups[1], groups[2]])


def test_what_helps_one_run_alone_is_not_selected(rows):
    target = noise()
    target[0] += 3.0 * rows[0, :, 2]
    target[1:] -= 0.2 * rows[1:, :, 2]
    regression = regression_of(rows, target, singles())
    assert regression.gains([])[2] > regression.price(singles()[2])
    assert not regression.generalises([], [singles()[2]])


def test_an_effect_generalises_although_one_run_alone_determines_a_coefficient(rows):
    """In the other runs, a small imitation makes that coefficient ten times too large."""
    rows[:3, :, 1] *= 0.01
    target = rows[:, :, 0] + 0.5 * rows[:, :, 1] + 0.1 * noise()
    target[:3] += 5.0 * rows[:3, :, 1]
    effect = DirectionGroup("effect", (0, 1), (False, False))
    regression = regression_of(rows, target, [effect])
    others = regression._compute_left_out_rss([effect])
    assert others[3] > 5.0 * regression._compute_left_out_rss([])[3]
    assert regression.generalises([], [effect])


def test_an_effect_of_the_model_is_put_back(rows):
    """Without the model's own effect, the regression is that about the base model."""
    whole = rows[:, :, 0]
    target = 0.7 * whole + noise()
    about = regression_of(rows, target - whole, singles()[1:], always=(5, 0))
    rest = about.make_regression_without([0])
    direct = regression_of(rows, target, singles()[1:], always=(5,))
    assert rest.solve([])[0] == pytest.approx(direct.solve([])[0], rel=1e-10)
    np.testing.assert_allclose(rest.gains([]), direct.gains([]), atol=1e-7)


def test_scores_name_what_acts_and_without_effects_nothing_is_significant(rows):
    target = rows @ np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]) + noise()
    regression = regression_of(rows, target, singles())
    names = {group.effect for group in regression.groups}
    scores = score_by_regression(regression, names, np.random.default_rng(2))
    assert scores.effects[0] == "effect2"
    assert scores.p_value < 1e-10
    # The others are noise.
    others = score_by_regression(regression, names - {"effect2"}, np.random.default_rng(2))
    assert others.p_value > 1e-4
    nothing = score_by_regression(regression, {"unknown"}, np.random.default_rng(2))
    assert nothing.effects == ()
    assert nothing.p_value == 1.0
