"""Tests of tuners that need an optional extra; without it they are reported as skipped."""

import importlib.util

import numpy as np
import pytest

from bench.core.plugin_registries import tuners
from methods.learning.quasi_random_points import draw_sobol_points
from methods.tuners.neural_posterior_estimation import NeuralPosteriorEstimation
from methods.tuners.turbo import TuRBO
from tests.methods.analytic_problems import START, TRUE_PARAMETERS, decays, errors
from tests.methods.test_tunenet import Toy, check_state, run

needs_sbi = pytest.mark.skipif(
    importlib.util.find_spec("sbi") is None, reason="sbi is not installed: extra npe"
)
needs_botorch = pytest.mark.skipif(
    importlib.util.find_spec("botorch") is None, reason="botorch is not installed: extra turbo"
)


@pytest.mark.parametrize(("name", "package"), [("npe", "sbi"), ("turbo", "botorch")])
def test_listed_as_skipped_without_its_extra(name, package, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n, *rest: None if n == package else found(n, *rest)
    )
    assert (
        tuners.describe(name) == f"skipped: needs {package}, not installed (pip install {package})"
    )


def test_candidates_fill_the_trust_region_and_stay_in_the_cube():
    sides = np.array([0.2, 0.4])
    points = TuRBO()._draw_candidates(np.array([0.05, 0.5]), sides, np.random.default_rng(0))
    assert points.shape == (1000, 2)
    assert np.allclose(points.min(axis=0), [0.0, 0.3], atol=1e-2)
    assert np.allclose(points.max(axis=0), [0.15, 0.7], atol=1e-2)
    centre = np.full(100, 0.5)
    points = TuRBO()._draw_candidates(centre, np.full(100, 0.2), np.random.default_rng(0))
    moved = (points != centre).sum(axis=1)
    assert moved.min() >= 1
    assert moved.mean() == pytest.approx(20.0, abs=1.0)
    assert draw_sobol_points(np.random.default_rng(0), 64, 3).mean() == pytest.approx(0.5, abs=0.02)


@needs_botorch
def test_turbo_closes_in():
    error = errors(TuRBO(), decays, TRUE_PARAMETERS[:2], START[:2], 40)
    assert error[4] > 0.03
    assert error[40] < 0.02


@pytest.fixture(scope="module")
def npe():
    tuner = NeuralPosteriorEstimation(scenarios=100, points=60)
    tuner.fit(Toy(), np.random.default_rng(0), 400)
    return tuner


@needs_sbi
def test_the_posterior_is_centred_and_calibrated(npe):
    off, inside = [], 0
    for seed in range(10):
        trace, truth = run(npe, Toy(), seed, budget=60)
        draws = trace.proposals[1:, 0]
        off.append(abs(trace.recommendations[0, 0] - truth[0]))
        low, high = np.quantile(draws, [0.025, 0.975])
        inside += low <= truth[0] <= high
    assert np.mean(off) < 0.03
    assert inside >= 7


@needs_sbi
def test_state_is_plain_and_checked(npe):
    state = npe.state()
    name = next(n for n in state if n.endswith("final_layer.weight"))
    check_state(
        npe,
        state,
        NeuralPosteriorEstimation(scenarios=100, points=60),
        {n: a for n, a in state.items() if n != name},
        {**state, name: state[name][:-1]},
        {**state, name: np.full_like(state[name], np.nan)},
        {**state, "extra": np.zeros(2)},
        {**state, "inputs.gain": state["inputs.gain"][:-1]},
        toy=Toy(),
    )


@needs_sbi
def test_the_budget_is_kept_to():
    toy = Toy(budget=80)
    NeuralPosteriorEstimation(points=60, epochs=2).fit(toy, np.random.default_rng(0), 80)
    assert toy.used == 80
