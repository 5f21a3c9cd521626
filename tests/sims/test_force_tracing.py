"""Tests of compiling effects and systems to programs, and that programs and array code agree."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.core.system import Coefficient, Force, Friction
from sims.engines.compiled import compilability, kernel
from sims.engines.compiled.batch_runner import step_batch
from sims.engines.compiled.expression_graph import LANE, ExpressionGraph
from sims.engines.compiled.node_arrays import NotTraceableError
from sims.engines.compiled.traced_array import TracedArray
from sims.systems.slider import Slider
from tests.sims.plain_systems import PLAIN, lanes_of
from tests.sims.simulation_cases import SIMULATORS


class Gusts(Force):
    name, noun, says = "gusts", "gusts", "it gusts"
    needs = "input"
    coefficients = (Coefficient("coefficient", ("m/s^2", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        raise NotImplementedError


class Written(Gusts):
    """An effect that uses many operations of array code."""

    def force(self, c, moment):
        wave = np.stack([np.tanh(moment.x[:, 0]), np.cos(3.0 * moment.t[:, 0])], axis=1)
        fast = (np.abs(moment.v) > 0.2) & ~(moment.x < -1.0)
        result = np.zeros_like(moment.x)
        result[:, 0] = wave.sum(axis=1) + np.linalg.norm(moment.v, axis=1) ** 1.5
        return c[0] * np.where(fast, result, np.exp(-(moment.x**2)) / (1.0 + moment.v**2))


class Asking(Gusts):
    def force(self, c, moment):
        return c[0] * moment.v if moment.v[0, 0] > 0 else 0.0 * moment.v


class Forgetful(Gusts):
    def force(self, c, moment):
        type(self).asked = getattr(type(self), "asked", 0) + 1
        return c[0] * moment.v * self.asked


class Stateful(Gusts):
    def __init__(self):
        self.size = 2.0

    def force(self, c, moment):
        return c[0] * self.size * np.ones_like(moment.v)


class Tabled(Gusts):
    def force(self, c, moment):
        return c[0] * np.interp(moment.x, [-1.0, 1.0], [0.0, 1.0])


def alone(effect, monkeypatch, c=0.3):
    simulator = Slider(engine="batch", effects=[effect], compiled=False)
    t = np.arange(15) / 100
    theta = np.array([[1.0, c], [1.2, 2 * c], [1.1, 0.0]])
    runs = [Scenario(t, {"x": 0.1, "v": 0.3}, {"u": np.sin(9 * t)})] * 3
    return simulator.engine, lanes_of(simulator, theta, runs, monkeypatch)


def test_a_plugin_compiles_as_it_stands(monkeypatch):
    engine, lanes = alone(Written, monkeypatch)
    found, left = step_batch(lanes, engine._turn, np.inf, PLAIN)
    assert not left.size
    np.testing.assert_allclose(found.x, engine._moved(lanes).x, rtol=1e-12)


@pytest.mark.parametrize(
    ("effect", "says"),
    [
        (Asking, "asks whether a number is true"),
        (Forgetful, "other numbers"),
        (Stateful, "state of its own"),
        (Tabled, "numpy.interp is not traced"),
    ],
)
def test_what_does_not_compile_is_said_once_and_stepped_in_numpy(effect, says, monkeypatch, capsys):
    effect = type(effect.__name__, (effect,), {})  # a new class, not yet compiled
    engine, lanes = alone(effect, monkeypatch)
    for _ in range(2):
        left = step_batch(lanes, engine._turn, np.inf, PLAIN)[1]
        assert len(left) == 2  # the elements in which the effect acts
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert "effect gusts" in told[0]
    assert says in told[0]
    monkeypatch.setattr(kernel, "get_kernel", lambda: PLAIN)
    monkeypatch.setattr(engine, "_compiled", True)
    whole = engine.integrate(lanes)
    monkeypatch.setattr(engine, "_compiled", False)
    if effect.__base__ is not Forgetful:
        np.testing.assert_allclose(whole.x, engine.integrate(lanes).x, rtol=1e-12)


class Rubbing(Friction):
    name, says, needs = "rubbing", "it rubs", "guide"
    coefficients = Gusts.coefficients

    def limit(self, c, moment):
        return np.maximum(c[0], 0.0) * (1.0 + moment.speed)


def test_a_plugin_friction_sticks_and_slips(monkeypatch):
    engine, lanes = alone(Rubbing, monkeypatch, 0.6)
    found, left = step_batch(lanes, engine._turn, np.inf, PLAIN)
    assert not left.size
    np.testing.assert_allclose(found.x, engine._moved(lanes).x, atol=1e-13)


def test_every_effect_of_the_library_compiles(monkeypatch, capsys):
    from sims import effects

    for cls in SIMULATORS.values():
        for name, effect in effects.list_effects_for(cls.system).items():
            simulator = cls(engine="batch", effects=[name], compiled=False)
            theta = np.array([[p.nominal for p in simulator.parameters]])
            theta[:, len(cls.parameters) :] = 0.1
            lanes = lanes_of(simulator, theta, [Scenario(np.arange(2) / 100)], monkeypatch)
            acting = [e for e, _ in lanes.effects]
            assert compilability.get_compiled_model(lanes, np.array([0]), acting) is not None, (
                cls.name,
                effect.name,
            )
    assert capsys.readouterr().err == ""


def test_equal_expressions_are_one_and_constants_are_computed():
    graph = ExpressionGraph()
    nodes = np.empty((1, 1), dtype=object)
    nodes[0, 0] = graph.make_input(LANE)
    x = TracedArray(graph, nodes)
    assert (np.sin(x) + 1.0).nodes[0, 0] is (np.sin(x) + 1.0).nodes[0, 0]
    assert (np.full((1, 1), 2.0) * np.ones_like(x)).nodes[0, 0].value == 2.0
    with pytest.raises(NotTraceableError, match=r"numpy\.sort is not"):
        np.sort(x)
