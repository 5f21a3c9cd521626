"""Particle swarm optimisation, by nevergrad.

Sources: J. Kennedy, R. Eberhart, Particle swarm optimization, ICNN 1995,
doi:10.1109/ICNN.1995.488968; M. Zambrano-Bigiarini, M. Clerc, R. Rojas, Standard particle swarm
optimisation 2011, CEC 2013, doi:10.1109/CEC.2013.6557848.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.library_optimisers import tune_with_nevergrad
from methods.tuner import Task, Tuner, TunerGenerator


@dataclass(eq=False)
class ParticleSwarm(Tuner):
    """Particle swarm with nevergrad's defaults (40 particles); recommends the lowest loss."""

    name: ClassVar[str] = "pso"
    requires: ClassVar[tuple[str, ...]] = ("nevergrad",)
    known_failures: ClassVar[dict[str, str]] = {
        "check_easy_problem_is_improved": "its first 40 particles are a random design"
    }

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose one point at a time; the first one is the start."""
        return tune_with_nevergrad("PSO", task, rng)
