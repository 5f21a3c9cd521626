"""Tests of the responses of a filter to changes of parameters."""

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.kalman.candidate_responses import compute_parameter_responses
from bench.diagnosis.kalman.filter_and_smoother import LinearRuns, add_noise_states, filter_runs
from bench.diagnosis.kalman.likelihood_fit import compute_likelihood_step
from bench.diagnosis.kalman.linearised_filter import FollowedRuns, linearise_run


@pytest.fixture(scope="module")
def followed(example_arm):
    """Return two runs of the example robot, followed with its model file."""
    noise = NoiseModel(np.full(2, 0.001), np.zeros(2))
    return FollowedRuns.follow(example_arm, example_arm.get_nominal_theta(), noise)


def test_parameter_responses_are_differences_of_whole_filters(followed):
    """The filter keeps its gains, because its Jacobians and its noise stay the same."""
    slices = followed.evaluator.coefficient_slices
    names = ("drag.linear@elbow", "mass.scale@forearm", "sensor.gain@q.elbow")
    places = [slices[name].start for name in names]
    sizes = np.array([1e-3, -1e-3, 1e-3])
    responses = compute_parameter_responses(followed, places, sizes)
    for column, (place, size) in enumerate(zip(places, sizes, strict=True)):
        theta = followed.theta.copy()
        theta[place] += size
        linear = [
            linearise_run(
                followed.evaluator, theta, followed.noise, run, one.trajectory, one
            ).interval_maps()
            for run, one in enumerate(followed.linear)
        ]
        runs = LinearRuns.stacked(linear, followed.evaluator.observed, followed.runs.prior)
        coloured, white = add_noise_states(runs, followed.noise)
        whitened = filter_runs(coloured, followed.force, white).whitened
        expected = (followed.filtered.whitened - whitened) / size
        error = np.linalg.norm(responses[..., column] - expected) / np.linalg.norm(expected)
        # A gain also scales the predicted deviations, which are small.
        assert error < (0.02 if names[column].startswith("sensor") else 2e-3), names[column]


def test_a_set_without_effects_has_no_step(followed):
    step, gain = compute_likelihood_step(followed, {})
    assert not step.any()
    assert gain == 0.0
