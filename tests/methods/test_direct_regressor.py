import numpy as np
import pytest

from methods.tuners.direct_regressor import DirectRegressor
from tests.methods.test_tunenet import Toy, check_state, run


@pytest.fixture(scope="module")
def fitted():
    tuner = DirectRegressor(scenarios=60, points=60, epochs=150)
    tuner.fit(Toy(), np.random.default_rng(0), 10_000)
    return tuner


def test_estimates_from_the_target_alone_and_simulates_once(fitted):
    off = []
    for seed in range(20):
        trace, truth = run(fitted, Toy(), seed)
        assert trace.status == "converged"
        assert len(trace.proposals) == 1
        assert np.array_equal(trace.recommendations[0], trace.recommendations[1])
        assert np.array_equal(trace.recommendations[0], trace.proposals[0])
        off.append(abs(trace.recommendations[0, 0] - truth[0]))
    assert np.mean(off) < 0.01


def test_the_start_does_not_matter(fitted):
    observed = Toy().observe(np.array([[0.4]]), [1.5])[0]
    tasks = [Toy().task(observed, start=np.full(1, start)) for start in (0.0, 1.0)]
    asked = [next(fitted.tune(task, np.random.default_rng(0))).points for task in tasks]
    assert np.array_equal(*asked)
    assert asked[0] == pytest.approx(0.4, abs=0.02)


def test_state_round_trip(fitted):
    faulty = {"limit": np.zeros(1)}
    check_state(fitted, fitted.state(), DirectRegressor(points=60), faulty, toy=Toy())
    with pytest.raises(RuntimeError, match="not been trained"):
        next(DirectRegressor().tune(None, np.random.default_rng(0)))


def test_published_trains_on_targets_alone():
    toy = Toy()
    tuner = DirectRegressor(published=True, points=60)
    tuner.fit(toy, np.random.default_rng(0), 100)
    assert toy.calls == [1] * 100
    assert tuner.state()["clean.joined.weight"].shape == (64, 32)
    assert run(tuner, toy, 0)[0].status == "converged"


@pytest.mark.slow
def test_two_parameters():
    toy = Toy(2, runs=2)
    tuner = DirectRegressor(scenarios=80, points=60, epochs=100)
    tuner.fit(toy, np.random.default_rng(0), 10_000)
    off = [
        np.abs(trace.recommendations[0] - truth).max()
        for trace, truth in (run(tuner, toy, s) for s in range(10))
    ]
    assert np.mean(off) < 0.05
