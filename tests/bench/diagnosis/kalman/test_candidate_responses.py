"""Tests of the responses of a filter to changes of parameters."""

import numpy as np

from bench.diagnosis.kalman.candidate_responses import (
    COLUMNS_PER_BATCH,
    Columns,
    SparseSignals,
    compute_parameter_responses,
    compute_responses,
)
from bench.diagnosis.kalman.kalman_recursions import LinearRuns, add_noise_states, filter_runs
from bench.diagnosis.kalman.likelihood_fit import compute_likelihood_step
from bench.diagnosis.kalman.linearised_filter import linearise_run


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


def make_sparse_inputs(shape, count, seed):
    """Return inputs (..., count) of which one row in five acts, and some columns not at all."""
    rng = np.random.default_rng(seed)
    acts = rng.random((shape[2], count)) < 0.2
    return (rng.normal(size=(*shape, count)) * acts).astype(np.float32)


def test_sparse_signals_are_those_that_were_stored():
    dense = make_sparse_inputs((2, 5, 4), 30, 1)
    signals = SparseSignals.join(
        [SparseSignals.from_dense(dense[..., :13]), SparseSignals.from_dense(dense[..., 13:])]
    )
    assert signals.values.shape[2] == dense.any(axis=(0, 1)).sum() < 40
    np.testing.assert_array_equal(signals.expand(0, 30), dense)
    np.testing.assert_array_equal(signals.expand(7, 21), dense[..., 7:21])
    # A column may be asked for twice.
    columns, weights = np.array([3, 20, 3]), np.array([0.5, -2.0, 1.5])
    np.testing.assert_allclose(
        signals.total(columns, weights), dense[..., columns] @ weights, atol=1e-6
    )


def test_responses_of_several_batches_are_those_of_single_columns(followed):
    """Candidates of a column share it, each in units of its own coefficient."""
    count = COLUMNS_PER_BATCH + 40
    runs, samples, channels = followed.runs.residuals.shape
    forces = make_sparse_inputs((runs, samples - 1, followed.runs.inputs.shape[3]), count, 2)
    readings = make_sparse_inputs((runs, samples, channels), count, 3)
    # The last candidate has the column of the fifth one, and all others are in disorder.
    order = np.append(np.random.default_rng(4).permutation(count), 4)
    sizes = np.linspace(0.5, 2.0, order.size)
    inputs = SparseSignals.from_dense(forces)
    probes = (None,) * order.size
    columns = Columns(probes, order, sizes, inputs, SparseSignals.from_dense(readings))
    responses = np.full((runs, samples, channels, order.size), np.nan, dtype=np.float32)
    compute_responses(followed, columns, responses)
    for candidate in (0, 100, order.size - 1):
        column = order[candidate]
        alone = Columns(
            (None,), np.array([0]), sizes[[candidate]],
            SparseSignals.from_dense(forces[..., [column]]),
            SparseSignals.from_dense(readings[..., [column]]),
        )  # fmt: skip
        expected = np.empty((runs, samples, channels, 1), dtype=np.float32)
        compute_responses(followed, alone, expected)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            responses[..., candidate], expected[..., 0], atol=1e-4 * scale, rtol=0
        )
