"""Noise-free reference recordings of ball, pendulum or slider, with effects or unmodelled causes.

They are solved with scipy or simulated by MuJoCo, not by the engine that `explain` uses (except
`simulated` with hidden-state effects). sims/effects/README.md defines the coefficients of the
effects. The unmodelled causes, which the library does not contain, are:

| cause | numbers | meaning |
|---|---|---|
| `patch` | friction, centre, half width | pendulum, slider: dry friction in a region of position |
| `gust` | force, seconds, begin in run 0, in run 1, ... | pendulum, slider: temporary force |
| `gust` | along x, upward, seconds, begin in run 0, ... | ball: temporary acceleration |
| `ageing` | growth | pendulum, slider: damping -c t v, which grows with time |
| `latch` | stiffness, place | pendulum, slider: spring beyond a place, in every other run |
| `updraft` | acceleration, centre, half width | ball: upward within a region of x |
| `wear` | rate | ball: restitution e0 (1 - c t) |
| `layer` | drag, height | ball: quadratic drag above a height |
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.worlds import flights, joints
from bench.diagnosis.worlds.base import Effects, World
from sims import effects as library
from sims.ball.simulator import Ball
from sims.base import Array, Scenario
from sims.pendulum.simulator import Pendulum
from sims.simulated import Simulated
from sims.slider.simulator import Slider

__all__ = [
    "CHANNELS",
    "FOREIGN",
    "SIMULATORS",
    "Effects",
    "World",
    "constants_of",
    "simulated",
    "solved",
]

SIMULATORS: dict[str, type[Simulated]] = {"ball": Ball, "pendulum": Pendulum, "slider": Slider}
FOREIGN = {"ball": flights.FOREIGN, "pendulum": joints.FOREIGN, "slider": joints.FOREIGN}
CHANNELS = {"ball": ("x", "y", "z"), "pendulum": ("q", "qd"), "slider": ("x", "v")}
FINE = 5e-4  # seconds: maximum step in which a lagging sensor is integrated
MUJOCO_STEP = 1e-3  # seconds: at MuJoCo's default step its error would be a tenth of the noise


def constants_of(system: str, **changed: float) -> dict[str, float]:
    """Return the constants of a system by name.

    Args:
        system: name of the system.
        **changed: constants with other values.
    """
    return {c.name: c.value for c in SIMULATORS[system].constants} | changed


def solved(world: World, scenario: Scenario, channels: Sequence[str], number: int = 0) -> Array:
    """Simulate a run with scipy and return noise-free sensor readings.

    Args:
        world: the true system.
        scenario: the run.
        channels: names of the C channels.
        number: index of the run in the recording.

    Returns:
        Readings, (T, C).
    """
    times = scenario.times - scenario.times[0]
    instants = times
    for name, c in world.effects.items():
        if name == "sensor.delay":
            instants = instants - c[0]
        elif name == "clock.skew":
            instants = instants * (1 + c[0])
    instants = np.maximum.accumulate(np.maximum(instants, 0.0))
    grid, rows = (
        _refined(instants)
        if "sensor.lag" in world.effects
        else (instants, np.arange(instants.size))
    )
    move = flights.move if world.system == "ball" else joints.move
    states = move(world, scenario, number, grid)
    observed = states[:, [CHANNELS[world.system].index(name) for name in channels]]
    reads = _read_at(world.system, channels)
    for name, c in world.effects.items():
        if name == "sensor.gain":
            observed[:, reads] *= 1 + c[0]
        elif name == "sensor.bias":
            observed[:, reads] += c[0]
        elif name == "sensor.drift":
            observed[:, reads] += c[0] * grid
        elif name == "sensor.eccentricity":
            angle = observed[:, reads].copy()
            observed[:, reads] += c[0] * np.sin(angle) + c[1] * np.cos(angle)
        elif name == "sensor.slip":
            observed[:, reads] += np.where(scenario.times[0] + grid >= c[1], c[0], 0.0)
        elif name == "sensor.lag":
            observed = _lagged(observed, grid, c[0])
    return observed[rows]


def simulated(world: World, scenario: Scenario, channels: Sequence[str]) -> Array:
    """Simulate a run with MuJoCo, without unmodelled causes, and return noise-free sensor readings.

    Hidden-state effects move more than one coordinate, so they are simulated by the batch engine,
    with a step of 2.5 ms.

    Args:
        world: the true system.
        scenario: the run.
        channels: names of the C channels.

    Returns:
        Readings, (T, C).
    """
    assert not world.foreign
    more = any(library.get(name).hook == "hidden" for name in world.effects)
    engine, step = ("batch", 2.5e-3) if more else ("mujoco", MUJOCO_STEP)
    effects = {name: list(c) for name, c in world.effects.items()}
    kind = SIMULATORS[world.system]
    simulator = kind(world.constants, channels, engine=engine, fixed=effects, time_step=step)
    theta = np.array([[world.parameters[p.name] for p in kind.system.parameters]])
    try:
        observed: Array = simulator.simulate(theta, scenario)[0]
        return observed
    finally:
        simulator.close()


def _read_at(system: str, channels: Sequence[str]) -> int:
    """Return the index of the channel on which sensor effects act."""
    preferred = {"ball": ("z", "x", "y"), "pendulum": ("q", "qd"), "slider": ("x", "v")}[system]
    return next(channels.index(name) for name in preferred if name in channels)


def _refined(instants: Array) -> tuple[Array, NDArray[np.intp]]:
    """Refine a time grid from 0 through all sample times.

    Returns:
        The grid, and the index of each sample time in it.
    """
    grid, rows = [0.0], []
    for instant in instants.tolist():
        if instant > grid[-1]:
            parts = int(np.ceil((instant - grid[-1]) / FINE))
            grid += np.linspace(grid[-1], instant, parts + 1)[1:].tolist()
        rows.append(len(grid) - 1)
    return np.array(grid), np.array(rows)


def _lagged(values: Array, grid: Array, lag: float) -> Array:
    """Solve y' = (x - y) / lag with y = x at the start, for x linear between grid points."""
    result, y = values.copy(), values[0].copy()
    for k, h in enumerate(np.diff(grid).tolist()):
        slope = (values[k + 1] - values[k]) / h
        ahead = values[k] - slope * lag  # particular solution: `lag` seconds behind the line
        y = ahead + slope * h + (y - ahead) * exp(-h / lag)
        result[k + 1] = y
    return result
