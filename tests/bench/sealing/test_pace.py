"""What a run in a process of its own may take, and what its process begins with."""

import os

import pytest

from bench.problem.experiment import Entry
from bench.runs import housing
from bench.runs.survey import admit
from bench.runs.worker import Order, perform, problem_of
from bench.sealing.wire import Channel
from tests.experiments import spring_experiment

GLOBAL = """
import numpy as np
from methods.base import Tuner

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
    one = Channel(reading, writing)
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
    admit([str(path)], experiment)
    entry = Entry("careless", "careless")
    target = problem_of(experiment).targets()[0].sealed
    order = Order("run", entry, 0, target, 2, tuned=housing.tuned_of(entry))
    first, second = (perform(experiment, order).trace for _ in range(2))
    housing.close()
    assert first.status == second.status == "done", first.reason
    assert (first.proposals != second.proposals).all()
