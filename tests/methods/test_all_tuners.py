"""Tests of properties common to all search methods that no conformance check of a tuner covers.

`tests/conformance/test_registered.py` applies these checks to every registered tuner.
"""

import numpy as np
import pytest

from methods.tuner import Array, Tuner
from methods.tuners.bayesian_optimisation import BayesianOptimisation
from methods.tuners.cma_es import CMAES
from methods.tuners.entropy_search import EntropySearch
from methods.tuners.least_squares import LeastSquares
from methods.tuners.nelder_mead import NelderMead
from methods.tuners.random_search import RandomSearch
from tests.methods.analytic_problems import (
    START,
    TRUE_PARAMETERS,
    decays,
    errors,
    problem,
    run,
    smooth,
)

TUNERS = [
    RandomSearch(),
    NelderMead(),
    CMAES(),
    BayesianOptimisation(),
    EntropySearch(),
    LeastSquares(),
    LeastSquares(horizons=(1.0,), secant=False, difference=1e-4),
]
each = pytest.mark.parametrize(
    "tuner", TUNERS, ids=[f"{tuner.name}-{i}" for i, tuner in enumerate(TUNERS)]
)


def beyond(true_parameters: Array) -> Array:
    """Return a target that no parameters reproduce, so that no tuner stops early."""
    target = decays(true_parameters)
    target[::2] += 0.1
    target[1::2] -= 0.1
    return target


@each
def test_starts_at_the_start(tuner: Tuner) -> None:
    for dim in (1, 2, 5):
        assert (run(tuner, *smooth(dim, 1)).proposals[0] == START[:dim]).all()


@pytest.mark.parametrize(
    ("tuner", "dim", "budget", "error", "seeds"),
    [
        (BayesianOptimisation(), 1, 20, 1.5e-2, 1),
        (BayesianOptimisation(), 2, 35, 3e-2, 1),
        (CMAES(), 1, 200, 1e-3, 5),
        (CMAES(), 2, 300, 1e-3, 5),
        (CMAES(), 5, 1000, 1e-2, 5),
        (EntropySearch(), 2, 40, 2e-2, 3),
        (LeastSquares(), 1, 10, 1e-8, 1),
        (LeastSquares(), 2, 14, 1e-8, 1),
        (LeastSquares(), 5, 35, 1e-8, 1),
        (NelderMead(), 1, 40, 1e-6, 1),
        (NelderMead(), 2, 120, 1e-6, 1),
        (NelderMead(), 5, 600, 1e-4, 1),
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_converges(tuner: Tuner, dim: int, budget: int, error: float, seeds: int) -> None:
    truth, start = TRUE_PARAMETERS[:dim], START[:dim]
    ends = [errors(tuner, decays, truth, start, budget, seed)[-1] for seed in range(seeds)]
    assert np.median(ends) < error


@each
def test_another_seed_is_another_run_where_the_tuner_says_so(tuner: Tuner) -> None:
    budget = 14 if tuner.name in {"bayes", "entropy_search"} else 60
    task, evaluate = problem(
        decays, TRUE_PARAMETERS[:2], START[:2], budget, observed=beyond(TRUE_PARAMETERS[:2])
    )
    first, other = run(tuner, task, evaluate, seed=3), run(tuner, task, evaluate, seed=4)
    assert (first.proposals == other.proposals).all() == (not tuner.stochastic)


@each
def test_failed_simulations_are_survived(tuner: Tuner) -> None:
    def fails_above(theta: Array) -> Array:
        return decays(theta) if theta[0] < 0.5 else np.full((30, len(theta)), np.nan)

    task, evaluate = problem(fails_above, TRUE_PARAMETERS[:2], np.array([0.49995, 0.3]), 30)
    trace = run(tuner, task, evaluate)
    assert np.isnan(trace.losses).any()
    assert np.nanmin(trace.losses) < 0.1 * np.sqrt((task.observed**2).mean())


@each
def test_flat_loss_is_survived(tuner: Tuner) -> None:
    task, evaluate = problem(
        lambda theta: np.ones((9, 1)), TRUE_PARAMETERS[:1], START[:1], 30, np.zeros((9, 1))
    )
    assert len(run(tuner, task, evaluate).losses) >= 2


@each
def test_missing_samples_are_survived(tuner: Tuner) -> None:
    observed = decays(TRUE_PARAMETERS[:1])
    observed[::3] = np.nan
    task, evaluate = problem(decays, TRUE_PARAMETERS[:1], START[:1], 30, observed)
    assert run(tuner, task, evaluate).losses.min() < 0.005


def test_search_beats_chance_in_five_dimensions() -> None:
    def final(tuner: Tuner, seeds: int) -> float:
        return float(
            np.mean([run(tuner, *smooth(5, 40), seed).losses.min() for seed in range(seeds)])
        )

    chance = final(RandomSearch(), 50)
    assert final(LeastSquares(), 1) < 1e-6 * chance
    for tuner in (NelderMead(), BayesianOptimisation(), EntropySearch()):
        assert final(tuner, 1) < 0.8 * chance
