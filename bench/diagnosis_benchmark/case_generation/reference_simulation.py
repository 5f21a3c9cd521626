"""Noise-free reference recordings of ball, pendulum or slider, with effects or unmodelled causes.

They are solved with scipy or simulated by MuJoCo, not by the engine that `explain` uses (except
`simulate_with_mujoco` with hidden-state effects). sims/effects/README.md defines the coefficients
of the effects. The unmodelled causes, which the library does not contain, are:

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

from bench.diagnosis_benchmark.case_generation import ball_reference, joint_reference
from bench.diagnosis_benchmark.case_generation.reference_signals import (
    SENSOR_EFFECTS,
    EffectCoefficients,
    TrueSystem,
)
from sims import effects as library
from sims.core.simulator import Array, Scenario
from sims.system_simulator import SystemSimulator
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.slider import Slider

__all__ = [
    "CHANNELS",
    "SIMULATORS",
    "UNMODELLED_CAUSES",
    "EffectCoefficients",
    "TrueSystem",
    "get_constants",
    "simulate_with_mujoco",
    "simulate_with_scipy",
]

SIMULATORS: dict[str, type[SystemSimulator]] = {
    "ball": Ball,
    "pendulum": Pendulum,
    "slider": Slider,
}
UNMODELLED_CAUSES = {
    "ball": ball_reference.UNMODELLED_CAUSES,
    "pendulum": joint_reference.UNMODELLED_CAUSES,
    "slider": joint_reference.UNMODELLED_CAUSES,
}
CHANNELS = {"ball": ("x", "y", "z"), "pendulum": ("q", "qd"), "slider": ("x", "v")}
FINE_STEP_SECONDS = 5e-4  # seconds: maximum step in which a lagging sensor is integrated
MUJOCO_STEP_SECONDS = (
    1e-3  # seconds: at MuJoCo's default step its error would be a tenth of the noise
)
HIDDEN_STATE_STEP = 2.5e-3
"""Step of the engine for effects with hidden states, s."""


def get_constants(system: str, **changed: float) -> dict[str, float]:
    """Return the constants of a system by name.

    Args:
        system: name of the system, such as ``pendulum``.
        **changed: constants with other values.
    """
    return {c.name: c.value for c in SIMULATORS[system].constants} | changed


def simulate_with_scipy(
    true_system: TrueSystem, scenario: Scenario, channels: Sequence[str], number: int = 0
) -> Array:
    """Simulate a run with scipy and return noise-free sensor readings.

    A delay or a wrong clock of the sensors changes the times at which the motion is read, a lag
    needs the motion between the samples, and the other sensor effects change the readings.

    Args:
        true_system: true system of a case: constants, parameters and hidden effects.
        scenario: scenario of the run: times, initial state, inputs and constants.
        channels: names of the C channels.
        number: index of the run in the recording.

    Returns:
        Readings, (T, C).
    """
    instants = _compute_read_times(true_system.effects, scenario.times - scenario.times[0])
    grid, sample_indices = (
        _refine_time_grid(instants)
        if "sensor.lag" in true_system.effects
        else (instants, np.arange(instants.size))
    )
    simulate_motion = (
        ball_reference.simulate_ball
        if true_system.system == "ball"
        else joint_reference.simulate_joint
    )
    states = simulate_motion(true_system, scenario, number, grid)
    observed = states[:, [CHANNELS[true_system.system].index(name) for name in channels]]
    # Effects of one sensor act on one channel, a lag on all of them.
    read_column = _get_read_column(true_system.system, channels)
    for name, coefficients in true_system.effects.items():
        if name in SENSOR_EFFECTS:
            observed[:, read_column] = SENSOR_EFFECTS[name](
                observed[:, read_column], coefficients, grid, scenario.times[0] + grid
            )
        elif name == "sensor.lag":
            observed = _apply_lag(observed, grid, coefficients[0])
    return observed[sample_indices]


def _compute_read_times(effects: EffectCoefficients, times: Array) -> Array:
    """Compute the times at which the sensors read the motion, with a delay and a wrong clock.

    The effects act in their order. The motion is known from time 0 on: before it, a delayed sensor
    shows the initial state.

    Args:
        effects: coefficients of the hidden effects by name.
        times: sample times since the first sample, s, (T,).

    Returns:
        Times that do not decrease, at least 0, s, (T,).
    """
    instants = times
    for name, coefficients in effects.items():
        if name == "sensor.delay":
            instants = instants - coefficients[0]
        elif name == "clock.skew":
            instants = instants * (1 + coefficients[0])
    read_times: Array = np.maximum.accumulate(np.maximum(instants, 0.0))
    return read_times


def simulate_with_mujoco(
    true_system: TrueSystem, scenario: Scenario, channels: Sequence[str]
) -> Array:
    """Simulate a run with MuJoCo, without unmodelled causes, and return noise-free sensor readings.

    Hidden-state effects move more than one coordinate, so they are simulated by the batch engine,
    with a step of 2.5 ms.

    Args:
        true_system: true system of a case: constants, parameters and hidden effects.
        scenario: scenario of the run: times, initial state, inputs and constants.
        channels: names of the C channels.

    Returns:
        Readings, (T, C).
    """
    has_hidden_states = any(
        library.get_effect(name).hook == "hidden" for name in true_system.effects
    )
    engine, step = (
        ("batch", HIDDEN_STATE_STEP) if has_hidden_states else ("mujoco", MUJOCO_STEP_SECONDS)
    )
    effects = {name: list(c) for name, c in true_system.effects.items()}
    kind = SIMULATORS[true_system.system]
    simulator = kind(true_system.constants, channels, engine=engine, fixed=effects, time_step=step)
    theta = np.array([[true_system.parameters[p.name] for p in kind.system.parameters]])
    try:
        observed: Array = simulator.simulate(theta, scenario)[0]  # theta has one row
        return observed
    finally:
        simulator.close()


def _get_read_column(system: str, channels: Sequence[str]) -> int:
    """Return the index of the channel on which sensor effects act: the height, angle or position.

    If that channel is not recorded, it is the first recorded one of the others.

    Args:
        system: name of the system, such as ``pendulum``.
        channels: names of the recorded channels.
    """
    preferred = {"ball": ("z", "x", "y"), "pendulum": ("q", "qd"), "slider": ("x", "v")}[system]
    return next(channels.index(name) for name in preferred if name in channels)


def _refine_time_grid(instants: Array) -> tuple[Array, NDArray[np.intp]]:
    """Refine a time grid from 0 through all sample times to steps of `FINE_STEP_SECONDS` or less.

    A lagging sensor depends on the motion between the samples, so it is integrated on this grid.

    Args:
        instants: sample times in increasing order, s, (T,).

    Returns:
        The grid, and the index of each sample time in it.
    """
    grid, sample_indices = [0.0], []
    for instant in instants.tolist():
        if instant > grid[-1]:
            parts = int(np.ceil((instant - grid[-1]) / FINE_STEP_SECONDS))
            grid += np.linspace(grid[-1], instant, parts + 1)[1:].tolist()
        sample_indices.append(len(grid) - 1)
    return np.array(grid), np.array(sample_indices)


def _apply_lag(values: Array, grid: Array, lag: float) -> Array:
    """Apply a first-order sensor lag: solve y' = (x - y) / lag.

    The solution is exact for readings x that are linear between grid points.

    Args:
        values: readings x of C channels without lag at G grid points, (G, C).
        grid: times, s, (G,).
        lag: time constant, s.

    Returns:
        Lagging readings y, (G, C); at the first grid point y = x.
    """
    lagged, y = values.copy(), values[0].copy()
    for sample, step in enumerate(np.diff(grid).tolist()):
        slope = (values[sample + 1] - values[sample]) / step
        # On a line, the lagging reading ends up `lag` seconds behind it.
        particular_solution = values[sample] - slope * lag
        y = particular_solution + slope * step + (y - particular_solution) * exp(-step / lag)
        lagged[sample + 1] = y
    return lagged
