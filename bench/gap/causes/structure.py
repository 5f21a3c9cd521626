"""Is there structure that no effect of the library accounts for?

Two tests. Where the recording states its noise, what a model leaves must not exceed it. And whether
or not it does, a force of any shape must not help: hats over time, position and speed, along each
axis and against the motion, stand for causes that nobody has thought of (a nonparametric
lack-of-fit test; J. D. Hart, Nonparametric Smoothing and Lack-of-Fit Tests, 1997,
doi:10.1007/978-1-4757-2722-7), calibrated by surrogates as the library is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.gap.causes.candidates import Directions, Probe, simulate_with
from bench.gap.causes.score_test import score
from bench.gap.causes.search import Search
from bench.gap.model.models import Model
from bench.gap.model.noise import surrogates
from bench.gap.model.world import World
from sims.base import Array
from sims.system import Coefficient, Force, Moment

BINS = 7
AGAINST, ALONG = 0, 2
TIME, SPEED, POSITION = 0, 1, 2
CHANCE, UNSURE = 1e-3, 1e-4
"""Chance at which structure would be seen where there is none; the second where the recording
states no noise, and a noise that remembers may be all there is."""
EXCESS, SIGMAS = 0.05, 4.0
"""What is left may exceed the stated noise by this share and so many standard errors: no sensor is
known better.
"""


class Hat(Force):
    """A force over a stretch of time, position or speed: along an axis, against the motion, or as
    dry friction.
    """

    name = "probe.hat"
    says = "a force acts over a stretch of time, position or speed"
    source = "this module"
    coefficients = tuple(
        Coefficient(name, ("1", "1", "1"), ((-1, 1), (-1, 1), (-1, 1)))
        for name in ("strength", "variable", "centre", "width", "direction", "slow")
    )

    def force(self, c: Array, moment: Moment) -> Array:
        """Strength times a triangle around the centre."""
        variables = np.concatenate(
            [np.broadcast_to(moment.t, moment.speed.shape), moment.speed, moment.x], axis=1
        )
        value = np.take_along_axis(variables, c[1].astype(np.intp), axis=1)
        height = np.maximum(1.0 - np.abs(value - c[2]) / np.maximum(c[3], 1e-12), 0.0)
        against = -moment.v / (
            moment.speed + np.maximum(c[5], 1e-9)
        )  # smooth, so that no step has to be shortened
        directions = [
            -moment.v,
            against,
            *(np.eye(moment.x.shape[1])[d] for d in range(moment.x.shape[1])),
        ]
        chosen = sum(np.where(c[4] == i, way, 0.0) for i, way in enumerate(directions))
        result: Array = c[0] * height * chosen
        return result


SLOWEST = 7.0
"""Estimated noise that is exceeded by more than this would have to remember for 30 samples: that is
no sensor's.
"""


@dataclass(frozen=True)
class Remains:
    """What a model leaves unexplained.

    Attributes:
        p_value: chance of the best force of any shape where nothing is missing; 1 where the test
            does not apply.
        where: what that force follows, e.g. ``position x``.
        excess: (C,) RMS left in units of the noise floor.
        loud: names of channels whose noise is exceeded.
        chance: below which the p value counts.
    """

    p_value: float
    where: str
    excess: Array
    loud: tuple[str, ...]
    chance: float = CHANCE

    @property
    def structure(self) -> bool:
        """Whether there is structure left."""
        return self.p_value < self.chance or bool(self.loud)


def remains(search: Search, model: Model) -> Remains:
    """Test what a fitted model leaves.

    Args:
        search: whose model it is.
        model: the model.
    """
    world, stated = search.world, search.stated
    left = np.where(np.isfinite(model.likelihood.sigma), model.likelihood.sigma, 0.0)
    excess = left / search.noise.sigma
    loud = tuple(
        name
        for c, name in enumerate(world.channels)
        if excess[c] > (1.0 + EXCESS + SIGMAS * _error(search, model, c) if stated[c] else SLOWEST)
    )
    if Hat.name not in world.slots:
        return Remains(1.0, "", excess, loud)
    found = hats(world, model)
    if not found.probes:
        return Remains(1.0, "", excess, loud)
    residual = search.residual(model.fit)
    like = surrogates(residual, search.seen, 150, search.rng)
    scores = score(model.fit, residual, found, search.seen, search.weights(model), like)
    promise = scores.score - scores.chance
    where = scores.effects[int(np.argmax(promise))]
    return Remains(scores.p_value, where, excess, loud, CHANCE if stated.all() else UNSURE)


def _error(search: Search, model: Model, channel: int) -> float:
    """Standard error of a channel's sigma, as a share of it: fewer samples count where noise
    remembers.
    """
    phi = min(abs(float(model.likelihood.phi[channel])), 0.99)
    count = max(int(search.seen[:, :, channel].sum()), 2)
    return float(np.sqrt((1.0 + phi * phi) / (1.0 - phi * phi) / (2.0 * count)))


def hats(world: World, model: Model) -> Directions:
    """What hats over every recorded variable would change about a model."""
    labels, added = [], []
    slow = 0.05 * _fastest(world)
    size = 1e-4 * {"point": 2.0, "linear": 5.0, "rotary": 0.5}[world.simulator.system.kind]
    for label, variable, direction, low, high in _families(world):
        width = (high - low) / (BINS - 1)
        for centre in np.linspace(low, high, BINS):
            labels.append(label)
            added.append((Hat.name, np.array([size, variable, centre, width, direction, slow])))
    if not added:
        return Directions((), np.zeros((*world.observed.shape, 0)))
    changed = simulate_with(world, model.fit, added) - model.fit.simulated
    values = np.nan_to_num(np.moveaxis(changed, 0, -1)) / size
    kept = np.flatnonzero(np.abs(values).max(axis=(0, 1, 2)) > 0)
    probes = tuple(Probe(labels[i], 0, 0, added[i][1], True) for i in kept)
    return Directions(probes, values[..., kept])


def _families(world: World) -> Iterator[tuple[str, int, int, float, float]]:
    """Label, variable, direction and range of each family of hats."""
    system, times = world.simulator.system, [t.scenario.times for t in world.tracks]
    axes, free = len(system.coordinates), system.bounces
    longest = max(float(t[-1] - t[0]) for t in times)
    for axis, name in enumerate(system.coordinates):
        if name in world.channels:
            yield f"time, along {name}", TIME, ALONG + axis, 0.0, longest
    yield "time, against the motion", TIME, AGAINST, 0.0, longest
    for axis, name in enumerate(system.coordinates):
        if name not in world.channels:
            continue
        values = world.observed[:, :, world.channels.index(name)]
        low, high = (float(v) for v in np.nanquantile(values, [0.01, 0.99]))
        if high > low:
            if not (free and axis == axes - 1):
                yield (
                    f"position {name}, along {system.coordinates[-1]}",
                    POSITION + axis,
                    ALONG + axes - 1,
                    low,
                    high,
                )
            yield f"position {name}, against the motion", POSITION + axis, AGAINST, low, high
            if not free:
                yield f"position {name}, dry", POSITION + axis, AGAINST + 1, low, high
    speed = _fastest(world)
    if speed > 0:
        yield "speed, against the motion", SPEED, AGAINST, 0.0, speed
    if speed > 0 and not free:
        yield "speed, dry", SPEED, AGAINST + 1, 0.0, speed


def _fastest(world: World) -> float:
    """A speed that is seldom exceeded, from the recorded coordinates."""
    system, squares = world.simulator.system, []
    for name in system.coordinates:
        if name in world.channels:
            c = world.channels.index(name)
            rates = [
                np.diff(t.observed[::3, c]) / np.diff(t.scenario.times[::3])
                for t in world.tracks
                if len(t.observed) > 3
            ]
            squares.append(np.square(np.concatenate([np.zeros(1), *rates])))
    return float(np.sqrt(np.nanquantile(sum(squares), 0.98))) if squares else 0.0
