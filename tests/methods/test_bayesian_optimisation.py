import warnings

import numpy as np
import pytest
from skopt import Optimizer
from skopt.learning.gaussian_process.kernels import ConstantKernel, Matern
from skopt.utils import cook_estimator

from methods.tuners.bayesian_optimisation import BayesianOptimisation
from tests.methods.analytic_problems import START, run, smooth


@pytest.mark.parametrize("dim", [1, 3])
def test_proposes_what_the_bare_library_proposes(dim: int) -> None:
    task, evaluate = smooth(dim, 14)
    seed = int(np.random.default_rng(5).integers(2**31))
    point, bare = START[:dim].tolist(), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        process = cook_estimator(
            "GP", space=[(0.0, 1.0)] * dim, random_state=seed, n_restarts_optimizer=0
        )
        library = Optimizer(
            [(0.0, 1.0)] * dim,
            process,
            n_initial_points=5,
            initial_point_generator="sobol",
            acq_func="EI",
            acq_optimizer_kwargs={"n_points": 1000, "n_restarts_optimizer": 2},
            random_state=seed,
        )
        for _ in range(14):
            bare.append(point)
            library.tell(point, float(evaluate(np.array([point]))[1][0]))
            point = library.ask()
    assert (run(BayesianOptimisation(), task, evaluate, seed=5).proposals == np.array(bare)).all()


def test_process_is_that_of_gp_minimize() -> None:
    optimiser = BayesianOptimisation(design="random").make_optimiser(2, 0)
    kernel = optimiser.base_estimator_.kernel
    assert isinstance(kernel.k1, ConstantKernel)
    assert isinstance(kernel.k2, Matern)
    assert kernel.k2.nu == 2.5
    assert optimiser.base_estimator_.noise == "gaussian"
    assert optimiser.acq_optimizer == "lbfgs"


def test_repeated_points_are_not_reported_as_warnings() -> None:
    trace = run(BayesianOptimisation(candidates=50), *smooth(1, 45))  # warnings are errors here
    assert len(trace.losses) == 45
