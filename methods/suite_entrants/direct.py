"""DIRECT, by nlopt.

Sources: D. R. Jones, C. D. Perttunen, B. E. Stuckman, Lipschitzian optimization without the
Lipschitz constant, JOTA 79, 1993, doi:10.1007/BF00941892; J. M. Gablonsky, C. T. Kelley, A
locally-biased form of the DIRECT algorithm, Journal of Global Optimization 21, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.library_optimisers import minimise_with_nlopt
from methods.tuner import Task, Tuner, TunerGenerator, from_callback

FAILED_LOSS = 1e6
"""Loss of a failed simulation, in place of infinity."""


@dataclass(eq=False)
class DIRECT(Tuner):
    """DIRECT (nlopt): locally biased division of the cube into boxes, from its centre."""

    name: ClassVar[str] = "direct"
    requires: ClassVar[tuple[str, ...]] = ("nlopt",)
    stochastic: ClassVar[bool] = False

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Pass nlopt's points to the harness one by one."""
        # nlopt's DIRECT stops at an infinite loss.
        return from_callback(
            lambda loss: minimise_with_nlopt("GN_DIRECT_L", loss, task, failed_loss=FAILED_LOSS)
        )
