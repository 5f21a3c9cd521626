"""What else differs from run to run: how far and how fast it moved and which way, how strongly it
was driven, when it was, and what further columns of the recording say, as a temperature.

Of a number that belongs to a joint that joint's motion counts; else the system's first coordinate.
The motion is the fitted model's, which has no noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from bench.gap.model.models import Model
from bench.gap.model.world import World
from sims.base import Array

Kind = Literal[
    "load", "supply", "amplitude", "speed", "direction", "position", "command", "time", "other"
]

LOADS = ("kg", "kg*m^2", "N", "N*m")
"""Units of constants that are loads."""
BARE = 1e-3
"""Share of its own size by which something has to differ between runs to be of any use."""


class Along(NamedTuple):
    """Something that differs from run to run.

    Attributes:
        kind: what it is to whoever asks what is missing.
        name: in words; of an extra column its name.
        values: (R,) of each run, in any unit.
    """

    kind: Kind
    name: str
    values: Array


def along(world: World, model: Model, number: str) -> list[Along]:
    """What differs between the runs of a world, as far as it may move a number of a model."""
    everything = [*_apart_from_motion(world), *_motion(world, model, number)]
    return [one for one in everything if _differs(one.values)]


def constant(world: World, name: str) -> Kind:
    """What a constant is that differs between runs."""
    units = {constant.name: constant.unit for constant in world.kind.constants}
    unit = units.get(name, "")
    if unit in LOADS:
        return "load"
    return "supply" if unit == "V" else "other"


def _apart_from_motion(world: World) -> Iterator[Along]:
    yield Along("time", "the order of runs", np.arange(len(world.runs), dtype=np.float64))
    for name in world.runs[0].inputs:
        sizes = [float(np.sqrt(np.mean(np.square(run.inputs[name])))) for run in world.runs]
        yield Along("command", f"the size of {name}", np.array(sizes))
    for name in world.runs[0].extra:
        columns = [run.extra.get(name, np.empty(0)) for run in world.runs]
        means = [float(np.nanmean(v)) if np.isfinite(v).any() else np.nan for v in columns]
        yield Along("other", name, np.array(means))


def _motion(world: World, model: Model, number: str) -> Iterator[Along]:
    """How the coordinate moved that a number is about."""
    system = world.simulator.system
    if not system.coordinates:
        return
    joint = f"q.{number.partition('@')[2]}"
    name = joint if joint in system.coordinates else system.coordinates[system.primary]
    if name not in world.channels:
        return
    column = world.channels.index(name)
    rows = []
    for track, simulated in zip(world.tracks, model.fit.simulated, strict=True):
        times = track.scenario.times
        place = simulated[: times.size, column]
        rate = np.gradient(place, times)
        way = float(rate.sum() / max(np.abs(rate).sum(), 1e-300))
        rows.append((float(place.std()), float(np.sqrt(np.mean(rate**2))), way, place.mean()))
    amplitude, speed, direction, position = np.array(rows).T
    yield Along("amplitude", "the amplitude", amplitude)
    yield Along("speed", "the speed", speed)
    yield Along("direction", "the direction of motion", direction)
    yield Along("position", "the position", position)


def _differs(values: Array) -> bool:
    return bool(np.isfinite(values).all() and np.ptp(values) > BARE * np.abs(values).max())
