"""Tests of the salt: it is committed by hash, and targets depend only on it and the experiment."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.core.random_streams import (
    TargetStreams,
    check_commitment,
    compute_commitment,
    generate_salt,
    make_rng,
)
from sims.core.simulator import InputError
from tests.sample_experiments import spring_experiment

pytestmark = pytest.mark.usefixtures("spring")


def true_parameters(salt, **changes):
    return [
        t.truth for t in draw_targets(TuningProblem(spring_experiment(salt="", **changes), salt))
    ]


def test_the_commitment_is_the_salts_sha_256_and_another_salt_is_refused():
    assert compute_commitment("hello") == hashlib.sha256(b"hello").hexdigest()
    assert compute_commitment("hello").startswith("2cf24dba5fb0a30e26e83b2ac5b9e29e")
    check_commitment("e", "hello", compute_commitment("hello"))
    with pytest.raises(InputError, match="one of the two was changed"):
        check_commitment("e", "hallo", compute_commitment("hello"))
    with pytest.raises(InputError, match="64 hexadecimal digits"):
        check_commitment("e", "", "2cf2")
    with pytest.raises(InputError, match="1000 characters"):
        check_commitment("e", "x" * 1001, "")


def test_fresh_salts_have_128_bits_and_are_never_the_same():
    salts = {generate_salt() for _ in range(100)}
    assert len(salts) == 100
    assert {len(bytes.fromhex(salt)) for salt in salts} == {16}


def test_targets_follow_from_the_salt():
    np.testing.assert_array_equal(true_parameters("a"), true_parameters("a"))
    assert not np.isclose(true_parameters("a"), true_parameters("b")).any()
    assert not np.isclose(true_parameters("a"), true_parameters("public")).any()
    np.testing.assert_array_equal(true_parameters("public"), true_parameters(""))
    np.testing.assert_array_equal(true_parameters("a"), true_parameters("a", seeds=5, budget=99))


def test_a_salt_draws_each_thing_from_a_stream_of_its_own():
    """Values visible to the tuner, such as the start, are not part of any other stream."""
    streams = TargetStreams("a", "e", "in", 0)
    drawn = {
        w: streams.get_stream(w).uniform(size=4) for w in ("start", "truth", "scenario", "noise")
    }
    drawn |= {f"held-out {i}": streams.get_held_out_stream(i).uniform(size=4) for i in range(2)}
    numbers = np.concatenate(list(drawn.values()))
    assert len(np.unique(numbers)) == numbers.size
    again = TargetStreams("a", "e", "in", 0)
    for what in ("truth", "start"):  # the order of the calls does not matter
        np.testing.assert_array_equal(again.get_stream(what).uniform(size=4), drawn[what])


def test_public_targets_are_those_of_the_published_stream():
    (target,) = draw_targets(TuningProblem(spring_experiment(targets=1, ranges=["in"])))
    low, high = TuningProblem(spring_experiment()).cube.training
    rng = make_rng("spring-test", "target", "in", 0)
    np.testing.assert_array_equal(target.blinded.start, rng.uniform(low, high))


def test_nobody_draws_a_secret_target_from_public_names():
    """A plugin can draw from public names (experiment, range, number), but gets another target."""
    problem = TuningProblem(spring_experiment(salt="", targets=1, ranges=["in"]), generate_salt())
    (target,) = draw_targets(problem)
    low, high = problem.cube.training
    rng = make_rng("spring-test", "target", "in", 0)
    drawn = problem.cube.to_physical(rng.uniform(low, high, size=(2, 2)))
    assert not np.isclose(drawn, target.truth).any()


def test_an_experiment_carries_no_secret():
    experiment = replace(spring_experiment(salt=""), salt_sha256=compute_commitment("secret"))
    assert "secret" not in repr(TuningProblem(experiment, "secret").experiment)
