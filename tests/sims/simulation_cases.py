"""Random batch elements of every system, for the batch engine and for SciPy."""

from functools import cache

import numpy as np

from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider
from tests.sims import scipy_reference

SIMULATORS = {"ball": Ball, "pendulum": Pendulum, "slider": Slider, "servo": Servo}
# Ranges of coefficients, slightly wider than plausible where that makes the test harder.
FORCES = {
    "ball": {
        "drag.linear": [(0, 0.5)],
        "drag.quadratic": [(0, 0.3)],
        "wind": [(0, 0.3), (-10, 10), (-10, 10)],
        "gravity.scale": [(-0.2, 0.2)],
        "gravity.tilt": [(-0.2, 0.2), (-0.2, 0.2)],
        "force.bias": [(-2, 2)],
        "force.periodic": [(-2, 2), (-2, 2), (0.1, 10)],
        "lift.magnus": [(-1, 1), (-1, 1)],
        "restitution.speed": [(-0.1, 0.2)],
        "contact.friction": [(0, 1)],
    },
    "pendulum": {
        "drag.linear": [(0, 0.01)],
        "drag.quadratic": [(0, 0.002)],
        "friction.coulomb": [(0, 0.05)],
        "friction.stribeck": [(0, 0.03), (0, 0.05), (0.05, 2)],
        "friction.load": [(0, 0.3)],
        "gravity.scale": [(-0.2, 0.2)],
        "gravity.tilt": [(-0.2, 0.2)],
        "spring.linear": [(0, 0.3)],
        "spring.cubic": [(-0.05, 0.1)],
        "force.bias": [(-0.1, 0.1)],
        "force.periodic": [(-0.1, 0.1), (-0.1, 0.1), (0.1, 10)],
        "force.ripple": [(-0.03, 0.03), (-0.03, 0.03), (0.3, 3)],
        "input.gain": [(-0.5, 0.5)],
        "input.bias": [(-0.1, 0.1)],
        "input.delay": [(0, 0.2)],
        "input.deadband": [(0, 0.1)],
        "input.saturation": [(0.05, 0.3)],
    },
    "slider": {
        "drag.linear": [(0, 5)],
        "drag.quadratic": [(0, 5)],
        "wind": [(0, 3), (-3, 3)],
        "friction.coulomb": [(0, 2)],
        "friction.stribeck": [(0, 1), (0, 1), (0.02, 0.5)],
        "friction.load": [(0, 0.4)],
        "gravity.tilt": [(-0.2, 0.2)],
        "spring.linear": [(0, 50)],
        "spring.cubic": [(0, 20)],
        "force.bias": [(-2, 2)],
        "force.periodic": [(-2, 2), (-2, 2), (0.1, 10)],
        "force.ripple": [(-1, 1), (-1, 1), (0.2, 1)],
        "input.gain": [(-0.5, 0.5)],
        "input.delay": [(0, 0.2)],
        "input.deadband": [(0, 1)],
    },
    "servo": {
        "drag.linear": [(0, 0.05)],
        "friction.coulomb": [(0, 0.2)],
        "friction.stribeck": [(0, 0.1), (0, 0.1), (0.05, 2)],
        "friction.load": [(0, 0.3)],
        "gravity.scale": [(-0.2, 0.2)],
        "spring.linear": [(0, 1)],
        "force.bias": [(-0.2, 0.2)],
        "input.bias": [(-0.2, 0.2)],
        "input.delay": [(0, 0.2)],
        "input.saturation": [(0.2, 1.0)],
    },
}


def drawn(rng, ranges):
    return [float(rng.uniform(*pair)) for pair in ranges]


def steps(rng, size, scale):
    """Return a command with four constant levels, which changes three times."""
    return np.repeat(rng.uniform(-scale, scale, 4), -(-size // 4))[:size]


def random_case(system, seed):
    """Return one batch element with parameters anywhere in their bounds and up to three effects."""
    rng = np.random.default_rng([seed, *system.encode()])
    t = np.arange(121) / rng.choice([40.0, 60.0, 100.0])
    names = rng.permutation(list(FORCES[system]))
    chosen = [str(name) for name in names[: rng.integers(0, 4)]]
    effects = {name: drawn(rng, FORCES[system][name]) for name in chosen}
    if {"drag.quadratic", "wind"} <= set(effects):
        del effects["wind"]
    if system == "ball":
        initial = np.array([0, 0, rng.uniform(0.6, 4.0), *rng.uniform(-3, 3, 3)])
        constants = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}
        return scipy_reference.Case(
            system, {"restitution": rng.uniform(0.2, 0.95)}, constants, initial, effects, t
        )
    u = {"pendulum": 0.15, "slider": 3.0, "servo": 1.5}[system]
    inputs = {"goal" if system == "servo" else "u": steps(rng, t.size, u)}
    if system == "servo":
        inputs["torque_enable"] = np.where(np.arange(t.size) < 0.8 * t.size, 1.0, 0.0)
    parameters = {
        p.name: float(np.exp(rng.uniform(*np.log(p.bounds)))) for p in SIMULATORS[system].parameters
    }
    constants = {c.name: c.value for c in SIMULATORS[system].constants}
    initial = {"x": rng.uniform(-1, 1), "v": rng.choice([0.0, rng.uniform(-2, 2)])}
    return scipy_reference.Case(system, parameters, constants, initial, effects, t, inputs)


def simulated(case, **settings):
    """Simulate the case on the batch engine; return the observation (T, C)."""
    cls = SIMULATORS[case.system]
    states = list(cls.states)
    values = case.initial if case.system == "ball" else (case.initial["x"], case.initial["v"])
    scenario = Scenario(case.t, dict(zip(states, values, strict=True)), case.inputs, case.constants)
    simulator = cls(engine="batch", fixed=case.effects, **settings)
    theta = np.array([[case.parameters[p.name] for p in cls.parameters]])
    return simulator.simulate(theta, scenario)[0]


@cache
def solved(system, seed):
    """Return a random case with SciPy's solution, the slowest part of these tests."""
    case = random_case(system, seed)
    return case, (scipy_reference.ball if system == "ball" else scipy_reference.hinge)(case)


def errors(system, seed, **settings):
    """Return the largest difference of each channel of a random case from SciPy's solution."""
    case, solution = solved(system, seed)
    seen = simulated(case, **settings)
    if system != "ball":
        return np.abs(seen - solution[:, : seen.shape[1]]).max(axis=0)
    expected, impacts = solution
    differences = np.abs(
        seen - np.column_stack([expected[:, :3], expected[:, 8] + case.constants["gravity"]])
    )
    if impacts.size:  # with drag, acceleration jumps at impacts
        away = np.abs(case.t[:, None] - impacts).min(axis=1) > 1e-3
        differences[~away, 3] = 0.0
    return differences.max(axis=0)
