"""Uniform random search, the yardstick below which no tuner should fall.

Source: J. Bergstra, Y. Bengio, Random search for hyper-parameter optimization, JMLR 13, 2012, pages
281-305.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class RandomSearch(Tuner):
    """Random search: the start, then uniform points of the cube; recommends the lowest loss.

    No tuner should be worse.
    """

    name = "random"
    known_failures = {"check_beats_random_search": "it is random search"}  # noqa: RUF012

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one random point at a time, without end.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        yield task.start[None]
        while True:
            yield rng.uniform(size=(1, task.dim))
