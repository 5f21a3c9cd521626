"""Worlds for the exam: one run of ball, pendulum or slider with any effect of the library, or with
a foreign cause.

Solved with scipy, or simulated by MuJoCo; never by the engine that `explain` itself uses. What the
numbers of an effect mean stands in sims/effects/README.md; the foreign causes are told here, where
the library has nothing like them:

| cause | numbers | it does |
|---|---|---|
| `patch` | friction, centre, half width | pendulum, slider: dry friction in a region of position |
| `gust` | force, seconds, begin in run 0, in run 1, ... | pendulum, slider: a force for a while |
| `gust` | along x, upward, seconds, begin in run 0, ... | ball: an acceleration for a while |
| `ageing` | growth | pendulum, slider: damping -c t v, which grows with time |
| `latch` | stiffness, place | pendulum, slider: a spring beyond a place, in every other run |
| `updraft` | acceleration, centre, half width | ball: upward within a region of x |
| `wear` | rate | ball: restitution e0 (1 - c t) |
| `layer` | drag, height | ball: quadratic drag above a height |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp

import numpy as np

from sims import effects as library
from sims.ball.simulator import Ball
from sims.pendulum.simulator import Pendulum
from sims.slider.simulator import Slider
from tests.exam import flights, joints

SIMULATORS = {"ball": Ball, "pendulum": Pendulum, "slider": Slider}
FOREIGN = {"ball": flights.FOREIGN, "pendulum": joints.FOREIGN, "slider": joints.FOREIGN}
CHANNELS = {"ball": ("x", "y", "z"), "pendulum": ("q", "qd"), "slider": ("x", "v")}
FINE = 5e-4  # seconds: a lagging sensor is followed in steps no longer than this
MUJOCO_STEP = 1e-3  # seconds: at MuJoCo's default step its error would be a tenth of the noise


@dataclass(frozen=True)
class World:
    """What there really is.

    Attributes:
        system: its name.
        parameters, constants: numbers by name.
        effects: coefficients of effects of the library, in the order in which a signal passes them.
        foreign: numbers of causes that the library does not have.
    """

    system: str
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    effects: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    foreign: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


def constants_of(system, **changed):
    """The system's constants by name, some changed."""
    return {c.name: c.value for c in SIMULATORS[system].constants} | changed


def solved(world, scenario, channels, number=0):
    """What noiseless sensors record of a run, (T, C), by scipy; `number` is the run's place in the
    recording.
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


def simulated(world, scenario, channels):
    """The same by MuJoCo, which knows no foreign causes; where one coordinate is not all that
    moves, by the engine that knows more.
    """
    assert not world.foreign
    more = any(library.get(name).hook == "hidden" for name in world.effects)
    engine, step = ("batch", 2.5e-3) if more else ("mujoco", MUJOCO_STEP)
    effects = {name: list(c) for name, c in world.effects.items()}
    kind = SIMULATORS[world.system]
    simulator = kind(world.constants, channels, engine=engine, fixed=effects, time_step=step)
    try:
        return simulator.simulate(
            np.array([[world.parameters[p.name] for p in kind.system.parameters]]), scenario
        )[0]
    finally:
        simulator.close()


def _read_at(system, channels):
    """The column that gain, bias and drift act on."""
    preferred = {"ball": ("z", "x", "y"), "pendulum": ("q", "qd"), "slider": ("x", "v")}[system]
    return next(channels.index(name) for name in preferred if name in channels)


def _refined(instants):
    """A grid from 0 through all instants, and where they stand in it."""
    grid, rows = [0.0], []
    for instant in instants.tolist():
        if instant > grid[-1]:
            parts = int(np.ceil((instant - grid[-1]) / FINE))
            grid += np.linspace(grid[-1], instant, parts + 1)[1:].tolist()
        rows.append(len(grid) - 1)
    return np.array(grid), np.array(rows)


def _lagged(values, grid, lag):
    """y' = (x - y) / lag from y = x, for x straight between the grid's points."""
    result, y = values.copy(), values[0].copy()
    for k, h in enumerate(np.diff(grid).tolist()):
        slope = (values[k + 1] - values[k]) / h
        ahead = values[k] - slope * lag  # the solution that stays `lag` behind the line
        y = ahead + slope * h + (y - ahead) * exp(-h / lag)
        result[k + 1] = y
    return result
