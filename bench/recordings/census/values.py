"""Single signals: steps of quantisation, ends where they saturate, stretches that stand still."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.recordings.census.finding import Finding, named
from bench.recordings.noise import estimated
from sims.base import Array, Channel, Simulator
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated

COARSE = 0.02
"""Of a signal's range: steps that are told."""
FLAT = 5
"""Samples in a row at the very end of a range, that are no coincidence."""
CLIPPED = 2.5
"""Steps of quantisation by which a signal comes to an end or leaves it, where it is cut there."""
FEW = 0.005
"""Share of samples from which on a flat end is told."""
STILL = 0.5
"""Share of samples from which on stillness is told."""
WINDOW = 20
"""Samples over which something stands still or moves."""
NOISES = 6.0
"""Range within a window, in noises, from which on it moves: of noise alone it is 3.7 on average."""


def steps(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    """Channels whose rounding hides the motion, or the noise that is stated for them."""
    for channel, signals in _signals(recording, kind):
        step = estimated(signals).step
        values = np.concatenate([values for _, values in signals])
        spread = float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() else 0.0
        stated = recording.noise.get(channel.name)
        rounding = step / 12**0.5
        unit = channel.unit
        if step and stated is not None and stated < rounding / 2:
            yield Finding(
                "quantisation",
                f"{channel.name} goes in steps of {step:.3g} {unit}, whose rounding alone is "
                f"{rounding:.2g} {unit}, and the noise stated is {stated:.2g}",
                f"state noise = {rounding:.2g} or more",
            )
        elif step > COARSE * spread > 0:
            yield Finding(
                "quantisation",
                f"{channel.name} goes in steps of {step:.3g} {unit}, {step / spread:.0%} of its "
                "range",
                "move further, or read a finer sensor: what is smaller than a step is hardly seen",
            )


def saturated(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    """Channels with a flat end, and commands at the end of their range."""
    for channel, signals in _signals(recording, kind):
        for sign, word in ((1.0, "highest"), (-1.0, "lowest")):
            values = [sign * own for _, own in signals if np.isfinite(own).any()]
            if not values:
                continue
            end = max(float(np.nanmax(own)) for own in values)
            jump = CLIPPED * estimated(signals).step
            flat = sum(_flat(own, end, jump) for own in values)
            total = sum(own.size for own in values)
            if flat > FEW * total and not all(_stands(own, end) for own in values):
                yield Finding(
                    "saturation",
                    f"{channel.name} stays at its {word} value, {sign * end:.4g} {channel.unit}, "
                    f"in {flat / total:.1%} of the samples",
                    "a sensor or a joint at its end shows nothing: leave these samples empty, or "
                    "keep clear of the end",
                )
    yield from _commands(recording, kind)


def _commands(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    if not kind.has_model:
        return
    robot: Any = kind
    for actuator in robot.robot.actuators:
        name = f"u.{actuator.name}"
        if actuator.range is None or name not in recording.runs[0].inputs:
            continue
        low, high = actuator.range
        values = np.concatenate([run.inputs[name] for run in recording.runs])
        share = float(np.mean((values <= low) | (values >= high)))
        if share > FEW:
            yield Finding(
                "saturation",
                f"{name} is at or beyond its range, {low:.4g} to {high:.4g}, in {share:.1%} of "
                "the samples",
                "beyond it a command does nothing more: command less, or correct the range",
            )


def still(recording: Recording, kind: type[Simulator]) -> Iterator[Finding]:
    """Coordinates that move in few samples or in none."""
    if not issubclass(kind, Simulated):
        return
    never, seldom = [], []
    positions = set(kind.system.coordinates)
    for channel, signals in _signals(recording, kind):
        if channel.name not in positions:
            continue
        noise = estimated(signals)
        least = NOISES * max(np.nan_to_num(noise.sigma), noise.step, 1e-9 * channel.scale)
        moving = np.concatenate([_moving(values, least) for _, values in signals])
        share = 1.0 - float(moving.mean()) if moving.size else 0.0
        if share == 1.0:
            never.append(channel.name)
        elif share > STILL:
            seldom.append(f"{channel.name} ({share:.0%})")
    if never:
        yield Finding(
            "stillness",
            f"{named(never)} never moves",
            "nothing that acts in its motion shows: move it, or leave its joint out",
        )
    if seldom:
        yield Finding(
            "stillness",
            f"{named(seldom)} of the samples stand still",
            "friction, damping and inertia show in motion alone: move more of the time",
        )


def _signals(
    recording: Recording, kind: type[Simulator]
) -> Iterator[tuple[Channel, list[tuple[Array, Array]]]]:
    """Each recorded channel with its times and values in every run."""
    for channel in kind.channels:
        signals = [(run.times, run.channels[channel.name]) for run in _with(recording, channel)]
        if signals:
            yield channel, signals


def _with(recording: Recording, channel: Channel) -> list[Run]:
    return [run for run in recording.runs if channel.name in run.channels]


def _flat(values: Array, end: float, jump: float) -> int:
    """Samples in rows of at least `FLAT` at the very end, into which or out of which the signal
    jumps: one in steps that turns back at its end comes and goes by a step.
    """
    at = np.concatenate([[False], values == end, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(at))
    first, last = edges[::2], edges[1::2]
    framed = np.concatenate([[end], values, [end]])
    jumps = np.fmax(np.abs(framed[first] - end), np.abs(framed[last + 1] - end))
    lengths = last - first
    return int(lengths[(lengths >= FLAT) & (jumps > jump)].sum())


def _stands(values: Array, end: float) -> bool:
    """Whether a run is at this value from its first sample on, or to its last: it rests there."""
    seen = values[np.isfinite(values)]
    return bool(seen.size and (seen[0] == end or seen[-1] == end)) or not (values == end).any()


def _moving(values: Array, least: float) -> Array:
    """Of each window of a run, whether it moves."""
    count = values.size // WINDOW
    if not count:
        return np.array([bool(np.nanmax(values) - np.nanmin(values) > least)])
    rows = values[: count * WINDOW].reshape(count, WINDOW)
    rows = rows[np.isfinite(rows).any(axis=1)]
    found: Array = (np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)) > least
    return found
