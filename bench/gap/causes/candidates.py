"""What to try of each effect: directions in which it would change the trajectories, and where a fit
of it may begin.

An effect's coefficients scale it (a drag), shape it (a period), or modify it (the speed of a wind
without which there is drag in still air). Those that scale give a direction each; those that shape
or modify are laid on a grid, since a trajectory says nothing of them while the effect is off.

With y(c) the simulated runs at coefficients c, the direction of a coefficient that scales is

    d = (y(c) - y(0)) / c                                                                      (1)

at a c so small that y is linear in it; where an effect has no such c (a limit changes nothing until
the input reaches it) the direction is the whole change at one size, and holds there alone.
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
"""Share of a plausible range at which a direction is first taken."""
LEVELS = (0.15, 0.35, 0.6, 0.85, 0.95, 0.99)
"""Shares of the largest input at which limits, dead bands and plays are tried besides."""
WAYS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""The same of how far a run goes, for gaps."""
GIVES = (0.01, 0.09, 0.6)
"""Shares of the largest plausible compliance of a joint."""
LIMITED = ("drive", "input/s", "input/s^2", "level", "travel", "stop", "give")
"""What a coefficient is a part of where no small size is like a large one: a limit's takes all
away, and in a gap nothing is passed on.
"""
RATES = (0.015, 0.05, 0.12, 0.3, 0.6, 0.9)
"""The same of what is largest for a moment alone: the rate of a command, the error of a servo."""
SPANS = (1.0, 0.25, 0.06, 0.016, 0.004)
"""The same of an acceleration, which takes a command twice as long at a quarter of it."""
NOTHING = 1e-11
"""Share of the largest observation below which a change is rounding."""
SHAPES = 12
"""Sizes tried of a shape."""
FREQUENCIES = 96
"""Frequencies tried at most."""
SPREAD = 1.5
"""How much closer slow frequencies lie than fast ones, as a power."""
MODIFIED = (-0.7, -0.25, 0.0, 0.25, 0.7)
"""Shares of its plausible range at which a coefficient that modifies is tried."""
DEPTHS = (0.005, 0.02, 0.08, 0.2)
"""Shares of where a coordinate has been that lie beyond the stops that are tried."""
HARDNESS = (0.003, 0.03, 0.3, 3.0)
"""Shares of the largest plausible stiffness that they have."""
LATER = (-8, -4, -2, -1, 1, 2, 4, 8)
"""Samples by which what happens once is made later."""
SHIFTS = (-1.0, -0.5, 0.5, 1.0)
"""Cycles over the longest run by which what repeats is made faster or slower."""


@dataclass(frozen=True)
class Probe:
    """One direction.

    Attributes:
        effect: its name.
        group: number of the grid point; directions of one group act together.
        place: which coefficient scales it.
        c: (k,) the coefficients simulated.
        signed: whether the coefficient may be negative.
        fixed: whether the direction holds at this size alone.
    """

    effect: str
    group: int
    place: int
    c: Array
    signed: bool
    fixed: bool = False


@dataclass(frozen=True)
class Directions:
    """Probes and what they change: (R, T, C, K), in units of the coefficient that scales, or of the
    whole change.
    """

    probes: tuple[Probe, ...]
    values: Array


def directions(world: World, at: Fit, names: Sequence[str]) -> Directions:
    """What each of these effects would change about a fitted model.

    Args:
        world: the runs.
        at: the model.
        names: effects, none of which the model has.
    """
    probes = [probe for name in names for probe in first_probes(world, at, name)]
    values = _responses(world, at, probes)
    acting = _acting(world, probes, values)
    # Only the first answers say which coefficients modify, and only of effects that act at all.
    modified = list(_modified(world, probes, acting))
    places = np.flatnonzero(acting)
    probes = [probes[i] for i in places] + modified
    # The largest array of explain: what acts moves up in its place.
    for row, place in enumerate(places.tolist()):
        if row < place:
            values[row] = values[place]
    values = values[: places.size]
    if modified:
        values = np.concatenate([values, _responses(world, at, modified)])
    return Directions(tuple(probes), np.moveaxis(values, 0, -1))


