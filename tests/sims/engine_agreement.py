"""Comparison of the same motion on every engine: scenarios, coefficients and differences.

`python -m tests.sims.engine_agreement` measures the tables of docs/engines.md; it takes some
minutes.
"""

import time

import numpy as np

from sims import effects
from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider

SIMULATORS = {"ball": Ball, "pendulum": Pendulum, "slider": Slider, "servo": Servo}
THETA = {"ball": [0.8], "pendulum": [3.3e-3], "slider": [1.3], "servo": [0.5, 4.0, 2e-3]}
STEPS = {
    name: np.array([1.0, 0.5, 0.25, 0.125]) / (60 if name == "ball" else 100) for name in SIMULATORS
}
OTHERS = ("pybullet", "mujoco")

# Coefficients for systems that state forces per unit mass, in N, and in N*m. An effect with fewer
# coefficients on a system uses only the first ones.
COEFFICIENTS = {
    "backlash": (None, 0.02, 0.02),
    "clock.skew": (0.002, 0.002, 0.002),
    "contact.friction": (0.1, None, None),
    "drag.linear": (0.2, 0.5, 2e-3),
    "drag.quadratic": (0.05, 0.5, 3e-4),
    "force.bias": (0.3, 0.5, 0.02),
    "force.periodic": ((1.0, 0.5, 1.3), (0.5, 0.3, 1.3), (0.02, 0.01, 1.3)),
    "force.ripple": (None, (0.4, 0.2, 0.3), (0.02, 0.01, 0.5)),
    "friction.coulomb": (None, 0.7, 0.015),
    "friction.direction": (None, (0.2, 0.6), (1e-3, 3e-3)),
    "friction.hysteresis": (None, (0.7, 0.02), (0.015, 0.1)),
    "friction.load": (None, 0.2, 0.1),
    "friction.load_direction": (None, None, (0.2, 0.05)),
    "friction.load_quadratic": (None, None, (0.05, 1.0)),
    "friction.position": (None, (0.7, 0.3, -0.4, 0.6), (0.015, 0.005, 0.005, 1.5)),
    "friction.stribeck": (None, (0.4, 0.4, 0.1), (0.01, 0.01, 0.5)),
    "friction.warming": (None, (0.5, 0.3, 1.0), (0.015, 1e-3, 1.0)),
    "gravity.scale": (0.05, 0.05, 0.05),
    "gravity.tilt": ((0.05, 0.03), 0.05, 0.05),
    "input.bias": (None, 0.3, 0.02),
    "input.deadband": (None, 0.4, 0.02),
    "input.delay": (None, 0.017, 0.017),
    "input.gain": (None, 0.1, 0.1),
    "input.hold": (None, 1.0, 1.0),
    "input.lag": (None, 0.04, 0.04),
    "input.power": (None, (-0.3, 0.5), (2.0, 0.5)),
    "input.rate": (None, 8.0, 0.4),
    "input.saturation": (None, 1.5, 0.05),
    "joint.backlash": (None, (0.02, 0.4), (0.02, 0.4)),
    "joint.flexibility": (None, (0.3, 30.0, 0.1), (0.3, 30.0, 0.1)),
    "lift.magnus": ((0.3, 0.1), None, None),
    "restitution.speed": (-0.15, None, None),
    "sensor.bias": (0.05, 0.05, 0.05),
    "sensor.delay": (0.013, 0.013, 0.013),
    "sensor.drift": (0.05, 0.05, 0.05),
    "sensor.eccentricity": (None, None, (0.02, 0.03)),
    "sensor.gain": (0.02, 0.02, 0.02),
    "sensor.lag": (0.03, 0.03, 0.03),
    "sensor.slip": (None, (0.05, 0.605), (0.05, 0.605)),
    "servo.deadband": (None, None, 0.05),
    "servo.derivative": (None, None, 0.02),
    "servo.profile": (None, None, 20.0),
    "state.limit": (None, (-8.0, -0.2, 0.2), (-0.02, -0.2, 0.05)),
    "spring.cubic": (None, 2.0, 0.05),
    "spring.linear": (None, 3.0, 0.1),
    "supply.braking": (None, 0.6, 0.3),
    "supply.sag": (None, 0.1, 1.0),
    "wind": ((0.05, 3.0, -2.0), (0.3, 2.0), None),
}


