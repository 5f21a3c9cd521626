"""Run optimisers of nevergrad, nlopt and Optuna as tuners, in the unit cube."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from methods.learning.library_isolation import isolated_library_call
from methods.tuner import Array, Task, TunerGenerator

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


def tune_with_optuna(
    make_sampler: Callable[[int], Any], task: Task, rng: np.random.Generator
) -> TunerGenerator:
    """Propose the points of an Optuna study, the task's start first, and tell it each loss.

    Args:
        make_sampler: makes the sampler from a seed.
        task: task of the target.
        rng: random generator of the run.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    names = [f"x{i}" for i in range(task.dim)]
    box: dict[str, Any] = {name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in names}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Experimental options of Optuna warn.
        study = optuna.create_study(sampler=make_sampler(int(rng.integers(2**31))))
    study.enqueue_trial(dict(zip(names, task.start.tolist(), strict=True)))
    while True:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trial = study.ask(box)
        evaluation = yield np.array([trial.params[name] for name in names])
        loss = float(evaluation.losses[0])
        if np.isfinite(loss):
            study.tell(trial, loss)
        else:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
