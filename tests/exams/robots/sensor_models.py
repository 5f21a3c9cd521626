"""Sensor readings of a motion."""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.reference_signals import SENSOR_EFFECTS
from bench.diagnosis_benchmark.machine_cases.reference_motion import select_signal_effects

NOISES = ("white", "ar1", "quantised")


def observed(world, run, channels, slips=()):
    """Return noise-free sensor readings of a run, (T, C).

    Args:
        world: `reference_world.World`.
        run: `reference_world.Run`.
        channels: names such as q.elbow.
        slips: (joint, time, jump) of a slipping encoder, an unmodelled cause.
    """
    skew = world.effects.get("clock.skew", (0.0,))[0]
    effects = {name: select_signal_effects(world.effects, "sensor.", name) for name in channels}
    instants = {}
    for name in channels:
        late = effects[name].get("sensor.delay", (0.0,))[0]
        instants[name] = np.maximum(run.times * (1 + skew) - late, 0.0)
    grid = np.unique(np.concatenate(list(instants.values())))
    motion = world.move(run, grid)
    columns = []
    for name in channels:
        kind, _, joint = name.partition(".")
        source = {"q": motion.q, "qd": motion.v, "tau": motion.force}[kind]
        index = world.machine.joints.index(joint)
        column = source[np.searchsorted(grid, instants[name]), index]
        for slipping, instant, jump in slips if kind == "q" else ():
            if slipping == index:
                column = column + jump * (run.times >= instant)
        for effect, c in effects[name].items():
            if effect in SENSOR_EFFECTS:
                column = SENSOR_EFFECTS[effect](column, c, run.times, run.times)
        columns.append(column)
    return np.column_stack(columns)
