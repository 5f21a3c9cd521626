"""What sensors make of a motion, and the noise that they add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NOISES = ("white", "ar1", "quantised")


def observed(world, run, channels, slips=()):
    """What noiseless sensors record of a run, (T, C).

    Args:
        world: of `world.World`.
        run: of `world.Run`.
        channels: names such as q.elbow.
        slips: (joint, instant, jump) of an encoder that slips: a foreign cause.
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
        columns.append(column * (1 + gain) + bias)
    return np.column_stack(columns)


@dataclass(frozen=True)
class Noise:
    """Sensor noise: `sigma` by channel, its `kind`, the AR(1) coefficient, white noise in units of
    a rounding step.
    """

    sigma: dict[str, float]
    kind: str
    phi: float
    dither: float

    def added(self, values, rng):
        """Noiseless observations (T, C) as recorded."""
        sigma = np.array(list(self.sigma.values()))
        white = rng.standard_normal(values.shape)
        if self.kind == "quantised":  # rounding is good for step / sqrt(12)
            step = sigma / np.sqrt(1 / 12 + self.dither**2)
            return np.round((values + self.dither * step * white) / step) * step
        if self.kind == "ar1":
            for k in range(1, len(white)):
                white[k] = self.phi * white[k - 1] + np.sqrt(1 - self.phi**2) * white[k]
        return values + sigma * white
