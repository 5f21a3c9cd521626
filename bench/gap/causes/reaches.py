"""Where an effect that acts at a place, a size or an instant may begin to act: what inputs, errors
and levels reach, where a coordinate has been, and when samples were taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from bench.gap.model.time_scale import is_instant
from bench.gap.model.tracks import Track
from bench.gap.model.world import World
from sims.base import Array, Parameter
from sims.system import Effect, members_of

HARDER = (0.3, 1.0, 3.0)
"""Times as hard as a stop that scores well, of those that a fit may begin with."""
DEEPER = tuple(np.geomspace(0.002, 0.4, 10).tolist())
"""Shares of where a coordinate has been that lie beyond them."""
FIRMER = (0.25, 0.5, 2.0, 4.0)
"""Times as hard as a stop that was found, of others that turn back at the same place."""
INSTANTS = 24
"""Instants tried of what happens once."""
BRIEF = 0.05
"""Seconds for which it hardly shows that a servo plans its own way to a command."""
FINER = 16
"""Stamps between two of them that are tried where a fit begins, at most."""


def parameters_of(world: World, name: str) -> Sequence[Parameter]:
    """The coefficients of an effect, with their units and their plausible ranges."""
    return world.parameters[world.slots[name]]


def reach(world: World, name: str) -> Array:
    """(k,) of each place where an effect limits something, what is reached there."""
    effect = world.effects[name]
    members = members_of(effect)
    of = effect.coefficients[0].of
    if of == "give":
        # What shapes it stands behind.
        return np.array([parameters_of(world, name)[0].bounds[1]])
    if of == "drive" or (of == "level" and not _recorded(world, effect)):
        # How large a force gets is not recorded: what is plausible has to do.
        return np.array([p.bounds[1] for p in parameters_of(world, name)])
    if of == "travel":
        return np.array([world.travel_of(name)])
    found = {"input/s": _fastest, "input/s^2": _hardest, "error": _farthest, "level": _fullest}
    most = found.get(of, _largest)
    return np.array([max(most(world, t, one) for t in world.tracks) for one in members])


def _command(track: Track, effect: Effect) -> Array:
    """(T,) the input that an effect acts on; the first one where it names none."""
    signals = track.scenario.inputs
    nothing = np.zeros(track.scenario.times.size)
    first = next(iter(signals.values()), nothing)
    return signals.get(effect.signal, nothing) if effect.signal else first


def _largest(world: World, track: Track, effect: Effect) -> float:  # noqa: ARG001
    """Of a run, of the input."""
    return float(np.abs(_command(track, effect)).max())


def _fastest(world: World, track: Track, effect: Effect) -> float:  # noqa: ARG001
    """Of a run, from sample to sample of the input, a second."""
    risen = np.abs(np.diff(_command(track, effect)))
    return float((risen / np.diff(track.scenario.times)).max(initial=0.0))


def _hardest(world: World, track: Track, effect: Effect) -> float:  # noqa: ARG001
    """Of a run, the acceleration that takes the input over its range and to rest in `BRIEF`."""
    return 4.0 * float(np.ptp(_command(track, effect))) / BRIEF**2


def _recorded(world: World, effect: Effect) -> str:
    """The channel that shows the level an effect acts on; empty where that is not recorded."""
    name = effect.place or world.simulator.system.levels[0]
    return name if name in world.channels else ""


def _fullest(world: World, track: Track, effect: Effect) -> float:
    """Of a run, of the level."""
    shown = track.observed[:, world.channels.index(_recorded(world, effect))]
    return float(np.nanmax(shown, initial=0.0))


def _farthest(world: World, track: Track, effect: Effect) -> float:
    """Of a run, by which a servo is off its set point; zero where that is not recorded."""
    system = world.simulator.system
    place = system.primary if effect.coordinate is None else effect.coordinate
    name = system.coordinates[place]
    if name not in world.channels:
        return 0.0
    turned = system.gear(place) * track.observed[:, world.channels.index(name)]
    apart = _command(track, effect) - turned
    return float(np.nanmax(np.abs(apart), initial=0.0))


def stopping(
    world: World, name: str, side: float, hardness: Sequence[float], depths: Sequence[float]
) -> Iterator[Array]:
    """Coefficients (k,) of stops on one side, of every hardness at every depth; none where it is
    not recorded where the coordinate has been.
    """
    low, high = world.ends_of(name)
    parameters = parameters_of(world, name)
    stiffest = parameters[0].bounds[1]
    for part, share in product(hardness, depths) if low < high else ():
        c = np.zeros(len(parameters))
        c[0] = side * part * stiffest
        c[1] = (high if side > 0 else low) - side * share * (high - low)
        yield c


def stops_about(world: World, name: str, c: Array) -> Iterator[Array]:
    """Stops (k,) on the same side as one, of all kinds: how hard one is says how deep it is met;
    nothing for other effects.
    """
    if world.effects[name].coefficients[0].of == "stop":
        part = abs(c[0]) / parameters_of(world, name)[0].bounds[1]
        # A robot's lanes cost a hundred times as much.
        times, depths = ((1.0,), DEEPER[::2]) if world.linear else (HARDER, DEEPER)
        yield from stopping(world, name, np.sign(c[0]), [part * t for t in times], depths)


def firmer(world: World, name: str, c: Array) -> Iterator[Array]:
    """Softer and harder stops (k,) that turn back at the same place as one: how deep a motion of
    the same energy goes is k^(-2/5) by (2) of `sims.effects.state`.
    """
    low, high = world.ends_of(name)
    if world.effects[name].coefficients[0].of != "stop" or not c[0]:
        return
    end = high if c[0] > 0 else low
    for times in FIRMER:
        firmer = c.copy()
        firmer[0] = times * c[0]
        firmer[1] = end - (end - c[1]) * times**-0.4
        yield firmer


def instants_about(world: World, name: str, c: Array) -> Iterator[Array]:
    """The coefficients (k,) of an effect that happens once, with its instant between any two
    stamps that are as near as the next instants that are tried; nothing for other effects.
    """
    for i, parameter in enumerate(parameters_of(world, name)):
        if not is_instant(parameter):
            continue
        first, last = world.clock
        stamps = np.unique(np.concatenate([track.scenario.times for track in world.tracks]))
        between = (stamps[1:] + stamps[:-1]) / 2.0
        near = between[np.abs(between - c[i]) <= (last - first) / (INSTANTS + 1)]
        for instant in near[:: -(-near.size // FINER) or 1].tolist():
            moved = c.copy()
            moved[i] = instant
            yield moved
