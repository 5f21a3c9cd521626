"""Tests of problems with several parameters: least squares reaches the noise limit."""

import numpy as np
import pytest
from scipy.stats import chi2

from bench.benchmark.problem.experiment_config import TunerEntry, load_experiment
from bench.benchmark.problem.fisher_information import compute_target_spectrum
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run
from bench.benchmark.runner.run_result_rows import build_rows


@pytest.mark.parametrize(
    ("name", "index", "budget", "predicts"),
    [
        ("ball-tilt", 2, 40, 0.002),
        ("pendulum-driven", 1, 60, 0.002),
        ("servo-friction", 0, 60, 0.001),
        pytest.param("arm-swing", 2, 120, 0.01, marks=pytest.mark.slow),
    ],
)
def test_true_parameters_are_recovered_up_to_the_noise(name, index, budget, predicts):
    experiment = load_experiment(name)
    problem = TuningProblem(experiment)
    target = draw_target(problem, "in", index)
    found = compute_target_spectrum(problem, target)
    order = RunRequest(
        "run", TunerEntry("least_squares", "least_squares"), 0, target.blinded, budget
    )
    columns = build_rows(problem, order, target, execute_run(experiment, order), found)
    delivered = np.array([columns[f"recommendation_{p.name}"][-1] for p in problem.cube.parameters])
    components = found.vectors.T @ (
        (delivered - target.truth) / problem.cube.compute_training_widths()
    )
    squares = (found.values * components**2)[found.is_stiff]
    assert squares.sum() < chi2.ppf(
        0.9999, found.is_stiff.sum()
    )  # in units of the Cramer-Rao bound
    assert columns["stiff_error"][-1] < 0.05
    assert columns["stiff_error"][-1] < 0.2 * columns["stiff_error"][0]
    assert columns["heldout_error"][-1] < predicts
    if name == "servo-friction":  # the sloppy direction is not identifiable and not needed
        assert columns["sloppy_error"][-1] > 0.1
    problem.close()