def first_probes(world: World, at: Fit, name: str) -> Iterator[Probe]:
    """Every coefficient that scales an effect, at every shape, a little of it each."""
    parameters = parameters_of(world, name)
    # A coefficient that cannot be zero does not scale: it says where or how the others act.
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
    # Coefficients that scale at one point of the grid act together: a sine with its cosine.
    for point in product(*grids):
        # Of a limit of force or of a rate every small size takes all of it away.
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
    # Of a limit no small size is like a large one: it is tried where the input reaches it.
    if leading.of in LIMITED or (leading.of in ("input", "error") and least == 0):
        shapes = np.array(list(product(*grids)))
        yield from _limits(world, name, group, shapes if shaping else None)


def _stood_for(world: World, at: Fit, name: str) -> bool:
    """Whether the model has an effect that this one contains, by itself or in a family."""
    effects = [world.effects[own] for own in at.effects]
    there = {m.name for effect in effects for m in members_of(effect)}
    return bool(there & set(world.effects[name].contains))


def _stops(world: World, name: str, first: int) -> Iterator[Probe]:
    """Soft and hard stops at either end of where a coordinate has been, met late and early."""
    either = [c for side in (1.0, -1.0) for c in stopping(world, name, side, HARDNESS, DEPTHS)]
    for number, c in enumerate(either, start=first):
        yield Probe(effect=name, group=number, place=0, c=c, signed=True, fixed=True)


def _limits(world: World, name: str, group: int, shapes: Array | None) -> Iterator[Probe]:
    """Limits, dead bands and plays of a size that the motion or the input reaches; where other
    coefficients shape them, at each of these (n, k - 1) too.
    """
    largest = reach(world, name)
    if not largest.any():
        return
    # A servo's error is largest for a moment after a jump, as a command's rate is.
    seldom = {"input/s": RATES, "input/s^2": SPANS, "error": RATES, "travel": WAYS, "give": GIVES}
    of = world.effects[name].coefficients[0].of
    levels = seldom.get(of, LEVELS)
    if of == "travel" and world.linear:
        # A robot's lanes cost a hundred times as much.
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
    """Sizes to try of a coefficient that shapes, where the position has this range in a run; those
    `tried` of which it says so itself.
    """
    if tried:
        return np.array(tried)
    low, high = parameter.bounds
    if parameter.unit == "Hz":
        # What comes and goes must do so once in a run, or any slow change would be periodic.
        seldom = max(low, CYCLES / world.longest)
        slowest = min(seldom, high / 2.0)
        return _frequencies(slowest, high, world.longest)
    if _is_period(parameter, travel):
        frequencies = _frequencies(1.0 / high, 1.0 / low, travel)
        return 1.0 / frequencies
    if is_instant(parameter):
        first, last = world.clock
        # At the ends there is nothing before or after.
        return np.linspace(first, last, INSTANTS + 2)[1:-1]
    if parameter.unit == "s":
        # What lasts much longer than the runs is constant in them; one time is at most twice the
        # time before it.
        high = max(min(high, LASTING * world.longest), 2.0 * low)
        return np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
    return np.geomspace(low, high, SHAPES)


def _is_period(parameter: Parameter, travel: float) -> bool:
    """Whether a coefficient is a period over position, of runs that go anywhere."""
    return parameter.name.endswith(".period") and travel > 0


