import numpy as np
import pytest
from scipy.optimize import check_grad

from methods.learning.gaussian_process import GaussianProcess, KernelSettings

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(size=(25, 2))
VALUES = np.sin(5.0 * POINTS[:, 0]) + 0.3 * POINTS[:, 1]


@pytest.mark.parametrize("kernel", ["rbf", "matern"])
def test_gradient_of_the_evidence(kernel: str) -> None:
    process = GaussianProcess(POINTS, VALUES, KernelSettings(kernel=kernel), fit=False)  # type: ignore[arg-type]
    for hyper in (np.log([0.3, 0.5, 1e-2]), np.log([1.0, 0.1, 1e-3])):
        error = check_grad(
            lambda h: process._compute_negative_evidence(h)[0],
            lambda h: process._compute_negative_evidence(h)[1],
            hyper,
        )
        assert error < 1e-4 * np.linalg.norm(process._compute_negative_evidence(hyper)[1])


@pytest.mark.parametrize("kernel", ["rbf", "matern"])
def test_predicts_what_it_has_not_seen(kernel: str) -> None:
    process = GaussianProcess(POINTS, VALUES, KernelSettings(kernel=kernel))  # type: ignore[arg-type]
    new = np.random.default_rng(1).uniform(0.1, 0.9, size=(50, 2))
    assert np.abs(process.predict(new) - np.sin(5.0 * new[:, 0]) - 0.3 * new[:, 1]).max() < 0.1


def test_length_scale_is_longer_where_less_happens() -> None:
    lengths = np.exp(GaussianProcess(POINTS, VALUES, KernelSettings()).hyper[:-1])
    assert lengths[1] > 2.0 * lengths[0]


def test_noise_is_found() -> None:
    points = np.linspace(0.0, 1.0, 60)[:, None]
    noisy = np.sin(6.0 * points[:, 0]) + 0.1 * np.random.default_rng(2).standard_normal(60)
    process = GaussianProcess(points, noisy, KernelSettings())
    assert np.sqrt(process.variance * np.exp(process.hyper[-1])) == pytest.approx(0.1, rel=0.25)


def test_draws_have_the_posterior_mean_and_covariance() -> None:
    process = GaussianProcess(POINTS[:8], VALUES[:8], KernelSettings(), fit=False)
    new = np.array([[0.2, 0.2], [0.25, 0.2], [0.9, 0.1]])
    draws = process.sample(new, 40000, np.random.default_rng(3))
    together = np.vstack([POINTS[:8], new])
    k = process._compute_correlation((together[:, None] - together) ** 2)[0]
    inside = k[:8, :8] + np.exp(process.hyper[-1]) * np.eye(8)
    covariance = process.variance * (k[8:, 8:] - k[8:, :8] @ np.linalg.solve(inside, k[:8, 8:]))
    assert np.allclose(
        draws.mean(axis=0), process.predict(new), atol=0.02 * np.sqrt(covariance.max())
    )
    assert np.allclose(np.cov(draws.T), covariance, atol=0.03 * covariance.max())


def test_repeated_points_and_constant_values_are_survived() -> None:
    points = np.repeat(POINTS[:5], 4, axis=0)
    process = GaussianProcess(points, np.ones(20), KernelSettings(noise=(1e-12, 0.1)))
    assert process.predict(POINTS) == pytest.approx(np.ones(25))
    assert np.isfinite(process.sample(points, 5, np.random.default_rng(0))).all()
