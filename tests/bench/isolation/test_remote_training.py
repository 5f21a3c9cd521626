"""Tests of training in an isolated process: equal weights, and limits enforced by the harness."""

import numpy as np
import pytest

from bench.benchmark.isolation.process_errors import KilledExternallyError, RunEndedError
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from bench.benchmark.runner import tuner_process_start
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.runner.trained_weights import read_weights
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.core.plugin_registries import tuners
from methods.tuner import Tuner
from tests.bench.isolation.isolated_process import make_training_request
from tests.hostile_tuners.attack_arena import HERE
from tests.sample_experiments import spring_experiment

ATTACKING_LEARNERS = str(HERE / "learning_attacks.py")
pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    tuner_process_start.close_isolated_processes()


@pytest.fixture
def experiment():
    made = spring_experiment(tuners={"school": {}}, training_budget=20)
    load_plugins_for_experiment([ATTACKING_LEARNERS], made)
    return made


class Learned(Tuner):
    """In-process equivalent of the plugin's tuner `school`."""

    name = source_digest = "learned"
    learned = True
    trains_as = "school"

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.learned_mean = simulator.simulate(rng, points).mean(axis=0)

    def state(self):
        return {"mean": self.learned_mean}


def test_an_isolated_training_gives_the_weights_of_a_trusted_one_bit_for_bit(experiment):
    sealed = train_or_load(experiment, make_training_request("school"))
    tuners.register(Learned)
    entry = make_training_request("school").entry
    entry = type(entry)("learned", "learned")
    trusted = train_or_load(experiment, TrainingRequest(entry, 0))
    one, other = read_weights(sealed.path)["mean"], read_weights(trusted.path)["mean"]
    assert one.tobytes() == other.tobytes()
    assert sealed.simulations == trusted.simulations == 20
    assert 0.0 < sealed.seconds < 30.0


class RecordingCallback:
    """Training observer that records the calls made to it."""

    def __init__(self, problem):
        self.problem, self.epochs, self.ground_reads = problem, [], 0

    @property
    def ground(self):
        self.ground_reads += 1
        return CountedTrainingSimulator(self.problem, 10)

    def epoch(self, *epochs):
        self.epochs.append(epochs)


def test_a_callback_is_informed_and_changes_nothing(experiment, tmp_path, monkeypatch):
    from bench.benchmark.problem.tuning_problem import TuningProblem

    path = tmp_path / "watched.py"
    path.write_text(WATCHED)
    load_plugins_for_experiment([str(path)], spring_experiment(tuners={"telling": {}}))
    plain = read_weights(train_or_load(experiment, make_training_request("telling")).path)
    watch = RecordingCallback(TuningProblem(experiment))
    made = train_or_load(experiment, make_training_request("telling"), watch, anew=True)
    assert [epoch[:3] for epoch in watch.epochs] == [("first", 1, 2), ("sec\ufffdond", 2, 2)]
    assert np.isnan(watch.epochs[1][4])
    assert watch.ground_reads == 1
    assert made.simulations == 20, "what only measures is not counted"
    again = read_weights(made.path)
    assert {name: array.tobytes() for name, array in again.items()} == {
        name: array.tobytes() for name, array in plain.items()
    }


WATCHED = """
import numpy as np
from methods.tuner import BudgetExceededError, Tuner

class Telling(Tuner):
    learned = True

    def fit(self, simulator, rng, budget):
        seen = simulator.simulate(rng, simulator.sample(rng, budget))
        self.facts = [simulator.used, simulator.budget, simulator.dim, *simulator.lengths]
        for wrong, kind in (
            (simulator.training[1:], BudgetExceededError),
            (np.full((1, 2), 1.0), ValueError),
            (np.full((1, 2), np.nan), ValueError),
        ):
            try:
                simulator.simulate(rng, wrong)
                raise AssertionError("it was let")
            except kind:
                pass
        if self.watch is not None:
            ground = self.watch.ground
            assert ground.simulate(np.random.default_rng(0), ground.training).shape[0] == 2
            assert ground.used == 2 and simulator.used == 20
            self.watch.epoch("first", 1, 2, 0.5, 0.25)
            self.watch.epoch("sec\\x1bond", 2, 2, 0.5, float("nan"))
        self.mean = seen.mean(axis=0)

    def state(self):
        return {"mean": self.mean, "facts": np.array(self.facts, dtype=np.int64)}
"""


