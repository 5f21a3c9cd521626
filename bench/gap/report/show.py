"""Shows the gap: how far above the noise, in which runs, channels and phases, and what it follows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.gap.model.world import Mask, World
from bench.gap.report.story import Place, Profile, Side
from sims.base import Array

BINS = 12
SLOW, QUIET = 0.05, 0.01
"""Shares of the largest speed: below the first a motion turns round, below the second, for a while,
it is at rest.
"""
NEAR_IMPACT = 2
"""Samples to either side of an impact that belong to it."""


def side(world: World, before: Array, after: Array) -> Side:
    """The runs of a world with two simulations of them."""
    names = tuple(t.name for t in world.tracks)
    return Side(names, tuple(t.scenario.times for t in world.tracks), world.observed, before, after)


def places(world: World, before: Array, after: Array, sigma: Array, mark: str = "") -> list[Place]:
    """RMS of the residual in units of the noise, by run, channel and phase; `mark` is set behind
    names of runs.
    """
    residuals = [(world.observed - simulated) / sigma for simulated in (before, after)]
    seen = np.isfinite(world.observed)
    parts: list[tuple[str, str, Mask]] = []
    for r, track in enumerate(world.tracks):
        parts.append(("run", track.name + mark, seen & (np.arange(len(seen)) == r)[:, None, None]))
    for c, name in enumerate(world.channels):
        parts.append(("channel", name, seen & (np.arange(seen.shape[2]) == c)))
    for phase, where in phases(world, after).items():
        parts.append(("phase", phase, seen & where[:, :, None]))
    return [
        Place(
            kind,
            label,
            int(mask.sum()),
            *(float(np.sqrt(np.square(r[mask]).mean())) for r in residuals),
        )
        for kind, label, mask in parts
        if mask.any()
    ]


def phases(world: World, simulated: Array) -> dict[str, Mask]:
    """(R, T) masks: flight, impact, at rest for what bounces; motion, reversal, at rest for the
    others; saturated.
    """
    system = world.simulator.system
    speed = speeds(world, simulated)
    if speed is None:
        return {}
    largest = max(float(np.nanmax(speed)), 1e-300)
    still = _lasting(speed < QUIET * largest)
    found: dict[str, Mask] = {}
    if system.bounces:
        impact = _impacts(world, simulated) & ~still
        found = {"flight": ~impact & ~still, "impact": impact, "at rest": still}
    else:
        reversal = (speed < SLOW * largest) & ~still
        found = {"motion": ~reversal & ~still, "reversal": reversal, "at rest": still}
    saturated = _saturated(world)
    if saturated.any():
        found["saturated input"] = saturated
    return found


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
            if size > 1:
                squares[r, :size] += np.square(np.gradient(values[r, :size], track.scenario.times))
    return np.sqrt(np.nan_to_num(squares)) if shown else None


def _lasting(mask: Mask, least: int = 5) -> Mask:
    """Where a mask holds for at least so many samples in a row."""
    result = np.zeros_like(mask)
    for row, out in zip(mask, result, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            out[begin:end] = end - begin >= least
    return result


def _impacts(world: World, simulated: Array) -> Mask:
    """Around the lowest points of the flight."""
    name = world.simulator.system.coordinates[-1]
    mask = np.zeros(simulated.shape[:2], dtype=bool)
    if name not in world.channels:
        return mask
    height = simulated[:, :, world.channels.index(name)]
    with np.errstate(invalid="ignore"):
        low = (height[:, 1:-1] <= height[:, :-2]) & (height[:, 1:-1] < height[:, 2:])
    for shift in range(-NEAR_IMPACT, NEAR_IMPACT + 1):
        mask |= np.roll(np.pad(low, ((0, 0), (1, 1))), shift, axis=1)
    return mask


def _saturated(world: World) -> Mask:
    """Where the first input stays at its extreme."""
    mask = np.zeros(world.observed.shape[:2], dtype=bool)
    for r, track in enumerate(world.tracks):
        for signal in list(track.scenario.inputs.values())[:1]:
            extreme = np.abs(signal) >= 0.999 * max(float(np.abs(signal).max()), 1e-300)
            mask[r, : signal.size] = extreme & (np.abs(signal) > 0)
    lasting = _lasting(mask)
    return lasting if lasting.mean() < 0.5 else np.zeros_like(mask)


def profiles(world: World, before: Array, after: Array, sigma: Array) -> list[Profile]:
    """The residual of the channel that the sensor effects act on, against time, position, speed and
    the inputs.
    """
    name = world.simulator.system.reading(world.channels)
    c = world.channels.index(name)
    found = []
    for variable, unit, values in _variables(world, after):
        good = np.isfinite(world.observed[:, :, c]) & np.isfinite(values)
        if not good.any() or np.ptp(values[good]) == 0:
            continue
        low, high = (float(v) for v in np.quantile(values[good], [0.005, 0.995]))
        edges = np.linspace(low, high, BINS + 1)
        if not edges[-1] > edges[0]:
            continue
        bins = np.clip(np.searchsorted(edges, values[good], side="right") - 1, 0, BINS - 1)
        counts = np.bincount(bins, minlength=BINS).astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = [
                np.bincount(bins, (world.observed - simulated)[:, :, c][good], BINS) / counts
                for simulated in (before, after)
            ]
            error = sigma[c] / np.sqrt(counts)
        error[counts == 0] = np.nan
        found.append(
            Profile(name, variable, unit, (edges[1:] + edges[:-1]) / 2.0, means[0], means[1], error)
        )
    return found


def _variables(world: World, simulated: Array) -> Iterator[tuple[str, str, Array]]:
    """Name, unit and (R, T) values of what a residual may follow."""
    shape = simulated.shape[:2]
    times = np.full(shape, np.nan)
    for r, track in enumerate(world.tracks):
        times[r, : len(track.observed)] = track.scenario.times - track.scenario.times[0]
    yield "time", "s", times
    system = world.simulator.system
    units = {channel.name: channel.unit for channel in world.kind.channels}
    primary = system.coordinates[system.primary] if system.coordinates else ""
    if primary in world.channels:
        yield "position", units[primary], simulated[:, :, world.channels.index(primary)]
    speed = speeds(world, simulated)
    if speed is not None:
        yield "speed", f"{units.get(primary, 'm')}/s", np.where(np.isfinite(times), speed, np.nan)
    for channel in world.kind.inputs:
        values = np.full(shape, np.nan)
        for r, track in enumerate(world.tracks):
            if channel.name in track.scenario.inputs:
                values[r, : len(track.observed)] = track.scenario.inputs[channel.name]
        if np.isfinite(values).any():
            yield channel.name, channel.unit, values
