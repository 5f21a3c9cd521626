from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from tests.bench.diagnosis.explained_samples import changed, evaluator, recording


def floor_of(simulated):
    return compute_noise_floor(evaluator(simulated, candidates=[]), simulated)


def test_stated_noise_is_believed_and_the_rest_estimated():
    made = recording(runs=3, seconds=2, rate=100, noise=["q=0.004", "qd=0.03"], seed=2)
    found = floor_of(replace(made, noise={"q": 0.01}))
    np.testing.assert_array_equal(found.is_stated, [True, False])
    assert found.sigma[0] == 0.01
    assert found.sigma[1] == pytest.approx(0.03, rel=0.12)
    assert found.uncertainty[0] == 0
    assert found.uncertainty[1] == pytest.approx(1.2 / np.sqrt(600))
    assert not found.quantisation_step.any()


def test_held_out_runs_tell_of_the_sensor_too():
    made = recording(runs=2, seconds=1, rate=100, noise=["q=0.004", "qd=0.03"], seed=4)
    few = replace(made, noise={})
    noise = np.random.default_rng(0).normal(size=100)
    louder = changed(made.runs[1], qd=lambda v: v + 0.3 * noise)
    assert floor_of(few).sigma[1] == pytest.approx(0.03, rel=0.2)
    assert floor_of(replace(few, runs=(made.runs[0], louder))).sigma[1] > 0.06


def test_rounding_is_noise():
    made = recording(runs=2, seconds=2, rate=100)
    rounded = [changed(run, q=lambda v: np.round(v / 0.05) * 0.05) for run in made.runs]
    found = floor_of(replace(made, runs=tuple(rounded)))
    assert found.quantisation_step[0] == pytest.approx(0.05)
    # The rounding error has a uniform distribution over one quantisation step.
    assert found.sigma[0] == pytest.approx(0.05 / 12**0.5, rel=0.4)
    assert found.quantisation_step[1] == 0


def test_without_noise_the_floor_is_a_share_of_the_range():
    made = recording(runs=2, seconds=2, rate=200, initial=["q=1.5"])
    found = floor_of(made)
    values = np.concatenate([run.channels["q"] for run in made.runs])
    # The range excludes the outermost 2 % of the samples on each side.
    spread = np.ptp(np.quantile(values, [0.02, 0.98]))
    assert 0.99e-4 * spread <= found.sigma[0] < 1e-3 * spread
    stated = floor_of(replace(made, noise={"q": 1e-9}))
    assert stated.sigma[0] == pytest.approx(1e-4 * spread), "no integrator is as exact as that"


def test_a_channel_without_samples_still_has_a_floor():
    made = recording(runs=2, seconds=1, rate=50, noise=["0.01"])
    empty = [changed(run, qd=lambda v: np.full_like(v, np.nan)) for run in made.runs]
    found = floor_of(replace(made, runs=tuple(empty), noise={}))
    assert found.sigma[1] == pytest.approx(1e-3 * 10.0), (
        "a thousandth of the channel's typical size"
    )
    assert found.sigma[0] == pytest.approx(0.01, rel=0.3)
