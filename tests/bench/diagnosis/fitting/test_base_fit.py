import numpy as np
import pytest

from bench.benchmark.runner.standalone_tuning import spread_start_points
from bench.diagnosis.fitting.base_fit import fit_base_model
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import evaluator, recorded, recording, white, with_runs

TIMES = np.arange(90) / 60
"""Sample times of 1.5 s at 60 Hz."""


def ball():
    return Ball(observe=["x", "z"])


@pytest.mark.parametrize("inertia", [1.0e-3, 1.7e-3, 3.0e-3, 5.0e-3, 7.5e-3, 1.0e-2])
def test_any_inertia_in_the_bounds_is_found(inertia):
    # With a wrong inertia, the end of a wide swing cannot be predicted.
    starts = [{"q": 0.9}, {"q": -2.0, "qd": 4.0}]
    sigma = [0.003, 0.02]
    made = recorded(Pendulum(), [inertia], starts, TIMES, sigma, seed=1)
    there = evaluator(made, candidates=[])
    base = fit_base_model(there, white(there, sigma))
    assert base.fit.theta[0] == pytest.approx(inertia, rel=3e-3)
    samples = np.isfinite(there.observed).sum()
    assert base.fit.cost / samples == pytest.approx(1.0, abs=0.2)
    assert not base.insensitive_parameters


def test_a_fit_ends_where_the_beginning_of_the_runs_exceeds_its_maximum_cost():
    sigma = [0.003, 0.02]
    made = recorded(Pendulum(), [3.0e-3], [{"q": 0.9}], TIMES, sigma, seed=1)
    there = evaluator(made, candidates=[])
    beginning = int(there.get_sample_mask(0.2).sum())
    whole = int(np.isfinite(there.observed).sum())
    noise = white(there, sigma)
    ended = fit_base_model(there, noise, max_cost=0.5 * beginning)
    assert ended.fit.cost / beginning == pytest.approx(1.0, abs=0.3)
    assert not np.isfinite(ended.fit.simulated[np.isfinite(there.observed)]).all()
    complete = fit_base_model(there, noise, max_cost=2.0 * whole)
    assert complete.fit.cost == fit_base_model(there, noise).fit.cost


@pytest.mark.parametrize("restitution", [0.35, 0.93])
def test_restitution_is_found_through_many_bounces(restitution):
    starts = [{"z": 2.5, "vx": 0.5}, {"z": 1.5, "vz": 1.0}]
    times = np.arange(150) / 60
    made = recorded(ball(), [restitution], starts, times, 0.005)
    there = evaluator(made, candidates=[])
    base = fit_base_model(there, white(there, 0.005))
    assert base.fit.theta[0] == pytest.approx(restitution, abs=2e-3)
    assert base.fit.cost / np.isfinite(there.observed).sum() == pytest.approx(1.0, abs=0.2)


def test_restitution_that_a_fall_does_not_touch_is_reported_and_stays_nominal():
    # A fall of one second from these heights is 5 m, so the ball does not reach the ground.
    starts = [{"z": 20.0, "vx": 1.0}, {"z": 25.0}]
    times = np.arange(60) / 60
    made = recorded(ball(), [0.9], starts, times, 0.005)
    there = evaluator(made, candidates=[])
    base = fit_base_model(there, white(there, 0.005))
    assert base.insensitive_parameters == frozenset({0})
    assert base.fit.theta[0] == there.get_nominal_theta()[0] == 0.5
    assert base.fit.free_indices.size == 0
    assert base.fit.cost / np.isfinite(there.observed).sum() == pytest.approx(1.0, abs=0.2)

    # One run with an impact is enough.
    hit = recorded(ball(), [0.9], [{"z": 1.0}], TIMES, 0.005)
    again = evaluator(with_runs(made, [*made.runs, *hit.runs]), candidates=[])
    touched = fit_base_model(again, white(again, 0.005))
    assert not touched.insensitive_parameters
    assert touched.fit.theta[0] == pytest.approx(0.9, abs=5e-3)


def test_a_given_start_is_where_it_begins():
    made = recording(theta=["6e-3"], runs=2, seconds=1, rate=60, noise=["q=0.003", "qd=0.02"])
    there = evaluator(made, candidates=[])
    noise = white(there, [0.003, 0.02])
    many = fit_base_model(there, noise)
    # Number of simulations of the fit with many starts.
    before = there.simulation_count
    one = fit_base_model(there, noise, np.array([5.9e-3]))
    assert one.fit.theta[0] == pytest.approx(many.fit.theta[0], rel=1e-4)
    assert there.simulation_count - before < 0.6 * before, "a single start costs less"


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_starts_are_spread_evenly(dim):
    points = spread_start_points(64, dim)
    assert points.shape == (64, dim)
    assert ((points >= 0) & (points < 1)).all()
    for column in points.T:
        assert np.diff(np.sort(column)).max() < 5 / 64, "no large gap along any axis"
    np.testing.assert_allclose(points.mean(axis=0), 0.5, atol=0.02)
