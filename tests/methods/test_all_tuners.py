"""Tests of properties common to all search methods."""

import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.tuner import Array, Evaluation, Proposal, Tuner
from methods.tuners.bayesian_optimisation import BayesianOptimisation
from methods.tuners.cma_es import CMAES
from methods.tuners.entropy_search import EntropySearch
from methods.tuners.least_squares import LeastSquares
from methods.tuners.nelder_mead import NelderMead
from methods.tuners.random_search import RandomSearch
from tests.methods.analytic_problems import START, TRUE_PARAMETERS, decays, problem, run, smooth

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
def test_budget_is_exact(tuner: Tuner) -> None:
    for dim in (1, 3):
        for budget in range(1, 8):
            trace = run(
                tuner,
                *problem(
                    decays,
                    TRUE_PARAMETERS[:dim],
                    START[:dim],
                    budget,
                    beyond(TRUE_PARAMETERS[:dim]),
                ),
            )
            assert len(trace.losses) == budget


@each
def test_starts_at_the_start(tuner: Tuner) -> None:
    for dim in (1, 2, 5):
        assert (run(tuner, *smooth(dim, 1)).proposals[0] == START[:dim]).all()


@each
@pytest.mark.parametrize("dim", [1, 2, 10])
def test_proposals_lie_in_the_cube_before_the_harness_moves_them(tuner: Tuner, dim: int) -> None:
    rng = np.random.default_rng(5)
    truth, start = rng.uniform(size=dim), rng.integers(2, size=dim).astype(float)
    task, evaluate = problem(decays, truth, start, 24, beyond(truth))
    steps = tuner.tune(task, np.random.default_rng(0))
    asked, used = next(steps), 0
    while used < 24:
        points = np.atleast_2d(asked.points if isinstance(asked, Proposal) else asked)
        assert points.shape[1] == dim
        assert points.min() >= 0.0
        assert points.max() <= 1.0
        used += len(points)
        asked = steps.send(Evaluation(points, *evaluate(points)))
    steps.close()


@each
def test_same_seed_same_run_whatever_ran_before(tuner: Tuner) -> None:
    task, evaluate = smooth(2, 14)
    first = run(tuner, task, evaluate, seed=3)
    run(tuner, task, evaluate, seed=4)
    again = run(tuner, task, evaluate, seed=3)
    assert (first.proposals == again.proposals).all()
    assert (first.recommendations == again.recommendations).all()


@each
def test_another_seed_is_another_run_where_the_tuner_says_so(tuner: Tuner) -> None:
    budget = 14 if tuner.name in {"bayes", "entropy_search"} else 60
    task, evaluate = problem(
        decays, TRUE_PARAMETERS[:2], START[:2], budget, observed=beyond(TRUE_PARAMETERS[:2])
    )
    first, other = run(tuner, task, evaluate, seed=3), run(tuner, task, evaluate, seed=4)
    assert (first.proposals == other.proposals).all() == (not tuner.stochastic)


@each
def test_global_random_state_is_neither_changed_nor_used(tuner: Tuner) -> None:
    task, evaluate = smooth(2, 14)
    np.random.seed(1)  # noqa: NPY002 - the global state is what is tested
    before = np.random.get_state()  # noqa: NPY002
    first = run(tuner, task, evaluate)
    after = np.random.get_state()  # noqa: NPY002
    assert (before[1] == after[1]).all()
    assert before[2:] == after[2:]
    np.random.seed(2)  # noqa: NPY002
    assert (run(tuner, task, evaluate).proposals == first.proposals).all()


@each
def test_options_are_all_that_a_tuner_keeps(tuner: Tuner) -> None:
    before = dict(vars(tuner))
    run(tuner, *smooth(2, 12))
    assert vars(tuner) == before


@each
def test_failed_simulations_are_survived(tuner: Tuner) -> None:
    def fails_above(theta: Array) -> Array:
        return decays(theta) if theta[0] < 0.5 else np.full((30, len(theta)), np.nan)

    task, evaluate = problem(fails_above, TRUE_PARAMETERS[:2], np.array([0.49995, 0.3]), 30)
    trace = run(tuner, task, evaluate)
    assert np.isnan(trace.losses).any()
    assert np.nanmin(trace.losses) < 0.1 * np.sqrt((task.observed**2).mean())


@each
def test_nothing_but_failed_simulations_is_survived(tuner: Tuner) -> None:
    task, evaluate = problem(
        lambda theta: np.full((30, 2), np.nan),
        TRUE_PARAMETERS[:2],
        START[:2],
        30,
        decays(TRUE_PARAMETERS[:2]),
    )
    trace = drive_tuner(tuner, task, evaluate, np.random.default_rng(0))
    assert trace.status == "diverged", trace.reason
    assert (trace.recommendations == START[:2]).all()


@each
def test_flat_loss_is_survived(tuner: Tuner) -> None:
    trace = run(
        tuner,
        *problem(
            lambda theta: np.ones((9, 1)),
            TRUE_PARAMETERS[:1],
            START[:1],
            30,
            observed=np.zeros((9, 1)),
        ),
    )
    assert len(trace.losses) >= 2


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
