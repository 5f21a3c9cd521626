"""TuRBO-1: Bayesian optimisation in one trust region, with Thompson sampling.

Sources: D. Eriksson et al., Scalable global optimization via local Bayesian optimization, NeurIPS
2019, arXiv 1910.01739 (section 2; constants from its supplement); M. Balandat et al., BoTorch: a
framework for efficient Monte-Carlo Bayesian optimization, NeurIPS 2020, arXiv 1910.06403. Gaussian
process and sampling are from the optional package `botorch`: pip install -e ".[turbo]".

The trust region is a box around the best point, with the sides

    (1)  length * l_i / (l_1 l_2 ... l_d)^(1/d)

for the length scales l_i of the process, so that its volume is length^d.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from methods.learning.library_isolation import isolated_library_call
from methods.learning.quasi_random_points import draw_sobol_points
from methods.tuner import Array, Task, Tuner, TunerGenerator

_MIN_RELATIVE_IMPROVEMENT = 0.999
"""Factor of the lowest loss; only a loss below this product counts as an improvement."""
_MIN_FAILURES_TO_SHRINK = 4
"""Minimum number of successive failures after which the side length is halved."""
_MAX_PERTURBED_COORDINATES = 20.0
"""Maximum mean number of coordinates in which a candidate differs from the centre."""
_MIN_LENGTH_SCALE = 0.005
"""Minimum length scale of the process, in the unit cube."""
_MAX_LENGTH_SCALE = 4.0
"""Maximum length scale of the process, in the unit cube."""
_MIN_NOISE_VARIANCE = 1e-8
"""Minimum variance of the noise, for losses scaled to variance 1."""
_MAX_NOISE_VARIANCE = 1e-3
"""Maximum variance of the noise, for losses scaled to variance 1.

