"""BOBYQA, by nlopt.

Sources: M. J. D. Powell, The BOBYQA algorithm for bound constrained optimization without
derivatives, DAMTP 2009/NA06, Cambridge, 2009; S. G. Johnson, The NLopt package,
https://github.com/stevengj/nlopt.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.library_optimisers import minimise_with_nlopt
from methods.tuner import Task, Tuner, TunerGenerator, from_callback


@dataclass(eq=False)
class BOBYQA(Tuner):
    """BOBYQA (nlopt): quadratic models of the loss in a trust region, from the start.

    Attributes:
        step_tolerance: tolerance on the parameters at which it stops, in the unit cube.
    """

    name: ClassVar[str] = "bobyqa"
    requires: ClassVar[tuple[str, ...]] = ("nlopt",)
    stochastic: ClassVar[bool] = False

    step_tolerance: float = 1e-12

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Pass nlopt's points to the harness one by one."""
        tolerance = self.step_tolerance
        return from_callback(lambda loss: minimise_with_nlopt("LN_BOBYQA", loss, task, tolerance))
