"""Tests of the compiled engine against the numpy engine, element by element.

Its functions are plain Python, so all but the last tests run slowly without a compiler.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.engines.batch import BatchEngine
from sims.engines.batch.batch_slicing import slice_batch
from sims.engines.compiled import element_stepping, interpreter, kernel, step_size
from sims.engines.compiled.batch_runner import step_batch
from sims.systems.pendulum import Pendulum
from tests.benchmarks import stepping_speed
from tests.sims.plain_systems import PLAIN, lanes_of
from tests.sims.simulation_cases import FORCES, SIMULATORS, drawn, random_case, steps


def two_lanes(system, seed, monkeypatch):
    """Return a random case and a second element with other parameters."""
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
        found, left = step_batch(lanes, simulator.engine._turn, np.inf, PLAIN)
    assert not left.size
    expected = simulator.engine._moved(lanes)
    for a, b in ((found.x, expected.x), (found.v, expected.v)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def test_a_lane_depends_on_itself_alone(monkeypatch):
    """The batch has more elements than slots, and the elements have different effects."""
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
    monkeypatch.setattr(kernel, "get_kernel", lambda: PLAIN)
    engine._compiled = True
    together = engine.integrate(lanes)
    for lane in (0, 7, 31, 44):
        one = engine.integrate(slice_batch(lanes, np.array([lane])))
        assert one.x[0].tobytes() == np.ascontiguousarray(together.x[lane]).tobytes()


def test_how_long_steps_may_be_depends_on_the_lane_alone(monkeypatch):
    """Inputs that determine the step size are read for every element, not only for the first
    slots.
    """
    t = np.arange(12) / 50
    on = np.where(t > 0.1, 1.0, 0.0)  # while its torque is off, the servo has no fast dynamics
    run = Scenario(t, {"q": 0.5}, {"goal": 0.3 + 0.0 * t, "torque_enable": on})
    simulator = SIMULATORS["servo"](engine="batch", compiled=False)
    theta = np.array([[1.3 * p.nominal for p in simulator.parameters]] * 40)
    lanes = lanes_of(simulator, theta, [run] * 40, monkeypatch)
    longest = []

    def noted(program, work, block, w):
        longest.extend(work.longest[work.order])

    plain = SimpleNamespace(
        choose_step_divisions=step_size.choose_step_divisions,
        step_block=noted,
        step_in_lockstep=noted,
    )
    step_batch(lanes, simulator.engine._turn, np.inf, plain)
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

    machine_of = {k: noted(v, k) for k, v in vars(PLAIN).items() if k != "choose_step_divisions"}
    found = [
        step_batch(lanes, 0.07, np.inf, SimpleNamespace(**{**vars(PLAIN), **machine_of, **other}))[
            0
        ]
        for other in ({}, {"step_in_lockstep": element_stepping.step_block})
    ]
    assert ways.count("step_in_lockstep") > 10
    assert found[0].x.tobytes() == found[1].x.tobytes()
    assert found[0].a.tobytes() == found[1].a.tobytes()


def test_elementary_functions_to_the_last_bits():
    rng = np.random.default_rng(1)
    r = np.zeros((4, 3000))
    for scale in (1e-3, 1.0, 40.0, 600.0, 9e4, 1e7):
        r[0] = rng.uniform(-scale, scale, 3000)
        interpreter.evaluate_sine(r, 1, 0, 3000, 0.0)
        interpreter.evaluate_sine(r, 2, 0, 3000, 1.0)
        assert np.abs(r[1] - np.sin(r[0])).max() < 2.3e-16
        assert np.abs(r[2] - np.cos(r[0])).max() < 2.3e-16
        with np.errstate(over="ignore", under="ignore"):
            interpreter.evaluate_exponential(r, 3, 0, 3000)
            np.testing.assert_allclose(r[3], np.exp(r[0]), rtol=5e-16)
    r[0, :4] = np.nan, np.inf, -np.inf, 0.0
    with np.errstate(all="ignore"):
        interpreter.evaluate_exponential(r, 3, 0, 4)
        interpreter.evaluate_sine(r, 1, 0, 4, 0.0)
    np.testing.assert_array_equal(r[3, :4], [np.nan, np.inf, 0.0, 1.0])
    np.testing.assert_array_equal(r[1, :4], [np.nan, np.nan, np.nan, 0.0])


needs_compiler = pytest.mark.skipif(kernel.get_kernel() is None, reason="no compiler is installed")


@needs_compiler
@pytest.mark.parametrize("system", list(SIMULATORS))
def test_machine_code_gives_what_the_functions_give(system, monkeypatch):
    simulator, lanes = two_lanes(system, 7, monkeypatch)
    found = step_batch(lanes, simulator.engine._turn, np.inf, kernel.get_kernel())[0]
    with np.errstate(all="ignore"):
        expected = step_batch(lanes, simulator.engine._turn, np.inf, PLAIN)[0]
    np.testing.assert_array_equal(found.x, expected.x)
    np.testing.assert_array_equal(found.a, expected.a)


def spoilt(lanes, rng):
    """Yield the batch with random states, inputs or coefficients replaced by non-finite or extreme
    values.
    """

    def bad(values, share):
        values = np.array(values)
        here = rng.random(values.shape) < share
        values[here] = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e150, 1e-320, 0.0], here.sum())
        return values

    yield replace(lanes, x=bad(lanes.x, 0.3))
    yield replace(lanes, v=bad(lanes.v, 0.3))
    yield replace(lanes, inputs={name: bad(u, 0.1) for name, u in lanes.inputs.items()})
    yield replace(lanes, effects=tuple((effect, bad(c, 0.3)) for effect, c in lanes.effects))
    yield replace(lanes, steps=np.where(rng.random(lanes.steps.shape) < 0.4, 0.0, lanes.steps))
    yield replace(lanes, steps=np.where(rng.random(lanes.steps.shape) < 0.4, 1e-15, lanes.steps))
    yield replace(lanes, steps=0.0 * lanes.steps)
    yield replace(lanes, steps_per_sample=10**6)


@needs_compiler
@pytest.mark.parametrize("system", list(SIMULATORS))
def test_spoilt_lanes_end_as_in_numpy(system, monkeypatch):
    lanes = two_lanes(system, 11, monkeypatch)[1]
    for one in spoilt(lanes, np.random.default_rng(11)):
        found, expected = (
            BatchEngine(patience=20.0, compiled=c).integrate(one) for c in (True, False)
        )
        for a, b in ((found.x, expected.x), (found.v, expected.v)):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


@needs_compiler
def test_threads_change_no_bit():
    names = ("drag.linear", "friction.coulomb")
    _, theta, runs = stepping_speed.work(Pendulum, names, 600)
    seen = [
        Pendulum(engine="batch", effects=names, jobs=jobs).simulate_batch(theta, runs)
        for jobs in (1, 2, 7)
    ]
    assert seen[0].tobytes() == seen[1].tobytes() == seen[2].tobytes()


@needs_compiler
@pytest.mark.slow
def test_sixteen_lanes_are_stepped_twenty_times_as_quickly():
    effects = ("drag.linear", "friction.coulomb")
    (before, _), (after, _) = stepping_speed.seconds(Pendulum, effects, 16, repeats=3)
    assert before > 20.0 * after