def test_what_the_stand_in_says_of_itself(experiment, tmp_path):
    path = tmp_path / "watched.py"
    path.write_text(WATCHED)
    load_plugins_for_experiment([str(path)], spring_experiment(tuners={"telling": {}}))
    facts = read_weights(train_or_load(experiment, make_training_request("telling")).path)["facts"]
    assert facts.tolist() == [20, 20, 2, 60]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("counter", "40 training simulations requested, 20 allowed"),
        ("fence", "inside the training range"),
        ("not-inside", "inside the training range"),
        ("streams", "not the state of a random generator"),
        ("huge", "bytes at once"),
        ("names", "invalid arrays"),
        ("keyword", "reserved names"),
        ("pickles", "expected numbers, found object"),
        ("watched", "a message of an unexpected kind"),
    ],
)
def test_a_training_that_cheats_fails_and_leaves_no_weights(name, reason, experiment, cache):
    with pytest.raises(RunEndedError, match=reason):
        train_or_load(experiment, make_training_request(name))
    assert not list(cache.glob("*")) if cache.exists() else True


def test_weights_of_a_trusted_tuner_are_not_those_of_an_isolated_one(experiment):
    from bench.benchmark.runner.tuner_training import compute_training_key

    entry = make_training_request("school").entry
    assert compute_training_key(experiment, entry, 0) != compute_training_key(
        experiment.chosen(trusted=True), entry, 0
    )


def test_a_training_that_is_made_again_after_a_kill_must_ask_for_the_same(experiment, monkeypatch):
    asked = []
    shift = 0.0

    def killed_once(self, rng, points):
        observations = simulate(self, rng, points - shift * len(asked))
        asked.append(points)
        if len(asked) == 1:
            raise KilledExternallyError("killed")
        return observations

    simulate = CountedTrainingSimulator.simulate
    monkeypatch.setattr(CountedTrainingSimulator, "simulate", killed_once)
    assert train_or_load(experiment, make_training_request("school")).simulations == 20
    np.testing.assert_array_equal(*asked)
    asked.clear()
    shift = 1e-10
    with pytest.raises(RunEndedError, match="requested other simulations"):
        train_or_load(experiment, make_training_request("school"), anew=True)


@pytest.mark.parametrize("is_lying", [False, True])
def test_an_installed_tuner_of_another_package_is_isolated_too(tmp_path, monkeypatch, is_lying):
    from importlib import metadata

    from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment

    (tmp_path / "their_package.py").write_text(THEIRS + OTHER_NAME * is_lying)
    about = tmp_path / "their_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[simgap.tuners]\ntheirs = their_package:Theirs\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(
        tuners, "_entry_points", {e.name: e for e in metadata.entry_points(group="simgap.tuners")}
    )
    tuner_process_start.close_isolated_processes()
    made = spring_experiment(tuners={"theirs": {}, "random": {}}, targets=1, ranges=["in"], seeds=1)
    load_plugins_for_experiment([], made)
    results = prepare_experiment(made)
    run_experiment(results, jobs=0)
    theirs, random = results.run_sink.statuses.values()
    assert (theirs.status, theirs.reason) == ("converged", "isolated")
    assert random.status == "done"
    import sys

    assert "their_package" not in sys.modules, "its code never ran here"


OTHER_NAME = """
from bench.benchmark.isolation.message_channel import MessageChannel

send = MessageChannel.send_document

def lie(channel, kind, document):
    if isinstance(document, list) and document and isinstance(document[0], dict):
        document = [{**document[0], "kind": "simulator", "name": "other"}]
    send(channel, kind, document)

MessageChannel.send_document = lie
"""
"""Code that describes the tuner as another part, so that the tuner itself would have no stub."""
THEIRS = """
import os
from methods.tuner import Tuner

class Theirs(Tuner):
    name = "theirs"

    def tune(self, task, rng):
        yield task.start
        try:
            os.fork()
        except OSError:
            return "isolated"
"""
