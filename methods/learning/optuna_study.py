"""Run an Optuna sampler as a tuner: ask for a point, tell its loss."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from methods.tuner import Task, TunerGenerator


def tune_with_optuna(
    make_sampler: Callable[[int], Any], task: Task, rng: np.random.Generator
) -> TunerGenerator:
    """Propose the points of an Optuna study, the task's start first.

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
