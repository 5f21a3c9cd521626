"""Shows the gap: how far above the noise, in which runs, channels, phases, and what it follows."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.gap.model.noise import Mask
from bench.gap.model.world import World
from bench.gap.report.story import Place, Profile, Side
from sims.base import Array

if TYPE_CHECKING:
    from sims.robot.model import Robot

BINS = 12
"""Of a profile."""
TAILS = 0.005
"""Share of the samples to either side that a profile's bins leave out: they would stretch it."""
SLOW = 0.05
"""Share of the largest speed below which a motion turns round."""
QUIET = 0.01
"""Share of the largest speed below which, for a while, it is at rest."""
REST = 5
"""Samples in a row for which something must hold to last."""
EXTREME = 0.999
"""Share of its largest value from which on an input is at its extreme."""
NEAR_IMPACT = 2
"""Samples to either side of an impact that belong to it."""


def side(world: World, before: Array, after: Array) -> Side:
    """The runs of a world with two simulations of them."""
    names = tuple(track.name for track in world.tracks)
    times = tuple(track.scenario.times for track in world.tracks)
    return Side(names, times, world.observed, before, after)


def places(world: World, before: Array, after: Array, sigma: Array, mark: str = "") -> list[Place]:
    """RMS of the residual in units of the noise, by run, channel and phase; `mark` is set behind
    names of runs.
    """
    parts = _parts(world, after, mark)
    residuals = [(world.observed - simulated) / sigma for simulated in (before, after)]
    shown = []
    for kind, label, mask in parts:
        # A run or phase without a sample has no RMS.
        if not mask.any():
            continue
        sizes = []
        for residual in residuals:
            square = np.square(residual[mask]).mean()
            sizes.append(float(np.sqrt(square)))
        samples = int(mask.sum())
        shown.append(Place(kind, label, samples, *sizes))
    return shown


def _parts(world: World, simulated: Array, mark: str) -> list[tuple[str, str, Mask]]:
    """Kind, label and (R, T, C) mask of what was observed in each run, channel and phase."""
    seen = np.isfinite(world.observed)
    runs, _, channels = seen.shape
    parts: list[tuple[str, str, Mask]] = []
    for r, track in enumerate(world.tracks):
        of_run = np.arange(runs) == r
        mask = seen & of_run[:, None, None]
        parts.append(("run", track.name + mark, mask))
    for c, name in enumerate(world.channels):
        of_channel = np.arange(channels) == c
        parts.append(("channel", name, seen & of_channel))
    # Told from the simulation: the noise of a measured speed would make phases of its own.
    for phase, where in phases(world, simulated).items():
        parts.append(("phase", phase, seen & where[:, :, None]))
    return parts


def phases(world: World, simulated: Array) -> dict[str, Mask]:
    """(R, T) masks: flight, impact, at rest for what bounces; motion, reversal, at rest for the
    others; saturated.
    """
    system = world.simulator.system
    speed = speeds(world, simulated)
    if speed is None:
        return {}
    # Where nothing moves all is at rest, and no share of zero.
    largest = max(float(np.nanmax(speed)), 1e-300)
    # A reversal is slow for a moment too: only what lasts is rest.
    still = _lasting(speed < QUIET * largest)
    if system.bounces:
        impact = _impacts(world, simulated) & ~still
        masks = {"flight": ~impact & ~still, "impact": impact, "at rest": still}
    else:
        reversal = (speed < SLOW * largest) & ~still
        masks = {"motion": ~reversal & ~still, "reversal": reversal, "at rest": still}
    # It lies across the others: an input may be at its limit in each of them.
    saturated = _saturated(world)
    if saturated.any():
        masks["saturated input"] = saturated
    return masks


