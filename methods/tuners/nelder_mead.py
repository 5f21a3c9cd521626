"""Nelder and Mead's simplex in a box, as nlopt has it (LN_NELDERMEAD).

Sources: J. A. Nelder, R. Mead, A simplex method for function minimization, The Computer Journal
7(4), 1965, doi:10.1093/comjnl/7.4.308; the treatment of bounds: M. J. Box, The Computer Journal
8(1), 1965, doi:10.1093/comjnl/8.1.42; S. G. Johnson, The NLopt nonlinear-optimization package,
https://github.com/stevengj/nlopt.

The simplex has dim + 1 corners. The worst is reflected through the middle of the others, and the
new one is expanded, contracted, or all shrink towards the best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from methods.learning.library_optimisers import minimise_with_nlopt
from methods.tuner import Array, Task, Tuner, TunerGenerator, from_callback


@dataclass(eq=False)
class NelderMead(Tuner):
    """Nelder-Mead simplex in a box (LN_NELDERMEAD of nlopt); recommends the lowest loss.

    Attributes:
        initial_step: edge of the first simplex at the start, a share of the cube; None for nlopt's
            choice, which depends on the distance from the bounds.
        step_tolerance: nlopt's absolute tolerance on the parameters; 0 continues to the limit of
            rounding.
    """

    requires = ("nlopt",)
    stochastic = False

    initial_step: float | None = None
    step_tolerance: float = 0.0

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Pass nlopt's points to the harness one by one.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: unused; the method is deterministic.
        """
        return from_callback(lambda loss: self._minimise(task, loss))

    def _minimise(self, task: Task, loss: Callable[[Array], float]) -> str:
        step = self.initial_step
        reached = minimise_with_nlopt("LN_NELDERMEAD", loss, task, self.step_tolerance, step)
        return f"the simplex {reached}"
