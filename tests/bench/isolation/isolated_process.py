"""Helpers that run tuners in isolated processes without a comparison."""

from dataclasses import replace

import pytest

from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.runner import tuner_process_start
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run, get_problem
from bench.benchmark.runner.tuner_training import TrainingRequest
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

PROBE = str(PLUGINS / "probe.py")


def run_isolated(code, files=(), memory=0):
    """Run code in an isolated process and return its result as text."""
    tuned = TunerSpec("probe", "", PROBE, {"code": code})
    house = tuner_process_start.get_fork_server()
    child = house.start_process(
        "bench.benchmark.isolation.tuner_server:serve_requests", [PROBE, *map(str, files)], memory
    )
    try:
        trace = _run(child, tuned)
    finally:
        child.end()
    assert trace.status == "converged", trace.reason
    return trace.reason


def _run(child, tuned):
    import numpy as np

    from bench.benchmark.isolation.tuner_processes import IsolatedRun, IsolatedTuner
    from bench.benchmark.runner.tuner_loop import drive_tuner
    from methods.tuner import Task

    observed, scale = np.zeros((3, 1)), np.ones(1)
    start, training = np.full(2, 0.5), np.array([[0.0, 0.0], [1.0, 1.0]])
    task = Task(2, start, observed, scale, training, 3, (3,))

    def evaluate(points):
        return np.zeros((len(points), 3, 1)), np.zeros(len(points))

    run = IsolatedRun(IsolatedTuner(child, tuned), np.zeros(8, np.uint32), 20.0)
    return drive_tuner(run, task, evaluate, np.random.default_rng(0))


def held():
    """Return the isolation layers that are active on this machine."""
    child = tuner_process_start.get_fork_server().start_process(
        "bench.benchmark.isolation.tuner_server:serve_requests"
    )
    child.wait_until_ready()
    child.end()
    return child.seals


def need(layer):
    """Skip a test, visibly, if an isolation layer is not available."""
    if layer not in held():
        pytest.skip(f"no isolation layer {layer} on this machine: {ISOLATION_LAYERS[layer]}")


def experiment(name, **changes):
    """Create an experiment with one tuner of the probe plugin, and load the plugin."""
    tuners = {name: {}}
    made = spring_experiment(tuners=tuners, targets=2, ranges=["in"], budget=4, **changes)
    load_plugins_for_experiment([PROBE], made)
    return made


def outcome(experiment, seed=0, target=0):
    """Execute one run of the experiment."""
    (entry,) = experiment.tuners
    target_data = draw_targets(get_problem(experiment))[target].blinded
    order = RunRequest("run", entry, seed, target_data, experiment.budget)
    return execute_run(experiment, replace(order, tuned=tuner_process_start.make_tuner_spec(entry)))


def make_training_request(name, **options):
    """Return a training request for a registered tuner."""
    entry = TunerEntry(name, name, options)
    return TrainingRequest(entry, 0, tuner_process_start.make_tuner_spec(entry))
