"""Candidate effects: their sensitivity directions along the trajectories, and starts of fits.

The coefficients of an effect scale it (a drag), shape it (a period), or modify it (a wind speed,
which only matters if there is drag). Each scaling coefficient gives one direction. Shape parameters
and modifiers are tried on a grid, because trajectories do not depend on them while the effect is
off.

With y(c) the simulated runs at coefficients c, the direction of a scaling coefficient is

    d = (y(c) - y(0)) / c                                                                      (1)

at a c so small that y is linear in it. If an effect has no such c (a limit changes nothing until
the input reaches it), the direction is the whole change at one size, and is valid only there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from bench.gap.causes.reaches import (
    INSTANTS,
    firmer,
    parameters_of,
    reach,
    stopping,
)
from bench.gap.model.bounds import CYCLES, coefficient_bounds
from bench.gap.model.differences import followed
from bench.gap.model.noise import Mask
from bench.gap.model.problem import Fit, Start
from bench.gap.model.time_scale import LASTING, is_instant
from bench.gap.model.world import World
from sims.base import Array, Parameter
from sims.system import FAMILY, members_of

SMALL = 1e-4
"""Size at which a direction is first computed, as a share of the plausible range."""
LEVELS = (0.15, 0.35, 0.6, 0.85, 0.95, 0.99)
"""Sizes of limits, dead bands and backlash that are tried, as shares of the largest input."""
WAYS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Widths of backlash that are tried, as shares of the largest range of motion within one run."""
GIVES = (0.01, 0.09, 0.6)
"""Compliances of a joint that are tried, as shares of the largest plausible one."""
LIMITED = ("drive", "input/s", "input/s^2", "level", "travel", "stop", "give")
"""Kinds of coefficients for which a small size does not act like a large one.

A small limit removes everything, and within the backlash nothing is transmitted.
"""
RATES = (0.015, 0.05, 0.12, 0.3, 0.6, 0.9)
"""Sizes of rate and error limits that are tried, as shares of the largest value.

These quantities, such as the rate of a command or the error of a servo, peak only briefly.
"""
SPANS = (1.0, 0.25, 0.06, 0.016, 0.004)
"""Acceleration limits that are tried, as shares of the largest one.

At a quarter of the acceleration, a command takes twice as long.
"""
NOTHING = 1e-11
"""Minimum change of the observations that is not rounding, as a share of the largest one."""
SHAPES = 12
"""Number of values tried of a shape parameter."""
FREQUENCIES = 96
"""Maximum number of frequencies tried."""
SPREAD = 1.5
"""Exponent of the spacing of frequencies, so that low ones are closer together."""
MODIFIED = (-0.7, -0.25, 0.0, 0.25, 0.7)
"""Values of a modifier that are tried, as shares of its plausible range."""
DEPTHS = (0.005, 0.02, 0.08, 0.2)
"""Depths of end stops that are tried, as shares of the range of the coordinate."""
HARDNESS = (0.003, 0.03, 0.3, 3.0)
"""Stiffnesses of end stops that are tried, as shares of the largest plausible one."""
LATER = (-8, -4, -2, -1, 1, 2, 4, 8)
"""Shifts of the time of a single event that are tried, in samples."""
SHIFTS = (-1.0, -0.5, 0.5, 1.0)
"""Shifts of a frequency or period that are tried, in cycles over the longest run."""


@dataclass(frozen=True)
class Probe:
    """One candidate direction.

    Attributes:
        effect: name of the effect.
        group: number of the grid point; directions of one group act together.
        place: index of the coefficient that scales it.
        c: (k,) coefficients that are simulated.
        signed: whether the scaling coefficient may be negative.
        fixed: whether the direction is valid only at this size.
    """

    effect: str
    group: int
    place: int
    c: Array
    signed: bool
    fixed: bool = False


@dataclass(frozen=True)
class Directions:
    """Candidate directions and their responses.

    Attributes:
        probes: the K candidates.
        values: (R, T, C, K) changes of the runs, per unit of the scaling coefficient, or the whole
            change for a fixed candidate.
    """

    probes: tuple[Probe, ...]
    values: Array