def neighbours(world: World, fit: Fit) -> Iterator[Start]:
    """The model with what repeats in it a little faster or slower: least squares stops at the
    nearest such minimum.
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
    """A frequency or a period, by parts of a cycle faster and slower; an instant by samples earlier
    and later; nothing else.
    """
    if is_instant(parameter):
        for samples in LATER:
            yield value + samples * world.spacing
    for cycles in SHIFTS:
        if parameter.unit == "Hz":
            yield value + cycles / world.longest
        elif _is_period(parameter, travel) and value > 0:
            frequency = 1.0 / value + cycles / travel
            # Slower than the longest period it might turn its sign.
            lowest = 1.0 / parameter.bounds[1]
            yield 1.0 / max(frequency, lowest)


def _frequencies(low: float, high: float, extent: float) -> Array:
    """Frequencies from low to high, half a cycle over the extent apart where they lie closest."""
    halves = 2.0 * (high - low) * extent
    count = int(np.clip(halves, 4, FREQUENCIES))
    # Slow ones lie closer: as periods they would else be far apart.
    shares = np.linspace(0.0, 1.0, count) ** SPREAD
    frequencies: Array = low + (high - low) * shares
    return frequencies


def _acting(world: World, probes: Sequence[Probe], values: Array) -> Mask:
    """(K,) which probes change more than rounding does, of what they change (K, R, T, C)."""
    rounding = NOTHING * np.nanmax(np.abs(world.observed), axis=(0, 1))
    # One channel that moves is enough: a sensor's effects show in no other.
    changes = [
        bool((np.abs(size * value) > rounding).any())
        for value, size in zip(values, _sizes(probes).tolist(), strict=True)
    ]
    acting: Mask = np.array(changes, dtype=bool)
    return acting


def _sizes(probes: Sequence[Probe]) -> Array:
    """(K,) of the coefficient that scales; one where the direction is the whole change."""
    sizes = []
    for probe in probes:
        size = 1.0 if probe.fixed else probe.c[probe.place]
        sizes.append(size)
    return np.array(sizes)


def _modified(world: World, probes: Sequence[Probe], acting: Mask) -> Iterator[Probe]:
    """Grid points of coefficients that change nothing by themselves but belong to an effect that
    acts.
    """
    leading: dict[str, Probe] = {}
    idle: list[Probe] = []
    for probe, acts in zip(probes, acting, strict=True):
        if acts:
            leading.setdefault(probe.effect, probe)
        # At its first shape a coefficient has shown already whether it acts by itself; members of a
        # family do not modify each other.
        elif probe.group == 0 and not probe.fixed and world.effects[probe.effect].place != FAMILY:
            idle.append(probe)
    modifiers: dict[str, list[Probe]] = {}
    for probe in idle:
        # Nothing of an effect that does not act at all can be modified.
        if probe.effect in leading:
            modifiers.setdefault(probe.effect, []).append(probe)
    for name, members in modifiers.items():
        yield from _grid_points(world, leading[name], members)


def _grid_points(world: World, first: Probe, modifiers: Sequence[Probe]) -> Iterator[Probe]:
    """An effect's first probe that acts, with its modifiers at every combination of sizes."""
    parameters = parameters_of(world, first.effect)
    points = product(MODIFIED, repeat=len(modifiers))
    for group, point in enumerate(points, start=1):
        # All at zero is the effect as it was tried first.
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
    """(K, R, T, C): the change that each probe makes, per unit of its coefficient, or as it is
    where that is fixed.
    """
    added = [(probe.effect, probe.c) for probe in probes]
    # These are the largest arrays of a search, so all is done in place.
    values = changes_by(world, at, added)
    near = followed(values)
    # A probe that the simulator cannot follow is a direction that changes nothing.
    if not near.all():
        values[~near] = 0.0
    values /= _sizes(probes)[:, None, None, None]  # (1)
    return values


def changes_by(world: World, at: Fit, added: Sequence[tuple[str, Array]]) -> Array:
    """(K, R, T, C): what one more effect changes about the fitted model's runs, for each of K
    effects with their coefficients; to first order where the simulator gives that for less.
    """
    if world.linear:
        # loaded where there is a robot alone
        from bench.gap.model.tangents import responses

        return responses(world, at.theta, at.states, added)
    values = simulate_with(world, at, added)
    values -= at.simulated
    return values


def simulate_with(world: World, at: Fit, added: Sequence[tuple[str, Array]]) -> Array:
    """(K, R, T, C): the fitted model's runs with one more effect, for each of K effects with their
    coefficients.
    """
    runs = len(world.tracks)
    theta = np.tile(at.theta, (len(added), 1))
    for row, (name, c) in zip(theta, added, strict=True):
        row[world.slots[name]] = c
    # All candidates of all runs in one call: the engine steps its lanes at once.
    count = len(added)
    simulated = world.simulate(
        theta=np.repeat(theta, runs, axis=0),
        runs=np.tile(np.arange(runs), count),
        states=np.tile(at.states, (count, 1)),
    )
    return simulated.reshape(count, runs, *simulated.shape[1:])
