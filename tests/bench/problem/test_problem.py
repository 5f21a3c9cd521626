"""The problems of several parameters can be solved: least squares ends where the data's own noise
lets it.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from bench.problem.experiment import Entry, load
from bench.problem.problem import Problem
from bench.runs.rows import rows
from bench.runs.worker import Order, perform


@pytest.mark.parametrize(
    ("name", "index", "budget", "predicts"),
    [
        ("ball-tilt", 2, 40, 0.002),
        ("pendulum-driven", 1, 60, 0.002),
        ("servo-friction", 0, 60, 0.001),
        pytest.param("arm-swing", 2, 120, 0.01, marks=pytest.mark.slow),
    ],
)
def test_truth_is_recovered_as_closely_as_the_noise_allows(name, index, budget, predicts):
    experiment = load(name)
    problem = Problem(experiment)
    target = problem.target("in", index)
    found = problem.spectrum(target)
    order = Order("run", Entry("least_squares", "least_squares"), 0, target.sealed, budget)
    columns = rows(problem, order, target, perform(experiment, order), found)
    delivered = np.array([columns[f"recommendation_{p.name}"][-1] for p in problem.cube.parameters])
    components = found.vectors.T @ ((delivered - target.truth) / problem.cube.training_widths())
    squares = (found.values * components**2)[found.stiff]
    assert squares.sum() < chi2.ppf(0.9999, found.stiff.sum())  # in units of the Cramer-Rao bound
    assert columns["stiff_error"][-1] < 0.05
    assert columns["stiff_error"][-1] < 0.2 * columns["stiff_error"][0]
    assert columns["heldout_error"][-1] < predicts
    if name == "servo-friction":  # what nobody could know is not known, and is not needed
        assert columns["sloppy_error"][-1] > 0.1
    problem.close()
