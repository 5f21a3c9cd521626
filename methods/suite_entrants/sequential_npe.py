"""Sequential neural posterior estimation (SNPE-C), by sbi, from the target's own simulations.

Sources: D. Greenberg, M. Nonnenmacher, J. Macke, Automatic posterior transformation for
likelihood-free inference, ICML 2019, arXiv:1905.07488; A. Tejero-Cantero et al., sbi, JOSS 5(52),
2020, doi:10.21105/joss.02505.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.posterior_rounds import PosteriorRounds
from methods.tuner import Proposal, Task, Tuner, TunerGenerator


@dataclass(eq=False)
class SequentialNPE(Tuner):
    """Sequential neural posterior estimation (SNPE-C of sbi); recommends the posterior mean.

    Attributes:
        rounds: number of rounds, each with draws from the posterior so far.
    """

    name: ClassVar[str] = "snpe"
    requires: ClassVar[tuple[str, ...]] = ("torch", "sbi")

    rounds: int = 4

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one round of points per yield; the first one is uniform, with the start."""
        posterior = PosteriorRounds(task)
        points = rng.uniform(size=(max(task.budget // self.rounds, 1), task.dim))
        points[0] = task.start
        while True:
            evaluation = yield Proposal(points, recommend=posterior.mean)
            points = posterior.update(evaluation, len(points), rng)
