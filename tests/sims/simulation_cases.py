"""Random batch elements of every system, for the batch engine and for independent references."""

from functools import cache
from itertools import pairwise
from unittest import mock

import numpy as np
from scipy.integrate import solve_ivp

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import TrueSystem
from bench.diagnosis_benchmark.case_generation.joint_reference import SOLVER_TOLERANCES
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    CHANNELS,
    simulate_with_scipy,
)
from sims.core.simulator import Scenario
from tests.sims.engine_agreement import SIMULATORS

REFERENCE_TOLERANCES = {"rtol": 1e-9, "atol": 1e-11}
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
    """Return system and run of one batch element.

    Parameters lie anywhere in their bounds, and up to three effects act.
    """
    rng = np.random.default_rng([seed, *system.encode()])
    cls = SIMULATORS[system]
    t = np.arange(121) / rng.choice([40.0, 60.0, 100.0])
    names = rng.permutation(list(FORCES[system]))
    chosen = [str(name) for name in names[: rng.integers(0, 4)]]
    effects = {name: drawn(rng, FORCES[system][name]) for name in chosen}
    if {"drag.quadratic", "wind"} <= set(effects):
        del effects["wind"]
    constants = {c.name: c.value for c in cls.constants}
    if system == "ball":
        values = [0, 0, rng.uniform(0.6, 4.0), *rng.uniform(-3, 3, 3)]
        parameters, inputs = {"restitution": rng.uniform(0.2, 0.95)}, {}
    else:
        largest = {"pendulum": 0.15, "slider": 3.0, "servo": 1.5}[system]
        inputs = {cls.inputs[0].name: steps(rng, t.size, largest)}
        if system == "servo":
            inputs["torque_enable"] = np.where(np.arange(t.size) < 0.8 * t.size, 1.0, 0.0)
        parameters = {p.name: np.exp(rng.uniform(*np.log(p.bounds))) for p in cls.parameters}
        values = rng.uniform(-1, 1), rng.choice([0.0, rng.uniform(-2, 2)])
    initial = dict(zip(cls.states, values, strict=True))
    return TrueSystem(system, parameters, constants, effects), Scenario(t, initial, inputs)


def simulate(world, scenario, **settings):
    """Simulate a case on the batch engine; return position and velocity, or those of the ball."""
    cls = SIMULATORS[world.system]
    observe = CHANNELS.get(world.system, ("q",))
    simulator = cls(world.constants, observe, engine="batch", fixed=world.effects, **settings)
    theta = np.array([[world.parameters[p.name] for p in cls.parameters]])
    return simulator.simulate(theta, scenario)[0]


def simulate_reference(world, scenario):
    """Simulate a case independently of the code under test; return the same channels."""
    if world.system == "servo":
        return simulate_servo(world, scenario)
    with mock.patch.dict(SOLVER_TOLERANCES, REFERENCE_TOLERANCES):
        return simulate_with_scipy(world, scenario, CHANNELS[world.system])


def simulate_servo(world, scenario):
    """Solve the servo's equations of motion from one change of the inputs to the next."""
    p, k, c = world.parameters, world.constants, {n: v[0] for n, v in world.effects.items()}
    inertia = p["armature"] + k["mass"] * k["length"] ** 2
    weight = k["mass"] * k["gravity"] * k["length"] * (1.0 + c.get("gravity.scale", 0.0))
    delay, most = c.get("input.delay", 0.0), c.get("input.saturation", np.inf)

    def goal_at(t):
        held = np.searchsorted(scenario.times, t - delay, side="right") - 1
        goal = scenario.inputs["goal"][max(held, 0)]
        for name in world.effects:  # in the order in which the signal passes them
            if name == "input.bias":
                goal += c[name]
            elif name == "input.saturation":
                goal = np.clip(goal, -most, most)
        return goal

    def rate(t, state, goal, is_driven):
        q, qd = state
        duty = np.clip(k["kp"] * k["error_gain"] * (goal - q), -1.0, 1.0)
        kt = p["torque_constant"]
        torque = is_driven * kt * (duty * k["voltage"] - kt * qd) / p["resistance"]
        torque += c.get("force.bias", 0.0) - weight * np.sin(q)
        torque -= c.get("drag.linear", 0.0) * qd + c.get("spring.linear", 0.0) * q
        return qd, torque / inertia

    times, enabled = scenario.times, scenario.inputs["torque_enable"]
    state, result = list(scenario.initial.values()), [scenario.initial["q"]]
    for i, (begin, end) in enumerate(pairwise(times)):
        change = [t for t in times + delay if begin < t < end]
        for first, last in pairwise([begin, *change, end]):
            arguments = goal_at(0.5 * (first + last)), enabled[i]
            solution = solve_ivp(
                rate, (first, last), state, "DOP853", args=arguments, **REFERENCE_TOLERANCES
            )
            state = solution.y[:, -1]
        result.append(state[0])
    return np.array(result)[:, None]


@cache
def solved(system, seed):
    """Return a random case with its reference, the slowest part of these tests."""
    world, scenario = random_case(system, seed)
    return world, scenario, simulate_reference(world, scenario)


def errors(system, seed, **settings):
    """Return the largest difference of each channel of a random case from its reference."""
    world, scenario, reference = solved(system, seed)
    return np.abs(simulate(world, scenario, **settings) - reference).max(axis=0)
