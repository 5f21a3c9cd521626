import sys

import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.learning.broyden_search import BroydenSearch
from methods.learning.input_features import make_weighted_features, resample_runs
from methods.learning.noise_matched_networks import estimate_noise_sigma
from methods.learning.pair_network import (
    PUBLISHED_DESIGN,
    PairInputs,
    PairNetworkDesign,
    estimate_difference,
    train_pair_network,
)
from methods.learning.training_data import TrainingData
from methods.tuner import EMPTY_SCENE, Array, BudgetExceededError, Task
from methods.tuners.tunenet import TuneNet, TuneNetPublished

TRAINING = {1: np.array([[0.3], [0.7]]), 2: np.array([[0.3, 0.2], [0.7, 0.6]])}


def swing(points: Array, amplitude: float, samples: int = 60) -> Array:
    """Return a damped oscillation and its rate, two channels; parameters: damping, optional
    frequency.
    """
    t = np.linspace(0.0, 6.0, samples)
    damping = 0.1 + 0.9 * points[:, :1]
    frequency = 2.0 + (points[:, 1:2] if points.shape[1] > 1 else 0.0)
    q = amplitude * np.exp(-damping * t) * np.cos(frequency * t)
    return np.stack([q, np.gradient(q, t, axis=1)], axis=2)


class Toy:
    """A training simulator that checks the training range and the budget."""

    def __init__(self, dim: int = 1, budget: int = 10_000, runs: int = 1) -> None:
        self.dim, self.budget, self.used, self.runs = dim, budget, 0, runs
        self.training, self.scale, self.lengths = TRAINING[dim], np.ones(2), (60,) * runs
        self.calls: list[int] = []
        self.scene = self.known(self.scenario(np.random.default_rng(0)))

    def sample(self, rng, n):
        return rng.uniform(*self.training, size=(n, self.dim))

    def scenario(self, rng):
        return rng.uniform(1.0, 2.0, size=self.runs)

    def known(self, scenario):
        """Return the scenario information given to a tuner."""
        return EMPTY_SCENE

    def observe(self, points, scenario):
        return np.concatenate([swing(points, amplitude) for amplitude in scenario], axis=1)

    def task(self, observed, scenario=None, start=None, budget=9):
        """Return the task to find the parameters of an observation, from zero by default."""
        start = np.zeros(self.dim) if start is None else start
        scene = self.scene if scenario is None else self.known(scenario)
        return Task(
            self.dim, start, observed, self.scale, self.training, budget, self.lengths, scene
        )

    def simulate(self, rng, points):
        assert (points >= self.training[0]).all()
        assert (points <= self.training[1]).all()
        self.calls.append(len(points))
        self.used += len(points)
        if self.used > self.budget:
            raise BudgetExceededError
        scenario = self.scenario(rng)
        self.scene = self.known(scenario)
        return self.observe(points, scenario)


def run(tuner, toy, seed, wide=False, budget=10, spoil=None):
    """Return the trace of one target, and its true parameters."""
    rng = np.random.default_rng(seed)
    low, high = (np.zeros(toy.dim), np.ones(toy.dim)) if wide else toy.training
    start, truth, scenario = rng.uniform(low, high), rng.uniform(low, high), toy.scenario(rng)
    observed = toy.observe(truth[None], scenario)[0]
    if spoil is not None:
        spoil(observed)
    task = toy.task(observed, scenario, start, budget)

    def evaluate(points):
        seen = toy.observe(points, scenario)
        return seen, np.sqrt(np.nanmean((seen - observed) ** 2, axis=(1, 2)))

    trace = drive_tuner(tuner, task, evaluate, rng)
    assert trace.status in ("done", "converged"), trace.reason
    return trace, truth


def errors(tuner, toy, seeds=range(20), budget=10, **kwargs):
    """Return the mean absolute error after each simulation, (budget + 1,)."""
    rows = []
    for seed in seeds:
        trace, truth = run(tuner, toy, seed, budget=budget, **kwargs)
        row = np.abs(trace.recommendations - truth).mean(axis=1)
        rows.append(np.append(row, np.full(budget + 1 - len(row), row[-1])))
    return np.mean(rows, axis=0)


