"""Tests of result rows: parameter errors in training widths, and the distance outside the range."""

import numpy as np
import pytest

from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment
from bench.core.plugin_registries import tuners
from methods.tuner import Proposal, Tuner
from tests.sample_experiments import spring_experiment

pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")

DELIVERED = [(3.0, 0.3), (4.6, 0.9), (1.4, 0.1)]
"""Recommendations in rad/s and 1/s after 0, 1 and 2 simulations, which are made at other points."""


class Wandering(Tuner):
    name = source_digest = "wandering"

    def tune(self, task, rng):
        for rate, decay in DELIVERED:
            yield Proposal(rng.uniform(size=2), recommend=np.array([(rate - 1.0) / 4.0, decay]))


def test_errors_are_means_over_parameters_in_widths_of_their_training_ranges():
    tuners.register(Wandering)
    results = prepare_experiment(
        spring_experiment(tuners=["wandering"], seeds=1, budget=2, trusted=True)
    )
    run_experiment(results, jobs=0)
    outside = []
    for place, job in enumerate(results.plan):
        columns, (rate, decay) = results.run_sink.columns[place], job.target.truth
        expected = [(abs(r - rate) / 2.0 + abs(d - decay) / 0.4) / 2 for r, d in DELIVERED]
        np.testing.assert_allclose(columns["param_error"], expected, rtol=1e-9)
        delivered = np.transpose([columns["recommendation_rate"], columns["recommendation_decay"]])
        np.testing.assert_allclose(delivered, DELIVERED, rtol=1e-12)
        beyond = [(2.0 - rate) / 2, (rate - 4.0) / 2, (0.2 - decay) / 0.4, (decay - 0.6) / 0.4]
        np.testing.assert_allclose(columns["outside"], max(0.0, *beyond), rtol=1e-9)
        outside.append(columns["outside"][0])
        assert "param_abs_error" not in columns, "of two parameters there is no such number"
    assert sorted(outside)[:4] == [0.0] * 4, "those in the training range"
    assert max(outside) > 0.2
