"""The compiled engine against the one in numpy, what it traces, and how it is kept.

Its functions are plain Python, so all but the last tests run without a compiler, slowly.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from sims.base import Scenario
from sims.engines.batch.parts import take
from sims.engines.compiled import advance, evaluate, known, lockstep, machine, pace
from sims.engines.compiled.graph import LANE, Graph
from sims.engines.compiled.nodes import UntracedError
from sims.engines.compiled.run import step
from sims.engines.compiled.traced import Traced
from sims.pendulum.simulator import Pendulum
from sims.slider.simulator import Slider
from sims.system import Coefficient, Force, Friction
from tests.benchmarks import stepping
from tests.sims.cases import FORCES, SIMULATORS, drawn, random_case, steps

PLAIN = SimpleNamespace(divide=pace.divide, advance=advance.advance, march=lockstep.march)


def lanes_of(simulator, theta, scenarios, monkeypatch):
    """What the simulator gives its engine."""
    seen = []
    engine = simulator.engine
    whole = engine.integrate
    monkeypatch.setattr(engine, "integrate", lambda lanes: seen.append(lanes) or whole(lanes))
    simulator.simulate_lanes(theta, scenarios)
    return seen[0]


def two_lanes(system, seed, monkeypatch):
    """A random case, and beside it one of other parameters."""
    case = random_case(system, seed)
    cls = SIMULATORS[system]
    values = case.initial if system == "ball" else (case.initial["x"], case.initial["v"])
    initial = dict(zip(cls.states, values, strict=True))
    scenario = Scenario(case.t[:15], initial, {k: u[:15] for k, u in case.inputs.items()})
    names = list(case.effects) or [next(iter(FORCES[system]))]
    simulator = cls(engine="batch", effects=names, compiled=False)
    given = [x for values in case.effects.values() for x in values]
    given = given or drawn(np.random.default_rng(seed), FORCES[system][names[0]])
    theta = np.array([[case.parameters[p.name] for p in cls.parameters] + given] * 2)
    theta[1] *= 0.97
    return simulator, lanes_of(simulator, theta, [scenario] * 2, monkeypatch)


@pytest.mark.parametrize("system", list(SIMULATORS))
@pytest.mark.parametrize("seed", range(4))
def test_the_same_numbers_as_in_numpy(system, seed, monkeypatch):
    simulator, lanes = two_lanes(system, seed, monkeypatch)
    with np.errstate(all="ignore"):
        found, left = step(lanes, simulator.engine._turn, np.inf, PLAIN)
    assert not left.size
    expected = simulator.engine._moved(lanes)
    for a, b in ((found.x, expected.x), (found.v, expected.v)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def test_every_effect_of_the_library_compiles(monkeypatch, capsys):
    from sims import effects

    for cls in SIMULATORS.values():
        for name, effect in effects.library(cls.system).items():
            simulator = cls(engine="batch", effects=[name], compiled=False)
            theta = np.array([[p.nominal for p in simulator.parameters]])
            theta[:, len(cls.parameters) :] = 0.1
            lanes = lanes_of(simulator, theta, [Scenario(np.arange(2) / 100)], monkeypatch)
            acting = [e for e, _ in lanes.effects]
            assert known.model(lanes, np.array([0]), acting) is not None, (cls.name, effect.name)
    assert capsys.readouterr().err == ""


class Gusts(Force):
    name, noun, says = "gusts", "gusts", "it gusts"
    needs = "input"
    coefficients = (Coefficient("coefficient", ("m/s^2", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        raise NotImplementedError


class Written(Gusts):
    """With much of what array code may hold."""

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
    found, left = step(lanes, engine._turn, np.inf, PLAIN)
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
    effect = type(effect.__name__, (effect,), {})  # which nobody has asked yet
    engine, lanes = alone(effect, monkeypatch)
    for _ in range(2):
        left = step(lanes, engine._turn, np.inf, PLAIN)[1]
        assert len(left) == 2  # those in which it acts
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert "effect gusts" in told[0]
    assert says in told[0]
    monkeypatch.setattr(machine, "machine", lambda: PLAIN)
    monkeypatch.setattr(engine, "_compiled", True)
    whole = engine.integrate(lanes)
    monkeypatch.setattr(engine, "_compiled", False)
    if effect.__base__ is not Forgetful:
        np.testing.assert_allclose(whole.x, engine.integrate(lanes).x, rtol=1e-12)


def test_a_lane_depends_on_itself_alone(monkeypatch):
    """More lanes than slots, of different effects, at different times in their runs."""
    rng = np.random.default_rng(3)
    names = ["drag.linear", "friction.stribeck", "input.delay"]
    simulator = Pendulum(engine="batch", effects=names, compiled=False)
    low, high = np.array([p.bounds for p in simulator.parameters]).T
    theta = rng.uniform(low, high, (45, low.size))
    theta[::3, 1] = 0.0
    theta[1::3, 2:5] = 0.0
    t = np.arange(12) / 50
    run = Scenario(t, {"q": 1.0}, {"u": steps(rng, t.size, 0.2)})
    lanes = lanes_of(simulator, theta, [run] * 45, monkeypatch)
    engine = simulator.engine
    monkeypatch.setattr(machine, "machine", lambda: PLAIN)
    engine._compiled = True
    together = engine.integrate(lanes)
    for lane in (0, 7, 31, 44):
        one = engine.integrate(take(lanes, np.array([lane])))
        assert one.x[0].tobytes() == np.ascontiguousarray(together.x[lane]).tobytes()


def test_how_long_steps_may_be_depends_on_the_lane_alone(monkeypatch):
    """Inputs that decide it are asked for in every lane, not in the first slots' alone."""
    t = np.arange(12) / 50
    on = np.where(t > 0.1, 1.0, 0.0)  # a servo that is let go first has nothing that is fast
    run = Scenario(t, {"q": 0.5}, {"goal": 0.3 + 0.0 * t, "torque_enable": on})
    simulator = SIMULATORS["servo"](engine="batch", compiled=False)
    theta = np.array([[1.3 * p.nominal for p in simulator.parameters]] * 40)
    lanes = lanes_of(simulator, theta, [run] * 40, monkeypatch)
    longest = []

    def noted(program, work, block, w):
        longest.extend(work.longest[work.order])

    plain = SimpleNamespace(divide=pace.divide, advance=noted, march=noted)
    step(lanes, simulator.engine._turn, np.inf, plain)
    assert len(set(longest)) == 1
    assert longest[0] < 1 / 50