def scenario(system):
    """Return a scenario of about two seconds in which every effect changes the motion."""
    if system == "ball":
        return Scenario(np.arange(120) / 60, {"x": 0.1, "z": 3.0, "vx": 2.0, "vy": -1.0, "vz": 1.0})
    t = np.arange(200) / 100
    if system == "pendulum":
        return Scenario(t, {"q": 1.2, "qd": -2.0}, {"u": 0.08 * np.sign(np.sin(4.1 * t + 0.3))})
    if system == "slider":
        return Scenario(t, {"x": 0.1, "v": -1.0}, {"u": 2.0 * np.sign(np.sin(5.3 * t + 0.2))})
    goal = np.where(t < 0.8, 1.0, -0.6)
    return Scenario(
        t, {"q": 0.2, "qd": 0.0}, {"goal": goal, "torque_enable": (t < 1.6).astype(float)}
    )


def has(system, effect):
    """Return whether the effect applies to the system."""
    return effect in effects.list_effects_for(SIMULATORS[system].system)


def carried(effect):
    """Return whether engines of one coordinate support the effect, which has no hidden state."""
    return effects.get_effect(effect).hook != "hidden"


def coefficients(system, effect):
    """Return the coefficients of the effect on this system."""
    kind = SIMULATORS[system].system
    values = COEFFICIENTS[effect][("point", "linear", "rotary").index(kind.kind)]
    count = len(effects.get_effect(effect).on(kind))
    return list(values)[:count] if isinstance(values, tuple) else values


def motion(system, engine, fixed=None, **settings):
    """Return the observed positions, (T, D)."""
    simulator = SIMULATORS[system](engine=engine, fixed=fixed or {}, **settings)
    observation = simulator.simulate(np.array([THETA[system]]), scenario(system))[0]
    simulator.close()
    return observation[:, : len(simulator.system.coordinates)]


def compute_max_difference(first, second):
    """Return the largest difference between two motions."""
    return float(np.abs(first - second).max())


def seconds(system, engine, fixed=None):
    """Return the minimum time of a rollout in 20 repetitions, s."""
    simulator, times = SIMULATORS[system](engine=engine, fixed=fixed or {}), []
    run, theta = scenario(system), np.array([THETA[system]])
    for _ in range(20):
        begin = time.perf_counter()
        simulator.simulate(theta, run)
        times.append(time.perf_counter() - begin)
    return min(times)


def systems_table():
    """Yield table rows, engine by system: errors against the batch engine at a step of 0.25 ms."""
    for system, steps in STEPS.items():
        exact = motion(system, "batch", time_step=2.5e-4)
        for engine in ("batch", *OTHERS):
            errors = [
                compute_max_difference(motion(system, engine, time_step=h), exact) for h in steps
            ]
            order = (
                "exact"
                if max(errors) < 1e-9
                else f"{np.polyfit(np.log(steps), np.log(errors), 1)[0]:.2f}"
            )
            error, cost = (
                compute_max_difference(motion(system, engine), exact),
                seconds(system, engine),
            )
            yield f"| {system} | {engine} | {order} | {error:.0e} | {1e3 * cost:.1f} |"


def effects_table():
    """Yield table rows, effect by system: the change due to the effect, and the larger difference
    of the two other engines from the batch engine.
    """
    for effect in effects.list_names():
        cells = []
        for system in SIMULATORS:
            if not has(system, effect) or not carried(effect):
                cells.append("–")
                continue
            fixed = {effect: coefficients(system, effect)}
            exact = motion(system, "batch", fixed, time_step=1e-3)
            off = max(
                compute_max_difference(motion(system, engine, fixed), exact) for engine in OTHERS
            )
            cells.append(
                f"{off:.0e} of {compute_max_difference(motion(system, 'batch'), exact):.0e}"
            )
        yield f"| `{effect}` | {' | '.join(cells)} |"


if __name__ == "__main__":
    for table in (systems_table, effects_table):
        for line in table():
            print(line, flush=True)
