"""The error of an extended simulator on another recording: initial states are estimated there,
nothing else.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.gap.measure import HeldOutRuns
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.registry import simulators
from sims.base import InputError, unknown
from sims.extended import opened
from sims.own import OwnSimulator
from sims.recording.recording import read_recording, system_of


def scored(model: Path, recording: Path, held_out: bool = False) -> dict[str, Any]:
    """RMSE by channel in its unit, in units of the noise over all channels, runs and samples
    counted.

    Args:
        model: extended.toml.
        recording: the table.
        held_out: count only runs that are marked so.

    Raises:
        InputError: a file cannot be read, or the recording is of another system.
    """
    extended, kind, _ = opened(model, simulators.get)
    if (other := system_of(recording)) not in (extended.system, extended.name):
        raise InputError(
            f"{recording}: expected a recording of {extended.system}, as {model} is; "
            f"found one of {other}"
        )
    data = read_recording(recording, kind, whole=True)
    data = replace(data, constants={**extended.constants, **data.constants})
    runs = data.held_out() if held_out else data.runs
    if not runs:
        raise InputError(f"{recording}: --held-out: no run is marked held_out")
    for channel in extended.observe:
        if channel not in runs[0].channels:
            raise unknown(f"channel of {recording}", channel, list(runs[0].channels))
    engine = None if issubclass(kind, OwnSimulator) else extended.engine
    world = World(kind, data, runs, engine, candidates=list(extended.effects))
    theta = world.nominal()
    for place, parameter in enumerate(world.parameters[: world.own]):
        if parameter.name in extended.parameters:
            theta[place] = extended.parameters[parameter.name].value
    for name, numbers in extended.effects.items():
        there = [c.name for c in world.effects[name].on(world.simulator.system)]
        theta[world.slots[name]] = [numbers[c].value if c in numbers else 0.0 for c in there]
    floor = noise_floor(world, data)
    measured = HeldOutRuns(world, Noise(floor.sigma, np.zeros(len(floor.sigma)))).measure([theta])[
        0
    ]
    world.close()
    seen = np.isfinite(world.observed)
    squares = np.where(seen, np.square(world.observed - measured.simulated), 0.0)
    counts = seen.sum(axis=(0, 1))
    if not np.isfinite(squares).all():
        raise InputError(f"{recording}: the simulation failed with the parameters of {model}")
    rmse = {
        name: float(np.sqrt(squares[:, :, c].sum() / counts[c]))
        for c, name in enumerate(world.channels)
        if counts[c]
    }
    return {
        "rmse": rmse,
        "normalised_rmse": float(np.sqrt((squares / np.square(floor.sigma)).sum() / counts.sum())),
        "runs": len(runs),
        "samples": int(seen.any(axis=2).sum()),
        "units": {c.name: c.unit for c in world.simulator.channels},
    }
