"""Bayesian optimisation with a Gaussian process and expected improvement (scikit-optimize).

Sources: D. R. Jones, M. Schonlau, W. J. Welch, Efficient global optimization of expensive black-box
functions, Journal of Global Optimization 13, 1998, doi:10.1023/A:1008306431147; T. Head et al.,
scikit-optimize, doi:10.5281/zenodo.1157319.

The Gaussian process predicts a loss of mean m and standard deviation s. With the lowest loss f so
far, the next point has the largest expected improvement:

    (1)  EI = (f - m) Phi((f - m) / s) + s phi((f - m) / s)

with Phi and phi the normal distribution and its density.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class BayesianOptimisation(Tuner):
    """Bayesian optimisation (scikit-optimize) with a Gaussian process and expected improvement.

    It uses skopt.Optimizer with the Gaussian process of gp_minimize, one point at a time, and
    recommends the lowest loss. The library's defaults of `candidates`, `polished` and `fits`
    (10000, 5 and 2) take several times as long and do not lower the errors on the bouncing ball.

    Attributes:
        initial: points before the first model, the start included.
        design: scikit-optimize's name of the design of the initial points.
        candidates: random points at which expected improvement is compared.
        polished: number of candidates that L-BFGS improves.
        fits: restarts of the fit of the hyper-parameters, beyond the first.
        noise: variance of the noise of losses, or "gaussian" to fit it: a jagged loss looks noisy.
    """

    name: ClassVar[str] = "bayes"
    requires = ("skopt",)

    initial: int = 5
    design: str = "sobol"
    candidates: int = 1000
    polished: int = 2
    fits: int = 0
    noise: float | str = "gaussian"

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one point at a time; the first one is the start.

        A failed simulation counts as the worst loss so far.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        with _ignore_skopt_warnings():
            optimiser = self.make_optimiser(task.dim, int(rng.integers(2**31)))
        point = task.start
        worst = 0.0
        while True:
            evaluation = yield np.array(point)[None]
            loss = float(evaluation.losses[0])
            # The library accepts no infinite loss; a very large one would flatten the process.
            if np.isfinite(loss):
                worst = max(worst, loss)
            else:
                loss = worst
            with _ignore_skopt_warnings():
                optimiser.tell([float(x) for x in point], loss)
                point = optimiser.ask()

    def make_optimiser(self, dim: int, seed: int) -> Any:
        """Make the library's optimiser of the unit cube with the options of this tuner.

        Args:
            dim: number of parameters.
            seed: seed of the library's random generator.
        """
        from skopt import Optimizer
        from skopt.utils import cook_estimator

        cube = [(0.0, 1.0)] * dim
        process = cook_estimator(
            "GP",
            space=cube,
            random_state=seed,
            n_restarts_optimizer=self.fits,
            noise=self.noise,
        )
        return Optimizer(
            cube,
            base_estimator=process,
            n_initial_points=self.initial,
            initial_point_generator=self.design,
            acq_func="EI",
            acq_optimizer="lbfgs",
            acq_optimizer_kwargs={
                "n_points": self.candidates,
                "n_restarts_optimizer": self.polished,
            },
            # Only the newest process is stored; by default all of them would be.
            model_queue_size=1,
            random_state=seed,
        )


class _ignore_skopt_warnings(warnings.catch_warnings):  # noqa: N801 - used like a function
    """Context manager that ignores scikit-optimize's warnings.

    It warns of each repeated point and of each fit that reaches a bound.
    """

    def __enter__(self) -> None:
        super().__enter__()
        warnings.simplefilter("ignore")