def directions(world: World, at: Fit, names: Sequence[str]) -> Directions:
    """Compute the sensitivity directions of effects about a fitted model.

    Args:
        world: the runs.
        at: the fitted model.
        names: names of effects that the model does not contain.
    """
    probes = [probe for name in names for probe in first_probes(world, at, name)]
    values = _responses(world, at, probes)
    acting = _acting(world, probes, values)
    # The first responses show which coefficients only modify, for effects that act at all.
    modified = list(_modified(world, probes, acting))
    places = np.flatnonzero(acting)
    probes = [probes[i] for i in places] + modified
    # This is the largest array of an explanation, so active rows are moved up in place.
    for row, place in enumerate(places.tolist()):
        if row < place:
            values[row] = values[place]
    values = values[: places.size]
    if modified:
        values = np.concatenate([values, _responses(world, at, modified)])
    return Directions(tuple(probes), np.moveaxis(values, 0, -1))


def first_probes(world: World, at: Fit, name: str) -> Iterator[Probe]:
    """Yield a small value of every scaling coefficient of an effect, at every shape.

    Args:
        world: the runs.
        at: the fitted model.
        name: name of the effect.
    """
    parameters = parameters_of(world, name)
    # A coefficient that cannot be zero is a shape parameter, and does not scale the effect.
    shaping = [i for i, p in enumerate(parameters) if p.bounds[0] > 0]
    count = len(parameters)
    scaling = [i for i in range(count) if i not in shaping]
    travel = world.travel_of(name)
    coefficients = world.effects[name].coefficients
    grids = [
        parameters[i].bounds[:1]
        if coefficients[i].of == "rotor" and _stood_for(world, at, name)
        else _grid(world, parameters[i], coefficients[i].tried, travel)
        for i in shaping
    ]
    group = 0
    leading = coefficients[0]
    # Scaling coefficients at one grid point act together, such as a sine and a cosine.
    for point in product(*grids):
        # A small limit of a force or a rate would remove all of it.
        for place in scaling if leading.of not in LIMITED else ():
            low, high = parameters[place].bounds
            c = np.zeros(count)
            c[shaping] = point
            c[place] = SMALL * high
            yield Probe(
                effect=name,
                group=group,
                place=place,
                c=c,
                signed=low < 0,
            )
        group += 1
    if leading.of == "stop":
        yield from _stops(world, name, group)
        return
    least, _ = parameters[0].bounds
    # A small limit does not act like a large one, so limits are tried at values that the input
    # reaches.
    if leading.of in LIMITED or (leading.of in ("input", "error") and least == 0):
        shapes = np.array(list(product(*grids)))
        yield from _limits(world, name, group, shapes if shaping else None)


def _stood_for(world: World, at: Fit, name: str) -> bool:
    """Return whether the model has an effect that this one contains, itself or in a family."""
    effects = [world.effects[own] for own in at.effects]
    there = {m.name for effect in effects for m in members_of(effect)}
    return bool(there & set(world.effects[name].contains))


def _stops(world: World, name: str, first: int) -> Iterator[Probe]:
    """Yield soft and hard end stops at both ends of the range of a coordinate."""
    either = [c for side in (1.0, -1.0) for c in stopping(world, name, side, HARDNESS, DEPTHS)]
    for number, c in enumerate(either, start=first):
        yield Probe(effect=name, group=number, place=0, c=c, signed=True, fixed=True)


def _limits(world: World, name: str, group: int, shapes: Array | None) -> Iterator[Probe]:
    """Yield limits, dead bands and backlash of sizes that the motion or the input reaches.

    Args:
        world: the runs.
        name: name of the effect.
        group: number of the first group.
        shapes: (n, k - 1) shape parameters to combine with each size; None if there are none.
    """
    largest = reach(world, name)
    if not largest.any():
        return
    # The error of a servo peaks briefly after a jump, as the rate of a command does.
    seldom = {"input/s": RATES, "input/s^2": SPANS, "error": RATES, "travel": WAYS, "give": GIVES}
    of = world.effects[name].coefficients[0].of
    levels = seldom.get(of, LEVELS)
    if of == "travel" and world.linear:
        # Simulating a robot costs a hundred times as much, so fewer sizes are tried.
        levels = WAYS[1:4]
    sizes = [level * largest for level in levels]
    if shapes is not None:
        sizes = [np.append(size, shape) for shape in shapes for size in sizes]
    for number, c in enumerate(sizes, start=group):
        yield Probe(
            effect=name,
            group=number,
            place=0,
            c=c,
            signed=False,
            fixed=True,
        )


