"""Tests of scenario features of learned tuners, and of their benefit if scenarios differ."""

import numpy as np
import pytest

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from bench.benchmark.problem.tuning_problem import TuningProblem
from methods.learning.input_features import ScenarioFeatures, compute_response_coefficients
from methods.tuner import EMPTY_SCENE, ScenarioInfo
from methods.tuners.direct_regressor import DirectRegressor
from methods.tuners.tunenet import TuneNet
from tests.methods.test_tunenet import Toy, check_state, errors

STEP, SAMPLES = 0.05, 120


def driven(points, force):
    """Simulate q'' = gain u - damping q' - 4 q from rest; return (n, 120, 1).

    Damping is 0.2 to 1.2, gain 0.5 to 2.5, and the input has shape (120, 1).
    """
    damping, gain = 0.2 + points[:, :1], 0.5 + 2.0 * points[:, 1:2]
    q, rate, out = np.zeros((len(points), 1)), np.zeros((len(points), 1)), []
    for u in force[:, 0]:
        out.append(q)
        for _ in range(10):
            rate = rate + STEP / 10 * (gain * u - damping * rate - 4.0 * q)
            q = q + STEP / 10 * rate
    return np.stack(out, axis=1)


class Driven(Toy):
    """A spring and damper driven by a force of random levels, different in each scenario."""

    def __init__(self, budget=1000):
        super().__init__(2, budget)
        self.scale, self.lengths = np.ones(1), (SAMPLES,)

    def scenario(self, rng):
        return np.repeat(rng.uniform(-2.0, 2.0, size=(12, 1)), 10, axis=0)

    def known(self, scenario):
        return ScenarioInfo(np.empty(0), scenario)

    def observe(self, points, scenario):
        return driven(points, scenario)


def trained(kind, is_informed):
    tuner = kind(scenarios=60, points=60, epochs=100, told=is_informed)
    tuner.fit(Driven(), np.random.default_rng(0), 1000)
    return tuner


@pytest.fixture(scope="module")
def informed():
    return trained(TuneNet, True)


@pytest.fixture(scope="module")
def blind():
    return trained(TuneNet, False)


def force(seed):
    return Driven().scenario(np.random.default_rng(seed))


def test_responses_are_the_coefficients_of_the_equation_of_motion():
    seen = driven(np.array([[0.5, 0.5], [0.1, 0.9]]), force(0))
    constant, position, cubed, sense, gain, rate = compute_response_coefficients(
        seen, force(0), (SAMPLES,)
    ).T
    assert gain == pytest.approx(np.array([1.5, 2.3]) * STEP**2, rel=0.02)
    assert rate == pytest.approx(-np.array([0.7, 0.3]) * STEP, rel=0.05)
    assert position == pytest.approx(-4.0 * STEP**2, rel=0.03)
    assert np.abs([constant, cubed, sense]).max() < 0.1 * STEP**2


def test_responses_hardly_depend_on_the_input_and_samples_do():
    points = np.array([[0.5, 0.5]])
    seen = [driven(points, force(seed)) for seed in range(8)]
    found = np.concatenate(
        [compute_response_coefficients(o, force(seed), (SAMPLES,)) for seed, o in enumerate(seen)]
    )
    gain, rate = found[:, 4], found[:, 5]
    assert gain.std() / gain.mean() < 0.02
    assert -rate.std() / rate.mean() < 0.05
    assert np.std(seen, axis=0).mean() > 0.5 * np.std(seen)


def test_each_run_has_its_own_and_a_short_one_none():
    both = np.concatenate([force(0), force(1)[:5]])
    seen = np.concatenate(
        [driven(np.full((1, 2), 0.5), part) for part in (force(0), force(1)[:5])], axis=1
    )
    assert np.array_equal(
        compute_response_coefficients(seen, both, (SAMPLES, 5)),
        compute_response_coefficients(seen[:, :SAMPLES], force(0), (SAMPLES,)),
    )


def test_a_network_that_reads_the_inputs_beats_one_that_does_not(informed, blind):
    knows, guesses = errors(informed, Driven()), errors(blind, Driven())
    assert knows[1] < 0.02 < guesses[1] / 2
    assert knows[3] < 1e-3 < guesses[3] / 5
    assert knows[10] < 1e-6


