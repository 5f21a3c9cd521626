"""Covariance matrix adaptation, as pycma has it.

Sources: N. Hansen, The CMA evolution strategy: a tutorial, 2016, arXiv:1604.00772; N. Hansen, Y.
Akimoto, P. Baudis, CMA-ES/pycma, doi:10.5281/zenodo.2559634; restarts with a growing population: A.
Auger, N. Hansen, A restart CMA evolution strategy with increasing population size, CEC 2005,
doi:10.1109/CEC.2005.1554902.

pycma draws points x = m + sigma N(0, C), and computes from those with the lowest losses a new mean
m, step size sigma and covariance C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from methods.tuner import Array, Proposal, Task, Tuner, TunerGenerator


@dataclass(eq=False)
class CMAES(Tuner):
    """CMA-ES (pycma) in the unit cube.

    To a single parameter, which pycma refuses, a coordinate is added that the simulation ignores.
    The published comparison let CMA-ES search the drop height too, although it was known; its
    settings are `sigma=0.1, population=10, recommend="mean", evaluate_start=False`.

    Attributes:
        sigma: first standard deviation, a share of the cube; pycma's manual advises about a
            quarter.
        population: points in a generation; None for pycma's choice.
        recommend: the lowest loss, or the mean of the distribution.
        evaluate_start: simulate the start before the first generation; pycma alone only draws
            points around it.
        restarts: if pycma stops early, start again at a random point with twice the population, as
            far as the budget allows.
    """

    name = "cma_es"
    requires = ("cma",)

    sigma: float = 0.25
    population: int | None = None
    recommend: Literal["best", "mean"] = "best"
    evaluate_start: bool = True
    restarts: bool = True

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one generation per yield.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        if self.evaluate_start:
            yield task.start[None]
        centre = task.start
        population = self.population
        while True:
            strategy = self._make_strategy(centre, population, rng)
            while not strategy.stop():
                generation = strategy.ask()
                # The coordinate that the simulation ignores is removed.
                points = np.array(generation)[:, : task.dim]
                proposal: Array | Proposal = points
                if self.recommend == "mean":
                    proposal = Proposal(points, self._get_clipped_mean(strategy, task.dim))
                evaluation = yield proposal
                strategy.tell(generation, _rank_failures_last(evaluation.losses))
            # `stop` has pycma's reasons by name, such as a step size that is too small.
            if not self.restarts:
                return "pycma: " + ", ".join(strategy.stop())
            # A larger population is less sensitive to a rugged loss; points beyond the budget would
            # be cut.
            centre = rng.uniform(size=task.dim)
            population = max(min(2 * strategy.popsize, task.budget), strategy.popsize)

    def _make_strategy(
        self, centre: Array, population: int | None, rng: np.random.Generator
    ) -> Any:
        """Make a strategy with its own random generator.

        By default pycma seeds and uses NumPy's global generator.

        Args:
            centre: (dim,) mean of the first generation, in the unit cube.
            population: points in a generation; None for pycma's own choice.
            rng: random numbers of the strategy.
        """
        import cma

        options: dict[str, Any] = {
            "bounds": [0.0, 1.0],
            "randn": lambda *shape: rng.standard_normal(shape),
            # NaN keeps pycma from seeding the global generator.
            "seed": np.nan,
            "verbose": -9,
            # By default pycma reads options from a file in the working directory.
            "signals_filename": "",
        }
        if population is not None:
            options["popsize"] = population
        # pycma refuses a single parameter; the simulation ignores the second coordinate.
        padded = centre if len(centre) > 1 else np.append(centre, 0.5)
        return cma.CMAEvolutionStrategy(padded, self.sigma, options)

    @staticmethod
    def _get_clipped_mean(strategy: Any, dim: int) -> Array:
        """Return the distribution's mean, clipped to the cube.

        Args:
            strategy: strategy of pycma.
            dim: number of parameters of the simulation.
        """
        # pycma calls the mean its favourite. It may have one more coordinate, which the simulation
        # ignores.
        mean: Array = np.clip(strategy.result.xfavorite[:dim], 0.0, 1.0)
        return mean


def _rank_failures_last(losses: Array) -> Sequence[float]:
    """Return losses (n,) with failed simulations ranked last.

    CMA-ES only uses the order of the losses, so an infinite one is replaced by a large number.
    """
    finite = np.isfinite(losses)
    worst = np.max(losses, where=finite, initial=0.0)
    # Only ranks matter, so any number larger than the worst loss is suitable.
    ranked = np.where(finite, losses, 10.0 * worst + 1.0)
    return [float(x) for x in ranked]
