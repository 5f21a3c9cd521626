"""Tests of TuneNet with another sensor for the target than for the simulation."""

import numpy as np
import pytest

from methods.tuner import ScenarioInfo
from methods.tuners.tunenet_vision import TuneNetVision
from tests.methods.test_tunenet import Toy, check_state, errors


class Filmed(Toy):
    """The toy oscillation, also shown by a sensor with random scale and offset and inverted
    sign.
    """

    def scenario(self, rng):
        return np.array([rng.uniform(1.0, 2.0), rng.uniform(0.5, 2.0), rng.uniform(-1.0, 1.0)])

    def known(self, scenario):
        return ScenarioInfo(scenario[1:], np.empty((60, 0)))

    def observe(self, points, scenario):
        q = super().observe(points, scenario[:1])[:, :, 0]
        return np.stack([q, 40.0 - 20.0 * scenario[1] * (q + scenario[2])], axis=2)


def hide(observed):
    observed[:, 0] = np.nan


@pytest.fixture(scope="module")
def tuner():
    trained = TuneNetVision(scenarios=150, points=60, epochs=150)
    trained.fit(Filmed(), np.random.default_rng(0), 10_000)
    return trained


def test_error_falls_although_the_target_is_seen_by_another_sensor_only(tuner):
    fell = errors(tuner, Filmed(), spoil=hide)
    assert fell[1] < 0.3 * fell[0]
    assert fell[5] < 0.2 * fell[0]


def test_there_is_one_network_which_is_prepared_for_the_sensor(tuner):
    assert not [name for name in tuner.state() if name.startswith("noisy.")]
    assert tuner.get_trained_network().noisy is tuner.get_trained_network().clean


def test_gaps_are_bridged_by_the_proposed_model(tuner):
    """The beginning is hidden. Filling it with the first visible sample would look like another
    motion.
    """
    toy, rng = Filmed(), np.random.default_rng(2)
    scenario = toy.scenario(rng)
    target = toy.observe(np.array([[0.55]]), scenario)[0]
    target[:, 0] = np.nan

    def off(observed):
        task = toy.task(observed, scenario, start=np.full(1, 0.4))
        return abs(
            tuner.get_trained_network()
            .select_for(task)
            .make_estimator(task)(toy.observe(np.array([[0.55]]), scenario))[0]
        )

    hidden, held = target.copy(), target.copy()
    hidden[:20, 1], held[:20, 1] = np.nan, target[20, 1]
    assert off(hidden) == pytest.approx(off(target), abs=1e-6)
    assert off(held) > off(target) + 0.02


def test_sides_read_their_own_channels(tuner):
    toy, rng = Filmed(), np.random.default_rng(1)
    scenario = toy.scenario(rng)
    target, proposed = (toy.observe(np.array([[value]]), scenario) for value in (0.6, 0.4))

    def estimate(seen, shown):
        task = toy.task(seen[0], scenario, start=np.full(1, 0.4))
        return tuner.get_trained_network().select_for(task).make_estimator(task)(shown)[0]

    blind, deaf = target.copy(), proposed.copy()
    blind[..., 0], deaf[..., 1] = 7.0, -7.0
    assert estimate(target, proposed) == pytest.approx(0.2, abs=0.1)
    assert estimate(blind, deaf) == estimate(target, proposed), (
        "z of the target and v of the simulation say nothing"
    )


def test_state_survives_a_round_trip(tuner):
    names = ("clean.own-inputs.gain", "clean.own-inputs.centre", "clean.inputs.gain")
    lacking = [{k: v for k, v in tuner.state().items() if k != name} for name in names]
    copy = TuneNetVision(scenarios=150, points=60, epochs=150)
    options = {"toy": Filmed(), "match": "inputs", "spoil": hide}
    check_state(tuner, tuner.state(), copy, *lacking, **options)
