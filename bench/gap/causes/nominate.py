"""Starts of fits with one more effect: high-scoring effects at the sizes that scores predict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench.gap.causes.candidates import Directions
from bench.gap.causes.gains import Group
from bench.gap.causes.reaches import instants_about, stops_about
from bench.gap.causes.score_test import Scores
from bench.gap.model.base_fit import HORIZONS
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.models import Model, Names
from bench.gap.model.noise import Noise
from bench.gap.model.problem import Known, Start
from bench.gap.model.world import World
from sims.base import Array

WHITE = 3
"""Number of best candidates by sum of squares that are refitted in addition.

Far from the data, AR(1) noise explains almost any residual, so likelihood scores are misleading.
"""
WHOLE = 2
"""Maximum number of candidates scored by full simulation that are refitted.

They are refitted if they outscore the best linearised candidate.
"""
PROMISING = 0.25
"""Minimum score of a candidate to be refitted, as a share of the best score."""
CLOSE = 0.6
"""Minimum score of a candidate to be refitted if scores are exact to first order.

It is a share of the best score.
"""
PATIENT = 20
"""Maximum number of candidates that are refitted in patient fits of robots."""
SHARES = (1.0, 0.25)
"""Shares of the size predicted by a score at which fits start.

Scores are linear, so a smaller size is tried, too.
"""
REACHES = (0.2, 0.7, 1.5)
"""Shares of the plausible range at which fits of a single coefficient start in addition."""


def nominated(
    world: World,
    noise: Noise,
    model: Model,
    found: Directions,
    scores: Scores,
    most: int,
    patient: bool,
) -> list[Start]:
    """Return starts for fits with the most promising candidates.

    Args:
        world: the runs.
        noise: noise of each channel.
        model: the model to extend.
        found: sensitivity directions of the candidates.
        scores: their scores.
        most: maximum number of candidates.
        patient: whether to include all candidates, or for robots up to `PATIENT`.
    """
    numbered = []
    # If scores use derivatives of the simulator, few candidates are better than their score.
    share = CLOSE if world.linear else PROMISING
    if patient and world.linear:
        most, share = PATIENT, 0.0
    # If scores are less reliable, they only order the patient fits, and exclude none.
    everything = patient and not world.linear
    for i in _promising(scores, most, share, everything, _apart(world, scores)):
        name = scores.effects[i]
        # The score peaks of an effect are fitted separately, because each may lead to its own
        # minimum.
        for peak, (group, scored) in enumerate(scores.peaks[i]):
            known = _known(world, model, found, group, name)
            for c in _sizes(world, found, group, scored, name):
                start = replace(with_effect(world, model.fit.start(), name, c), known=known)
                numbered.append((peak, start))
    # Patient fits begin with the first part of the runs, so starts are compared there.
    share = HORIZONS[0].share if patient else 1.0
    return _nearest(world, noise, numbered, share)


def _apart(world: World, scores: Scores) -> frozenset[int]:
    """Return the indices of candidates scored by full simulation, if the others are linearised."""
    if not world.linear:
        return frozenset()
    # Imported here, because only robots need it.
    from sims.robot.series import is_series

    return frozenset(i for i, name in enumerate(scores.effects) if is_series(world.effects[name]))


def _promising(
    scores: Scores, most: int, share: float, everything: bool, apart: frozenset[int]
) -> list[int]:
    """Return the indices of the candidates to refit, the most promising first."""
    promise = scores.score - scores.chance
    ranked: list[int] = np.argsort(-promise, kind="stable").tolist()
    if everything:
        return ranked
    # Far from the data, the score of a full simulation may exceed the first-order score of the true
    # effect, so such candidates are added to the others and displace none.
    order = [i for i in ranked if i not in apart]
    good = [i for i in order if promise[i] >= share * promise[order[0]]][:most]
    by_squares = [int(i) for i in np.argsort(-scores.white, kind="stable") if i not in apart]
    besides = by_squares[:WHITE]
    leading = promise[order[0]] if order else -np.inf
    whole = [i for i in ranked if i in apart and promise[i] >= leading][:WHOLE]
    good += [i for i in besides if i not in good]
    return good + whole


def with_effect(world: World, start: Start, name: str, c: Array) -> Start:
    """Add an effect to a model, in place of the effects that it contains.

    Args:
        world: the runs.
        start: the model.
        name: name of the effect.
        c: (k,) coefficients of the effect.
    """
    effect = world.effects[name]
    contained, theta = effect.contains, start.theta.copy()
    # An effect and one that it contains together would have no unique solution.
    for part in sorted(set(contained) & set(start.effects)):
        own = world.slots[part]
        c = effect.taking(c, part, theta[own])
        theta[own] = 0.0
    theta[world.slots[name]] = c
    rest = [n for n in start.effects if n not in contained]
    return Start((*rest, name), theta, start.states)


def _known(world: World, model: Model, found: Directions, group: Group, name: str) -> Known | None:
    """Return approximate derivatives of the model with one more effect of small size.

    They consist of the derivatives of the model and the directions; None if these do not contain
    all coefficients.
    """
    if not world.linear:
        return None
    columns = {found.probes[i].place: i for i in group.columns if not found.probes[i].fixed}
    places = world.places(name)
    shaping = [i for i in range(len(places)) if world.parameters[places[i]].bounds[0] > 0]
    if not columns or shaping:
        return None
    jacobian = np.zeros((*found.values.shape[:3], len(places)))
    for place, column in columns.items():
        jacobian[..., place] = found.values[..., column]
    contained = [world.places(n) for n in world.effects[name].contains if n in model.names]
    gone = {place for span in contained for place in span}
    return model.fit.known().without(gone).beside(places, jacobian)


def _sizes(
    world: World, found: Directions, group: Group, scored: Array, name: str
) -> Iterator[Array]:
    """Yield initial coefficients: as scored, smaller, and at shares of the plausible range."""
    bounds = coefficient_bounds(world, name)
    first = found.probes[group.columns[0]]
    # A direction for one full size says nothing about other sizes.
    if first.fixed:
        yield first.c
        yield from stops_about(world, name, first.c)
        return
    for share in SHARES:
        c = first.c.copy()
        for column, size in zip(group.columns, scored, strict=True):
            place = found.probes[column].place
            c[place] = share * float(np.clip(size, *bounds[place]))
        yield c
        yield from instants_about(world, name, c)
    # With several coefficients, the ranges do not show how the coefficients are related.
    if len(group.columns) > 1:
        return
    place = world.slots[name].start + first.place
    _, reach = world.parameters[place].bounds
    shares = list(REACHES)
    if first.signed:
        shares += [-share for share in REACHES]
    for share in shares:
        c = first.c.copy()
        c[first.place] = share * reach
        yield c


def _nearest(
    world: World, noise: Noise, numbered: Sequence[tuple[int, Start]], share: float
) -> list[Start]:
    """Return the start with the lowest cost for each peak number and set of effects.

    Args:
        world: the runs.
        noise: noise of each channel.
        numbered: starts with the number of their score peak.
        share: initial share of the runs on which the cost is computed.
    """
    if not numbered:
        return []
    starts = [start for _, start in numbered]
    runs = len(world.tracks)
    count = len(starts)
    theta = np.repeat([s.theta for s in starts], runs, axis=0)
    states = np.concatenate([s.states for s in starts])
    lanes = np.tile(np.arange(runs), count)
    # All starts are simulated in one engine call, as one batch.
    seen = world.simulate(theta, lanes, states, share)
    seen = seen.reshape(count, runs, *seen.shape[1:])
    counted = world.counted(share)
    best: dict[tuple[int, Names], tuple[float, Start]] = {}
    for (number, start), simulated in zip(numbered, seen, strict=True):
        residual = world.observed - simulated
        left = np.where(counted, residual, 0.0) / noise.sigma
        cost = float(np.square(left).sum())
        key = (number, start.effects)
        nearest = best[key][0] if key in best else np.inf
        # A failed simulation has the cost NaN, which is never the lowest.
        if cost < nearest:
            best[key] = cost, start
    return [start for _, start in best.values()]