@pytest.mark.slow
def test_so_does_the_regressor():
    knows, guesses = (
        errors(trained(DirectRegressor, is_informed), Driven(), budget=1)[1]
        for is_informed in (True, False)
    )
    assert knows < 0.02 < guesses / 2


def test_missing_samples_do_not_move_the_optimum(informed):
    def spoil(observed):
        observed[30:40] = np.nan

    ends = [errors(informed, Driven(), seeds=[seed], spoil=spoil)[10] for seed in range(10)]
    assert (
        sorted(ends)[8] < 1e-6
    )  # filled gaps are new to the network: one of ten runs does not converge


def test_state_survives_and_is_checked(informed, blind):
    state = informed.state()
    assert state["clean.inputs.chosen"].size == 0  # response coefficients replace samples
    assert state["clean.told.centre"].shape == (6,)
    check_state(
        informed,
        state,
        TuneNet(points=60),
        {**state, "clean.told.spread": state["clean.told.spread"][:-1]},
        {**state, "clean.told.centre": np.full(6, np.nan)},
        {k: v for k, v in state.items() if k != "clean.told.initial"},
        {k: v for k, v in state.items() if not k.startswith("clean.told")},
        {**state, **{k: v for k, v in blind.state().items() if k.startswith("clean.inputs")}},
        toy=Driven(),
    )


def test_a_scene_of_another_kind_is_refused(informed):
    read = informed._fitted.clean.features
    with pytest.raises(ValueError, match="train on"):
        read(
            np.zeros((1, SAMPLES, 1)), (SAMPLES,), ScenarioInfo(np.empty(0), np.zeros((SAMPLES, 2)))
        )


def test_nothing_is_learned_where_scenarios_are_alike():
    seen = np.random.default_rng(0).normal(size=(3, 4, SAMPLES, 1))
    assert ScenarioFeatures.fit([EMPTY_SCENE] * 3, seen, (SAMPLES,)) is None
    assert ScenarioFeatures.fit([ScenarioInfo(np.ones(2), force(0))] * 3, seen, (SAMPLES,)) is None
    initial = [ScenarioInfo(np.array([2.0, float(i)]), force(0)) for i in range(3)]
    found = ScenarioFeatures.fit(initial, seen, (SAMPLES,))
    assert not found.has_varying_inputs
    assert found(seen[0], (SAMPLES,), initial[2]).tolist() == [[0.0, np.arcsinh(1.0 / 1.4826)]] * 4


@pytest.mark.parametrize(
    ("name", "initial", "inputs"),
    [
        ("ball-drop", 0, (400, 0)),  # the height is the first sample
        ("ball-tilt", 2, (150, 0)),  # vx and vy are not
        ("pendulum-driven", 0, (200, 1)),
        ("arm-swing", 0, (150, 2)),
    ],
)
def test_experiments_tell_what_observations_do_not_show(name, initial, inputs):
    problem = TuningProblem(load_experiment(name))
    scenarios = problem.draw_scenarios(np.random.default_rng(0))
    scene = problem.describe_scenarios(scenarios)
    assert (scene.initial.size, scene.inputs.shape) == (initial, inputs)
    if initial:
        assert scene.initial.tolist() == [scenarios[0].initial["vx"], scenarios[0].initial["vy"]]
    if inputs[1] == 2:
        assert np.array_equal(scene.inputs[:, 1], scenarios[0].inputs["u2"])
    practice = CountedTrainingSimulator(problem, 4)
    practice.simulate(np.random.default_rng(0), practice.sample(np.random.default_rng(1), 2))
    assert np.array_equal(
        practice.scene.inputs, scene.inputs
    )  # the features are those of the simulated scenario
    problem.close()


def test_ball_drop_learns_the_same_weights_bit_for_bit():
    states = []
    for is_informed in (True, False):
        problem, tuner = (
            TuningProblem(load_experiment("ball-drop")),
            TuneNet(told=is_informed, epochs=2),
        )
        tuner.fit(CountedTrainingSimulator(problem, 64), np.random.default_rng(0), 64)
        states.append(tuner.state())
        problem.close()
    assert states[0].keys() == states[1].keys()
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])
