from itertools import pairwise

import numpy as np
import pytest

from methods.tuner import Array, Evaluation
from methods.tuners.least_squares import EvaluationHistory, LeastSquares, _Damping
from tests.methods.analytic_problems import (
    START,
    TRUE_PARAMETERS,
    decays,
    errors,
    logistic,
    problem,
    run,
    smooth,
)

PLAIN = LeastSquares(horizons=(1.0,), secant=False, difference=1e-6, damping=1e-12, restart=False)


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_convergence_is_quadratic_with_finite_differences(dim: int) -> None:
    found = errors(PLAIN, decays, TRUE_PARAMETERS[:dim], START[:dim], 6 * (dim + 1))
    newton = found[1 :: dim + 1]  # the start, then after each step
    assert 0.1 < newton[0] < 0.4
    for before, after in pairwise(newton[:4]):
        assert after < max(1.2 * before**2, 1e-11)
    assert newton[4] < 1e-9


def test_secant_updates_need_fewer_simulations_than_finite_differences() -> None:
    def needed(tuner: LeastSquares) -> int:
        return int((errors(tuner, decays, TRUE_PARAMETERS, START, 100) > 1e-6).sum())

    secant = needed(LeastSquares(horizons=(1.0,)))
    assert secant < 30
    assert secant < needed(LeastSquares(horizons=(1.0,), secant=False))


@pytest.mark.parametrize("true_parameter", [0.2, 0.5, 0.83])
def test_growing_horizon_fits_what_is_chaotic_in_the_long_run(true_parameter: float) -> None:
    start = np.array([0.6])
    assert errors(LeastSquares(), logistic, np.array([true_parameter]), start, 25)[-1] < 1e-10
    assert (
        errors(LeastSquares(horizons=(1.0,)), logistic, np.array([true_parameter]), start, 25)[-1]
        > 1e-3
    )


def test_horizon_is_a_share_of_each_run() -> None:
    task, _ = problem(decays, TRUE_PARAMETERS[:2], START[:2], 5, observed=np.zeros((6, 2)))
    task = type(task)(2, task.start, task.observed, task.scale, task.training, 5, (4, 2))
    assert (
        EvaluationHistory(task, 0.0).select_samples(0.5).tolist()
        == [True] * 4 + [False] * 4 + [True] * 2 + [False] * 2
    )
    assert EvaluationHistory(task, 0.0).select_samples(1.0).all()


def test_finite_differences_are_one_batch_and_step_inward_at_the_border() -> None:
    task, evaluate = problem(decays, TRUE_PARAMETERS[:3], np.array([1.0, 0.5, 0.0]), 20)
    steps = LeastSquares(difference=0.1).tune(task, np.random.default_rng(0))
    first = np.asarray(next(steps))
    moved = np.asarray(steps.send(Evaluation(first, *evaluate(first))))
    assert np.allclose(moved - first, np.diag([-0.1, 0.1, 0.1]), atol=1e-15)
    steps.close()


def test_minimum_outside_the_cube_leaves_the_others_free() -> None:
    outside = np.array([1.2, 0.4])
    task, evaluate = problem(decays, outside, START[:2], 40)
    best = run(LeastSquares(restart=False), task, evaluate).recommendations[-1]
    edge = np.linspace(0.0, 1.0, 2001)
    losses = evaluate(np.column_stack([np.ones_like(edge), edge]))[1]
    assert best[0] == 1.0
    assert best[1] == pytest.approx(edge[losses.argmin()], abs=1e-3)


def test_parameters_that_only_act_together_are_survived() -> None:
    task, evaluate = problem(
        lambda theta: decays(theta[:1] + theta[1:]), np.array([0.2, 0.3]), START[:2], 30
    )
    trace = run(LeastSquares(), task, evaluate)
    assert trace.losses.min() < 1e-10
    assert trace.recommendations[-1].sum() == pytest.approx(0.5, abs=1e-8)


def test_parameter_without_effect_stays_where_it_is() -> None:
    trace = run(
        LeastSquares(),
        *problem(lambda theta: decays(theta[:1]), TRUE_PARAMETERS[:2], START[:2], 30),
    )
    assert trace.recommendations[-1] == pytest.approx([TRUE_PARAMETERS[0], START[1]], abs=1e-8)


def test_new_start_leaves_a_plateau() -> None:
    def flat_below(theta: Array) -> Array:
        return decays(np.maximum(theta, 0.5))

    found = [
        errors(LeastSquares(), flat_below, np.array([0.8]), np.array([0.2]), 20, seed)[-1]
        for seed in range(5)
    ]
    assert max(found) < 1e-8


def test_new_start_leaves_a_local_minimum() -> None:
    def two_valleys(theta: Array) -> Array:
        x = theta[0]
        return np.array(
            [[(x - 0.8) * (1.0 + 4.0 * (x - 0.3) ** 2)], [1.5 * np.sin(6.0 * (x - 0.8))]]
        )

    true_parameter, start = np.array([0.8]), np.array([0.05])
    alone = LeastSquares(restart=False, horizons=(1.0,))
    assert errors(alone, two_valleys, true_parameter, start, 40)[-1] > 0.1
    assert errors(LeastSquares(horizons=(1.0,)), two_valleys, true_parameter, start, 40)[-1] < 1e-8


def test_new_starts_are_far_from_what_was_tried() -> None:
    task, _ = smooth(1, 5)
    record = EvaluationHistory(task, 0.0, tried=[np.array([0.0]), np.array([0.5])])
    assert record.find_untried_point(np.random.default_rng(0))[0] == pytest.approx(1.0, abs=0.05)


def test_noise_leaves_the_least_squares_estimate() -> None:
    noisy = decays(TRUE_PARAMETERS[:2]) + 0.01 * np.random.default_rng(0).standard_normal((30, 2))
    task, evaluate = problem(decays, TRUE_PARAMETERS[:2], START[:2], 60, observed=noisy)
    trace = run(LeastSquares(), task, evaluate)
    best = trace.recommendations[-1]
    around = best + 1e-3 * np.random.default_rng(1).standard_normal((200, 2))
    assert trace.losses.min() < (1.0 + 1e-5) * evaluate(around)[1].min()
    assert trace.losses.min() == pytest.approx(0.01, rel=0.2)
    assert trace.status == "done"


def test_ends_when_the_target_is_reproduced() -> None:
    trace = run(LeastSquares(), *smooth(2, 100))
    assert trace.status == "converged"
    assert trace.reason == "the simulation reproduces the target"
    assert len(trace.losses) < 25


def test_failed_simulation_quarters_the_step() -> None:
    damping = _Damping(0.0)
    damping.adapt(np.nan)
    assert 1.0 / (1.0 + damping.mu) == pytest.approx(0.25)
    damping.adapt(np.nan)
    assert 1.0 / (1.0 + damping.mu) == pytest.approx(1.0 / 16.0)


def test_damping_follows_nielsen() -> None:
    damping = _Damping(1.0)
    damping.adapt(1.0)
    assert damping.mu == pytest.approx(1.0 / 3.0)
    damping.adapt(-1.0)
    damping.adapt(-1.0)
    assert damping.mu == pytest.approx(8.0 / 3.0)
    damping.adapt(0.5)
    assert (damping.mu, damping.nu) == (pytest.approx(8.0 / 3.0), 2.0)
