"""NGOpt, the meta-optimiser of nevergrad, which chooses a method by dimension and budget.

Sources: L. Meunier et al., Black-box optimization revisited: improving algorithm selection wizards
through massive benchmarking, IEEE TEVC 26(3), 2022, arXiv:2010.04542; J. Rapin, O. Teytaud,
Nevergrad, https://github.com/facebookresearch/nevergrad.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.library_optimisers import tune_with_nevergrad
from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class NevergradNGOpt(Tuner):
    """NGOpt, nevergrad's choice of a method by dimension and budget; recommends the lowest loss."""

    name: ClassVar[str] = "nevergrad_ngopt"
    requires: ClassVar[tuple[str, ...]] = ("nevergrad",)

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one point at a time; the first one is the start."""
        return tune_with_nevergrad("NGOpt", task, rng)