def trained(toy, seed=0, **options):
    tuner = TuneNet(**{"scenarios": 40, "points": 60, "epochs": 100, **options})
    tuner.fit(toy, np.random.default_rng(seed), toy.budget)
    return tuner


@pytest.fixture(scope="module")
def one():
    return trained(Toy())


def test_error_falls_in_range(one):
    error = errors(one, Toy())
    assert error[0] > 0.1
    assert error[1] < 5e-3
    assert error[3] < 1e-6
    assert error[10] < 1e-9


def test_error_falls_outside_the_training_range(one):
    error = errors(one, Toy(), wide=True)
    assert error[1] < 0.1
    assert error[10] < 1e-6


def test_two_parameters_three_runs_two_channels(two):
    error = errors(two, Toy(2, runs=3))
    assert error[1] < 0.02
    assert error[3] < 2e-3
    assert error[10] < 1e-7


def test_missing_samples_do_not_move_the_optimum(two):
    def spoil(observed):
        observed[10:20] = np.nan
        observed[60:120, 1] = np.nan  # one channel of one run is missing completely

    assert errors(two, Toy(2, runs=3), seeds=range(10), spoil=spoil)[10] < 1e-6


def test_a_noisy_target_is_left_to_the_network_that_knows_noise(one):
    noise = np.random.default_rng(3)

    def spoil(observed):
        observed += 0.01 * noise.standard_normal(observed.shape)

    assert errors(one, Toy(), spoil=spoil)[10] < 0.01
    task = Toy().task(swing(np.full((1, 1), 0.9), 1.5)[0])
    assert one._fitted.select_for(task) is one._fitted.clean
    spoil(task.observed)
    assert one._fitted.select_for(task) is one._fitted.noisy


def test_roughness_is_the_noise_and_sees_no_motion():
    t = np.linspace(0.0, 6.0, 2000)
    smooth = np.stack([np.sin(t), t**2], axis=1)[None]
    assert estimate_noise_sigma(smooth, (1000, 1000)).max() < 1e-7
    rough = smooth + np.array([0.01, 0.3]) * np.random.default_rng(0).standard_normal(smooth.shape)
    rough[0, 5:50] = np.nan
    share = estimate_noise_sigma(rough, (1000, 1000))[0] / [
        0.01,
        0.3,
    ]  # the estimate is the lowest of eight parts, so it is slightly low
    assert ((share > 0.75) & (share < 1.0)).all()
    assert (estimate_noise_sigma(np.full((1, 9, 1), np.nan), (3, 6)) == 0.0).all()


def test_same_observation_means_no_difference(one):
    fitted = one._fitted.clean
    seen = fitted.features.observation_features(
        Toy().simulate(np.random.default_rng(0), np.full((3, 1), 0.5)), (60,)
    )
    assert (fitted.predict_difference(seen, seen) == 0.0).all()
    assert (
        fitted.predict_difference(seen[0], seen[0] + 1.0)
        == -fitted.predict_difference(seen[0] + 1.0, seen[0])
    ).all()


def test_recommends_its_newest_guess(one):
    trace, _ = run(one, Toy(), 1, budget=3)
    assert (trace.recommendations[:3] == trace.proposals).all()
    assert len(trace.recommendations) == 4


def test_published_network_has_the_published_size():
    tuner = TuneNetPublished()
    toy = Toy(runs=1)
    toy.observe = lambda points, scenario: swing(points, scenario[0], samples=400)[:, :, :1]
    toy.lengths = (400,)
    tuner.fit(toy, np.random.default_rng(0), 40)
    weights = tuner._fitted.clean.weights
    assert {name: w.shape for name, w in weights.items() if name.endswith("weight")} == {
        "proposed.weight": (400, 32),
        "target.weight": (400, 32),
        "joined.weight": (64, 32),
        "output.weight": (32, 1),
    }
    assert sum(w.size for w in weights.values()) == 27_777
    assert toy.calls == [2] * 20
    assert (
        tuner._fitted.clean.features.observation_features(
            toy.observe(np.ones((1, 1)), [1.0]), (400,)
        )[0, 0]
        == 1.0
    )  # raw metres


