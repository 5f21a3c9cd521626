"""Tests of processes that are killed from outside: their work is repeated with the same result."""

import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

from bench.benchmark.isolation.process_errors import KilledExternallyError
from bench.benchmark.isolation.temporary_folders import create_locked_folder, remove_stale_folders
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.runner import retry_after_kill, tuner_process_start
from bench.benchmark.runner.plugin_inspection import inspect_plugins, load_plugins_for_experiment
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run, get_problem
from bench.benchmark.runner.trained_weights import read_weights
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from sims.core.simulator import InputError
from tests.kill_and_resume import ISOLATION_PROCESSES, below
from tests.sample_experiments import spring_experiment

SLOW = """
import time
import numpy as np
from methods.tuner import Tuner

time.sleep(0.5)


class Slow(Tuner):
    name = "slow"
    learned = True

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        time.sleep(0.2)
        self.seen = simulator.simulate(rng, points)

    def state(self):
        return {"seen": self.seen}

    def restore(self, state):
        self.seen = state["seen"]

    def tune(self, task, rng):
        while True:
            time.sleep(0.1)
            yield rng.uniform(size=(1, task.dim))
"""


@pytest.fixture
def slow(tmp_path, spring, fresh_registries):
    path = tmp_path / "slow.py"
    path.write_text(SLOW)
    experiment = spring_experiment(budget=4, training_budget=5, simulator=spring.name)
    yield experiment, str(path)
    tuner_process_start.close_isolated_processes()


class Killing:
    """Kill the first process of a kind, 0.05 s after a tuner process is seen."""

    def __init__(self, what):
        self._what, self.killed = what, 0
        self._thread = threading.Thread(target=self._kill)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._thread.join()

    def _kill(self):
        until = time.monotonic() + 10.0
        while not self.killed and time.monotonic() < until:
            tuners = below([psutil.Process()], "tuner")
            if not tuners:
                time.sleep(0.01)
                continue
            time.sleep(0.05)
            with suppress(psutil.NoSuchProcess, IndexError):
                below([psutil.Process()], self._what)[0].kill()
                self.killed += 1


@pytest.mark.slow
@pytest.mark.parametrize("what", ISOLATION_PROCESSES)
def test_what_is_killed_is_made_again_with_the_same_result(slow, what):
    experiment, path = slow
    with Killing(what) as killing:
        known = inspect_plugins([path], [])
    assert killing.killed == 1
    assert [tuner["name"] for tuner in known[0].parts] == ["slow"]
    load_plugins_for_experiment([path], experiment)
    entry = TunerEntry("slow", "slow")
    lesson = TrainingRequest(entry, 0, tuner_process_start.make_tuner_spec(entry))
    undisturbed = read_weights(train_or_load(experiment, lesson, anew=True).path)
    with Killing(what) as killing:
        disturbed = read_weights(train_or_load(experiment, lesson, anew=True).path)
    assert killing.killed == 1
    np.testing.assert_array_equal(disturbed["seen"], undisturbed["seen"])
    weights = train_or_load(experiment, lesson).path
    target = draw_targets(get_problem(experiment))[0].blinded
    order = RunRequest(
        "run", entry, 0, target, 4, weights, tuner_process_start.make_tuner_spec(entry)
    )
    undisturbed = execute_run(experiment, order).trace
    with Killing(what) as killing:
        disturbed = execute_run(experiment, order).trace
    assert killing.killed == 1
    assert disturbed.status == undisturbed.status == "done", disturbed.reason
    np.testing.assert_array_equal(disturbed.recommendations, undisturbed.recommendations)


@pytest.mark.parametrize("kills", [2, 3])
def test_a_check_of_the_isolation_is_repeated_as_often_as_a_run(monkeypatch, kills):
    ends = iter([KilledExternallyError("killed")] * kills + [("process",)])

    def looked():
        match next(ends):
            case KilledExternallyError() as killed:
                raise killed
            case held:
                return held

    monkeypatch.setattr(tuner_process_start, "_find_active_layers", looked)
    # Call the undecorated function, because another test may have cached its result.
    look = tuner_process_start.list_active_isolation_layers.__wrapped__
    if kills < retry_after_kill.MAX_RETRIES:
        assert look() == ("process",)
    else:
        with pytest.raises(
            InputError, match=r"a process of their own here: killed, 3 times; .*--trust"
        ):
            look()


ALONE = """
import sys, time
from bench.benchmark.runner import retry_after_kill, tuner_process_start
tuner_process_start.get_fork_server()
print("there", flush=True)
time.sleep(60)
"""


def test_folders_whose_processes_were_all_killed_are_cleared_by_the_next(tmp_path, monkeypatch):
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", ALONE]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE)
    assert process.stdout.readline()
    (nursery,) = below([psutil.Process(process.pid)], "nursery")
    (left,) = tmp_path.iterdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    remove_stale_folders()
    assert left.exists()
    for one in (nursery, process):
        one.kill()
    process.stdout.close()
    process.wait()
    assert left.exists()
    folder = create_locked_folder()
    assert list(tmp_path.iterdir()) == [Path(folder.path)]
    folder.remove()
    assert not list(tmp_path.iterdir())