@pytest.mark.parametrize("shared", [True, False])
def test_lanes_in_lockstep_do_what_they_do_apart(shared, monkeypatch):
    rng = np.random.default_rng(5)
    simulator = SIMULATORS["servo"](engine="batch", compiled=False)
    low, high = np.array([p.bounds for p in simulator.parameters]).T
    theta = rng.uniform(low, high, (35, low.size))
    t = np.arange(14) / 100
    on = np.where(t < 0.1, 1.0, 0.0)
    goals = [steps(rng, t.size, 1.0) for _ in range(35)]
    runs = [Scenario(t, {"q": 0.1}, {"goal": goal, "torque_enable": on}) for goal in goals]
    lanes = lanes_of(simulator, theta, runs[:1] * 35 if shared else runs, monkeypatch)
    assert (lanes.inputs["goal"].strides[0] == 0) == shared
    ways = []

    def noted(way, name):
        return lambda *given: ways.extend([name] * len(given[1].order)) or way(*given)

    machine_of = {k: noted(v, k) for k, v in vars(PLAIN).items() if k != "divide"}
    found = [
        step(lanes, 0.07, np.inf, SimpleNamespace(**{**vars(PLAIN), **machine_of, **other}))[0]
        for other in ({}, {"march": advance.advance})
    ]
    assert ways.count("march") > 10
    assert found[0].x.tobytes() == found[1].x.tobytes()
    assert found[0].a.tobytes() == found[1].a.tobytes()


