"""Tests of the Kalman filter, the smoother and the process noise against dense linear algebra."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.kalman import kalman_recursions
from bench.diagnosis.kalman.kalman_recursions import (
    SEGMENT_SAMPLES,
    LinearRuns,
    add_noise_states,
    filter_runs,
    fit_process_noise,
    smooth_runs,
)
from sims.robot.dynamics.linearisation_about_recording import IntervalMaps

SAMPLES, SIZE = 12, 2
SIGMA, FORCE = 0.1, 0.7
JUMPS = [3, 7]


def runs_of(residuals, prior=(0.5, 0.8), with_jumps=False):
    """Return runs of a unit mass with measured position and unknown forces between samples."""
    number, samples, _ = residuals.shape
    a = np.array([[1.0, 0.1], [-0.05, 0.98]])
    g = np.array([[0.005], [0.1]])
    shape = (number, samples - 1)
    jumps = np.zeros((*shape, 2))
    jumps[:, JUMPS] = 0.3, 2.0
    return LinearRuns(
        states=np.broadcast_to(a, (*shape, 2, 2)).copy(),
        defects=np.broadcast_to([0.01, -0.02], (*shape, 2)).copy(),
        forces=np.broadcast_to(g, (*shape, 2, 1)).copy(),
        inputs=np.zeros((*shape, 2, 1)),
        readings=np.broadcast_to([[1.0, 0.0]], (number, samples, 1, 2)).copy(),
        residuals=residuals,
        recorded=np.isfinite(residuals),
        prior=np.array(prior),
        jumps=jumps if with_jumps else np.zeros_like(jumps),
    )


def dense(runs, noise):
    """Return mean (T,) and covariance of the readings, and the matrix from unknowns to states.

    The unknowns are the first state in units of its prior, then the forces, then the jumps.
    """
    samples = runs.residuals.shape[1]
    mean, states = np.zeros(SIZE), [np.zeros(SIZE)]
    more = (1 + SIZE) * (samples - 1)
    columns = np.concatenate([np.diag(runs.prior), np.zeros((SIZE, more))], axis=1)
    maps = [columns]
    for i in range(samples - 1):
        a, g = runs.states[0, i], runs.forces[0, i, :, 0]
        mean = a @ mean - runs.defects[0, i]
        columns = a @ columns
        columns[:, SIZE + i] += FORCE * g
        first = SIZE + samples - 1 + SIZE * i
        columns[:, first : first + SIZE] += np.diag(runs.jumps[0, i])
        states.append(mean)
        maps.append(columns)
    maps, states = np.array(maps), np.array(states)
    read = maps[:, 0]
    return states, maps, read @ read.T + noise


@pytest.fixture
def residuals():
    return np.random.default_rng(3).normal(size=(1, SAMPLES, 1))


def log_likelihood(error, covariance):
    """Return the log-likelihood without its constant n/2 log 2 pi, as the filter does."""
    constant = 0.5 * error.size * np.log(2 * np.pi)
    return multivariate_normal.logpdf(error, cov=covariance) + constant


@pytest.mark.parametrize("with_jumps", [False, True])
def test_the_likelihood_is_that_of_the_joint_distribution(residuals, with_jumps):
    runs = runs_of(residuals, with_jumps=with_jumps)
    states, _, covariance = dense(runs, SIGMA**2 * np.eye(SAMPLES))
    error = residuals[0, :, 0] - states[:, 0]
    found = filter_runs(runs, np.array([FORCE]), np.array([SIGMA**2]))
    assert found.log_likelihood[0] == pytest.approx(log_likelihood(error, covariance), rel=1e-10)
    assert np.square(found.whitened).sum() == pytest.approx(
        error @ np.linalg.solve(covariance, error), rel=1e-10
    )


def test_coloured_noise_has_the_covariance_of_a_first_order_process(residuals):
    phi = 0.8
    lags = np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES)))
    runs, white = add_noise_states(
        runs_of(residuals), NoiseModel(np.array([SIGMA]), np.array([phi]))
    )
    noise = SIGMA**2 * phi**lags + white[0] * np.eye(SAMPLES)
    states, _, covariance = dense(runs_of(residuals), noise)
    error = residuals[0, :, 0] - states[:, 0]
    found = filter_runs(runs, np.array([FORCE]), white)
    assert found.log_likelihood[0] == pytest.approx(log_likelihood(error, covariance), rel=1e-9)


@pytest.mark.parametrize("with_jumps", [False, True])
def test_the_smoother_gives_conditional_means(residuals, with_jumps):
    runs = runs_of(residuals, with_jumps=with_jumps)
    states, maps, covariance = dense(runs, SIGMA**2 * np.eye(SAMPLES))
    error = residuals[0, :, 0] - states[:, 0]
    unknowns = maps[:, 0].T @ np.linalg.solve(covariance, error)
    force = np.array([FORCE])
    found = smooth_runs(runs, filter_runs(runs, force, np.array([SIGMA**2])), force)
    np.testing.assert_allclose(found.states[0], states + maps @ unknowns, atol=1e-10)
    np.testing.assert_allclose(
        found.forces[0, :, 0], FORCE * unknowns[SIZE : SIZE + SAMPLES - 1], atol=1e-10
    )


def test_a_missing_sample_is_no_sample(residuals):
    gone = residuals.copy()
    gone[0, 5] = np.nan
    runs = runs_of(gone)
    runs.readings[~runs.recorded] = 0.0
    runs.residuals[~runs.recorded] = 0.0
    states, _, covariance = dense(runs_of(residuals), SIGMA**2 * np.eye(SAMPLES))
    there = np.arange(SAMPLES) != 5
    error = (residuals[0, :, 0] - states[:, 0])[there]
    own = covariance[np.ix_(there, there)]
    found = filter_runs(runs, np.array([FORCE]), np.array([SIGMA**2]))
    assert found.log_likelihood[0] == pytest.approx(log_likelihood(error, own), rel=1e-10)


def join_runs(first, second, order, coupling=0.0):
    """Return two one-channel models as one, whose states are in another order.

    Args:
        first: runs of a model.
        second: the same number of runs of another model.
        order: states of the result, as indices of those of the first model and then the second.
        coupling: derivative of the first state of the second model by that of the first one.
    """

    def stack(name):
        one, other = getattr(first, name), getattr(second, name)
        shape = *one.shape[:2], one.shape[2] + other.shape[2], one.shape[3] + other.shape[3]
        result = np.zeros(shape)
        result[:, :, : one.shape[2], : one.shape[3]] = one
        result[:, :, one.shape[2] :, one.shape[3] :] = other
        return result

    states = stack("states")
    states[:, :, SIZE, 0] = coupling
    joined = {
        name: np.concatenate([getattr(first, name), getattr(second, name)], axis=-1)
        for name in ("residuals", "recorded")
    }
    by_state = {
        name: np.concatenate([getattr(first, name), getattr(second, name)], axis=-1)[..., order]
        for name in ("defects", "jumps", "prior")
    }
    return LinearRuns(
        states=states[:, :, order][..., order],
        forces=stack("forces")[:, :, order],
        inputs=stack("inputs")[:, :, order],
        readings=stack("readings")[..., order],
        **joined,
        **by_state,
    )


def test_independent_parts_are_filtered_and_smoothed_like_models_of_their_own():
    rng = np.random.default_rng(5)
    singles = [
        runs_of(rng.normal(size=(2, SAMPLES, 1)), prior, with_jumps=True)
        for prior in ((0.5, 0.8), (0.1, 0.3))
    ]
    force, white = np.array([FORCE, 0.2]), np.array([SIGMA**2, 0.04])
    # The states of the two models alternate.
    order = [0, 2, 1, 3]
    runs = join_runs(*singles, order)
    parts = runs.independent_parts
    assert [part.states.tolist() for part in parts] == [[0, 2], [1, 3]]
    assert [(part.channels.tolist(), part.forces.tolist()) for part in parts] == [
        ([0], [0]),
        ([1], [1]),
    ]
    filtered = filter_runs(runs, force, white)
    smoothed = smooth_runs(runs, filtered, force)
    total = 0.0
    for k, (single, states) in enumerate(zip(singles, ([0, 2], [1, 3]), strict=True)):
        alone = filter_runs(single, force[[k]], white[[k]])
        total = total + alone.log_likelihood
        np.testing.assert_array_equal(filtered.predicted[..., states], alone.predicted)
        np.testing.assert_array_equal(filtered.gains[:, :, states, k], alone.gains[..., 0])
        # A reading says nothing about the states of the other part.
        assert not filtered.gains[:, :, states, 1 - k].any()
        np.testing.assert_array_equal(filtered.whitened[..., [k]], alone.whitened)
        of_single = smooth_runs(single, alone, force[[k]])
        np.testing.assert_array_equal(smoothed.states[..., states], of_single.states)
        np.testing.assert_array_equal(smoothed.forces[..., [k]], of_single.forces)
        np.testing.assert_array_equal(smoothed.score[[k]], of_single.score)
    np.testing.assert_allclose(filtered.log_likelihood, total, rtol=1e-14)
    # A coupled model is one part, with another result.
    coupled = join_runs(*singles, order, coupling=1e-3)
    assert len(coupled.independent_parts) == 1
    changed = filter_runs(coupled, force, white).log_likelihood
    assert (np.abs(changed - filtered.log_likelihood) > 1e-6).all()


@pytest.mark.parametrize(("coupling", "part_count"), [(1e-11, 2), (1e-7, 1)])
def test_rounding_errors_of_derivatives_do_not_couple_states(coupling, part_count):
    single = runs_of(np.zeros((1, SAMPLES, 1)))
    runs = join_runs(single, single, [0, 1, 2, 3], coupling)
    maps = IntervalMaps(
        **{name: getattr(runs, name)[0] for name in kalman_recursions.STACKED},
        predicted=np.zeros((SAMPLES, 2)),
    )
    stacked = LinearRuns.stacked([maps], np.zeros((1, SAMPLES, 2)), runs.prior)
    assert len(stacked.independent_parts) == part_count
    kept = coupling if part_count == 1 else 0.0
    np.testing.assert_array_equal(stacked.states[0, :, SIZE, 0], kept)


@pytest.mark.parametrize("begin", [0.02, 20.0])
def test_the_process_noise_is_found_by_maximum_likelihood(begin):
    rng = np.random.default_rng(8)
    number, samples = 6, 200
    runs = runs_of(np.zeros((number, samples, 1)))
    x = rng.normal(size=(number, 2)) * runs.prior
    for i in range(samples):
        runs.residuals[:, i, 0] = x[:, 0] + SIGMA * rng.normal(size=number)
        if i + 1 < samples:
            pushed = FORCE * rng.normal(size=number)[:, None] * runs.forces[:, i, :, 0]
            x = x @ runs.states[0, 0].T - runs.defects[:, i] + pushed
    white, typical = np.array([SIGMA**2]), np.array([1.0])
    force, filtered, _ = fit_process_noise(runs, np.array([begin]), white, typical)
    assert force[0] == pytest.approx(FORCE, rel=0.25)
    around = [
        filter_runs(runs, force * factor, white).log_likelihood.sum() for factor in (0.6, 1.6)
    ]
    assert filtered.log_likelihood.sum() > max(around)


@pytest.mark.parametrize("samples", [40, 4 * SEGMENT_SAMPLES])
@pytest.mark.parametrize("iterations", [1, 2])
def test_the_process_noise_is_that_of_the_returned_filter(monkeypatch, samples, iterations):
    """This holds for a fit that ends before it has converged, too."""
    monkeypatch.setattr(kalman_recursions, "MAX_ITERATIONS", iterations)
    rng = np.random.default_rng(7)
    runs = runs_of(rng.normal(size=(3, samples, 1)))
    white = np.array([SIGMA**2])
    force, filtered, _ = fit_process_noise(runs, np.array([1e-3]), white, np.array([1.0]))
    expected = filter_runs(runs, force, white).log_likelihood
    np.testing.assert_allclose(filtered.log_likelihood, expected, rtol=1e-12)


def test_no_process_noise_is_found_where_the_model_is_right():
    rng = np.random.default_rng(9)
    runs = runs_of(SIGMA * rng.normal(size=(6, 150, 1)), prior=(1e-6, 1e-6))
    runs.defects[:] = 0.0
    force, *_ = fit_process_noise(runs, np.array([0.5]), np.array([SIGMA**2]), np.array([1.0]))
    assert force[0] < 0.05