def test_published_is_clamped_at_zero_only_and_does_not_settle():
    tuner = TuneNetPublished(points=60)
    tuner.fit(Toy(), np.random.default_rng(0), 400)
    seen = tuner._fitted.clean.features.observation_features(
        Toy().observe(np.array([[0.5]]), [1.5]), (60,)
    )[0]
    assert np.abs(tuner._fitted.clean.predict_difference(seen, seen)).max() > 1e-6
    steps = tuner.tune(Toy().task(swing(np.ones((1, 1)), 1.5)[0]), None)
    next(steps)
    tuner._fitted.clean.weights["output.bias"] = np.full(1, 9.0)
    assert steps.send(evaluation(0.9))[0] > 1.5
    tuner._fitted.clean.weights["output.bias"] = np.full(1, -9.0)
    assert steps.send(evaluation(0.5))[0] == 0.0


def evaluation(at):
    from methods.tuner import Evaluation

    point = np.full((1, 1), at)
    return Evaluation(point, swing(point, 1.5), np.zeros(1))


@pytest.mark.parametrize(
    ("budget", "used"),
    [(50, 48), (320, 320)],  # six and forty scenarios of eight
)
def test_budget_is_met_exactly_and_never_passed(budget, used):
    toy = Toy(budget=budget)
    trained(toy, epochs=1)
    assert toy.used == used


def test_a_budget_for_one_scenario_is_refused():
    with pytest.raises(ValueError, match="two scenarios"):
        trained(Toy(budget=15))


def test_same_seed_gives_the_same_weights_and_touches_no_global_state(request):
    import torch

    before = torch.get_num_threads()
    request.addfinalizer(lambda: torch.set_num_threads(before))
    torch.set_num_threads(2)
    torch_state, numpy_state, threads = (
        torch.get_rng_state(),
        np.random.get_state()[1].copy(),  # noqa: NPY002
        torch.get_num_threads(),
    )
    first, second = (trained(Toy(budget=64), epochs=3).state() for _ in range(2))
    other = trained(Toy(budget=64), seed=1, epochs=3).state()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not np.array_equal(first["clean.joined.weight"], other["clean.joined.weight"])
    assert torch.equal(torch_state, torch.get_rng_state())
    assert np.array_equal(numpy_state, np.random.get_state()[1])  # noqa: NPY002
    assert threads == torch.get_num_threads()


def check_state(tuner, state, copy, *faulty_states, toy, match="expected", **options):
    """Check that a copy with this state acts as the tuner, and that it refuses faulty states."""
    copy.restore(state)
    first, again = (run(one, toy, 4, **options)[0] for one in (tuner, copy))
    np.testing.assert_array_equal(first.proposals, again.proposals)
    np.testing.assert_array_equal(first.recommendations, again.recommendations)
    for faulty in faulty_states:
        with pytest.raises(ValueError, match=match):
            copy.restore(faulty)


def test_state_survives_a_round_trip_and_is_checked(one, tmp_path):
    np.savez(tmp_path / "state.npz", **one.state())
    with np.load(tmp_path / "state.npz", allow_pickle=False) as stored:
        state = dict(stored)
    check_state(
        one,
        state,
        TuneNet(scenarios=40, points=60),
        {k: v for k, v in state.items() if k != "clean.joined.bias"},
        {**state, "extra": np.zeros(1)},
        {**state, "noisy.joined.weight": state["noisy.joined.weight"].T},
        {k: v for k, v in state.items() if not k.startswith("noisy")},
        {k: v for k, v in state.items() if k != "limit"},
        {**state, "clean.output.bias": np.array([np.nan])},
        toy=Toy(),
    )
    with pytest.raises(ValueError, match="train on"):
        one._fitted.clean.features.observation_features(np.zeros((1, 60, 1)), (60,))
    with pytest.raises(RuntimeError, match="not been trained"):
        next(TuneNet().tune(Toy().task(np.zeros((60, 2))), None))


def test_weight_decay_is_that_of_equation_1():
    """With constant data, a gradient descent step gives w <- w - rate * 2 * lambda * w."""
    rows, parameters = PairInputs(*[np.zeros((4, 2, 5))] * 2), np.full((4, 2, 1), 0.5)
    design = {
        "smooth": False,
        "antisymmetric": False,
        "adam": False,
        "rate": 0.1,
        "epochs": 1,
        "batch": 4,
    }
    free, decayed = (
        train_pair_network(
            rows,
            parameters,
            PairNetworkDesign(**design, weight_decay=decay),
            np.random.default_rng(0),
        )
        for decay in (0.0, 0.5)
    )
    assert np.allclose(
        decayed["proposed.weight"], free["proposed.weight"] * (1 - 0.1 * 2 * 0.5), rtol=1e-5
    )
    assert (
        PUBLISHED_DESIGN.weight_decay * 2 == 1e-2
    )  # torch's weight_decay is the factor in the gradient


