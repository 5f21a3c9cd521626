"""Run a nevergrad optimiser as a tuner: ask for a point, tell its loss."""

from __future__ import annotations

import numpy as np

from methods.learning.library_isolation import isolated_library_call
from methods.tuner import Task, TunerGenerator

_FAILED_LOSS = 1e300
"""Loss that represents a failed simulation; nevergrad refuses infinite losses."""


def _to_float(value: object) -> float:
    """Convert a number, or an array of one element."""
    return float(np.asarray(value).item())


def tune_with_nevergrad(method: str, task: Task, rng: np.random.Generator) -> TunerGenerator:
    """Propose the points of a nevergrad optimiser, the task's start first.

    Args:
        method: name in nevergrad's registry of optimisers.
        task: task of the target.
        rng: random generator of the run.
    """
    with isolated_library_call(rng):
        import nevergrad
        from nevergrad.optimization import metamodel

        # nevergrad 1.0.12 converts arrays of one element by float(), which NumPy 2.4 refuses.
        metamodel.float = _to_float
        # The start may lie on a bound, where the default transform of bounds is not defined.
        box = nevergrad.p.Array(init=np.clip(task.start, 1e-6, 1.0 - 1e-6))
        box.set_bounds(0.0, 1.0)
        box.random_state.seed(int(rng.integers(2**31)))
        optimiser = nevergrad.optimizers.registry[method](box, budget=max(task.budget, 2))
        candidate = box.spawn_child()
    evaluation = yield task.start
    while True:
        with isolated_library_call(rng):
            loss = float(evaluation.losses[0])
            optimiser.tell(candidate, loss if np.isfinite(loss) else _FAILED_LOSS)
            candidate = optimiser.ask()
        evaluation = yield np.array(candidate.value, dtype=np.float64)
