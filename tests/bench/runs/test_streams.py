"""What a run's random stream depends on: the tuner, the target and the seed, each of them."""

import itertools

import numpy as np
import pytest

from bench.runs.runner import prepare, run
from tests.experiments import spring_experiment

pytestmark = pytest.mark.usefixtures("spring")


@pytest.fixture(scope="module")
def proposals(spring):
    """Proposed rates (12,) in rad/s, by label, target and seed; two labels of one tuner."""
    tuners = {"random": {}, "again": {"tuner": "random"}, "cma_es": {}}
    results = prepare(spring_experiment(tuners=tuners, targets=2, seeds=3))
    run(results, jobs=0)
    return {
        (status.tuner, status.target, status.seed): results.kept.columns[place]["proposal_rate"][1:]
        for place, status in results.kept.statuses.items()
    }


def shared(first, second):
    return np.isin(first, second).sum()


@pytest.mark.parametrize("tuner", ["random", "cma_es"])
def test_every_seed_draws_numbers_of_its_own(proposals, tuner):
    for target in ("in-000", "in-001", "wide-000", "wide-001"):
        for one, other in itertools.combinations(range(3), 2):
            pair = proposals[tuner, target, one], proposals[tuner, target, other]
            assert len(pair[0]) == 12
            # What lies outside the cube is moved to its border, which all share.
            inside = [p[(p > 1.0) & (p < 5.0)] for p in pair]
            # A tuner of the start begins where the target lets all begin.
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
