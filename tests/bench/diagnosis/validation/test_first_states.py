"""Tests that first states of fitted runs are found again after a fit lost them."""

from pathlib import Path

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.validation.held_out_runs import find_first_states
from bench.logs.recording_loading import load_joined

EXAMPLE = Path(__file__).parents[4] / "examples" / "robot" / "log.csv"


@pytest.fixture(scope="module")
def fitter():
    recording, kind = load_joined([EXAMPLE], None, None, ())
    evaluator = RunEvaluator(kind, recording, recording.training()[:2], kind.default_engine)
    sigma = np.full(len(evaluator.channels), 1e-3)
    yield TrajectoryFitter(evaluator, NoiseModel(sigma, np.zeros(sigma.size)))
    evaluator.close()


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
