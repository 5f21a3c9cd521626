"""What to try of each effect: directions in which it would change the trajectories, and where a fit
of it may begin.

An effect's coefficients scale it (a drag), shape it (a period), or modify it (the speed of a wind
without which there is drag in still air). Those that scale give a direction each; those that shape
or modify are laid on a grid, since a trajectory says nothing of them while the effect is off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from bench.gap.model.bounds import CYCLES
from bench.gap.model.fit import Fit, Start
from bench.gap.model.world import Mask, World
from sims.base import Array, Parameter
from sims.simulated import effect_parameters

SMALL = 1e-4
"""Share of a plausible range at which a direction is first taken."""
LEVELS = (0.15, 0.35, 0.6, 0.85, 0.95, 0.99)
"""Shares of the largest input at which limits, dead bands and plays are tried besides."""
NOTHING = 1e-11
"""Share of the largest observation below which a change is rounding."""
SHAPES, FREQUENCIES, SPREAD = 12, 96, 1.5
"""Sizes tried of a shape, frequencies at most, and how much closer slow ones lie than fast ones, as
a power.
"""
MODIFIED = (-0.7, -0.25, 0.0, 0.25, 0.7)


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
    probes = [probe for name in names for probe in _first(world, name)]
    values = _responses(world, at, probes)
    moves = _moving(world, probes, values)
    again = list(_modified(world, probes, moves))
    kept = np.flatnonzero(moves)
    probes, values = [probes[i] for i in kept], values[..., kept]
    if again:
        more = _responses(world, at, again)
        probes, values = [*probes, *again], np.concatenate([values, more], axis=3)
    return Directions(tuple(probes), values)


def _first(world: World, name: str) -> Iterator[Probe]:
    parameters = effect_parameters(world.effects[name], world.simulator.system, world.channels)
    shaping = [i for i, p in enumerate(parameters) if p.bounds[0] > 0]
    grids = [_grid(world, parameters[i]) for i in shaping]
    group = 0
    for point in product(*grids):
        for place, p in enumerate(parameters):
            if place in shaping:
                continue
            c = np.zeros(len(parameters))
            c[shaping] = point
            c[place] = SMALL * p.bounds[1]
            yield Probe(name, group, place, c, p.bounds[0] < 0)
        group += 1
    if world.effects[name].coefficients[0].of == "input" and parameters[0].bounds[0] == 0:
        largest = max(
            float(np.abs(next(iter(t.scenario.inputs.values()), np.zeros(1))).max())
            for t in world.tracks
        )
        for level in LEVELS:
            if largest > 0:
                yield Probe(name, group, 0, np.array([level * largest]), False, True)
                group += 1


def _grid(world: World, parameter: Parameter) -> Array:
    low, high = parameter.bounds
    if parameter.unit == "Hz":
        return _frequencies(min(max(low, CYCLES / world.longest), high / 2.0), high, world.longest)
    if parameter.name.endswith(".period") and (travel := world.travel) > 0:
        return 1.0 / _frequencies(1.0 / high, 1.0 / low, travel)
    return np.geomspace(low, high, SHAPES)


def neighbours(world: World, fit: Fit) -> Iterator[Start]:
    """The model with what repeats in it a little faster or slower: least squares stops at the
    nearest such minimum.
    """
    for name in fit.effects:
        for place in range(*world.slots[name].indices(len(world.parameters))):
            parameter, value = world.parameters[place], float(fit.theta[place])
            for cycles in (-1.0, -0.5, 0.5, 1.0):
                if parameter.unit == "Hz":
                    moved = value + cycles / world.longest
                elif parameter.name.endswith(".period") and world.travel > 0 and value > 0:
                    moved = 1.0 / max(
                        1.0 / value + cycles / world.travel, 1.0 / parameter.bounds[1]
                    )
                else:
                    break
                theta = fit.theta.copy()
                theta[place] = np.clip(moved, *parameter.bounds)
                yield Start(fit.effects, theta, fit.states)


def _frequencies(low: float, high: float, extent: float) -> Array:
    """Frequencies from low to high, half a cycle over the extent apart where they lie closest."""
    count = int(np.clip(2.0 * (high - low) * extent, 4, FREQUENCIES))
    found: Array = low + (high - low) * np.linspace(0.0, 1.0, count) ** SPREAD
    return found


def _moving(world: World, probes: Sequence[Probe], values: Array) -> Mask:
    """(K,) which probes change more than rounding does."""
    sizes = np.array([1.0 if p.fixed else p.c[p.place] for p in probes])
    changes = np.abs(values).max(axis=(0, 1), initial=0.0) * np.abs(sizes)
    moving: Mask = (
        changes > NOTHING * np.nanmax(np.abs(world.observed), axis=(0, 1))[:, None]
    ).any(axis=0)
    return moving


def _modified(world: World, probes: Sequence[Probe], moves: Mask) -> Iterator[Probe]:
    """Grid points of coefficients that change nothing by themselves but belong to an effect that
    acts.
    """
    acting = {p.effect for p, m in zip(probes, moves, strict=True) if m}
    idle: dict[str, list[Probe]] = {}
    for p, m in zip(probes, moves, strict=True):
        if not m and p.effect in acting and not p.fixed and p.group == 0:
            idle.setdefault(p.effect, []).append(p)
    for name, modifiers in idle.items():
        first = next(p for p, m in zip(probes, moves, strict=True) if m and p.effect == name)
        parameters = effect_parameters(world.effects[name], world.simulator.system, world.channels)
        for group, point in enumerate(product(MODIFIED, repeat=len(modifiers)), start=1):
            if any(point):
                c = first.c.copy()
                for modifier, share in zip(modifiers, point, strict=True):
                    c[modifier.place] = share * parameters[modifier.place].bounds[1]
                yield Probe(name, group, first.place, c, first.signed)


def _responses(world: World, at: Fit, probes: Sequence[Probe]) -> Array:
    """(R, T, C, K): the change that each probe makes, per unit of its coefficient, or as it is
    where that is fixed.
    """
    changed = simulate_with(world, at, [(p.effect, p.c) for p in probes])
    values = np.nan_to_num(np.moveaxis(changed - at.simulated, 0, -1))
    sizes = np.array([1.0 if p.fixed else p.c[p.place] for p in probes])
    result: Array = values / sizes
    return result


def simulate_with(world: World, at: Fit, added: Sequence[tuple[str, Array]]) -> Array:
    """(K, R, T, C): the fitted model's runs with one more effect, for each of K effects with their
    coefficients.
    """
    runs = len(world.tracks)
    theta = np.tile(at.theta, (len(added), 1))
    for row, (name, c) in zip(theta, added, strict=True):
        row[world.slots[name]] = c
    seen = world.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), len(added)),
        np.tile(at.states, (len(added), 1)),
    )
    return seen.reshape(len(added), runs, *seen.shape[1:])