def test_estimate_by_hand():
    one = np.ones((1, 1))
    weights = {
        f"{layer}.weight": one * v
        for layer, v in (("proposed", 2.0), ("target", 3.0), ("output", 0.5))
    }
    weights |= {
        f"{layer}.bias": np.zeros(1) for layer in ("proposed", "target", "joined", "output")
    }
    weights["joined.weight"] = np.array([[-1.0], [1.0]])
    value = estimate_difference(weights, PUBLISHED_DESIGN, np.array([1.0]), np.array([2.0]))
    assert value == pytest.approx(np.tanh(0.5 * (3.0 * 2.0 - 2.0 * 1.0)))


def test_resampling_is_linear_run_by_run_and_bridges_gaps():
    observed = np.array([0.0, 1.0, 2.0, 10.0, np.nan, 30.0, 40.0, 50.0])[None, :, None]
    assert resample_runs(observed, (3, 5), 5)[0].tolist() == [
        [0.0, 0.5, 1.0, 1.5, 2.0],
        [10.0, 20.0, 30.0, 40.0, 50.0],
    ]
    with pytest.raises(ValueError, match="add up"):
        resample_runs(observed, (3, 4), 5)


def test_inputs_prefer_what_follows_the_parameters():
    rng = np.random.default_rng(0)
    parameters = rng.uniform(size=(20, 8, 1))
    jumping = np.where(parameters > 0.5, 3.0, 0.0)
    circumstance = np.broadcast_to(rng.uniform(size=(20, 1, 1)), (20, 8, 1))
    observations = np.stack(
        [parameters, jumping, circumstance], axis=-1
    )  # one channel each, a single sample
    observations = np.repeat(observations, 2, axis=2)
    data = TrainingData(parameters, observations, (2,), (EMPTY_SCENE,) * 20)
    inputs = make_weighted_features(data, 2, max_inputs=3 * 6, strictness=1000.0)
    gain = {int(number): gain for number, gain in zip(inputs.chosen, inputs.gain, strict=True)}
    assert gain[0] * np.std(parameters) > 1e3 * gain[6] * np.std(jumping)
    assert gain[12] * np.std(circumstance) > 1e3 * gain[6] * np.std(jumping)


def test_search_solves_a_linear_system_in_as_many_steps_as_it_must():
    matrix, root = np.array([[-0.6, 0.2], [0.1, -1.5]]), np.array([0.4, 0.7])
    task = Toy(2).task(np.zeros((1, 1)), start=np.array([0.1, 0.9]))
    search, guess = BroydenSearch(task), task.start
    distances = []
    for _ in range(6):
        guess = search.propose_next(guess, matrix @ (guess - root))
        distances.append(np.abs(guess - root).max())
    assert distances[0] > 0.05
    assert distances[5] < 1e-9


def test_search_survives_a_failed_simulation():
    search = BroydenSearch(Toy().task(np.zeros((1, 1))))
    assert search.propose_next(np.zeros(1), np.array([np.nan])).tolist() == [0.25]
    assert search.propose_next(np.full(1, 0.2), np.array([0.4])).tolist() == pytest.approx([0.6])
    assert search.propose_next(np.full(1, 0.6), np.array([np.nan])).tolist() == pytest.approx([0.4])


def test_failed_simulation_is_no_evidence(one):
    steps = one.tune(Toy().task(swing(np.ones((1, 1)), 1.5)[0]), None)
    next(steps)
    failed = evaluation(0.0)._replace(observations=np.full((1, 60, 2), np.nan))
    assert steps.send(failed).recommend.tolist() == [
        0.25
    ]  # half-way to the centre of the training range


def test_torch_stays_out_until_it_trains(one):
    import subprocess

    code = (
        "import methods.tuners.tunenet, methods.tuners.direct_regressor, sys; "
        "print('torch' in sys.modules)"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"