def speeds(world: World, simulated: Array) -> Array | None:
    """(R, T) speed of the simulated motion along the recorded coordinates, 0 behind the end; None
    without any.
    """
    squares = np.zeros(simulated.shape[:2])
    shown = [n for n in world.simulator.system.coordinates if n in world.channels]
    for name in shown:
        values = simulated[:, :, world.channels.index(name)]
        for r, track in enumerate(world.tracks):
            size = len(track.observed)
            # One sample has no slope.
            if size > 1:
                slope = np.gradient(values[r, :size], track.scenario.times)
                squares[r, :size] += np.square(slope)
    return np.sqrt(np.nan_to_num(squares)) if shown else None


def _lasting(mask: Mask) -> Mask:
    """Where a mask holds for at least `REST` samples in a row."""
    lasting = np.zeros_like(mask)
    for row, out in zip(mask, lasting, strict=True):
        # Framed by zeros, changes come in pairs: where a stretch begins, and one behind its end.
        framed = np.concatenate([[0], row.astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(framed))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            out[begin:end] = end - begin >= REST
    return lasting


def _impacts(world: World, simulated: Array) -> Mask:
    """Around the lowest points of the flight."""
    name = world.simulator.system.coordinates[-1]
    mask = np.zeros(simulated.shape[:2], dtype=bool)
    if name not in world.channels:
        return mask
    height = simulated[:, :, world.channels.index(name)]
    # Behind the end of a shorter run heights are NaN, and no lowest point.
    before, here, behind = height[:, :-2], height[:, 1:-1], height[:, 2:]
    with np.errstate(invalid="ignore"):
        # Of a level stretch the last sample counts: one impact is not many.
        low = (here <= before) & (here < behind)
    low = np.pad(low, ((0, 0), (1, 1)))
    for shift in range(-NEAR_IMPACT, NEAR_IMPACT + 1):
        mask |= np.roll(low, shift, axis=1)
    return mask


def _saturated(world: World) -> Mask:
    """Where the first input stays at its extreme."""
    mask = np.zeros(world.observed.shape[:2], dtype=bool)
    for r, track in enumerate(world.tracks):
        for signal in list(track.scenario.inputs.values())[:1]:
            size = np.abs(signal)
            largest = max(float(size.max()), 1e-300)
            mask[r, : signal.size] = (size >= EXTREME * largest) & (size > 0)
    lasting = _lasting(mask)
    # A constant or square input is at its extreme always, which is no saturation.
    return lasting if lasting.mean() < 0.5 else np.zeros_like(mask)


def profiles(world: World, before: Array, after: Array, sigma: Array) -> list[Profile]:
    """The residual of the channel that the sensor effects act on, against time, position, speed and
    the inputs; of a robot that of the channel with the largest gap, against its own joint's.
    """
    name = world.simulator.system.reading(world.channels)
    followed_by = _variables(world, after)
    if robot_of(world) is not None:
        name = _loudest(world, before, sigma)
        followed_by = _variables_of_joint(world, after, name)
    c = world.channels.index(name)
    shown = []
    for variable, unit, values in followed_by:
        good = np.isfinite(world.observed[:, :, c]) & np.isfinite(values)
        followed = values[good]
        edges = _edges(followed)
        if edges is None:
            continue
        # What lies beyond the edges counts in the outermost bins.
        places = np.searchsorted(edges, followed, side="right") - 1
        bins = np.clip(places, 0, BINS - 1)
        counts = np.bincount(bins, minlength=BINS).astype(np.float64)
        # An empty bin has no mean: NaN, not drawn.
        with np.errstate(invalid="ignore", divide="ignore"):
            means = []
            for simulated in (before, after):
                residual = (world.observed - simulated)[:, :, c][good]
                means.append(np.bincount(bins, residual, BINS) / counts)
            error = sigma[c] / np.sqrt(counts)
        error[counts == 0] = np.nan
        centres = (edges[1:] + edges[:-1]) / 2.0
        shown.append(Profile(name, variable, unit, centres, means[0], means[1], error))
    return shown


def robot_of(world: World) -> Robot | None:
    """The robot of a recording; None where it is of another system."""
    robot: Robot | None = getattr(world.kind.system, "robot", None)
    return robot


def _loudest(world: World, before: Array, sigma: Array) -> str:
    """The channel with the largest residual in units of its noise."""
    squares = np.square((world.observed - before) / sigma)
    sizes = []
    for c in range(len(world.channels)):
        there = squares[:, :, c][np.isfinite(squares[:, :, c])]
        sizes.append(float(there.mean()) if there.size else 0.0)
    return world.channels[int(np.argmax(sizes))]


def _edges(values: Array) -> Array | None:
    """(BINS + 1,) edges over most of the values; None where they do not differ."""
    if not values.size or np.ptp(values) == 0:
        return None
    low, high = (float(v) for v in np.quantile(values, [TAILS, 1.0 - TAILS]))
    edges: Array = np.linspace(low, high, BINS + 1)
    return edges if edges[-1] > edges[0] else None


def _variables(world: World, simulated: Array) -> Iterator[tuple[str, str, Array]]:
    """Name, unit and (R, T) values of what a residual may follow."""
    times = _times(world)
    yield "time", "s", times
    system = world.simulator.system
    units = {channel.name: channel.unit for channel in world.kind.channels}
    primary = system.coordinates[system.primary] if system.coordinates else ""
    # Simulated: the noise of a measured one is in the residual too, and would follow itself.
    if primary in world.channels:
        position = simulated[:, :, world.channels.index(primary)]
        yield "position", units[primary], position
    speed = speeds(world, simulated)
    if speed is not None:
        unit = f"{units.get(primary, 'm')}/s"
        yield "speed", unit, np.where(np.isfinite(times), speed, np.nan)
    yield from _inputs(world, [channel.name for channel in world.kind.inputs])


def _times(world: World) -> Array:
    """(R, T) seconds from the beginning of each run: clocks of runs may stand anywhere."""
    times = np.full(world.observed.shape[:2], np.nan)
    for r, track in enumerate(world.tracks):
        times[r, : len(track.observed)] = track.scenario.times - track.scenario.times[0]
    return times


def _inputs(world: World, names: Collection[str]) -> Iterator[tuple[str, str, Array]]:
    """Name, unit and (R, T) values of the inputs of these names that were recorded."""
    for channel in world.kind.inputs:
        values = np.full(world.observed.shape[:2], np.nan)
        for r, track in enumerate(world.tracks):
            signal = track.scenario.inputs.get(channel.name)
            if signal is not None and channel.name in names:
                values[r, : len(track.observed)] = signal
        if np.isfinite(values).any():
            yield channel.name, channel.unit, values


def _variables_of_joint(
    world: World, simulated: Array, channel: str
) -> Iterator[tuple[str, str, Array]]:
    """As `_variables`, of the joint of a channel: its velocity has a sign, as friction has."""
    times = _times(world)
    yield "time", "s", times
    robot = robot_of(world)
    joints = robot.joints if robot is not None else ()
    joint = next((j for j in joints if j.name == channel.partition(".")[2]), None)
    if robot is None or joint is None:
        return
    position, rate = f"q.{joint.name}", f"qd.{joint.name}"
    unit = joint.unit
    if position in world.channels:
        values = simulated[:, :, world.channels.index(position)]
        yield f"position of {joint.name}", unit, values
        slopes = np.full_like(values, np.nan)
        for r, track in enumerate(world.tracks):
            size = len(track.observed)
            if size > 1:
                slopes[r, :size] = np.gradient(values[r, :size], track.scenario.times)
        yield f"velocity of {joint.name}", f"{unit}/s", slopes
    elif rate in world.channels:
        values = simulated[:, :, world.channels.index(rate)]
        yield f"velocity of {joint.name}", f"{unit}/s", values
    drives = [f"u.{a.name}" for a in robot.actuators if a.joint == joint.name]
    yield from _inputs(world, [*drives, f"force.{joint.name}"])
