import numpy as np
import pytest
from scipy.stats import chi2

from bench.diagnosis.evaluation.noise_model import (
    NoiseModel,
    compute_log_determinant,
    compute_portmanteau_p_value,
    maximise_likelihood,
    whiten,
)
from tests.bench.diagnosis.explained_samples import (
    autocorrelation,
    correlated,
    covariance_of,
    everything,
    holes,
)


@pytest.mark.parametrize("phi", [0.0, 0.4, 0.9, -0.3])
def test_whitening_makes_autocorrelated_noise_independent_and_of_variance_one(phi):
    noise = NoiseModel(np.array([0.3, 7.0]), np.full(2, phi))
    made = correlated(np.random.default_rng(1), phi, noise.sigma, (40, 500, 2))
    white = whiten(made, everything(made), noise)
    # Each channel has unit variance, independent of its unit.
    for c in range(2):
        assert white[:, :, c].std() == pytest.approx(1.0, abs=0.015)
    for lag in (1, 2, 3):
        assert abs(autocorrelation(white, lag)) < 0.015
    assert white[:, 0].std() == pytest.approx(1.0, abs=0.2), (
        "the first sample counts as much as the others"
    )


def test_whitening_by_hand_starts_anew_across_a_hole():
    noise = NoiseModel(np.array([2.0]), np.array([0.6]))
    # The value of a missing sample is arbitrary.
    values = np.array([1.0, 2.0, 99.0, 4.0, 5.0])
    seen = np.array([True, True, False, True, True])
    white = whiten(values.reshape(1, 5, 1), seen.reshape(1, 5, 1), noise)
    # In units of sigma the values are 0.5, 1, -, 2 and 2.5; sqrt(1 - 0.6²) is 0.8.
    expected = [
        0.5,
        (1.0 - 0.6 * 0.5) / 0.8,
        0.0,
        2.0,
        (2.5 - 0.6 * 2.0) / 0.8,
    ]
    np.testing.assert_allclose(white[0, :, 0], expected, rtol=1e-14)


def test_whitening_treats_derivatives_like_the_samples():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(3, 20, 2, 4))
    noise = NoiseModel(np.array([0.1, 3.0]), np.array([0.5, -0.2]))
    seen = holes((3, 20, 2), 0.2, 5)
    together = whiten(values, seen, noise)
    for k in range(4):
        np.testing.assert_array_equal(together[..., k], whiten(values[..., k], seen, noise))


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_likelihood_is_that_of_the_normal_distribution(share):
    residual = correlated(np.random.default_rng(4), 0.7, 0.02, (3, 30, 1))
    seen = holes(residual.shape, share, 6)
    found = maximise_likelihood(np.where(seen, residual, 0.0), seen)
    r, count, phi = residual[seen], int(seen.sum()), float(found.phi[0])
    correlation = covariance_of(seen[:, :, 0], phi)
    variance = float(r @ np.linalg.solve(correlation, r)) / count
    assert found.sigma[0] == pytest.approx(variance**0.5, rel=1e-9)
    assert found.value == pytest.approx(
        -count * np.log(variance) - np.linalg.slogdet(correlation)[1], rel=1e-9
    )
    half = compute_log_determinant(seen, phi)
    assert 2 * half == pytest.approx(-np.linalg.slogdet(correlation)[1], rel=1e-9)
    # The likelihood is not higher anywhere else, except for the coarseness of the grid.
    for other in np.linspace(-0.4, 0.98, 70):
        correlation = covariance_of(seen[:, :, 0], other)
        variance = r @ np.linalg.solve(correlation, r) / count
        there = -count * np.log(variance) - np.linalg.slogdet(correlation)[1]
        assert there < found.value + 0.1


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8, 0.95])
def test_likelihood_finds_sigma_and_correlation(phi):
    made = correlated(np.random.default_rng(7), phi, 0.02, (6, 800, 1))
    found = maximise_likelihood(made, everything(made))
    assert found.phi[0] == pytest.approx(phi, abs=0.025)
    assert found.sigma[0] == pytest.approx(0.02, rel=0.06)


