"""Training over effects that the world may have: what is drawn, and that it acts."""

from dataclasses import replace

import numpy as np
import pytest

from bench.problem.entries import Entry
from bench.problem.experiment import load
from bench.problem.nuisance import ABSENT, Nuisance
from bench.problem.practice import Practice
from bench.problem.problem import Problem
from bench.runs.identity import Identities
from bench.runs.training import key
from sims.base import InputError

SHOT = replace(
    load("misspecified-shot"), calibration=None, nuisance={"restitution.speed": (-0.2, -0.1)}
)
PLAIN = Entry("tunenet", "tunenet")
RANDOMISED = Entry("tunenet-randomised", "tunenet", randomised=True)


def test_coefficients_are_drawn_in_their_range_or_are_none():
    drawn = Nuisance(Problem(SHOT)).drawn(np.random.default_rng(1), 4000)
    there = drawn[drawn != 0]
    assert there.size / drawn.size == pytest.approx(1 - ABSENT, abs=0.03)
    assert (there.min(), there.max()) == pytest.approx((-0.2, -0.1), abs=1e-3)
    assert there.mean() == pytest.approx(-0.15, abs=0.002)


def test_the_effect_acts_on_each_simulation_with_its_own_coefficient():
    problem = Problem(SHOT)
    scenes = problem.scenarios(np.random.default_rng(0))
    points = np.full((12, 1), 0.7)
    nuisance = Nuisance(problem)
    seen = nuisance.simulate(np.random.default_rng(2), points, scenes)
    plain = problem.simulate(points, scenes)
    coefficients = nuisance.drawn(np.random.default_rng(2), 12)[:, 0]
    # The first impact is at more than 3 m/s, so who loses more there leaves more slowly.
    away = np.abs(seen - plain).max(axis=(1, 2))
    assert (away[coefficients == 0] == 0).all()
    assert away[coefficients != 0].min() > 0.01
    # Of two simulations the one with the larger exponent's size is further from the plain one.
    order = np.argsort(-coefficients)
    assert (np.diff(away[order][coefficients[order] != 0]) > 0).all()
    assert problem.simulated == 24, "counted like any others"


def test_practice_counts_and_fences_as_before():
    problem = Problem(SHOT)
    ground = Practice(problem, 10, Nuisance(problem))
    rng = np.random.default_rng(3)
    assert ground.simulate(rng, ground.sample(rng, 10)).shape == (10, 120, 2)
    assert ground.used == 10
    with pytest.raises(ValueError, match="inside the training range"):
        ground.simulate(rng, np.zeros((1, 1)))


def test_weights_and_runs_of_the_randomised_are_others_and_of_the_plain_the_same():
    wide = replace(SHOT, nuisance={"restitution.speed": (-0.3, 0.0)})
    assert key(SHOT, PLAIN, 0) == key(wide, PLAIN, 0) != key(SHOT, RANDOMISED, 0)
    assert key(SHOT, RANDOMISED, 0) != key(wide, RANDOMISED, 0)
    target = Problem(SHOT).target("in", 0).sealed
    alike = [Identities(e).run(PLAIN, target, 0, 5) for e in (SHOT, wide)]
    others = [Identities(e).run(RANDOMISED, target, 0, 5) for e in (SHOT, wide)]
    assert alike[0] == alike[1]
    assert others[0] != others[1]


def test_what_it_cannot_train_over_is_refused():
    with pytest.raises(InputError, match=r"tunenet-randomised is randomised: expected a \[nuis"):
        replace(SHOT, nuisance={}, tuners=(RANDOMISED,))
    with pytest.raises(InputError, match=r"nuisance: .*'drag.cubic'"):
        Nuisance(Problem(replace(SHOT, nuisance={"drag.cubic": (0.0, 1.0)})))
    with pytest.raises(InputError, match=r"expected one of wind.drag, wind.x, .*found wind.up"):
        Nuisance(Problem(replace(load("ball-drop"), nuisance={"wind.up": (0.0, 1.0)})))


def test_what_the_simulator_was_extended_with_acts_as_it_is_known():
    settings = {**SHOT.settings, "fixed": {"restitution.speed": [-0.1]}}
    both = {**SHOT.nuisance, "drag.quadratic": (0.05, 0.1)}
    extended = replace(SHOT, settings=settings, nuisance=both)
    problem = Problem(extended)
    point, rng = np.full((9, 1), 0.6), np.random.default_rng(0)
    scenarios = problem.scenarios(rng)
    seen = Nuisance(problem).simulate(rng, point, scenarios)
    assert len(np.unique(seen[:, -1, 0])) > 1, "the others are still drawn"
    alone = replace(extended, nuisance={"restitution.speed": (-0.2, 0.0)})
    seen = Nuisance(Problem(alone)).simulate(rng, point, scenarios)
    assert np.array_equal(seen, problem.simulate(point, scenarios))
    assert not np.array_equal(seen, Problem(SHOT).simulate(point, scenarios))
