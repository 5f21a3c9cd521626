"""CMA-ES with margin-free defaults, by Optuna and the `cmaes` package.

Sources: N. Hansen, The CMA evolution strategy: a tutorial, arXiv:1604.00772; M. Nomura, M.
Shibata, cmaes: a simple yet practical Python library for CMA-ES, arXiv:2402.01373; T. Akiba et
al., Optuna, KDD 2019, doi:10.1145/3292500.3330701.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from methods.learning.library_optimisers import tune_with_optuna
from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class OptunaCMA(Tuner):
    """CMA-ES with Optuna's defaults (package `cmaes`, no margin); recommends the lowest loss.

    For one parameter Optuna draws independent samples instead.
    """

    name: ClassVar[str] = "optuna_cma"
    requires: ClassVar[tuple[str, ...]] = ("optuna", "cmaes")

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one point at a time; the first one is the start."""
        return tune_with_optuna(self._make_sampler, task, rng)

    def _make_sampler(self, seed: int) -> Any:
        from optuna.samplers import CmaEsSampler

        return CmaEsSampler(seed=seed, warn_independent_sampling=False)
