"""Gaussian-process regression with a constant mean and maximum a posteriori hyperparameters.

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, 2006,
doi:10.7551/mitpress/3206.001.0001; equation numbers are theirs. With K the correlation of the
points with noise on its diagonal, L its Cholesky factor, y the values and m the mean:

    (2.25)  posterior mean = m + k* K^-1 (y - m)
    (2.26)  posterior covariance = variance (k** - k* K^-1 k*^T)
    (2.30)  log likelihood = -(y - m)^T K^-1 (y - m) / (2 variance) - log |K| / 2 - ...

The mean and variance of the largest likelihood are known in closed form, given the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from methods.tuner import Array


@dataclass(frozen=True)
class KernelSettings:
    """Kernel and log-normal priors of the hyper-parameters.

    Attributes:
        kernel: squared exponential (4.9) or Matérn 5/2 (4.17).
        length: median of a length scale, as a share of the cube, and its standard deviation on the
            logarithmic scale.
        noise: median of the noise variance, as a share of the process's variance, and its standard
            deviation on the logarithmic scale.
    """

    kernel: Literal["rbf", "matern"] = "matern"
    length: tuple[float, float] = (0.3, 1.0)
    noise: tuple[float, float] = (1e-3, 3.0)


class GaussianProcess:
    """Gaussian-process posterior given n simulations.

    Mean and variance are profiled out; length scales and noise are fitted.

    Attributes:
        hyper: (dim + 1,) logarithms of the length scales and of the noise.
        mean: constant mean.
        variance: variance of the process.
    """

    def __init__(
        self,
        points: Array,
        values: Array,
        settings: KernelSettings,
        hyper: Array | None = None,
        fit: bool = True,
    ) -> None:
        """Condition the process on simulated values, and fit its length scales and noise.

        Args:
            points: (n, dim) points of the unit cube.
            values: (n,) values at the points.
            settings: kernel and priors.
            hyper: (dim + 1,) initial hyper-parameters; None for the prior medians.
            fit: True to fit the hyper-parameters, False to use the initial ones.
        """
        self.points = points
        self.values = values
        self.settings = settings
        # (n, n, dim) for all pairs of points.
        self._squared_differences = (points[:, None] - points) ** 2
        dim = points.shape[1]
        length, length_width = settings.length
        noise, noise_width = settings.noise
        lengths = np.full(dim, length)
        widths = np.full(dim, length_width)
        # Means and standard deviations of the priors, of the logarithms of lengths and noise.
        self._prior_centre = np.log(np.append(lengths, noise))
        self._prior_width = np.append(widths, noise_width)
        self.hyper = self._prior_centre if hyper is None else hyper
        # Two points, or equal values, give no information about a length scale.
        if fit and len(points) > 2 and np.ptp(values) > 0.0:
            self.hyper = self._maximise_posterior()
        k, _ = self._compute_correlation(self._squared_differences)
        # Cholesky factor of K, the correlation with noise on its diagonal; alpha is
        # K^-1 (values - mean).
        self._cholesky = _compute_cholesky_factor(k, float(np.exp(self.hyper[-1])))
        self.mean, self.variance, self._alpha = _compute_mean_and_variance(self._cholesky, values)

    def _compute_correlation(
        self, squares: Array, hyper: Array | None = None
    ) -> tuple[Array, Array]:
        """Compute the correlation of pairs, and its derivative by their scaled squared distance.

        The scaled squared distance r^2 is the sum over the coordinates of squared difference by
        squared length scale. The correlation is exp(-r^2 / 2) (4.9), or with the Matérn kernel
        (1 + q + q^2 / 3) exp(-q), q = sqrt(5) r (4.17).

        Args:
            squares: (n, m, dim) squared differences of the pairs of n and m points.
            hyper: (dim + 1,) logarithms of length scales and noise; None for the present ones.

        Returns:
            Correlations (n, m) and derivatives (n, m).
        """
        log_lengths = (self.hyper if hyper is None else hyper)[:-1]  # the last one is the noise
        scaled = squares @ np.exp(-2.0 * log_lengths)
        if self.settings.kernel == "rbf":
            k = np.exp(-0.5 * scaled)  # (4.9)
            return k, -0.5 * k
        root = np.sqrt(5.0 * scaled)
        decay = np.exp(-root)
        polynomial = 1.0 + root + root**2 / 3.0
        k = polynomial * decay  # (4.17)
        # The derivative by the squared distance avoids a division by zero at zero distance.
        return k, -5.0 / 6.0 * (1.0 + root) * decay

    def _maximise_posterior(self) -> Array:
        """Return the most probable hyper-parameters (dim + 1,), found by L-BFGS.

        These maximise likelihood times prior. They are searched within four standard deviations of
        the prior.
        """
        from scipy.optimize import minimize

        def objective(hyper: Array) -> tuple[float, Array]:
            """Compute the negative log posterior of the hyper-parameters, and its gradient.

            Args:
                hyper: (dim + 1,) logarithms of the length scales and of the noise.
            """
            value, slope = self._compute_negative_evidence(hyper)
            # The priors are normal distributions of the logarithms; z is in standard deviations.
            z = (hyper - self._prior_centre) / self._prior_width
            return value + 0.5 * float(z @ z), slope + z / self._prior_width

        low = self._prior_centre - 4.0 * self._prior_width
        high = self._prior_centre + 4.0 * self._prior_width
        bounds = list(zip(low, high, strict=True))
        optimum = minimize(
            objective,
            self.hyper,
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": 20},
        )
        return np.asarray(optimum.x)

    def _compute_negative_evidence(self, hyper: Array) -> tuple[float, Array]:
        """Compute the negative log marginal likelihood and its gradient (dim + 1,).

        With K the correlation of the n values with noise and v their most likely variance, it is
        n / 2 log v + log |K| / 2, which is (2.30) of Rasmussen and Williams without constant terms.
        Its derivative by K is (K^-1 - alpha alpha^T / v) / 2 (5.9), with alpha = K^-1 (values -
        mean).

        Args:
            hyper: (dim + 1,) logarithms of the length scales and of the noise.
        """
        from scipy.linalg import cho_solve

        n = len(self.values)
        k, slope = self._compute_correlation(self._squared_differences, hyper)
        lower = _compute_cholesky_factor(k, float(np.exp(hyper[-1])))
        _, variance, alpha = _compute_mean_and_variance(lower, self.values)
        # (2.30) with the profiled variance: its quadratic term is the constant n / 2.
        half_determinant = np.log(np.diag(lower)).sum()
        value = 0.5 * n * np.log(variance) + half_determinant
        inverse = cho_solve((lower, True), np.eye(n))
        outer = np.outer(alpha, alpha)
        weight = 0.5 * (inverse - outer / variance)  # (5.9)
        by_squares = np.einsum("ij,ijd->d", weight * slope, self._squared_differences)
        # Chain rule: squares are divided by squared lengths, whose logarithms are the variables.
        by_length = by_squares * -2.0 * np.exp(-2.0 * hyper[:-1])
        by_noise = np.trace(weight) * np.exp(hyper[-1])
        return float(value), np.append(by_length, by_noise)

    def predict(self, points: Array) -> Array:
        """Compute the posterior mean (m,) of the function at points (m, dim).

        It is mean + k alpha (2.25), with the correlations k (m, n) of the points with the n known
        ones, and alpha = K^-1 (values - mean).
        """
        squares = (points[:, None] - self.points) ** 2
        k, _ = self._compute_correlation(squares)
        mean: Array = self.mean + k @ self._alpha  # (2.25)
        return mean

    def sample(self, points: Array, draws: int, rng: np.random.Generator) -> Array:
        """Draw joint samples of the posterior by a Cholesky factor of its covariance.

        The covariance, relative to the variance, is k2 - k K^-1 k' (2.26), and the mean is mean + k
        alpha (2.25). k are the correlations of the m points with the n known ones, k2 those among
        the m points, K those among the known ones, and alpha = K^-1 (values - mean).

        Args:
            points: (m, dim) m points of the unit cube.
            draws: number of samples.
            rng: random generator.

        Returns:
            (draws, m) samples.
        """
        from scipy.linalg import solve_triangular

        # Correlations with the n known points (m, n), and among the m points.
        cross_correlation, _ = self._compute_correlation((points[:, None] - self.points) ** 2)
        prior, _ = self._compute_correlation((points[:, None] - points) ** 2)
        explained = solve_triangular(self._cholesky, cross_correlation.T, lower=True)
        spread = _compute_cholesky_factor(prior - explained.T @ explained, 1e-10)  # (2.26)
        noise = rng.standard_normal((draws, len(points)))
        centre = self.mean + cross_correlation @ self._alpha  # (2.25)
        samples = centre + self.variance**0.5 * (noise @ spread.T)
        return np.asarray(samples, dtype=np.float64)


def _compute_cholesky_factor(matrix: Array, jitter: float) -> Array:
    """Return the lower Cholesky factor of matrix + jitter, with more jitter if it is needed.

    Args:
        matrix: (n, n) covariance matrix.
        jitter: First number to add to the diagonal; multiplied by ten until the factor exists.
    """
    while True:
        shifted = matrix + jitter * np.eye(len(matrix))
        try:
            return np.asarray(np.linalg.cholesky(shifted), dtype=np.float64)
        except np.linalg.LinAlgError:
            # Points that nearly coincide give eigenvalues below zero by rounding.
            jitter = max(10.0 * jitter, 1e-12)


def _compute_mean_and_variance(lower: Array, values: Array) -> tuple[float, float, Array]:
    """Return the maximum-likelihood constant mean and variance, and K⁻¹(values - mean), (n,).

    Args:
        lower: (n, n) Cholesky factor of K, the correlation of the n points with noise.
        values: (n,) function values at the points.
    """
    from scipy.linalg import cho_solve

    weights = cho_solve((lower, True), np.ones(len(values)))
    mean = float(weights @ values / weights.sum())
    centred = values - mean
    alpha = cho_solve((lower, True), centred)
    variance = float(centred @ alpha) / len(values)
    # Equal values have variance zero, whose logarithm would be infinite.
    return mean, max(variance, 1e-20), alpha
