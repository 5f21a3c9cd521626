"""Greedy entropy search: simulate where the minimiser of the error is most uncertain.

Source: S. Zhu et al., Fast model identification via physics engines for data-efficient policy
search, IJCAI 2018, doi:10.24963/ijcai.2018/451 (arXiv:1710.08893), algorithm 1.

The error as a function of the parameters θ is a Gaussian process. P(θ) is the share of its
posterior draws whose minimiser among the candidates is θ. The next simulation is where

    (1)  -P(θ) log P(θ)

is largest. Candidates are quasi-random points (`methods.learning.quasi_random_points`).

The published candidates are a fixed grid, which limits the accuracy, and the published search stops
when its estimate repeats, often too early. The default draws new candidates each time, dense around
the likely minimisers, models the logarithm of the error, and continues.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from methods.learning.gaussian_process import GaussianProcess, KernelSettings
from methods.learning.quasi_random_points import generate_quasi_random_points
from methods.tuner import Array, Proposal, Task, Tuner, TunerGenerator

_PUBLISHED_DRAWS = 200
"""Number of posterior samples of the published search."""
_REFIT_INTERVAL_THRESHOLD = 20
"""Number of simulations from which on hyper-parameters are not fitted after each simulation."""
_MIN_DISTANCE_SHARE = 0.1
"""Smallest distance of a nearby candidate, as a share of the distance to the nearest neighbour."""
_LOSS_FLOOR_SHARE = 1e-6
"""Number added to losses before the logarithm, as a share of the median loss."""


@dataclass(eq=False)
class EntropySearch(Tuner):
    """Greedy entropy search: simulate where the minimiser of the error is most uncertain.

    It recommends the lowest loss so far, or with `published` the candidate with the largest P.

    Attributes:
        published: fixed grid over the cube, plain error, and the stop (the authors' grid lay
            between their smallest and largest test target, which a tuner cannot know).
        grid: number of grid points, if published; quasi-random for several parameters.
        repeats_within: change of the estimate, a share of the cube, at which the published search
            stops.
        draws: draws of the posterior; 200 if published.
        initial: simulations before the first model, the start included.
        everywhere: candidates all over the cube.
        nearby: candidates around the best point and the minimiser of the process's mean.
        process: kernel and priors of the Gaussian process.
        refit: with many simulations, refit the hyper-parameters after this number of simulations.
    """

    requires = ("scipy",)

    published: bool = False
    grid: int = 50
    repeats_within: float = 1e-3
    draws: int = 500
    initial: int = 4
    everywhere: int = 200
    nearby: int = 200
    process: KernelSettings = field(default_factory=KernelSettings)
    refit: int = 3

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Run the published search, or the refined one.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        return (
            self._tune_as_published(task, rng) if self.published else self._tune_refined(task, rng)
        )

    def _tune_as_published(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Search on a fixed grid, and stop when the estimate repeats (algorithm 1 of the paper).

        After each simulation the error is modelled by a Gaussian process. P of a grid point is the
        share of draws of the process in which it has the smallest error. The estimate is the grid
        point with the largest P; the next simulation is at the point with the largest entropy term
        -P log P (1).

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        grid = np.linspace(0.0, 1.0, self.grid)[:, None]
        if task.dim > 1:
            grid = generate_quasi_random_points(self.grid, rng.uniform(size=task.dim))
        # The simulation has no noise; a small noise variance keeps the covariance invertible.
        settings = KernelSettings(kernel="rbf", noise=(1e-8, 0.01))
        points = np.empty((0, task.dim))
        losses = np.empty(0)
        proposal = task.start
        hyper = None
        estimate: Array | None = None
        while True:
            evaluation = yield Proposal(proposal[None], estimate)
            points = np.vstack([points, evaluation.proposals])
            losses = np.append(losses, evaluation.losses)
            process = GaussianProcess(points, replace_failed_losses(losses), settings, hyper)
            # The next fit starts from these values, because one more point changes them little.
            hyper = process.hyper
            p = compute_minimiser_probability(process, grid, _PUBLISHED_DRAWS, rng)
            previous_estimate = estimate
            estimate = grid[p.argmax()]
            # The published criterion, which often stops too early.
            if (
                previous_estimate is not None
                and np.abs(estimate - previous_estimate).max() <= self.repeats_within
            ):
                return "the estimate repeated"
            proposal = grid[compute_entropy_terms(p).argmax()]  # (1)

    def _tune_refined(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Search with new candidates for every simulation, without stopping.

        The first points are quasi-random; then each simulation is at the candidate with the largest
        entropy term -P log P (1), with P its probability to be the minimiser of the error: there it
        is most uncertain whether the error has its minimum.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        design = generate_quasi_random_points(self.initial, rng.uniform(size=task.dim))
        points = np.empty((0, task.dim))
        losses = np.empty(0)
        proposal = task.start
        hyper = None
        while True:
            evaluation = yield proposal[None]
            points = np.vstack([points, evaluation.proposals])
            losses = np.append(losses, evaluation.losses)
            point_count = len(points)
            if point_count < self.initial:
                proposal = design[point_count]
                continue
            # Near the minimum the loss spans several decades, which only a logarithm resolves.
            values = compute_log_losses(replace_failed_losses(losses))
            fit = point_count < _REFIT_INTERVAL_THRESHOLD or point_count % self.refit == 0
            process = GaussianProcess(points, values, self.process, hyper, fit=fit)
            hyper = process.hyper
            candidates = self._choose_candidates(process, points[values.argmin()], rng)
            p = compute_minimiser_probability(process, candidates, self.draws, rng)
            score = compute_entropy_terms(p)  # (1)
            # The first candidate is the best point, which has already been simulated.
            proposal = candidates[score[1:].argmax() + 1]

    def _choose_candidates(
        self, process: GaussianProcess, best: Array, rng: np.random.Generator
    ) -> Array:
        """Choose N candidates (N, dim) for the next simulation, in the unit cube.

        They are the best point so far, `everywhere` quasi-random points in the cube, and `nearby`
        points: half of these around the best point, half around the quasi-random point with the
        lowest predicted loss, at distances of all orders of magnitude.

        Args:
            process: Gaussian process of the loss.
            best: (dim,) best point so far.
            rng: random numbers of the run.
        """
        dim = len(best)
        spread_points = generate_quasi_random_points(self.everywhere, rng.uniform(size=dim))
        distances = np.linalg.norm(process.points - best, axis=1)
        # Distances range from a tenth of the distance to the nearest neighbour to half the cube.
        nearest = np.min(distances, where=distances > 0.0, initial=0.5)
        min_scale = max(_MIN_DISTANCE_SHARE * nearest, 1e-9)
        exponents = rng.uniform(np.log(min_scale), np.log(0.5), size=(self.nearby, 1))
        # The expected length is the same in any number of dimensions.
        scales = np.exp(exponents) / np.sqrt(dim)
        expected_minimiser = spread_points[process.predict(spread_points).argmin()]
        is_even = np.arange(self.nearby)[:, None] % 2 == 0
        centres = np.where(is_even, best, expected_minimiser)
        near_points = centres + scales * rng.standard_normal((self.nearby, dim))
        return np.vstack([best, spread_points, np.clip(near_points, 0.0, 1.0)])


def compute_minimiser_probability(
    process: GaussianProcess, candidates: Array, draws: int, rng: np.random.Generator
) -> Array:
    """Compute the probability P (n,) that each candidate (n, dim) is the minimiser.

    It is the share of joint posterior samples whose minimiser is the candidate.

    Args:
        process: Gaussian process of the loss.
        candidates: (n, dim) points of the unit cube.
        draws: number of posterior samples.
        rng: random generator.
    """
    minimisers = process.sample(candidates, draws, rng).argmin(axis=1)
    return np.bincount(minimisers, minlength=len(candidates)) / draws


def compute_entropy_terms(p: Array) -> Array:
    """Compute -P log P, and -1 if P = 0, so that such a candidate is chosen last."""
    is_positive = p > 0.0
    logarithms = np.log(np.where(is_positive, p, 1.0))
    return np.where(is_positive, -p * logarithms, -1.0)


def replace_failed_losses(losses: Array) -> Array:
    """Replace the losses of failed simulations by the largest finite loss."""
    is_finite = np.isfinite(losses)
    return np.where(is_finite, losses, np.max(losses, where=is_finite, initial=0.0))


def compute_log_losses(losses: Array) -> Array:
    """Compute the logarithm of the losses, with a floor far below the typical loss."""
    values: Array = np.log(losses + _LOSS_FLOOR_SHARE * np.median(losses) + 1e-300)
    return values
