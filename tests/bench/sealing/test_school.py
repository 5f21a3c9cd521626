"""Training in a process of its own: the same weights, counted and fenced on the other side."""

import numpy as np
import pytest

from bench.registry import tuners
from bench.runs import housing
from bench.runs.survey import admit
from bench.runs.training import Lesson, train, weights_of
from bench.sealing.ended import EndedError
from methods.base import Tuner
from tests.bench.sealing.room import lesson
from tests.cheats.arena import HERE
from tests.experiments import spring_experiment

SCHOOL = str(HERE / "school.py")
pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    housing.close()


@pytest.fixture
def experiment():
    made = spring_experiment(tuners={"school": {}}, training_budget=20)
    admit([SCHOOL], made)
    return made


class Learned(Tuner):
    """As `school` of the plugin, here."""

    name = source_digest = "learned"
    learned = True
    trains_as = "school"

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.learned_mean = simulator.simulate(rng, points).mean(axis=0)

    def state(self):
        return {"mean": self.learned_mean}


def test_a_sealed_training_gives_the_weights_of_a_trusted_one_bit_for_bit(experiment):
    sealed = train(experiment, lesson("school"))
    tuners.register(Learned)
    entry = lesson("school").entry
    entry = type(entry)("learned", "learned")
    trusted = train(experiment, Lesson(entry, 0))
    one, other = weights_of(sealed.path)["mean"], weights_of(trusted.path)["mean"]
    assert one.tobytes() == other.tobytes()
    assert sealed.simulations == trusted.simulations == 20
    assert 0.0 < sealed.seconds < 30.0


class Watch:
    """Looks on, and notes what it is told."""

    def __init__(self, problem):
        self.problem, self.told, self.asked = problem, [], 0

    @property
    def ground(self):
        self.asked += 1
        return self.problem.practice(10)

    def epoch(self, *told):
        self.told.append(told)


def test_who_looks_on_is_told_and_changes_nothing(experiment, tmp_path, monkeypatch):
    from bench.problem.problem import Problem

    path = tmp_path / "watched.py"
    path.write_text(WATCHED)
    admit([str(path)], spring_experiment(tuners={"telling": {}}))
    plain = weights_of(train(experiment, lesson("telling")).path)
    watch = Watch(Problem(experiment))
    made = train(experiment, lesson("telling"), watch, anew=True)
    assert [told[:3] for told in watch.told] == [("first", 1, 2), ("sec\ufffdond", 2, 2)]
    assert np.isnan(watch.told[1][4])
    assert watch.asked == 1
    assert made.simulations == 20, "what only measures is not counted"
    again = weights_of(made.path)
    assert {name: array.tobytes() for name, array in again.items()} == {
        name: array.tobytes() for name, array in plain.items()
    }


WATCHED = """
import numpy as np
from methods.base import BudgetExceededError, Tuner

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
    admit([str(path)], spring_experiment(tuners={"telling": {}}))
    facts = weights_of(train(experiment, lesson("telling")).path)["facts"]
    assert facts.tolist() == [20, 20, 2, 60]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("counter", "40 training simulations asked, 20 allowed"),
        ("fence", "inside the training range"),
        ("not-inside", "inside the training range"),
        ("streams", "no state of a random stream"),
        ("huge", "bytes at once"),
        ("names", "no arrays"),
        ("keyword", "cannot be kept by the names"),
        ("pickles", "expected numbers, found object"),
        ("watched", "what nobody asked for"),
    ],
)
def test_a_training_that_cheats_fails_and_leaves_no_weights(name, says, experiment, cache):
    with pytest.raises(EndedError, match=says):
        train(experiment, lesson(name))
    assert not list(cache.glob("*")) if cache.exists() else True


def test_weights_that_a_trusted_tuner_learned_are_not_those_of_a_sealed_one(experiment):
    from bench.runs.training import key

    entry = lesson("school").entry
    assert key(experiment, entry, 0) != key(experiment.chosen(trusted=True), entry, 0)


def test_a_training_that_is_made_again_after_a_kill_must_ask_for_the_same(experiment, monkeypatch):
    from bench.problem.practice import Practice
    from bench.sealing.ended import KilledError

    asked = []

    def killed_once(self, rng, points):
        asked.append(points)
        if len(asked) == 1:
            raise KilledError("killed")
        return simulate(self, rng, points)

    simulate = Practice.simulate
    monkeypatch.setattr(Practice, "simulate", killed_once)
    assert train(experiment, lesson("school")).simulations == 20
    np.testing.assert_array_equal(*asked)
    asked.clear()
    drawn = iter(range(10))
    monkeypatch.setattr("bench.runs.training.digest", lambda *_, **__: str(next(drawn)))
    with pytest.raises(EndedError, match="asked for other simulations"):
        train(experiment, lesson("school"), anew=True)


def test_an_installed_tuner_of_another_package_is_sealed_too(tmp_path, monkeypatch):
    from importlib import metadata

    from bench.runs.runner import prepare, run

    (tmp_path / "their_package.py").write_text(THEIRS)
    about = tmp_path / "their_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[simgap.tuners]\ntheirs = their_package:Theirs\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(
        tuners, "_entries", {e.name: e for e in metadata.entry_points(group="simgap.tuners")}
    )
    housing.close()
    made = spring_experiment(tuners={"theirs": {}, "random": {}}, targets=1, ranges=["in"], seeds=1)
    admit([], made)
    results = prepare(made)
    run(results, jobs=0)
    theirs, random = results.kept.statuses.values()
    assert (theirs.status, theirs.reason) == ("converged", "sealed")
    assert random.status == "done"
    import sys

    assert "their_package" not in sys.modules, "its code never ran here"


THEIRS = """
import os
from methods.base import Tuner

class Theirs(Tuner):
    name = "theirs"

    def tune(self, task, rng):
        yield task.start
        try:
            os.fork()
        except OSError:
            return "sealed"
"""
