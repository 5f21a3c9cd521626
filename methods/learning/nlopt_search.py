"""Minimise a loss in the unit cube with a derivative-free algorithm of nlopt."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from methods.tuner import Array, Task


def minimise_with_nlopt(
    algorithm: str,
    loss: Callable[[Array], float],
    task: Task,
    step_tolerance: float = 0.0,
    initial_step: float | None = None,
    failed_loss: float = np.inf,
) -> str:
    """Run an algorithm from the task's start until it converges; return what it reached.

    Args:
        algorithm: nlopt's name of it.
        loss: loss of a point; not finite if the simulation failed.
        task: task of the target.
        step_tolerance: nlopt's absolute tolerance on the parameters; 0 for the limit of rounding.
        initial_step: first step, in the unit cube; None for nlopt's choice.
        failed_loss: loss that represents a failed simulation.
    """
    import nlopt

    def objective(point: Array, gradient: Array) -> float:  # noqa: ARG001 - nlopt's signature
        value = loss(point)
        # NaN cannot be ordered.
        return value if np.isfinite(value) else failed_loss

    optimiser = nlopt.opt(getattr(nlopt, algorithm), task.dim)
    optimiser.set_lower_bounds(np.zeros(task.dim))
    optimiser.set_upper_bounds(np.ones(task.dim))
    optimiser.set_min_objective(objective)
    optimiser.set_xtol_abs(step_tolerance)
    if initial_step is not None:
        optimiser.set_initial_step(initial_step)
    try:
        optimiser.optimize(task.start)
    except nlopt.RoundoffLimited:
        # With a tolerance of 0 this is the usual end, and not an error.
        return "reached the limit of rounding"
    return "reached its tolerance"
