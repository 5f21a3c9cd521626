"""Learned tuners where the world has an effect that the simulator lacks: trained in the simulator
as it is, and over effects that the world may have; and whether intervals that a conformal
calibration gives them cover the truth.

Split-conformal intervals (H. Papadopoulos et al., ECML 2002; J. Lei et al., JASA 113, 2018, arXiv
1604.04173): on n simulations that the training has not seen, the size of the error in each
parameter is sorted; the ceil((n + 1) 0.9)-th smallest is the interval's half width. It covers 90 %
of the targets that come from where these simulations come from.

python -m tests.benchmarks.randomised results/reference/misspecified/learned.csv ball servo shot
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from bench.problem.entries import Entry
from bench.problem.experiment import load
from bench.problem.nuisance import Nuisance
from bench.problem.problem import Problem
from bench.problem.recorded import Side
from bench.problem.seeds import rng_for
from bench.runs.training import Lesson, train
from bench.runs.worker import Order, perform
from sims.files import write

TUNERS = ("regressor", "tunenet", "in_context")
TARGETS, CALIBRATION, BUDGET = 20, 60, 12
COVERED = 0.9


def halves(errors, covered=COVERED):
    """(dim,) half widths of split-conformal intervals, of sizes of errors (n, dim)."""
    n = len(errors)
    place = int(np.ceil((n + 1) * covered))
    if place > n:
        return np.full(errors.shape[1], np.inf)
    return np.sort(errors, axis=0)[place - 1]


def rehearsed(problem, randomised, index):
    """A target from where the tuner trains, and its truth (dim,) in the unit cube."""
    rng = rng_for("randomised", problem.experiment.name, index)
    scenarios = problem.scenarios(rng)
    low, high = problem.cube.training
    point = rng.uniform(low, high)
    simulate = problem.simulate
    if randomised:
        nuisance = Nuisance(problem)

        def simulate(points, scenarios):
            return nuisance.simulate(rng, points, scenarios)

    seen = simulate(point[None], scenarios)[0]
    seen = seen + problem.noise * rng.standard_normal(seen.shape)
    like = problem.target("in", 0).sealed
    nothing = Side((), np.empty((0, seen.shape[1])))
    fitting = Side(scenarios, seen)
    sealed = replace(like, name=f"in-{index:03d}", fitting=fitting, held_out=nothing)
    return sealed, problem.cube.physical(point)


def measured(name):
    """Rows of the table for one system."""
    experiment = load(f"misspecified-{name}")
    experiment = replace(experiment, calibration=None, trusted=True, salt="public", budget=BUDGET)
    problem = Problem(experiment)
    widths = problem.cube.training_widths()
    world = [problem.target("in", index) for index in range(TARGETS)]
    met = [(target.sealed, target.truth) for target in world]
    rows = []
    for tuner in TUNERS:
        for randomised in (False, True):
            entry = Entry(tuner, tuner, randomised=randomised)
            weights = train(experiment.chosen(tuners=(entry,)), Lesson(entry, 0)).path

            def errors(targets, entry=entry, weights=weights):
                found = []
                for sealed, truth in targets:
                    order = Order("r", entry, 0, sealed, BUDGET, weights, None, ())
                    trace = perform(experiment, order).trace
                    last = problem.cube.physical(trace.recommendations[-1:])[0]
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
    write(Path(out), frame.to_csv(index=False, float_format="%.4g"))
