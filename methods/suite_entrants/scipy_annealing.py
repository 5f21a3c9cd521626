"""Dual annealing (generalised simulated annealing with a local search), by SciPy.

Sources: Y. Xiang, D. Sun, W. Fan, X. Gong, Generalized simulated annealing algorithm and its
application to the Thomson model, Physics Letters A 233, 1997; SciPy,
doi:10.1038/s41592-019-0686-2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.tuner import Array, Task, Tuner, TunerGenerator, from_callback


@dataclass(eq=False)
class DualAnnealing(Tuner):
    """Dual annealing and local search with SciPy's defaults, from the start."""

    name: ClassVar[str] = "scipy_annealing"
    requires: ClassVar[tuple[str, ...]] = ("scipy",)

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Pass SciPy's points to the harness one by one; SciPy calls back for the loss of each."""

        def minimise(loss: Callable[[Array], float]) -> str:
            """Minimise the loss over the unit cube with dual annealing; return why it stopped."""
            from scipy.optimize import dual_annealing

            bounds = [(0.0, 1.0)] * task.dim
            return str(dual_annealing(loss, bounds, x0=task.start, rng=rng).message[0])

        return from_callback(minimise)
