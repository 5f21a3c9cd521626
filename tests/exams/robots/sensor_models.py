"""Sensor readings of a motion."""

from __future__ import annotations

import numpy as np

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
    instants = {}
    for name in channels:
        late = world.effects.get(f"sensor.delay@{name}", (0.0,))[0]
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
        gain = world.effects.get(f"sensor.gain@{name}", (0.0,))[0]
        bias = world.effects.get(f"sensor.bias@{name}", (0.0,))[0]
        sine, cosine = world.effects.get(f"sensor.eccentricity@{name}", (0.0, 0.0))
        column = column + sine * np.sin(column) + cosine * np.cos(column)
        jump, instant = world.effects.get(f"sensor.slip@{name}", (0.0, 0.0))
        columns.append(column * (1 + gain) + bias + jump * (run.times >= instant))
    return np.column_stack(columns)
