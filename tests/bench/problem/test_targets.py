"""Tests of targets: which experiments share them, and which simulator generates their data."""

from dataclasses import replace

import numpy as np
import pytest

from bench.benchmark.problem.experiment_config import parse_experiment
from bench.benchmark.problem.targets import draw_target, draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment
from tests.sample_experiments import spring_experiment

TIMES = np.arange(60) / 20
BIAS = 0.4
"""Constant force in N that acts in the true system but not in the tuned simulator."""
NARROW = 1e-6
"""Width in kg of the range of start and true parameters, so small that both are practically 1
kg."""


def everything(target):
    """Return all numbers of a target as one array."""
    sides = target.blinded.fitting, target.blinded.held_out
    starts = [list(s.initial.values()) for side in sides for s in side.scenarios]
    observed = [side.observed.ravel() for side in sides]
    return np.concatenate([target.truth, target.blinded.start, *starts, *observed])


def test_targets_of_another_experiment_are_met_whole(spring):
    """Shared targets have equal true parameters, start, noise, scenario and held-out scenarios."""
    other = spring_experiment(noise={"x": 0.05}, held_out={"scenarios": 2}, targets=2)
    met = replace(other, name="mine", same_targets_as="spring-test", budget=5, seeds=1)
    own = replace(other, name="mine")
    for theirs, mine, apart in zip(
        *(draw_targets(TuningProblem(e)) for e in (other, met, own)), strict=True
    ):
        np.testing.assert_array_equal(everything(mine), everything(theirs))
        assert len(np.unique(everything(mine))) == 2 + 2 + 3 + 3 * 60 - 2, (
            "each its own draw; held-out runs, without noise, begin with their initial state"
        )
        assert not np.isin(everything(apart), everything(theirs)).any()


def test_a_comparison_meets_the_targets_of_another_and_searches_them_in_its_own_way(spring):
    other = spring_experiment(noise={"x": 0.05}, targets=2, seeds=1)
    columns = []
    for name, met in (("spring-test", ""), ("mine", "spring-test"), ("mine", "")):
        results = prepare_experiment(replace(other, name=name, same_targets_as=met))
        run_experiment(results, jobs=0)
        columns.append(results.run_sink.columns)
    theirs, mine, apart = columns
    for place in theirs:
        for name in ("true_rate", "true_decay"):
            assert theirs[place][name][0] == mine[place][name][0] != apart[place][name][0]
        # At the start, the error depends only on the target and its noise.
        assert theirs[place]["obs_error"][0] == mine[place]["obs_error"][0]
        # Both runs simulate the start first and then choose different points.
        assert theirs[place]["loss"][1] == mine[place]["loss"][1]
        assert not np.isin(theirs[place]["loss"][2:], mine[place]["loss"][2:]).any()


@pytest.mark.parametrize(("kind", "low", "high"), [("in", 2.0, 4.0), ("wide", 1.0, 5.0)])
def test_start_and_true_parameters_are_drawn_evenly_from_their_range(kind, low, high, spring):
    problem = TuningProblem(spring_experiment())
    drawn = [draw_target(problem, kind, i) for i in range(200)]
    for rates in (
        np.array([target.truth[0] for target in drawn]),
        np.array([1.0 + 4.0 * target.blinded.start[0] for target in drawn]),
    ):
        assert low <= rates.min() < low + 0.03 * (high - low)
        assert high >= rates.max() > high - 0.03 * (high - low)
        assert rates.mean() == pytest.approx(3.0, abs=0.25 * (high - low) / 2)


def test_every_channel_has_noise_of_its_own_size(spring):
    experiment = spring_experiment(observe=["x", "v"], noise={"x": 0.05, "v": 0.5})
    problem = TuningProblem(experiment)
    assert problem.scale.tolist() == [0.05, 0.5]
    left = []
    for target in draw_targets(problem):
        (scene,), theta = target.blinded.fitting.scenarios, target.truth[None]
        left.append(target.blinded.fitting.observed - problem.simulator.simulate(theta, scene)[0])
    spread = np.concatenate(left).std(axis=0)
    np.testing.assert_allclose(spread, [0.05, 0.5], rtol=0.1)
    assert abs(np.corrcoef(np.concatenate(left).T)[0, 1]) < 0.15


def slider(**changes):
    """Build an experiment with a mass on which a constant force acts only in the true system."""
    document = {
        "simulator": "slider", "observe": ["x"], "targets": 1, "ranges": ["in"], "budget": 1,
        "parameters": {"mass": {"training": [1.0, 1.0 + NARROW]}},
        "settings": {"engine": "batch"},
        "world": {"engine": "batch", "fixed": {"force.bias": BIAS}},
        "sampling": {"rate": 20.0, "samples": 60}, "initial": {"x": 0.1},
        "held_out": {"scenarios": 2, "initial": {"x": 0.3, "v": 0.5}},
        "tuners": ["nelder_mead"], **changes,
    }  # fmt: skip
    return parse_experiment("pushed", document, "pushed.toml")


def test_held_out_runs_are_the_worlds_and_not_the_tuned_simulators():
    """The force moves the mass by F t^2 / 2 m, in the fitted run and in the held-out runs."""
    results = prepare_experiment(slider())
    held_out = results.plan[0].target.blinded.held_out
    moved = 0.3 + 0.5 * TIMES + BIAS * TIMES**2 / 2
    np.testing.assert_allclose(held_out.observed[:, 0], [*moved, *moved], atol=1e-5)
    run_experiment(results, jobs=0)
    missing = np.sqrt(np.mean((BIAS * TIMES**2 / 2) ** 2))
    assert missing == pytest.approx(0.8, rel=0.05)
    for metric in ("obs_error", "heldout_error"):
        (columns,) = results.run_sink.columns.values()
        assert columns[metric][0] == pytest.approx(missing, rel=1e-5), metric
    away = np.abs(columns["recommendation_mass"] - columns["true_mass"])
    np.testing.assert_array_equal(columns["param_abs_error"], away)
    np.testing.assert_allclose(columns["param_error"], away / NARROW, rtol=1e-6)


def test_held_out_runs_of_an_equal_world_are_predicted_at_the_true_parameters():
    results = prepare_experiment(slider(world={}))
    run_experiment(results, jobs=0)
    (columns,) = results.run_sink.columns.values()
    assert columns["heldout_error"][0] < 1e-5
