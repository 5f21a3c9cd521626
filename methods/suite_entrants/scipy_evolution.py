"""Differential evolution, by SciPy.

Sources: R. Storn, K. Price, Differential evolution, Journal of Global Optimization 11, 1997,
doi:10.1023/A:1008202821328; SciPy, doi:10.1038/s41592-019-0686-2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.tuner import Array, Task, Tuner, TunerGenerator, from_callback


@dataclass(eq=False)
class DifferentialEvolution(Tuner):
    """Differential evolution with SciPy's defaults and the start in its first generation."""

    name: ClassVar[str] = "scipy_de"
    requires: ClassVar[tuple[str, ...]] = ("scipy",)
    known_failures: ClassVar[dict[str, str]] = {
        "check_beats_random_search": "the first 15 points per parameter are a random design"
    }

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Pass SciPy's points to the harness one by one."""

        def minimise(loss: Callable[[Array], float]) -> str:
            """Minimise the loss by differential evolution in the unit cube; return why it stops."""
            from scipy.optimize import Bounds, differential_evolution

            box = Bounds(np.zeros(task.dim), np.ones(task.dim))
            return str(differential_evolution(loss, box, x0=task.start, rng=rng).message)

        return from_callback(minimise)
