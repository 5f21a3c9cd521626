"""Tests of isolated runs: state kept between runs, timing, and how a run ends."""

import numpy as np
import psutil
import pytest

from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.problem.tuning_problem import ProposalEvaluator
from bench.benchmark.runner import tuner_process_start
from tests.bench.isolation.isolated_process import experiment, outcome
from tests.kill_and_resume import below

pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


@pytest.fixture(autouse=True)
def no_process_is_left():
    # Tests of other files may have left idle processes that wait for further runs.
    tuner_process_start.close_isolated_processes()
    yield
    tuner_process_start.close_isolated_processes()
    assert not below([psutil.Process()], "tuner")


@pytest.mark.parametrize(("isolation", "seen"), [("run", [0, 0, 0, 0]), ("tuner", [0, 1, 0, 1])])
def test_a_process_serves_one_run_or_all_of_a_seed(isolation, seen):
    made = experiment("remembering", isolation=isolation)
    runs = [(0, 0), (0, 1), (1, 0), (1, 1)]
    reasons = [outcome(made, seed, target).trace.reason for seed, target in runs]
    assert reasons == [f"saw {n}" for n in seen]
    waiting = below([psutil.Process()], "tuner")
    assert bool(waiting) == (isolation == "tuner")


def test_all_of_a_tuners_time_counts_by_the_harnesss_clock():
    made = experiment("late")
    trace = outcome(made).trace
    assert trace.status == "done", trace.reason
    seconds = trace.tuner_seconds
    assert seconds[0] >= 0.02
    assert (seconds[1:] >= 0.01).all()
    assert seconds[-1] >= 0.01 + 0.05, "what comes behind the last simulation is part of it"
    assert (trace.simulator_seconds > 0.0).all()


@pytest.mark.parametrize("exits", ["os._exit(137)", "os._exit(0)", "os._exit(143)"])
def test_who_leaves_as_if_killed_gets_no_other_try(exits):
    made = experiment("probe")
    entry = TunerEntry("probe", "probe", {"code": f"import os\n{exits}"})
    made = made.chosen(tuners=(entry,))
    trace = outcome(made).trace
    assert trace.status == "crashed"
    assert "exited with code" in trace.reason


class Killing(ProposalEvaluator):
    """Evaluator that kills the tuner process once, while its second proposal is simulated."""

    calls = 0

    def __call__(self, points):
        Killing.calls += 1
        if Killing.calls == 2:
            (process,) = below([psutil.Process()], "tuner")
            process.kill()
        return super().__call__(points)


@pytest.mark.parametrize("name", ["random", "drawing"])
def test_a_run_that_is_made_again_after_a_kill_must_ask_for_the_same(name, monkeypatch):
    made = experiment(name)
    undisturbed = outcome(made).trace
    monkeypatch.setattr(Killing, "calls", 0)
    monkeypatch.setattr("bench.benchmark.runner.run_in_worker.ProposalEvaluator", Killing)
    trace = outcome(made).trace
    if name == "random":
        assert Killing.calls == 2 + 4
        np.testing.assert_array_equal(trace.proposals, undisturbed.proposals)
    else:
        assert (trace.status, Killing.calls) == ("crashed", 2)
        assert "requested other simulations" in trace.reason


def test_tuners_end_with_their_fork_server_and_another_is_started():
    made = experiment("remembering", isolation="tuner")
    outcome(made)
    (tuner,) = below([psutil.Process()], "tuner")
    (nursery,) = below([psutil.Process()], "nursery")
    nursery.kill()
    psutil.wait_procs([tuner], timeout=5.0)
    assert not tuner.is_running()
    assert outcome(made).trace.reason == "saw 0"
    assert below([psutil.Process()], "nursery") != [nursery]
