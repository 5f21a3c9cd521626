"""Gaussian-process regression with a constant mean, its hyper-parameters at their most probable
values.

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

from methods.base import Array


@dataclass(frozen=True)
class Settings:
    """Kernel and priors (log-normal) of the hyper-parameters.

    Attributes:
        kernel: squared exponential (4.9) or Matérn 5/2 (4.17).
        length: a length scale's median, a share of the cube, and its standard deviation in units of
            the logarithm.
        noise: the same for the noise variance, as a share of the process's variance.
    """

    kernel: Literal["rbf", "matern"] = "matern"
    length: tuple[float, float] = (0.3, 1.0)
    noise: tuple[float, float] = (1e-3, 3.0)


class GaussianProcess:
    """The posterior given n simulations; mean and variance are profiled out, length scales and
    noise are fitted.

    Attributes:
        hyper: (dim + 1,) logarithms of the length scales and of the noise.
        mean: constant mean.
        variance: the process's variance.
    """

    def __init__(
        self,
        points: Array,
        values: Array,
        settings: Settings,
        hyper: Array | None = None,
        fit: bool = True,
    ) -> None:
        """Condition on `values` (n,) at `points` (n, dim); start the fit from `hyper`, or take it
        as it is.
        """
        self.points = points
        self.values = values
        self.settings = settings
        self._squares = (points[:, None] - points) ** 2
        dim = points.shape[1]
        length, length_width = settings.length
        noise, noise_width = settings.noise
        lengths = np.full(dim, length)
        widths = np.full(dim, length_width)
        self._centre = np.log(np.append(lengths, noise))
        self._width = np.append(widths, noise_width)
        self.hyper = self._centre if hyper is None else hyper
        # two points, or values all alike, say nothing of a length
        if fit and len(points) > 2 and np.ptp(values) > 0.0:
            self.hyper = self._most_probable()
        k, _ = self._correlation(self._squares)
        self._lower = _cholesky(k, float(np.exp(self.hyper[-1])))
        self.mean, self.variance, self._alpha = _profile(self._lower, values)

    def _correlation(self, squares: Array, hyper: Array | None = None) -> tuple[Array, Array]:
        """Correlation of pairs with squared differences (n, m, dim), and its derivative by their
        scaled sum.
        """
        chosen = self.hyper if hyper is None else hyper
        lengths = chosen[:-1]
        scaled = squares @ np.exp(-2.0 * lengths)
        if self.settings.kernel == "rbf":
            k = np.exp(-0.5 * scaled)  # (4.9)
            return k, -0.5 * k
        root = np.sqrt(5.0 * scaled)
        decay = np.exp(-root)
        polynomial = 1.0 + root + root**2 / 3.0
        k = polynomial * decay  # (4.17)
        # by the scaled sum and not by the distance, whose derivative at zero would divide by it
        return k, -5.0 / 6.0 * (1.0 + root) * decay

    def _most_probable(self) -> Array:
        """Maximum of likelihood times prior, by L-BFGS."""
        from scipy.optimize import minimize

        def objective(hyper: Array) -> tuple[float, Array]:
            value, slope = self._evidence(hyper)
            # the priors, normal in the logarithms
            z = (hyper - self._centre) / self._width
            return value + 0.5 * float(z @ z), slope + z / self._width

        low = self._centre - 4.0 * self._width
        high = self._centre + 4.0 * self._width
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

    def _evidence(self, hyper: Array) -> tuple[float, Array]:
        """Negative logarithm of the marginal likelihood (2.30), and its gradient (5.9)."""
        from scipy.linalg import cho_solve

        n = len(self.values)
        k, slope = self._correlation(self._squares, hyper)
        lower = _cholesky(k, float(np.exp(hyper[-1])))
        _, variance, alpha = _profile(lower, self.values)
        # (2.30) with the best variance: its quadratic term is then n / 2, a constant
        half_determinant = np.log(np.diag(lower)).sum()
        value = 0.5 * n * np.log(variance) + half_determinant
        inverse = cho_solve((lower, True), np.eye(n))
        outer = np.outer(alpha, alpha)
        weight = 0.5 * (inverse - outer / variance)  # (5.9)
        by_squares = np.einsum("ij,ijd->d", weight * slope, self._squares)
        # the chain rule: squares are divided by squared lengths, whose logarithms are the variables
        by_length = by_squares * -2.0 * np.exp(-2.0 * hyper[:-1])
        by_noise = np.trace(weight) * np.exp(hyper[-1])
        return float(value), np.append(by_length, by_noise)

    def predict(self, points: Array) -> Array:
        """Posterior mean (2.25) at (m, dim)."""
        squares = (points[:, None] - self.points) ** 2
        k, _ = self._correlation(squares)
        mean: Array = self.mean + k @ self._alpha  # (2.25)
        return mean

    def sample(self, points: Array, draws: int, rng: np.random.Generator) -> Array:
        """Joint posterior draws (draws, m) at (m, dim), by a Cholesky factor of their covariance
        (2.26).
        """
        from scipy.linalg import solve_triangular

        to_known = (points[:, None] - self.points) ** 2
        among = (points[:, None] - points) ** 2
        cross, _ = self._correlation(to_known)
        prior, _ = self._correlation(among)
        explained = solve_triangular(self._lower, cross.T, lower=True)
        spread = _cholesky(prior - explained.T @ explained, 1e-10)  # (2.26)
        noise = rng.standard_normal((draws, len(points)))
        centre = self.mean + cross @ self._alpha  # (2.25)
        drawn = centre + self.variance**0.5 * (noise @ spread.T)
        return np.asarray(drawn, dtype=np.float64)


def _cholesky(matrix: Array, jitter: float) -> Array:
    """Lower factor of matrix + jitter, with as much more jitter as it takes."""
    while True:
        shifted = matrix + jitter * np.eye(len(matrix))
        try:
            return np.asarray(np.linalg.cholesky(shifted), dtype=np.float64)
        except np.linalg.LinAlgError:
            # points that nearly coincide leave rounding below zero
            jitter = max(10.0 * jitter, 1e-12)


def _profile(lower: Array, values: Array) -> tuple[float, float, Array]:
    """The most likely constant mean and variance, and K⁻¹(values - mean)."""
    from scipy.linalg import cho_solve

    weights = cho_solve((lower, True), np.ones(len(values)))
    mean = float(weights @ values / weights.sum())
    rest = values - mean
    alpha = cho_solve((lower, True), rest)
    variance = float(rest @ alpha) / len(values)
    # values all alike have none, and its logarithm is taken
    return mean, max(variance, 1e-20), alpha
