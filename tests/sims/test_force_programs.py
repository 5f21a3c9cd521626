"""Tests of force programs: traced ones, and those whose functions NumPy evaluates."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from sims import effects as library
from sims.core.effect import Coefficient, Force, Friction
from sims.core.simulator import InputError, Scenario
from sims.engines.batch_engine import BatchEngine
from sims.engines.compiled import force_program, register_programs
from sims.engines.compiled.register_programs import make_instruction_runner
from sims.engines.compiled.traced_array import (
    OPERATION_CODES,
    PER_ELEMENT,
    ExpressionGraph,
    NotTraceableError,
    TracedArray,
)
from sims.engines.engine_lookup import make_engine
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.slider import Slider
from tests.benchmarks import stepping_speed
from tests.sims.simulation_cases import SIMULATORS, random_case


class Gusts(Force):
    name, noun, says = "gusts", "gusts", "it gusts"
    needs = "input"
    coefficients = (Coefficient("coefficient", ("m/s^2", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        raise NotImplementedError


class ManyOperations(Gusts):
    """An effect that uses many operations of array code."""

    def force(self, c, moment):
        wave = np.stack([np.tanh(moment.x[:, 0]), np.cos(3.0 * moment.t[:, 0])], axis=1)
        fast = (np.abs(moment.v) > 0.2) & ~(moment.x < -1.0)
        result = np.zeros_like(moment.x)
        result[:, 0] = wave.sum(axis=1) + np.linalg.norm(moment.v, axis=1) ** 1.5
        return c[0] * np.where(fast, result, np.exp(-(moment.x**2)) / (1.0 + moment.v**2))


class Branching(Gusts):
    def force(self, c, moment):
        return c[0] * moment.v if moment.t[0, 0] >= 0 else 0.0 * moment.v


class Counting(Gusts):
    def force(self, c, moment):
        type(self).calls = getattr(type(self), "calls", 0) + 1
        return c[0] * moment.v + 1e-6 * self.calls


class Stateful(Gusts):
    def __init__(self):
        self.size = 2.0

    def force(self, c, moment):
        return c[0] * self.size * np.ones_like(moment.v)


class Tabulated(Gusts):
    def force(self, c, moment):
        return c[0] * np.interp(moment.x, [-1.0, 1.0], [0.0, 1.0])


class SpeedFriction(Friction):
    name, says, needs = "speed-friction", "friction grows with speed", "guide"
    coefficients = Gusts.coefficients

    def limit(self, c, moment):
        return np.maximum(c[0], 0.0) * (1.0 + moment.speed)


class BranchingFriction(SpeedFriction):
    def limit(self, c, moment):
        return super().limit(c, moment) if moment.t[0, 0] >= 0 else 0.0 * c[0]


def simulate_slider(effect, c=0.3):
    """Simulate three sliders, of which the last is without the effect."""
    t = np.arange(15) / 100
    theta = np.array([[1.0, c], [1.2, 2 * c], [1.1, 0.0]])
    scenario = Scenario(t, {"x": 0.1, "v": 0.3}, {"u": np.sin(9 * t)})
    return Slider(engine="batch", effects=[effect]).simulate(theta, scenario)


@pytest.mark.parametrize(
    ("effect", "equal", "reason"),
    [
        (Branching, lambda c, moment: c[0] * moment.v, "tests whether a number is true"),
        (Stateful, lambda c, moment: 2.0 * c[0] * np.ones_like(moment.v), "instance attributes"),
        (
            Tabulated,
            lambda c, moment: c[0] * (0.5 + 0.5 * np.clip(moment.x, -1, 1)),
            "numpy.interp is not traced",
        ),
    ],
)
def test_an_effect_that_cannot_be_traced_is_reported_once_and_acts(effect, equal, reason, capsys):
    untraced = type(effect.__name__, (effect,), {})  # a new class, not yet traced
    traced = type("Traced", (Gusts,), {"force": lambda self, c, moment: equal(c, moment)})
    for _ in range(2):
        found = simulate_slider(untraced)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "effect gusts" in lines[0]
    assert reason in lines[0]
    np.testing.assert_allclose(found, simulate_slider(traced), rtol=1e-12)
    assert capsys.readouterr().err == ""


def test_an_effect_with_a_hidden_counter_gives_other_numbers_when_traced(capsys):
    assert np.isfinite(simulate_slider(type("New", (Counting,), {}))).all()
    assert "other numbers" in capsys.readouterr().err


def test_traced_and_evaluated_friction_agree(capsys):
    traced, evaluated = (simulate_slider(e, 0.6) for e in (SpeedFriction, BranchingFriction))
    assert "tests whether a number is true" in capsys.readouterr().err
    np.testing.assert_allclose(evaluated, traced, rtol=1e-12)
    assert not np.allclose(traced[:2], simulate_slider(SpeedFriction, 1e-9)[:2], atol=1e-3)


@pytest.mark.parametrize("error", [ValueError("no table"), KeyboardInterrupt()])
def test_an_exception_in_an_evaluated_effect_reaches_the_caller(error):
    class Failing(Gusts):
        def force(self, c, moment):
            if moment.t[0, 0] > 0.05:
                raise error
            return c[0] * moment.v

    with pytest.raises(type(error)):
        simulate_slider(Failing)


def test_an_effect_with_many_array_operations_is_traced(monkeypatch, capsys):
    traced = simulate_slider(ManyOperations)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(register_programs.TracedPrograms, "find", lambda *_: None)
    monkeypatch.setattr(force_program, "_traced_forces", {})
    np.testing.assert_allclose(traced, simulate_slider(ManyOperations), rtol=1e-12)


def test_every_effect_of_the_library_is_traced(capsys):
    for cls in SIMULATORS.values():
        for name in library.list_effects_for(cls.system):
            simulator = cls(engine="batch", effects=[name])
            theta = np.array([[p.nominal for p in simulator.parameters]])
            theta[:, len(cls.parameters) :] = 0.1
            simulator.simulate(theta, Scenario(np.arange(2) / 100))
    assert capsys.readouterr().err == ""


def record_batch(simulator, theta, scenarios, monkeypatch):
    """Return the batch that the simulator passes to its engine."""
    batches = []
    integrate = simulator.engine.integrate
    monkeypatch.setattr(
        simulator.engine,
        "integrate",
        lambda batch: batches.append(batch) or integrate(batch),
    )
    simulator.simulate_batch(theta, scenarios)
    return batches[0]


def damaged_batches(batch, rng):
    """Yield the batch with random numbers replaced by non-finite or extreme ones."""

    def damage(values, share):
        values = np.array(values)
        here = rng.random(values.shape) < share
        values[here] = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e150, 1e-320, 0.0], here.sum())
        return values

    yield replace(batch, x=damage(batch.x, 0.3))
    yield replace(batch, v=damage(batch.v, 0.3))
    yield replace(
        batch,
        inputs={name: damage(u, 0.1) for name, u in batch.inputs.items()},
    )
    yield replace(
        batch,
        effects=tuple((effect, damage(c, 0.3)) for effect, c in batch.effects),
    )
    yield replace(
        batch,
        steps=np.where(rng.random(batch.steps.shape) < 0.4, 0.0, batch.steps),
    )
    yield replace(
        batch,
        steps=np.where(rng.random(batch.steps.shape) < 0.4, 1e-15, batch.steps),
    )
    yield replace(batch, steps=0.0 * batch.steps)
    yield replace(batch, steps_per_sample=10**6)


@pytest.mark.parametrize("system", list(SIMULATORS))
def test_damaged_batches_end_in_the_same_state_with_evaluated_forces(system, monkeypatch):
    world, whole = random_case(system, 11)
    cls = SIMULATORS[system]
    inputs = {name: u[:15] for name, u in whole.inputs.items()}
    scenario = Scenario(whole.times[:15], whole.initial, inputs)
    simulator = cls(engine="batch", effects=list(world.effects))
    coefficients = [x for values in world.effects.values() for x in values]
    theta = np.array([[world.parameters[p.name] for p in cls.parameters] + coefficients] * 2)
    theta[1] *= 0.97
    batch = record_batch(simulator, theta, [scenario] * 2, monkeypatch)
    engine = BatchEngine(patience=20.0)
    with np.errstate(all="ignore"):
        batches = list(damaged_batches(batch, np.random.default_rng(11)))
        traced = [engine.integrate(batch) for batch in batches]
        monkeypatch.setattr(register_programs.TracedPrograms, "find", lambda *_: None)
        monkeypatch.setattr(force_program, "_traced_forces", {})
        evaluated = [engine.integrate(batch) for batch in batches]
    for found, expected in zip(evaluated, traced, strict=True):
        np.testing.assert_allclose(found.x, expected.x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(found.v, expected.v, rtol=1e-9, atol=1e-10)


def test_the_number_of_threads_changes_no_bit():
    names = ("drag.linear", "friction.coulomb")
    _, theta, runs = stepping_speed.work(Pendulum, names, 600)
    found = [
        Pendulum(engine="batch", effects=names, jobs=jobs).simulate_batch(theta, runs)
        for jobs in (1, 2, 7)
    ]
    assert found[0].tobytes() == found[1].tobytes() == found[2].tobytes()


def test_a_system_with_too_many_coordinates_is_refused():
    names = tuple(f"q{k}" for k in range(16))
    wide = type("Wide", (Slider.system,), {"coordinates": names})
    with pytest.raises(InputError, match="16 coordinates, and the engine at most 15"):
        make_engine("batch", wide, {})


@pytest.mark.slow
def test_ball_rollouts_are_fifty_times_as_many_as_in_pybullet():
    scenario = Scenario(np.arange(400) / 60, {"z": 4.5})
    theta = np.random.default_rng(1).uniform(0.3, 0.7, (1000, 1))
    batch, bullet = Ball(engine="batch"), Ball(engine="pybullet")
    bullet.simulate(theta[:1], scenario)
    seconds = []
    for _ in range(5):  # The engines alternate, so that changes of the machine affect both.
        started = process_time()
        batch.simulate(theta, scenario)
        between = process_time()
        bullet.simulate(theta[:10], scenario)
        seconds.append(((between - started) / 1000, (process_time() - between) / 10))
    bullet.close()
    batch_seconds, bullet_seconds = np.min(seconds, axis=0)
    assert bullet_seconds > 50.0 * batch_seconds


def run_operation(name, values):
    """Return a function of one argument as the kernel computes it."""
    r = np.zeros((2, len(values)))
    r[0] = values
    code = np.array([[OPERATION_CODES[name], 1, 0, 0, 0]], dtype=np.int64)
    make_instruction_runner(code, 0, 1, r)()
    return r[1]


def test_sine_cosine_and_exponential_are_accurate_to_rounding():
    rng = np.random.default_rng(1)
    for scale in (1e-3, 1.0, 40.0, 600.0, 9e4, 1e7):
        x = rng.uniform(-scale, scale, 3000)
        assert np.abs(run_operation("sin", x) - np.sin(x)).max() < 2.3e-16
        assert np.abs(run_operation("cos", x) - np.cos(x)).max() < 2.3e-16
        with np.errstate(over="ignore", under="ignore"):
            np.testing.assert_allclose(run_operation("exp", x), np.exp(x), rtol=5e-16)
    special = [np.nan, np.inf, -np.inf, 0.0]
    np.testing.assert_array_equal(run_operation("exp", special), [np.nan, np.inf, 0.0, 1.0])
    np.testing.assert_array_equal(run_operation("sin", special), [np.nan, np.nan, np.nan, 0.0])


def test_equal_expressions_are_one_node_and_constants_are_computed():
    graph = ExpressionGraph()
    nodes = np.empty((1, 1), dtype=object)
    nodes[0, 0] = graph.make_input(PER_ELEMENT)
    x = TracedArray(graph, nodes)
    assert (np.sin(x) + 1.0).nodes[0, 0] is (np.sin(x) + 1.0).nodes[0, 0]
    assert (np.full((1, 1), 2.0) * np.ones_like(x)).nodes[0, 0].value == 2.0
    with pytest.raises(NotTraceableError, match=r"numpy\.sort is not"):
        np.sort(x)