def _grid(world: World, parameter: Parameter, tried: tuple[float, ...], travel: float) -> Array:
    """Return the values to try of a shape parameter.

    Args:
        world: the runs.
        parameter: the shape parameter.
        tried: values that the coefficient specifies itself, if any.
        travel: largest range of the position in one run.
    """
    if tried:
        return np.array(tried)
    low, high = parameter.bounds
    if parameter.unit == "Hz":
        # A periodic effect must complete a cycle within a run, otherwise any slow change would be
        # periodic.
        seldom = max(low, CYCLES / world.longest)
        slowest = min(seldom, high / 2.0)
        return _frequencies(slowest, high, world.longest)
    if _is_period(parameter, travel):
        frequencies = _frequencies(1.0 / high, 1.0 / low, travel)
        return 1.0 / frequencies
    if is_instant(parameter):
        first, last = world.clock
        # An event at the ends of the recording would have nothing before or after it.
        return np.linspace(first, last, INSTANTS + 2)[1:-1]
    if parameter.unit == "s":
        # A decay much longer than the runs is constant within them; successive times differ by at
        # most a factor of two.
        high = max(min(high, LASTING * world.longest), 2.0 * low)
        return np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
    return np.geomspace(low, high, SHAPES)


def _is_period(parameter: Parameter, travel: float) -> bool:
    """Return whether a coefficient is a period over position, in runs with motion."""
    return parameter.name.endswith(".period") and travel > 0


def neighbours(world: World, fit: Fit) -> Iterator[Start]:
    """Yield starts with shifted periodic effects, event times and end stops.

    Least squares stops at the nearest of the many local minima that such effects have.

    Args:
        world: the runs.
        fit: the fitted model.
    """
    for name in fit.effects:
        for c in firmer(world, name, fit.theta[world.slots[name]]):
            theta = fit.theta.copy()
            theta[world.slots[name]] = c
            yield Start(fit.effects, theta, fit.states)
        bounds = coefficient_bounds(world, name)
        for number, place in enumerate(world.places(name)):
            parameter = world.parameters[place]
            value = float(fit.theta[place])
            for moved in _shifted(world, parameter, value, world.travel_of(name)):
                theta = fit.theta.copy()
                theta[place] = np.clip(moved, *bounds[number])
                yield Start(fit.effects, theta, fit.states)


def _shifted(world: World, parameter: Parameter, value: float, travel: float) -> Iterator[float]:
    """Yield shifted values of a frequency, a period or an event time; nothing for others.

    Frequencies and periods are shifted by parts of a cycle, event times by samples.
    """
    if is_instant(parameter):
        for samples in LATER:
            yield value + samples * world.spacing
    for cycles in SHIFTS:
        if parameter.unit == "Hz":
            yield value + cycles / world.longest
        elif _is_period(parameter, travel) and value > 0:
            frequency = 1.0 / value + cycles / travel
            # Beyond the longest period, the frequency might become negative.
            lowest = 1.0 / parameter.bounds[1]
            yield 1.0 / max(frequency, lowest)


def _frequencies(low: float, high: float, extent: float) -> Array:
    """Return frequencies from low to high, about half a cycle over the extent apart on average."""
    halves = 2.0 * (high - low) * extent
    count = int(np.clip(halves, 4, FREQUENCIES))
    # Low frequencies are closer together, because their periods would be far apart otherwise.
    shares = np.linspace(0.0, 1.0, count) ** SPREAD
    frequencies: Array = low + (high - low) * shares
    return frequencies


def _acting(world: World, probes: Sequence[Probe], values: Array) -> Mask:
    """Return which probes (K,) change the runs (K, R, T, C) by more than rounding."""
    rounding = NOTHING * np.nanmax(np.abs(world.observed), axis=(0, 1))
    # One changed channel is sufficient, because effects of a sensor show only in its channel.
    changes = [
        bool((np.abs(size * value) > rounding).any())
        for value, size in zip(values, _sizes(probes).tolist(), strict=True)
    ]
    acting: Mask = np.array(changes, dtype=bool)
    return acting


