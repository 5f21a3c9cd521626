"""Compile the recursions of the filter, the smoother and the effects during installation.

The first command then need not compile them. `make install` runs `python -m
bench.diagnosis.kalman.precompile`.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.kalman.kalman_recursions import LinearRuns, filter_runs, smooth_runs
from sims.effects.compiled_recursions import LINEAR, run_recursion


def precompile() -> None:
    """Run the recursions of tiny examples, so that their code is compiled and stored.

    Otherwise the first command would wait for the compiler.
    """
    # One run of two samples, with one channel, two states and one force.
    states, forces = np.ones((1, 1, 2, 2)), np.ones((1, 1, 2, 1))
    runs = LinearRuns(
        states=states,
        defects=np.zeros((1, 1, 2)),
        forces=forces,
        inputs=forces,
        readings=np.ones((1, 2, 1, 2)),
        residuals=np.zeros((1, 2, 1)),
        recorded=np.ones((1, 2, 1), dtype=bool),
        prior=np.ones(2),
        jumps=np.zeros((1, 1, 2)),
    )
    force, white = np.ones(1), np.ones(1)
    smooth_runs(runs, filter_runs(runs, force, white), force)
    run_recursion(LINEAR, np.ones((1, 1)), np.ones((1, 1)), np.ones((1, 1)))


if __name__ == "__main__":
    precompile()
