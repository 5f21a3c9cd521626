"""Measure the cost of the harness compared with a bare loop over the same work.

An evaluation uses `drive_tuner` and `ProposalEvaluator`. Run with `make benchmark`. The bare loop
draws the same proposals and calls the same simulator; the difference is the cost of the harness:
budget, checks, unit cube, loss, recommendation, timing, rows. The simulators are one without cost,
and the spring in closed form.
"""

from __future__ import annotations

import json
import statistics
import sys
from time import perf_counter

import numpy as np

from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.tuning_problem import ProposalEvaluator, TuningProblem
from bench.benchmark.runner.run_in_worker import RunOutcome, RunRequest
from bench.benchmark.runner.run_result_rows import build_rows
from bench.benchmark.runner.tuner_loop import drive_tuner
from bench.core.plugin_registries import load_plugins
from methods.tuner import Task, Tuner
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

EVALUATIONS = 5000
REPEATS = 7


class Drawing(Tuner):
    """Proposes prepared points, so that the tuner itself costs almost nothing."""

    def __init__(self, points):
        self.points = points

    def tune(self, task, rng):
        steps = iter(self.points)
        while (point := next(steps, None)) is not None:
            yield point
        yield task.start


def bare(points, problem, scenario):
    """Time the bare loop: map to physical units and simulate."""
    low, span = problem.cube._low, problem.cube._span
    simulate = problem.simulator.simulate
    started = perf_counter()
    for point in points:
        simulate((low + point * span)[None], scenario)
    return perf_counter() - started


def harnessed(points, problem, is_isolated):
    task = Task(
        problem.cube.dim, is_isolated.start, is_isolated.fitting.observed, problem.scale,
        problem.cube.training,
        len(points), (len(is_isolated.fitting.observed),),
    )  # fmt: skip
    evaluator = ProposalEvaluator(problem, is_isolated.fitting)
    started = perf_counter()
    trace = drive_tuner(Drawing(points), task, evaluator, np.random.default_rng(0))
    seconds = perf_counter() - started
    assert trace.status == "done"
    assert len(trace.losses) == len(points)
    return seconds, trace, evaluator


def measure(problem, name):
    target = draw_targets(problem)[0]
    points = np.random.default_rng(0).uniform(size=(EVALUATIONS, problem.cube.dim))
    costs, ratios, scoring = [], [], []
    for _ in range(REPEATS):
        plain = bare(points, problem, target.blinded.fitting.scenarios[0])
        seconds, trace, evaluator = harnessed(points, problem, target.blinded)
        costs.append((seconds - plain) / EVALUATIONS * 1e6)
        ratios.append(seconds / plain)
        started = perf_counter()
        rmse = evaluator.compute_rmse(trace.proposals, trace.recommendations)
        request = RunRequest(
            "run", TunerEntry("drawing", "drawing"), 0, target.blinded, EVALUATIONS
        )
        build_rows(problem, request, target, RunOutcome(trace, rmse, None, 0.0))
        scoring.append((perf_counter() - started) / EVALUATIONS * 1e6)
    return {
        "simulator": name,
        "harness_microseconds_an_evaluation": round(statistics.median(costs), 2),
        "ratio_to_bare_loop": round(statistics.median(ratios), 2),
        "scoring_and_rows_microseconds_an_evaluation": round(statistics.median(scoring), 2),
    }


def make_problems():
    """Return problems by the name of their simulator: one that only returns data, and a spring."""
    load_plugins([PLUGINS / "spring.py"])
    experiment = spring_experiment(targets=1, sampling={"rate": 60.0, "samples": 400})
    spring, nothing = TuningProblem(experiment), TuningProblem(experiment)
    fixed = spring.simulate(np.full((1, 2), 0.5), draw_targets(spring)[0].blinded.fitting.scenarios)
    nothing.simulator.simulate = lambda theta, scenario: fixed
    return {"none": nothing, "spring, 400 samples": spring}


def main():
    for name, problem in make_problems().items():
        print(json.dumps(measure(problem, name)))


if __name__ == "__main__":
    sys.exit(main())