def test_elementary_functions_to_the_last_bits():
    rng = np.random.default_rng(1)
    r = np.zeros((4, 3000))
    for scale in (1e-3, 1.0, 40.0, 600.0, 9e4, 1e7):
        r[0] = rng.uniform(-scale, scale, 3000)
        evaluate.turn(r, 1, 0, 3000, 0.0)
        evaluate.turn(r, 2, 0, 3000, 1.0)
        assert np.abs(r[1] - np.sin(r[0])).max() < 2.3e-16
        assert np.abs(r[2] - np.cos(r[0])).max() < 2.3e-16
        with np.errstate(over="ignore", under="ignore"):
            evaluate.grow(r, 3, 0, 3000)
            np.testing.assert_allclose(r[3], np.exp(r[0]), rtol=5e-16)
    r[0, :4] = np.nan, np.inf, -np.inf, 0.0
    with np.errstate(all="ignore"):
        evaluate.grow(r, 3, 0, 4)
        evaluate.turn(r, 1, 0, 4, 0.0)
    np.testing.assert_array_equal(r[3, :4], [np.nan, np.inf, 0.0, 1.0])
    np.testing.assert_array_equal(r[1, :4], [np.nan, np.nan, np.nan, 0.0])


def test_equal_expressions_are_one_and_constants_are_computed():
    graph = Graph()
    nodes = np.empty((1, 1), dtype=object)
    nodes[0, 0] = graph.input(LANE)
    x = Traced(graph, nodes)
    assert (np.sin(x) + 1.0).nodes[0, 0] is (np.sin(x) + 1.0).nodes[0, 0]
    assert (np.full((1, 1), 2.0) * np.ones_like(x)).nodes[0, 0].value == 2.0
    with pytest.raises(UntracedError, match=r"numpy\.sort is not"):
        np.sort(x)


needs_compiler = pytest.mark.skipif(machine.machine() is None, reason="no compiler is installed")


@needs_compiler
@pytest.mark.parametrize("system", list(SIMULATORS))
def test_machine_code_gives_what_the_functions_give(system, monkeypatch):
    simulator, lanes = two_lanes(system, 7, monkeypatch)
    found = step(lanes, simulator.engine._turn, np.inf, machine.machine())[0]
    with np.errstate(all="ignore"):
        expected = step(lanes, simulator.engine._turn, np.inf, PLAIN)[0]
    np.testing.assert_array_equal(found.x, expected.x)
    np.testing.assert_array_equal(found.a, expected.a)


class Rubbing(Friction):
    name, says, needs = "rubbing", "it rubs", "guide"
    coefficients = Gusts.coefficients

    def limit(self, c, moment):
        return np.maximum(c[0], 0.0) * (1.0 + moment.speed)


def test_a_plugin_friction_sticks_and_slips(monkeypatch):
    engine, lanes = alone(Rubbing, monkeypatch, 0.6)
    found, left = step(lanes, engine._turn, np.inf, PLAIN)
    assert not left.size
    np.testing.assert_allclose(found.x, engine._moved(lanes).x, atol=1e-13)


@needs_compiler
def test_threads_change_no_bit():
    names = ("drag.linear", "friction.coulomb")
    _, theta, runs = stepping.work(Pendulum, names, 600)
    seen = [
        Pendulum(engine="batch", effects=names, jobs=jobs).simulate_lanes(theta, runs)
        for jobs in (1, 2, 7)
    ]
    assert seen[0].tobytes() == seen[1].tobytes() == seen[2].tobytes()


@needs_compiler
@pytest.mark.slow
def test_sixteen_lanes_are_stepped_twenty_times_as_quickly():
    effects = ("drag.linear", "friction.coulomb")
    (before, _), (after, _) = stepping.seconds(Pendulum, effects, 16, repeats=3)
    assert before > 20.0 * after
