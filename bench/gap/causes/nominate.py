"""Where fits of a model with one more effect begin: the effects that score well, at the sizes that
their scores say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.gap.causes.candidates import Directions
from bench.gap.causes.score_test import Group, Scores
from bench.gap.model.base_fit import HORIZONS
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.fit import Start
from bench.gap.model.models import Model, Names
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from sims.base import Array

WHITE = 3
"""So many of the best by sum of squares alone are refitted besides: far from the data, noise that
remembers explains almost anything."""
PROMISING = 0.25
"""Candidates are refitted that promise at least this share of the best one's score."""


def nominated(
    world: World,
    noise: Noise,
    model: Model,
    found: Directions,
    scores: Scores,
    most: int,
    patient: bool,
) -> list[Start]:
    """Where to begin with the most promising candidates, at what scores say and at less; with all
    in patience.
    """
    promise = scores.score - scores.chance
    order = np.argsort(-promise, kind="stable")
    chosen = [i for i in order if patient or promise[i] >= PROMISING * promise[order[0]]]
    if not patient:
        near = [
            i for i in np.argsort(-scores.white, kind="stable")[:WHITE] if i not in chosen[:most]
        ]
        chosen = chosen[:most] + near
    result = []
    for i in chosen:
        name = scores.effects[i]
        for peak, (group, scored) in enumerate(scores.peaks[i]):
            result += [
                (peak, _with(world, model, name, c))
                for c in _sizes(world, found, group, scored, name)
            ]
    return _nearest(world, noise, result, HORIZONS[0][0] if patient else 1.0)


def _with(world: World, model: Model, name: str, c: Array) -> Start:
    """The model with one more effect, which takes the place of those that it contains."""
    theta, held = model.fit.theta.copy(), world.effects[name].contains
    theta[world.slots[name]] = c
    for part in set(held) & set(model.names):
        theta[world.slots[part]] = 0.0
    return Start((*(n for n in model.names if n not in held), name), theta, model.fit.states)


def _sizes(
    world: World, found: Directions, group: Group, scored: Array, name: str
) -> Iterator[Array]:
    """Coefficients to begin with: as scored, less, and at shares of the plausible range where one
    scales it.
    """
    bounds = coefficient_bounds(world, name)
    first = found.probes[group.columns[0]]
    if first.fixed:
        yield first.c
        return
    for share in (1.0, 0.25):
        c = first.c.copy()
        for column, size in zip(group.columns, scored, strict=True):
            place = found.probes[column].place
            c[place] = share * float(np.clip(size, *bounds[place]))
        yield c
    if len(group.columns) == 1:
        reach = world.parameters[world.slots[name].start + first.place].bounds[1]
        for share in (0.2, 0.7, 1.5, *((-0.2, -0.7, -1.5) if first.signed else ())):
            c = first.c.copy()
            c[first.place] = share * reach
            yield c


def _nearest(
    world: World, noise: Noise, numbered: Sequence[tuple[int, Start]], share: float
) -> list[Start]:
    """Of starts of one number and the same effects the one nearest to the data over the first share
    of the runs.
    """
    if not numbered:
        return []
    starts = [start for _, start in numbered]
    runs = len(world.tracks)
    theta = np.repeat([s.theta for s in starts], runs, axis=0)
    states = np.concatenate([s.states for s in starts])
    seen = world.simulate(theta, np.tile(np.arange(runs), len(starts)), states, share)
    seen = seen.reshape(len(starts), runs, *seen.shape[1:])
    counted = world.counted(share)
    best: dict[tuple[int, Names], tuple[float, Start]] = {}
    for (number, start), part in zip(numbered, seen, strict=True):
        left = np.where(counted, world.observed - part, 0.0) / noise.sigma
        cost = float(np.square(left).sum())
        if cost < best.get((number, start.effects), (np.inf,))[0]:
            best[number, start.effects] = cost, start
    return [start for _, start in best.values()]
