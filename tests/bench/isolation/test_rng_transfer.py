"""Tests of random streams, which depend on tuner, target and seed, and of the number of runs."""

import itertools

import numpy as np
import pytest

from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment
from bench.benchmark.runner.trained_weights import WeightsError
from bench.core.plugin_registries import tuners
from methods.tuner import Tuner
from tests.sample_experiments import spring_experiment

pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


class Drawing(Tuner):
    name = source_digest = "drawing"

    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(1, task.dim))


class AlsoDrawing(Drawing):
    name = source_digest = "also_drawing"


class Learned(Tuner):
    """Tuner that learns two random numbers and proposes them."""

    name = source_digest = "learned"
    learned, stochastic = True, False

    def fit(self, simulator, rng, budget):
        self.numbers = rng.uniform(size=2)

    def state(self):
        return {"numbers": self.numbers}

    def restore(self, state):
        self.numbers = state["numbers"]

    def tune(self, task, rng):
        yield self.numbers


class SharedTraining(Learned):
    name = source_digest = "trained_alike"
    trains_as = "learned"


class SeparateTraining(Learned):
    name = source_digest = "trained_apart"


def run_trusted(*kinds, **changes):
    """Run an experiment in this process; return statuses and rates by (label, target, seed)."""
    for kind in kinds:
        tuners.register(kind)
    results = prepare_experiment(spring_experiment(**{"trusted": True, **changes}))
    run_experiment(results, jobs=0)
    statuses = list(results.run_sink.statuses.values())
    rates = {
        (status.tuner, status.target, status.seed): results.run_sink.columns[place][
            "proposal_rate"
        ][1:]
        for place, status in results.run_sink.statuses.items()
    }
    return statuses, rates


@pytest.fixture(scope="module")
def proposals(spring):
    """Proposed rates (12,) in rad/s by (label, target, seed); two labels belong to one tuner."""
    tuners = {"random": {}, "again": {"tuner": "random"}, "cma_es": {}}
    return run_trusted(tuners=tuners, targets=2, seeds=3)[1]


def shared(first, second):
    return np.isin(first, second).sum()


@pytest.mark.parametrize("tuner", ["random", "cma_es"])
def test_every_seed_draws_numbers_of_its_own(proposals, tuner):
    for target in ("in-000", "in-001", "wide-000", "wide-001"):
        for one, other in itertools.combinations(range(3), 2):
            pair = proposals[tuner, target, one], proposals[tuner, target, other]
            assert len(pair[0]) == 12
            # Proposals outside the cube are moved to its border, so border values may be equal.
            inside = [p[(p > 1.0) & (p < 5.0)] for p in pair]
            # A tuner that uses the start begins there in each run, so one value may be shared.
            assert shared(*inside) <= 1, (target, one, other)


def test_every_target_has_numbers_of_its_own_even_where_the_tuner_looks_at_none(proposals):
    for seed in range(3):
        drawn = [proposals["random", target, seed] for target in ("in-000", "in-001", "wide-000")]
        assert all(shared(*pair) == 0 for pair in itertools.combinations(drawn, 2))


def test_the_label_of_an_entry_changes_no_number_of_its_runs(proposals):
    for target, seed in itertools.product(("in-000", "wide-001"), range(3)):
        np.testing.assert_array_equal(
            proposals["random", target, seed], proposals["again", target, seed]
        )


def test_two_tuners_that_draw_alike_draw_other_numbers():
    names = ["drawing", "also_drawing"]
    _, rates = run_trusted(Drawing, AlsoDrawing, tuners=names, targets=1, seeds=2)
    for target, seed in itertools.product(("in-000", "wide-000"), range(2)):
        pair = [rates[name, target, seed] for name in names]
        assert len(pair[0]) == 12
        assert shared(*pair) == 0


def test_a_training_draws_by_its_seed_and_by_whom_the_tuner_trains_as(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path))
    names = ["learned", "trained_alike", "trained_apart"]
    kinds = Learned, SharedTraining, SeparateTraining
    statuses, rates = run_trusted(*kinds, tuners=names, targets=1, ranges=["in"], seeds=3)
    assert [(s.tuner, s.seed) for s in statuses] == list(itertools.product(names, range(3)))
    drawn = {
        (name, seed): rates[name, "in-000", seed].item() for name in names for seed in range(3)
    }
    assert len({drawn["learned", seed] for seed in range(3)}) == 3
    for seed in range(3):
        assert drawn["learned", seed] == drawn["trained_alike", seed]
        assert drawn["learned", seed] != drawn["trained_apart", seed]


def test_weights_of_another_seed_are_not_taken_for_ones_own(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path))
    asked = {"tuners": ["learned"], "targets": 1, "ranges": ["in"], "seeds": 2}
    _, before = run_trusted(Learned, **asked)
    first, second = sorted(tmp_path.glob("learned-spring-*.npz"))
    own = first.read_bytes()
    first.write_bytes(second.read_bytes())
    with pytest.raises(WeightsError, match=r"expected the weights of learned-spring-0-.*-spring-1"):
        run_trusted(Learned, **asked)
    first.write_bytes(own)
    _, after = run_trusted(Learned, **asked)
    assert before == after


def test_an_entry_has_its_own_number_of_seeds_and_of_simulations():
    entries = {
        "random": {}, "few": {"tuner": "random", "seeds": 1},
        "short": {"tuner": "random", "budget": 5}, "nelder_mead": {},
    }  # fmt: skip
    statuses, rates = run_trusted(tuners=entries, targets=1, ranges=["in"], seeds=2)
    made_of = {name: [s.simulations for s in statuses if s.tuner == name] for name in entries}
    # Nelder-Mead is deterministic, so one seed is enough.
    assert made_of == {"random": [12, 12], "few": [12], "short": [5, 5], "nelder_mead": [12]}
    np.testing.assert_array_equal(rates["short", "in-000", 1], rates["random", "in-000", 1][:5])
