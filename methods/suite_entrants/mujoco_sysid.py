"""Least squares of mujoco.sysid, the system identification toolbox of MuJoCo.

Sources: E. Todorov et al., IROS 2012; https://github.com/google-deepmind/mujoco, python/sysid.
"""

import importlib
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.tuner import Array, Task, Tuner, TunerGenerator, from_callback


@dataclass(eq=False)
class MuJoCoSysId(Tuner):
    """Least squares of mujoco.sysid (defaults), from the start; works with every simulator."""

    name: ClassVar[str] = "mujoco_sysid"
    requires: ClassVar[tuple[str, ...]] = ("mujoco", "colorama", "plotly")  # mujoco[sysid]
    stochastic: ClassVar[bool] = False

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Pass the toolbox's points to the harness, finite differences in one batch."""

        def minimise(residuals: Callable[[Array], Array]) -> str:
            """Minimise the N residuals (n, N) of n points (n, dim); return why it stopped."""
            os.environ.setdefault("MUJOCO_GL", "disable")  # else MuJoCo looks for a display
            sysid = importlib.import_module("mujoco.sysid")  # it has no types
            cube = sysid.ParameterDict()
            cube.add(sysid.Parameter("cube", task.start, np.zeros(task.dim), np.ones(task.dim)))
            # Points are in columns; one group of residuals, no predictions and no data are needed.
            compute_groups = lambda x, _: ([residuals(x.reshape(task.dim, -1).T).T], None, None)  # noqa: E731
            sysid.optimize(cube, compute_groups, verbose=False, output=io.StringIO())
            return "mujoco.sysid reached its tolerance"

        return from_callback(minimise, task.compute_finite_residuals)
