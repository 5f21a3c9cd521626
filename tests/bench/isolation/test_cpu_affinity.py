"""Tests of long time limits and of random numbers in isolated processes."""

import os

import pytest

from bench.benchmark.isolation.message_channel import MessageChannel
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.runner import tuner_process_start
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run, get_problem
from tests.sample_experiments import spring_experiment

GLOBAL = """
import numpy as np
from methods.tuner import Tuner

AT_ONCE = "numpy.random" in __import__("sys").modules


class Careless(Tuner):
    name = "careless"

    def tune(self, task, rng):
        assert AT_ONCE
        while True:
            yield np.random.uniform(size=(1, task.dim))
"""


@pytest.mark.parametrize("seconds", [1e9, 1e300])
def test_a_limit_of_years_is_waited_for(seconds):
    reading, writing = os.pipe()
    one = MessageChannel(reading, writing)
    one.send(b"K", deadline=seconds)
    assert one.receive(deadline=seconds).kind == b"K"
    one.close()


def test_random_numbers_are_loaded_ahead_and_yet_others_in_each_run(
    tmp_path, spring, fresh_registries
):
    assert spring.name == "spring"
    path = tmp_path / "careless.py"
    path.write_text(GLOBAL)
    experiment = spring_experiment(budget=2, timeout=1e9)
    load_plugins_for_experiment([str(path)], experiment)
    entry = TunerEntry("careless", "careless")
    target = draw_targets(get_problem(experiment))[0].blinded
    order = RunRequest("run", entry, 0, target, 2, tuned=tuner_process_start.make_tuner_spec(entry))
    first, second = (execute_run(experiment, order).trace for _ in range(2))
    tuner_process_start.close_isolated_processes()
    assert first.status == second.status == "done", first.reason
    assert (first.proposals != second.proposals).all()
