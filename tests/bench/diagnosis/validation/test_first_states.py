"""Tests that first states of fitted runs are found again after a fit lost them."""

import pytest

from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.search.fit_starts import find_first_states
from tests.bench.diagnosis.explained_samples import white


@pytest.fixture(scope="module")
def fitter(example_arm):
    return TrajectoryFitter(example_arm, white(example_arm, 1e-3))


def fit(fitter, states, iterations):
    start = FitStart((), fitter.evaluator.get_nominal_theta(), states)
    return fitter.fit_models([start], iterations)[0]


def test_displaced_first_states_are_found_again(fitter):
    evaluator = fitter.evaluator
    best = fit(fitter, evaluator.initial_state_guesses, 12)
    lost = fit(fitter, best.initial_states + 0.2, 0)
    assert lost.cost > 1.5 * best.cost
    start = find_first_states(evaluator, fitter.noise, lost)
    again = fit(fitter, start.initial_states, 0)
    assert again.cost == pytest.approx(best.cost, rel=0.01)


def test_the_best_first_states_stay(fitter):
    best = fit(fitter, fitter.evaluator.initial_state_guesses, 12)
    assert find_first_states(fitter.evaluator, fitter.noise, best) is None
