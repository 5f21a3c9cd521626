import cma
import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.tuner import Array, Evaluation
from methods.tuners.cma_es import CMAES
from tests.methods.analytic_problems import (
    START,
    TRUE_PARAMETERS,
    problem,
    run,
    smooth,
)

PUBLISHED = CMAES(sigma=0.1, population=10, recommend="mean", evaluate_start=False)


@pytest.mark.parametrize("population", [None, 10])
def test_proposes_what_the_bare_library_proposes(population: int | None) -> None:
    task, evaluate = smooth(3, 200)
    bare: list[Array] = []

    def objective(point: Array) -> float:
        bare.append(np.array(point))
        return float(evaluate(np.array(point)[None])[1][0])

    rng = np.random.default_rng(7)
    options = {
        "bounds": [0, 1],
        "verbose": -9,
        "maxfevals": 190,
        "seed": np.nan,
        "randn": lambda *n: rng.normal(size=n),
    }
    if population:
        options["popsize"] = population
    cma.fmin2(objective, START[:3], 0.25, options, eval_initial_x=True)
    trace = run(CMAES(population=population), task, evaluate, seed=7)
    assert np.array_equal(trace.proposals[:180], bare[:180])


def test_a_single_parameter_is_simulated_alone() -> None:
    trace = run(CMAES(), *smooth(1, 50))
    assert trace.proposals.shape == (50, 1)
    assert len(np.unique(trace.proposals)) == 50


def test_mean_is_recommended_after_each_generation() -> None:
    task, evaluate = smooth(2, 40)
    found = run(PUBLISHED, task, evaluate).recommendations
    assert (found[:10] == START[:2]).all()
    for generation in range(4):
        same = found[10 * generation : 10 * generation + 10]
        assert np.ptp(same, axis=0).max() < 1e-12
    best = run(CMAES(sigma=0.1, population=10, evaluate_start=False), task, evaluate)
    assert best.recommendations[-1].tolist() == best.proposals[best.losses.argmin()].tolist()
    assert best.recommendations[-1].tolist() != found[-1].tolist()


def test_restarts_with_twice_the_population_when_pycma_stops() -> None:
    flat = problem(
        lambda theta: np.ones((3, 1)),
        TRUE_PARAMETERS[:2],
        START[:2],
        400,
        observed=np.zeros((3, 1)),
    )
    steps = CMAES().tune(flat[0], np.random.default_rng(0))
    sizes, seen = [], next(steps)
    for _ in range(30):
        points = np.asarray(seen)
        sizes.append(len(points))
        seen = steps.send(Evaluation(points, *flat[1](points)))
    assert sizes[0] == 1
    assert sorted(set(sizes[1:])) == [6, 12, 24, 48, 96, 192, 384, 400]  # at most the budget
    trace = drive_tuner(CMAES(restarts=False), *flat, np.random.default_rng(0))
    assert trace.status == "converged"
    assert trace.reason.startswith("pycma: tol")
