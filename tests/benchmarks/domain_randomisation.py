"""Test learned tuners if the true system has an effect that the simulator lacks.

They are trained in the base simulator, and over effects that the true system may have.
Split-conformal intervals (H. Papadopoulos et al., ECML 2002; J. Lei et al., JASA 113, 2018, arXiv
1604.04173) are tested for coverage: the absolute errors of each parameter on n simulations outside
the training data are sorted; the ceil((n + 1) 0.9)-th smallest is the half width of the interval.
It covers 90 % of the targets that have the same distribution as these simulations.

python -m tests.benchmarks.domain_randomisation results/reference/misspecified/learned.csv ball
servo shot
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import TunerEntry, load_experiment
from bench.benchmark.problem.experiment_recording import ObservedRuns
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.training_simulator import RandomisedSimulator
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.core.random_streams import make_rng
from sims.core.files import write_atomically

TUNERS = ("regressor", "tunenet", "in_context")
TARGETS, CALIBRATION, BUDGET = 20, 60, 12
COVERED = 0.9


def halves(errors, covered=COVERED):
    """Return half widths (dim,) of split-conformal intervals from absolute errors (n, dim)."""
    n = len(errors)
    place = int(np.ceil((n + 1) * covered))
    if place > n:
        return np.full(errors.shape[1], np.inf)
    return np.sort(errors, axis=0)[place - 1]


def rehearsed(problem, randomised, index):
    """Draw a target from the training distribution, and its true parameters (dim,) in physical
    units."""
    rng = make_rng("randomised", problem.experiment.name, index)
    scenarios = problem.draw_scenarios(rng)
    low, high = problem.cube.training
    point = rng.uniform(low, high)
    simulate = problem.simulate
    if randomised:
        nuisance = RandomisedSimulator(problem)

        def simulate(points, scenarios):
            return nuisance.simulate(rng, points, scenarios)

    seen = simulate(point[None], scenarios)[0]
    seen = seen + problem.noise * rng.standard_normal(seen.shape)
    like = draw_target(problem, "in", 0).blinded
    nothing = ObservedRuns((), np.empty((0, seen.shape[1])))
    fitting = ObservedRuns(scenarios, seen)
    sealed = replace(like, name=f"in-{index:03d}", fitting=fitting, held_out=nothing)
    return sealed, problem.cube.to_physical(point)


def measured(name):
    """Return the rows of the table for one system."""
    experiment = load_experiment(f"misspecified-{name}")
    experiment = replace(experiment, calibration=None, trusted=True, salt="public", budget=BUDGET)
    problem = TuningProblem(experiment)
    widths = problem.cube.compute_training_widths()
    world = [draw_target(problem, "in", index) for index in range(TARGETS)]
    met = [(target.blinded, target.truth) for target in world]
    rows = []
    for tuner in TUNERS:
        for randomised in (False, True):
            entry = TunerEntry(tuner, tuner, randomised=randomised)
            weights = train_or_load(
                experiment.chosen(tuners=(entry,)), TrainingRequest(entry, 0)
            ).path

            def errors(targets, entry=entry, weights=weights):
                found = []
                for sealed, truth in targets:
                    order = RunRequest("r", entry, 0, sealed, BUDGET, weights, None, ())
                    trace = execute_run(experiment, order).trace
                    last = problem.cube.to_physical(trace.recommendations[-1:])[0]
                    found.append((last - truth) / widths)
                return np.array(found)

            apart = [rehearsed(problem, randomised, index) for index in range(CALIBRATION)]
            half = halves(np.abs(errors(apart)))
            away = errors(met)
            rows.append(
                {
                    "system": name,
                    "tuner": tuner,
                    "randomised": randomised,
                    "targets": TARGETS,
                    "error": np.abs(away).mean(),
                    "error_sigma": np.abs(away).mean(axis=1).std(ddof=1) / np.sqrt(TARGETS),
                    "half_width": half.mean(),
                    "covered": (np.abs(away) <= half).mean(),
                }
            )
            print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    out, *systems = sys.argv[1:]
    frame = pd.DataFrame([row for name in systems for row in measured(name)])
    write_atomically(Path(out), frame.to_csv(index=False, float_format="%.4g"))
