"""Simulate recordings of ball, pendulum or slider with hidden effects or unmodelled causes.

The runs of a case (`simulate_runs`) are solved with scipy or simulated by MuJoCo, not by the engine
that `explain` uses, except for hidden-state effects in `simulate_with_mujoco`. The observations by
which causes are sized (`simulate_causes`, `simulate_observations`) have no noise and mostly come
from that engine, which is faster.

sims/effects/README.md defines the coefficients of the effects. The unmodelled causes, which the
library does not contain, are:

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

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis_benchmark.case_generation import ball_reference, joint_reference
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase, make_case_rng
from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import (
    SENSOR_EFFECTS,
    EffectCoefficients,
    TrueSystem,
    apply_sensor_lag,
    compute_read_times,
)
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    SIMULATORS,
    RecordingConditions,
)
from sims import effects as library
from sims.core.simulator import Array, Scenario
from sims.recording.recording import Run

UNMODELLED_CAUSES = {
    "ball": ball_reference.UNMODELLED_CAUSES,
    "pendulum": joint_reference.UNMODELLED_CAUSES,
    "slider": joint_reference.UNMODELLED_CAUSES,
}
"""Unmodelled causes by system."""

CHANNELS = {"ball": ("x", "y", "z"), "pendulum": ("q", "qd"), "slider": ("x", "v")}
"""Channels that the reference simulations can observe, by system."""

FINE_STEP_SECONDS = 5e-4
"""Maximum step in which a lagging sensor is integrated, s."""

MUJOCO_STEP_SECONDS = 1e-3
"""Step of MuJoCo, s; at its default step the error would be a tenth of the noise."""

HIDDEN_STATE_STEP = 2.5e-3
"""Step of the engine for effects with hidden states, s."""


def simulate_runs(case: BenchmarkCase, setting: RecordingConditions) -> tuple[Run, ...]:
    """Simulate every run of a case, add sensor noise, and mark the last runs as held out.

    Args:
        case: the case; it states the simulator of the recording (`source`).
        setting: its recording conditions, with all runs.

    Returns:
        The runs, named by their indices, with noisy channels and the inputs.
    """
    rng = make_case_rng(case.name, "noise")
    first_held_out = case.runs - count_held_out_runs(case)
    true_system, runs = setting.make_true_system(case.effects), []
    for run_index, scenario in enumerate(setting.scenarios):
        if case.source == "mujoco":
            observed = simulate_with_mujoco(true_system, scenario, setting.channels)
        else:
            observed = simulate_with_scipy(true_system, scenario, setting.channels, run_index)
        recorded = setting.noise.add_to(observed, rng)
        channels = dict(zip(setting.channels, recorded.T, strict=True))
        is_held_out = run_index >= first_held_out
        # The recording states neither initial states nor constants of a run.
        runs.append(
            Run(str(run_index), scenario.times, channels, scenario.inputs, {}, {}, is_held_out)
        )
    return tuple(runs)


def count_held_out_runs(case: BenchmarkCase) -> int:
    """Return the number of held-out runs; they are the last runs of the recording."""
    return max(1, case.runs // 3)


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
    instants = compute_read_times(true_system.effects, scenario.times - scenario.times[0])
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
            observed = apply_sensor_lag(observed, grid, coefficients[0])
    return observed[sample_indices]


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


def simulate_causes(setting: RecordingConditions, causes: EffectCoefficients) -> Array:
    """Simulate noise-free observations (R, T, C) with hidden causes.

    Unmodelled causes are simulated by scipy, because the batch engine does not know them.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions.
        causes: coefficients of the hidden causes by name.
    """
    if set(causes).isdisjoint(UNMODELLED_CAUSES[setting.system]):
        return simulate_observations(setting, causes)
    true_system = setting.make_true_system(causes)
    return np.array(
        [
            simulate_with_scipy(true_system, scenario, setting.channels, run_index)
            for run_index, scenario in enumerate(setting.scenarios)
        ]
    )


def simulate_observations(setting: RecordingConditions, effects: EffectCoefficients) -> Array:
    """Simulate noise-free observations (R, T, C) with given effects by the batch engine.

    They serve to size the causes of a case. `explain` uses the same engine, so recordings of the
    benchmark must not come from it.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions with the true base parameters and the runs.
        effects: coefficients of the effects by name; empty for none.
    """
    kind = SIMULATORS[setting.system]
    fixed_effects = {name: list(c) for name, c in effects.items()}
    simulator = kind(setting.constants, setting.channels, engine="batch", fixed=fixed_effects)
    # One row of base parameters for each run.
    theta = np.array(
        [[setting.parameters[p.name] for p in kind.system.parameters]] * len(setting.scenarios)
    )
    return simulator.simulate_batch(theta, setting.scenarios)