It is small, because simulations are reproducible.
"""


@dataclass(eq=False)
class TuRBO(Tuner):
    """Trust-region Bayesian optimisation (TuRBO-1); recommends the lowest loss.

    The trust region grows with successes and shrinks with failures. Below its smallest side, the
    search starts again elsewhere with new initial points.

    Attributes:
        initial: points before the first model, per parameter, the start included; at least 2 in
            all.
        candidates: points among which a Thompson sample is compared.
        length: first side of the trust region, unit cube.
        longest: largest side of the trust region.
        shortest: smallest side of the trust region.
        successes: improvements in succession after which the side is doubled; it is halved after as
            many failures in succession as there are parameters, at least 4.
    """

    name: ClassVar[str] = "turbo"
    requires: ClassVar[tuple[str, ...]] = ("torch", "botorch")

    initial: int = 2
    candidates: int = 1000
    length: float = 0.8
    longest: float = 1.6
    shortest: float = 0.5**7
    successes: int = 3

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose initial points, then one Thompson sample at a time.

        When the trust region has collapsed, start again from new initial points.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        first: Array | None = task.start
        while True:
            count = max(2, self.initial * task.dim)
            points = list(draw_sobol_points(rng, count, task.dim))
            if first is not None:  # the start is used in the first region only
                points[0] = first
                first = None
            losses = []
            for point in points:
                evaluation = yield point
                losses.append(float(evaluation.losses[0]))
            yield from self._search_region(task.dim, rng, np.array(points), np.array(losses))

    def _search_region(
        self, dim: int, rng: np.random.Generator, points: Array, losses: Array
    ) -> TunerGenerator:
        """Search in one trust region until it has collapsed.

        Its side length doubles after some successes in a row, and halves after some failures in a
        row. A new region begins elsewhere when the length falls below `shortest`.

        Args:
            dim: number of parameters.
            rng: random generator.
            points: (n, dim) points simulated so far in this region.
            losses: (n,) their losses.
        """
        length = self.length
        success_count = 0
        failure_count = 0
        while length >= self.shortest:
            point = self._sample_best_candidate(points, losses, length, rng)
            evaluation = yield point
            loss = float(evaluation.losses[0])
            # An improvement by rounding does not count as success.
            if loss < _MIN_RELATIVE_IMPROVEMENT * losses.min():
                success_count += 1
                failure_count = 0
            else:
                success_count = 0
                failure_count += 1
            if success_count == self.successes:
                length = min(2.0 * length, self.longest)
                success_count = 0
            elif failure_count == max(_MIN_FAILURES_TO_SHRINK, dim):
                length = length / 2.0
                failure_count = 0
            points = np.vstack([points, point])
            losses = np.append(losses, loss)
        return None

    def _sample_best_candidate(
        self, points: Array, losses: Array, length: float, rng: np.random.Generator
    ) -> Array:
        """Draw the next point (dim,) of a trust region by Thompson sampling.

        A random function of the Gaussian process is drawn at candidates in the region, and the
        candidate where it is largest (it models the negative loss) is chosen. The region is a box
        around the best point, whose sides are proportional to the length scales and have the
        geometric mean `length` (1). Without a successful simulation the point is
        uniformly random.

        Args:
            points: (n, dim) simulated points.
            losses: (n,) their losses; infinite for failed simulations.
            length: side length of the region.
            rng: random generator.
        """
        import torch

        finite = np.isfinite(losses)
        if not finite.any():
            anywhere: Array = rng.uniform(size=(points.shape[1],))
            return anywhere
        values = np.where(finite, losses, losses[finite].max())
        # Equal losses need no scale.
        scale = float(values.std()) or 1.0
        with isolated_library_call(rng):
            from botorch.generation.sampling import MaxPosteriorSampling

            model = _fit_gaussian_process(points, -(values - values.mean()) / scale)
            length_scales = model.covar_module.base_kernel.lengthscale.detach().numpy().ravel()
            side_lengths = length * length_scales / np.exp(np.log(length_scales).mean())  # (1)
            candidates = self._draw_candidates(points[values.argmin()], side_lengths, rng)
            with torch.no_grad():
                sampled_point = MaxPosteriorSampling(model=model, replacement=False)(
                    torch.from_numpy(candidates)
                )
            best: Array = np.clip(sampled_point.numpy()[0].astype(np.float64), 0.0, 1.0)
        return best

    def _draw_candidates(
        self, centre: Array, side_lengths: Array, rng: np.random.Generator
    ) -> Array:
        """Draw points in the box around `centre`.

        In many dimensions each one differs from the centre in about 20 coordinates.

        Args:
            centre: (dim,) best point so far.
            side_lengths: (dim,) lengths of the sides of the box, in the unit cube.
            rng: random numbers of the run.
        """
        dim = len(centre)
        low = np.clip(centre - side_lengths / 2.0, 0.0, 1.0)
        high = np.clip(centre + side_lengths / 2.0, 0.0, 1.0)
        spread = low + (high - low) * draw_sobol_points(rng, self.candidates, dim)
        is_perturbed = rng.uniform(size=spread.shape) <= min(_MAX_PERTURBED_COORDINATES / dim, 1.0)
        # At least one coordinate is changed, because the centre has already been simulated.
        is_perturbed[~is_perturbed.any(axis=1), rng.integers(dim)] = True
        return np.where(is_perturbed, spread, centre)


def _fit_gaussian_process(points: Array, values: Array) -> Any:
    """Fit a Gaussian process with a scaled Matérn-5/2 kernel by its marginal likelihood.

    Args:
        points: (n, dim) points of the unit cube.
        values: (n,) values there, with mean 0 and standard deviation 1.

    Returns:
        botorch's model, ready for prediction.
    """
    import torch
    from botorch.exceptions.errors import ModelFittingError
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from gpytorch.constraints import Interval
    from gpytorch.kernels import MaternKernel, ScaleKernel
    from gpytorch.likelihoods import GaussianLikelihood
    from gpytorch.mlls import ExactMarginalLogLikelihood

    kernel = MaternKernel(
        nu=2.5,  # the surrogate is twice differentiable
        ard_num_dims=points.shape[1],
        lengthscale_constraint=Interval(_MIN_LENGTH_SCALE, _MAX_LENGTH_SCALE),
    )
    likelihood = GaussianLikelihood(
        noise_constraint=Interval(_MIN_NOISE_VARIANCE, _MAX_NOISE_VARIANCE)
    )
    x = torch.from_numpy(points)
    y = torch.from_numpy(values)[:, None]
    model = SingleTaskGP(
        x,
        y,
        covar_module=ScaleKernel(kernel),
        likelihood=likelihood,
        # Losses have already been scaled.
        outcome_transform=None,
    )
    # If the fit fails, the initial kernel is used.
    with suppress(ModelFittingError):
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    return model.eval()