def _sizes(probes: Sequence[Probe]) -> Array:
    """Return the scaling coefficients (K,); one where the direction is the whole change."""
    sizes = []
    for probe in probes:
        size = 1.0 if probe.fixed else probe.c[probe.place]
        sizes.append(size)
    return np.array(sizes)


def _modified(world: World, probes: Sequence[Probe], acting: Mask) -> Iterator[Probe]:
    """Yield grid points of modifiers: coefficients that act only together with an active one."""
    leading: dict[str, Probe] = {}
    idle: list[Probe] = []
    for probe, acts in zip(probes, acting, strict=True):
        if acts:
            leading.setdefault(probe.effect, probe)
        # The first shape already shows whether a coefficient acts by itself; members of a family do
        # not modify each other.
        elif probe.group == 0 and not probe.fixed and world.effects[probe.effect].place != FAMILY:
            idle.append(probe)
    modifiers: dict[str, list[Probe]] = {}
    for probe in idle:
        # An effect that does not act at all cannot be modified.
        if probe.effect in leading:
            modifiers.setdefault(probe.effect, []).append(probe)
    for name, members in modifiers.items():
        yield from _grid_points(world, leading[name], members)


def _grid_points(world: World, first: Probe, modifiers: Sequence[Probe]) -> Iterator[Probe]:
    """Yield the first active probe of an effect with all combinations of modifier values."""
    parameters = parameters_of(world, first.effect)
    points = product(MODIFIED, repeat=len(modifiers))
    for group, point in enumerate(points, start=1):
        # All modifiers at zero give the effect that was already tried.
        if not any(point):
            continue
        c = first.c.copy()
        for modifier, share in zip(modifiers, point, strict=True):
            _, high = parameters[modifier.place].bounds
            c[modifier.place] = share * high
        yield Probe(
            effect=first.effect,
            group=group,
            place=first.place,
            c=c,
            signed=first.signed,
        )


def _responses(world: World, at: Fit, probes: Sequence[Probe]) -> Array:
    """Return the responses (K, R, T, C), per unit of the coefficient or as a whole change."""
    added = [(probe.effect, probe.c) for probe in probes]
    # These are the largest arrays of a search, so all operations are in place.
    values = changes_by(world, at, added)
    near = followed(values)
    # A probe that the simulator cannot follow gets a direction of zeros.
    if not near.all():
        values[~near] = 0.0
    values /= _sizes(probes)[:, None, None, None]  # (1)
    return values


def changes_by(world: World, at: Fit, added: Sequence[tuple[str, Array]]) -> Array:
    """Compute the changes of a fitted model's runs by one additional effect each.

    Linearised responses are used if the simulator provides them, because they cost less.

    Args:
        world: the runs.
        at: the fitted model.
        added: K effects with their coefficients.

    Returns:
        Changes (K, R, T, C).
    """
    if world.linear:
        # Imported here, because only robots need it.
        from bench.gap.model.tangents import responses

        return responses(world, at.theta, at.states, added)
    values = simulate_with(world, at, added)
    values -= at.simulated
    return values


def simulate_with(world: World, at: Fit, added: Sequence[tuple[str, Array]]) -> Array:
    """Simulate the runs of a fitted model with one additional effect each.

    Args:
        world: the runs.
        at: the fitted model.
        added: K effects with their coefficients.

    Returns:
        Observations (K, R, T, C).
    """
    runs = len(world.tracks)
    theta = np.tile(at.theta, (len(added), 1))
    for row, (name, c) in zip(theta, added, strict=True):
        row[world.slots[name]] = c
    # All candidates and runs are simulated in one engine call, as one batch.
    count = len(added)
    simulated = world.simulate(
        theta=np.repeat(theta, runs, axis=0),
        runs=np.tile(np.arange(runs), count),
        states=np.tile(at.states, (count, 1)),
    )
    return simulated.reshape(count, runs, *simulated.shape[1:])
