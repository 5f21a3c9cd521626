"""Tree-structured Parzen estimator, by Optuna.

Sources: J. Bergstra, R. Bardenet, Y. Bengio, B. Kegl, Algorithms for hyper-parameter optimization,
NeurIPS 2011; T. Akiba et al., Optuna, KDD 2019, doi:10.1145/3292500.3330701.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from methods.learning.library_optimisers import tune_with_optuna
from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class OptunaTPE(Tuner):
    """Tree-structured Parzen estimator with Optuna's defaults; recommends the lowest loss.

    Attributes:
        multivariate: model the parameters jointly, as Optuna's authors recommend.
    """

    name: ClassVar[str] = "optuna_tpe"
    requires: ClassVar[tuple[str, ...]] = ("optuna",)

    multivariate: bool | None = None

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one point at a time; the first one is the start."""
        return tune_with_optuna(self._make_sampler, task, rng)

    def _make_sampler(self, seed: int) -> Any:
        from optuna.samplers import TPESampler

        return TPESampler(seed=seed, multivariate=self.multivariate)
