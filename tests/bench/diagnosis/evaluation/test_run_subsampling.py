"""Tests of run thinning: kept samples, resampled inputs, and runs that stay unchanged."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.search import subsampled_search
from bench.diagnosis.search.subsampled_search import thin_runs
from sims.systems.slider import Slider
from tests.bench.diagnosis.explained_samples import changed, evaluator, recorded, with_runs

TIMES = np.arange(0, 2.0, 0.001)
PUSHED = np.sin(40.0 * TIMES)


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """Lower the sample limits so that short runs are thinned."""
    monkeypatch.setattr(subsampled_search, "MIN_SAMPLES_TO_THIN", 3000)
    monkeypatch.setattr(subsampled_search, "MIN_THINNED_SAMPLES", 100)


@pytest.fixture(scope="module")
def log():
    slider = Slider(observe=["x"], engine="batch")
    return recorded(slider, [1.0], [({"v": 1.0}, {"u": PUSHED})] * 2, TIMES, noise=0.001)


def test_of_samples_closer_than_steps_every_so_manyth_is_kept(log):
    there = evaluator(log)
    few = thin_runs(there)
    assert few.lengths.tolist() == [200, 200]
    np.testing.assert_array_equal(few.observed, there.observed[:, ::10])
    np.testing.assert_array_equal(few.prepared_runs[0].scenario.times, TIMES[::10])
    assert [p.name for p in few.parameters] == [p.name for p in there.parameters]
    assert (few.longest_duration, few.search_control) == (
        there.longest_duration,
        there.search_control,
    )


def test_an_input_gives_the_same_momentum(log):
    few = thin_runs(evaluator(log)).prepared_runs[0].scenario
    before = np.concatenate([[0.0], np.cumsum(PUSHED[:-1] * np.diff(TIMES))])[::10]
    after = np.concatenate([[0.0], np.cumsum(few.inputs["u"][:-1] * np.diff(few.times))])
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_the_same_parameters_give_nearly_the_same_motion(log):
    there = evaluator(log)
    few = thin_runs(there)
    theta, runs = np.array([there.get_nominal_theta()]), np.zeros(1, dtype=int)
    whole = there.simulate(theta, runs, there.initial_state_guesses[:1])
    seldom = few.simulate(theta, runs, there.initial_state_guesses[:1])
    assert np.abs(seldom - whole[:, ::10]).max() < 1e-4 * np.ptp(whole)


def test_few_samples_or_far_apart_or_seldom_recorded_are_left_alone(log, monkeypatch):
    one = with_runs(log, log.runs[:1])
    assert thin_runs(evaluator(one)) is None, "few"
    slow = [replace(run, times=20.0 * run.times) for run in log.runs]
    assert thin_runs(evaluator(with_runs(log, slow))) is None, "far apart"

    def seldom(values):
        values[np.arange(values.size) % 10 != 5] = np.nan
        return values

    holes = [changed(run, x=seldom) for run in log.runs]
    assert thin_runs(evaluator(with_runs(log, holes))) is None, (
        "of the samples kept none is recorded"
    )
    monkeypatch.setattr(subsampled_search, "MIN_THINNED_SAMPLES", 1000)
    assert thin_runs(evaluator(log)).lengths.tolist() == [500, 500], "as many as must be left"
