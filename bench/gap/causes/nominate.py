"""Where fits of a model with one more effect begin: the effects that score well, at the sizes that
their scores say.
"""

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
"""So many of the best by sum of squares alone are refitted besides: far from the data, noise that
remembers explains almost anything.
"""
WHOLE = 2
"""So many of those at most whose scores are no first order, where they lead."""
PROMISING = 0.25
"""Candidates are refitted that promise at least this share of the best one's score."""
CLOSE = 0.6
"""The same where the scores are to first order exact."""
PATIENT = 20
"""So many of them at most, with patience."""
SHARES = (1.0, 0.25)
"""Of the size that a score says; the score is linear, so less of it is tried too."""
REACHES = (0.2, 0.7, 1.5)
"""Shares of the plausible range at which a fit of one coefficient begins besides."""


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
    numbered = []
    # Where scores are those of the simulator's own derivatives, few can be better than they seem.
    share = CLOSE if world.linear else PROMISING
    if patient and world.linear:
        most, share = PATIENT, 0.0
    # Where scores mean less they order what is tried with patience, and leave nothing out.
    everything = patient and not world.linear
    for i in _promising(scores, most, share, everything, _apart(world, scores)):
        name = scores.effects[i]
        # The peaks of an effect are fitted apart: each may end in a minimum of its own.
        for peak, (group, scored) in enumerate(scores.peaks[i]):
            known = _known(world, model, found, group, name)
            for c in _sizes(world, found, group, scored, name):
                start = replace(with_effect(world, model.fit.start(), name, c), known=known)
                numbered.append((peak, start))
    # In patience the fit begins with the first part of the runs, so the nearest is asked there.
    share = HORIZONS[0].share if patient else 1.0
    return _nearest(world, noise, numbered, share)


def _apart(world: World, scores: Scores) -> frozenset[int]:
    """Places of candidates whose scores are those of whole simulations, among scores that are of
    first order.
    """
    if not world.linear:
        return frozenset()
    # loaded where there is a robot alone
    from sims.robot.series import is_series

    return frozenset(i for i, name in enumerate(scores.effects) if is_series(world.effects[name]))


def _promising(
    scores: Scores, most: int, share: float, everything: bool, apart: frozenset[int]
) -> list[int]:
    """Places of the candidates to refit, the most promising first."""
    promise = scores.score - scores.chance
    ranked: list[int] = np.argsort(-promise, kind="stable").tolist()
    if everything:
        return ranked
    # Far from the data a whole change outdoes the first order of the truth: it stands beside what
    # is nominated, and takes nothing's place.
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
        name: of the effect.
        c: (k,) its coefficients.
    """
    effect = world.effects[name]
    contained, theta = effect.contains, start.theta.copy()
    # Both at once would share what they explain in any way.
    for part in sorted(set(contained) & set(start.effects)):
        own = world.slots[part]
        c = effect.taking(c, part, theta[own])
        theta[own] = 0.0
    theta[world.slots[name]] = c
    rest = [n for n in start.effects if n not in contained]
    return Start((*rest, name), theta, start.states)


def _known(world: World, model: Model, found: Directions, group: Group, name: str) -> Known | None:
    """The derivatives of the model with one more effect where it acts a little, from the model's
    own and from the directions; None where these say nothing of a coefficient.
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
    """Coefficients to begin with: as scored, less, and at shares of the plausible range where one
    scales it.
    """
    bounds = coefficient_bounds(world, name)
    first = found.probes[group.columns[0]]
    # A direction that is one whole change says nothing of other sizes.
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
    # Of several coefficients the range says nothing about how they go together.
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
    """Of starts of one number and the same effects the one nearest to the data over the first share
    of the runs.
    """
    if not numbered:
        return []
    starts = [start for _, start in numbered]
    runs = len(world.tracks)
    count = len(starts)
    theta = np.repeat([s.theta for s in starts], runs, axis=0)
    states = np.concatenate([s.states for s in starts])
    lanes = np.tile(np.arange(runs), count)
    # All starts in one call: the engine steps its lanes at once.
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
        # A simulation that failed has a cost that is no number, and is never the nearest.
        if cost < nearest:
            best[key] = cost, start
    return [start for _, start in best.values()]
