import threading

import nlopt
import numpy as np
import pytest

from methods.tuner import Array
from methods.tuners.nelder_mead import NelderMead
from tests.methods.analytic_problems import (
    START,
    TRUE_PARAMETERS,
    problem,
    run,
    smooth,
)


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_proposes_what_the_bare_library_proposes(dim: int) -> None:
    task, evaluate = smooth(dim, 60)
    bare = []

    def objective(point: Array, gradient: Array) -> float:
        bare.append(point.copy())
        return float(evaluate(point[None])[1][0])

    optimiser = nlopt.opt(nlopt.LN_NELDERMEAD, dim)
    optimiser.set_lower_bounds(np.zeros(dim))
    optimiser.set_upper_bounds(np.ones(dim))
    optimiser.set_min_objective(objective)
    optimiser.set_maxeval(60)
    optimiser.optimize(START[:dim])
    assert (run(NelderMead(), task, evaluate).proposals == np.array(bare)).all()


def test_initial_step_is_nlopts() -> None:
    assert run(NelderMead(initial_step=0.2), *smooth(1, 2)).proposals[1, 0] == pytest.approx(
        START[0] + 0.2
    )


def test_collapsed_simplex_ends_the_run_with_a_reason_and_its_thread() -> None:
    trace = run(NelderMead(), *smooth(1, 5000))
    assert trace.status == "converged"
    assert "simplex" in trace.reason
    assert len(trace.losses) < 500
    assert not [thread for thread in threading.enumerate() if thread.name == "callback-optimiser"]


def test_step_tolerance_ends_the_run_earlier() -> None:
    fine, coarse = (
        run(NelderMead(step_tolerance=tolerance), *smooth(1, 500)) for tolerance in (0.0, 1e-3)
    )
    assert len(coarse.losses) < len(fine.losses)
    assert abs(coarse.recommendations[-1, 0] - TRUE_PARAMETERS[0]) < 2e-3


def test_constant_loss_ends() -> None:
    task, evaluate = problem(lambda theta: np.ones((3, 1)), TRUE_PARAMETERS[:2], START[:2], 5000)
    assert run(NelderMead(), task, evaluate).status == "converged"
