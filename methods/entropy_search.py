"""Greedy entropy search: simulate where it is most uncertain whether the minimiser of the error
lies there.

Source: S. Zhu, A. Kimmel, K. E. Bekris, A. Boularias, Fast model identification via physics engines
for data-efficient policy search, IJCAI 2018, doi:10.24963/ijcai.2018/451 (arXiv:1710.08893),
algorithm 1. The candidates' quasi-random
sequence: M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018,
https://extremelearning.com.au/unreasonable-effectiveness-of-quasirandom-sequences/.

The error over the parameters θ is a Gaussian process; P(θ) is the share of its posterior draws
whose minimiser, among candidates, is θ; the next simulation is where -P log P is largest. As
published the candidates are a fixed grid, which bounds the accuracy, and the search stops when its
estimate repeats, which is often too early. The default draws new candidates each time, dense around
the likely minimisers, models the logarithm of the error, and goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from methods.base import Array, Ask, Steps, Task, Tuner
from methods.gaussian_process import GaussianProcess, Settings


@dataclass(eq=False)
class EntropySearch(Tuner):
    """Greedy entropy search; recommends the lowest loss seen, or as published the candidate of the
    largest P.

    Attributes:
        published: the fixed grid over the cube (the authors of the comparison laid it between their
            smallest and largest test target, which a tuner cannot know), the plain error, and the
            stop.
        grid: number of grid points, if published (quasi-random where there are several parameters).
        repeats_within: change of the estimate, a share of the cube, at which the published search
            stops.
        draws: draws of the posterior; 200 if published.
        initial: simulations before the first model, the start included.
        everywhere: candidates all over the cube.
        nearby: candidates around the best point seen and the minimiser of the process's mean.
        process: kernel and priors of the Gaussian process.
        refit: with many simulations, the process's hyper-parameters are fitted anew after so many.
    """

    requires = ("scipy",)

    published: bool = False
    grid: int = 50
    repeats_within: float = 1e-3
    draws: int = 500
    initial: int = 4
    everywhere: int = 200
    nearby: int = 200
    process: Settings = field(default_factory=Settings)
    refit: int = 3

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:
        """The published search, or the refined one."""
        return self._published(task, rng) if self.published else self._refined(task, rng)

    def _published(self, task: Task, rng: np.random.Generator) -> Steps:
        """A fixed grid; stops when the estimate repeats."""
        grid = np.linspace(0.0, 1.0, self.grid)[:, None]
        if task.dim > 1:
            grid = spread(self.grid, rng.uniform(size=task.dim))
        settings = Settings(kernel="rbf", noise=(1e-8, 0.01))
        points, losses = np.empty((0, task.dim)), np.empty(0)
        asked, hyper = task.start, None
        estimate: Array | None = None
        while True:
            seen = yield Ask(asked[None], estimate)
            points, losses = np.vstack([points, seen.proposals]), np.append(losses, seen.losses)
            process = GaussianProcess(points, finite(losses), settings, hyper)
            hyper = process.hyper
            p = minimiser_probability(process, grid, 200, rng)
            last, estimate = estimate, grid[p.argmax()]
            if last is not None and np.abs(estimate - last).max() <= self.repeats_within:
                return "the estimate repeated"
            asked = grid[uncertainty(p).argmax()]

    def _refined(self, task: Task, rng: np.random.Generator) -> Steps:
        """New candidates for every simulation; never stops."""
        design = spread(self.initial, rng.uniform(size=task.dim))
        points, losses = np.empty((0, task.dim)), np.empty(0)
        asked, hyper = task.start, None
        while True:
            seen = yield asked[None]
            points, losses = np.vstack([points, seen.proposals]), np.append(losses, seen.losses)
            n = len(points)
            if n < self.initial:
                asked = design[n]
                continue
            values = logarithm(finite(losses))
            process = GaussianProcess(
                points, values, self.process, hyper, fit=n < 20 or n % self.refit == 0
            )
            hyper = process.hyper
            candidates = self._candidates(process, points[values.argmin()], rng)
            score = uncertainty(minimiser_probability(process, candidates, self.draws, rng))
            asked = candidates[score[1:].argmax() + 1]  # the first is simulated already

    def _candidates(self, process: GaussianProcess, best: Array, rng: np.random.Generator) -> Array:
        """The best point seen, quasi-random points, and points around the likely minimisers at all
        scales.
        """
        dim = len(best)
        wide = spread(self.everywhere, rng.uniform(size=dim))
        distances = np.linalg.norm(process.points - best, axis=1)
        finest = max(0.1 * np.min(distances, where=distances > 0.0, initial=0.5), 1e-9)
        scales = np.exp(rng.uniform(np.log(finest), np.log(0.5), size=(self.nearby, 1))) / np.sqrt(
            dim
        )
        centres = np.where(
            np.arange(self.nearby)[:, None] % 2 == 0, best, wide[process.predict(wide).argmin()]
        )
        near = centres + scales * rng.standard_normal((self.nearby, dim))
        return np.vstack([best, wide, np.clip(near, 0.0, 1.0)])


def minimiser_probability(
    process: GaussianProcess, candidates: Array, draws: int, rng: np.random.Generator
) -> Array:
    """P (n,): the share of joint posterior draws in which each candidate (n, dim) is the minimiser."""
    minimisers = process.sample(candidates, draws, rng).argmin(axis=1)
    return np.bincount(minimisers, minlength=len(candidates)) / draws


def uncertainty(p: Array) -> Array:
    """-P log P, and -1 where P = 0, which is never chosen while there is anything else."""
    return np.where(p > 0.0, -p * np.log(np.where(p > 0.0, p, 1.0)), -1.0)


def spread(n: int, shift: Array) -> Array:
    """(n, dim) quasi-random points in the unit cube: an additive recurrence, shifted by (dim,)."""
    dim, root = len(shift), 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dim + 1))  # the solution of root^(dim+1) = root + 1
    points: Array = (shift + np.arange(1, n + 1)[:, None] * root ** -np.arange(1.0, dim + 1)) % 1.0
    return points


def finite(losses: Array) -> Array:
    """Losses with failed simulations as bad as the worst."""
    good = np.isfinite(losses)
    return np.where(good, losses, np.max(losses, where=good, initial=0.0))


def logarithm(losses: Array) -> Array:
    """Logarithm of the losses, with a floor far below the typical one."""
    values: Array = np.log(losses + 1e-6 * np.median(losses) + 1e-300)
    return values