def test_each_channel_has_its_own_noise_and_holes_do_not_spoil_it():
    sigma, phi = np.array([0.01, 4.0]), np.array([0.85, 0.2])
    made = correlated(np.random.default_rng(8), phi, sigma, (6, 800, 2))
    seen = holes(made.shape, 0.15, 9)
    found = maximise_likelihood(np.where(seen, made, 0.0), seen)
    np.testing.assert_allclose(found.phi, phi, atol=0.03)
    np.testing.assert_allclose(found.sigma, sigma, rtol=0.06)
    residual = np.where(seen, made, 0.0)
    apart = [maximise_likelihood(residual[..., [c]], seen[..., [c]]).value for c in range(2)]
    assert found.value == pytest.approx(sum(apart), rel=1e-12)


def test_lost_degrees_of_freedom_enlarge_sigma_and_leave_the_value():
    made = np.random.default_rng(10).normal(size=(2, 50, 1))
    full, fewer = (
        maximise_likelihood(made, everything(made)),
        maximise_likelihood(made, everything(made), 19.0),
    )
    # 19 of 100 degrees of freedom are lost.
    ratio = fewer.sigma[0] / full.sigma[0]
    assert ratio == pytest.approx((100 / 81) ** 0.5, rel=1e-12)
    assert fewer.value == full.value


def test_a_channel_without_samples_is_left_out():
    made = np.random.default_rng(11).normal(size=(2, 50, 2))
    seen = everything(made)
    seen[:, :, 1] = False
    found = maximise_likelihood(np.where(seen, made, 0.0), seen)
    assert found.value == maximise_likelihood(made[..., :1], seen[..., :1]).value
    assert np.isnan(found.sigma[1])
    assert np.isfinite(found.sigma[0])


@pytest.mark.parametrize(("phi", "wave"), [(0.0, 0.5), (0.6, 2.0)])
def test_the_portmanteau_test_is_that_of_ljung_and_box(phi, wave):
    """The estimated correlation costs one degree of freedom, and C channels multiply p by C."""
    structure = wave * np.sin(np.arange(400) / 15.0)[None, :, None]
    made = correlated(np.random.default_rng(16), phi, 1.0, (1, 400, 1)) + structure
    found = maximise_likelihood(made, everything(made))
    white = whiten(made, everything(made), NoiseModel(np.ones(1), found.phi))[0, :, 0]
    lags = np.arange(1, 21)
    correlations = np.array([white[k:] @ white[:-k] for k in lags]) / (white @ white)
    statistic = 400 * 402 * (correlations**2 / (400 - lags)).sum()
    chance = compute_portmanteau_p_value(made, everything(made), found)
    assert chance == pytest.approx(chi2.sf(statistic, 19), rel=1e-9, abs=0)
    assert 1e-9 < chance < 0.45
    twice = np.concatenate([made, 3.0 * made], axis=2)
    both = compute_portmanteau_p_value(
        twice, everything(twice), maximise_likelihood(twice, everything(twice))
    )
    assert both == pytest.approx(2 * chance, rel=1e-6, abs=0)


def test_first_order_noise_is_distinguished_from_structure_of_equal_size():
    seen = np.ones((4, 300, 2), dtype=bool)
    chances = {"noise": [], "structure": []}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noise = correlated(rng, 0.7, np.array([1.0, 5.0]), seen.shape)
        wave = np.sin(np.arange(300) / 15.0 + rng.uniform(0, 6))[None, :, None]
        # The wave has about the amplitude of the first channel's noise and is equal in all runs.
        mixed = rng.standard_normal(seen.shape) * np.array([1.0, 5.0]) + 1.2 * wave
        for name, values in (("noise", noise), ("structure", mixed)):
            chances[name].append(
                compute_portmanteau_p_value(values, seen, maximise_likelihood(values, seen))
            )
    assert np.mean(np.array(chances["noise"]) > 0.01) > 0.9
    assert max(chances["structure"]) < 1e-6
