"""Tests of the training simulator: simulations are counted, and points are limited to the range."""

import numpy as np
import pytest

from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from bench.benchmark.problem.tuning_problem import TuningProblem
from methods.tuner import BudgetExceededError
from tests.sample_experiments import spring_experiment

LOW, HIGH = np.array([0.25, 0.2]), np.array([0.75, 0.6])
"""Training range of the spring in the unit cube: 2..4 of 1..5 rad/s and 0.2..0.6 of 0..1 1/s."""


@pytest.fixture
def simulator(spring):
    return CountedTrainingSimulator(TuningProblem(spring_experiment()), 10)


def test_every_simulation_counts_and_none_beyond_the_budget_is_made(simulator):
    rng = np.random.default_rng(0)
    for points, used in ((4, 4), (1, 5), (3, 8)):
        assert simulator.simulate(rng, simulator.sample(rng, points)).shape == (points, 60, 1)
        assert simulator.used == used
    with pytest.raises(BudgetExceededError, match="11 training simulations requested, 10 allowed"):
        simulator.simulate(rng, simulator.sample(rng, 3))
    assert simulator.used == 8, "refused whole"
    simulator.simulate(rng, simulator.sample(rng, 2))
    assert simulator.used == 10
    with pytest.raises(BudgetExceededError, match="11 training simulations requested"):
        simulator.simulate(rng, simulator.sample(rng, 1))


def test_parameters_are_drawn_evenly_from_the_training_range(simulator):
    drawn = simulator.sample(np.random.default_rng(1), 4000)
    np.testing.assert_allclose(simulator.training, [LOW, HIGH], atol=1e-12)
    np.testing.assert_allclose(drawn.min(axis=0), LOW, atol=0.01)
    np.testing.assert_allclose(drawn.max(axis=0), HIGH, atol=0.01)
    np.testing.assert_allclose(drawn.mean(axis=0), [0.5, 0.4], atol=0.01)


@pytest.mark.parametrize(
    "point", [LOW - np.array([0, 1e-6]), HIGH + np.array([1e-6, 0]), [0.0, 0.4], [0.5, 1.0]]
)
def test_no_point_outside_the_training_range_is_simulated(simulator, point):
    points = np.array([[0.5, 0.4], point])
    with pytest.raises(ValueError, match="only simulate inside the training range"):
        simulator.simulate(np.random.default_rng(0), points)
    assert simulator.used == 0
    simulator.simulate(np.random.default_rng(0), np.array([LOW, HIGH]))  # corners are inside
