"""Tests of domain randomisation: the distribution of the effects and their action."""

from dataclasses import replace

import numpy as np
import pytest

from bench.benchmark.problem.experiment_config import TunerEntry, load_experiment
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.training_simulator import (
    NO_EFFECT_SHARE,
    CountedTrainingSimulator,
    RandomisedSimulator,
)
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_fingerprint import RunIds
from bench.benchmark.runner.tuner_training import compute_training_key
from sims.core.simulator import InputError

SHOT = replace(
    load_experiment("misspecified-shot"),
    calibration=None,
    nuisance={"restitution.speed": (-0.2, -0.1)},
)
PLAIN = TunerEntry("tunenet", "tunenet")
RANDOMISED = TunerEntry("tunenet-randomised", "tunenet", randomised=True)


def test_coefficients_are_drawn_in_their_range_or_missing():
    drawn = RandomisedSimulator(TuningProblem(SHOT)).draw_coefficients(
        np.random.default_rng(1), 4000
    )
    there = drawn[drawn != 0]
    assert there.size / drawn.size == pytest.approx(1 - NO_EFFECT_SHARE, abs=0.03)
    assert (there.min(), there.max()) == pytest.approx((-0.2, -0.1), abs=1e-3)
    assert there.mean() == pytest.approx(-0.15, abs=0.002)


def test_the_effect_acts_on_each_simulation_with_its_own_coefficient():
    problem = TuningProblem(SHOT)
    scenes = problem.draw_scenarios(np.random.default_rng(0))
    points = np.full((12, 1), 0.7)
    nuisance = RandomisedSimulator(problem)
    seen = nuisance.simulate(np.random.default_rng(2), points, scenes)
    plain = problem.simulate(points, scenes)
    coefficients = nuisance.draw_coefficients(np.random.default_rng(2), 12)[:, 0]
    # The first impact is faster than 3 m/s, so a nonzero exponent reduces the speed after it.
    away = np.abs(seen - plain).max(axis=(1, 2))
    assert (away[coefficients == 0] == 0).all()
    assert away[coefficients != 0].min() > 0.01
    # The deviation from the simulation without the effect grows with the size of the exponent.
    order = np.argsort(-coefficients)
    assert (np.diff(away[order][coefficients[order] != 0]) > 0).all()
    assert problem.simulated == 24, "counted like any others"


def test_the_training_simulator_counts_and_limits_as_before():
    problem = TuningProblem(SHOT)
    ground = CountedTrainingSimulator(problem, 10, RandomisedSimulator(problem))
    rng = np.random.default_rng(3)
    assert ground.simulate(rng, ground.sample(rng, 10)).shape == (10, 120, 2)
    assert ground.used == 10
    with pytest.raises(ValueError, match="inside the training range"):
        ground.simulate(rng, np.zeros((1, 1)))


def test_weights_and_runs_of_the_randomised_are_others_and_of_the_plain_the_same():
    wide = replace(SHOT, nuisance={"restitution.speed": (-0.3, 0.0)})
    assert (
        compute_training_key(SHOT, PLAIN, 0)
        == compute_training_key(wide, PLAIN, 0)
        != compute_training_key(SHOT, RANDOMISED, 0)
    )
    assert compute_training_key(SHOT, RANDOMISED, 0) != compute_training_key(wide, RANDOMISED, 0)
    target = draw_target(TuningProblem(SHOT), "in", 0).blinded
    alike = [RunIds(e).make_run_id(PLAIN, target, 0, 5) for e in (SHOT, wide)]
    others = [RunIds(e).make_run_id(RANDOMISED, target, 0, 5) for e in (SHOT, wide)]
    assert alike[0] == alike[1]
    assert others[0] != others[1]


def test_what_it_cannot_train_over_is_refused():
    with pytest.raises(InputError, match=r"tunenet-randomised is randomised: expected a \[nuis"):
        replace(SHOT, nuisance={}, tuners=(RANDOMISED,))
    with pytest.raises(InputError, match=r"nuisance: .*'drag.cubic'"):
        RandomisedSimulator(TuningProblem(replace(SHOT, nuisance={"drag.cubic": (0.0, 1.0)})))
    with pytest.raises(InputError, match=r"expected one of wind.drag, wind.x, .*found wind.up"):
        RandomisedSimulator(
            TuningProblem(replace(load_experiment("ball-drop"), nuisance={"wind.up": (0.0, 1.0)}))
        )


def test_what_the_simulator_was_extended_with_acts_as_it_is_known():
    settings = {**SHOT.settings, "fixed": {"restitution.speed": [-0.1]}}
    both = {**SHOT.nuisance, "drag.quadratic": (0.05, 0.1)}
    extended = replace(SHOT, settings=settings, nuisance=both)
    problem = TuningProblem(extended)
    point, rng = np.full((9, 1), 0.6), np.random.default_rng(0)
    scenarios = problem.draw_scenarios(rng)
    seen = RandomisedSimulator(problem).simulate(rng, point, scenarios)
    assert len(np.unique(seen[:, -1, 0])) > 1, "the others are still drawn"
    alone = replace(extended, nuisance={"restitution.speed": (-0.2, 0.0)})
    seen = RandomisedSimulator(TuningProblem(alone)).simulate(rng, point, scenarios)
    assert np.array_equal(seen, problem.simulate(point, scenarios))
    assert not np.array_equal(seen, TuningProblem(SHOT).simulate(point, scenarios))
