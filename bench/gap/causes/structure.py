"""Is there structure that no effect of the library accounts for?

Two tests. Where the recording states its noise, what a model leaves must not exceed it. And whether
or not it does, a force of any shape must not help: hats over time, position and speed, along each
axis and against the motion, stand for causes that nobody has thought of (a nonparametric
lack-of-fit test; J. D. Hart, Nonparametric Smoothing and Lack-of-Fit Tests, 1997,
doi:10.1007/978-1-4757-2722-7), calibrated by surrogates as the library is.

A hat of width w around a centre m of a variable z (time, position or speed) is a force

    f(z) = c max(1 - |z - m| / w, 0) d                                                         (1)

with d its direction. Neighbours overlap by half, so the sum of a family over one variable is any
force that is linear between `BINS` knots. How well sigma is known that is estimated from n samples
of noise with a correlation phi between neighbours is (M. S. Bartlett's formula of 1946 at lag 0)

    sd(sigma) / sigma = sqrt((1 + phi^2) / (1 - phi^2) / (2 n))                                (2)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions, Probe, changes_by
from bench.gap.causes.joint_hats import JointFamily, JointHat
from bench.gap.causes.joint_hats import families as joint_families
from bench.gap.causes.rules import CHANCE, has_structure, is_loud, level_of
from bench.gap.causes.score_test import ScoreTest, calibrated
from bench.gap.model.models import Model, Models
from bench.gap.model.surrogates import surrogates
from bench.gap.model.world import World
from sims.base import Array
from sims.simulated import Simulated
from sims.system import Coefficient, Effect, Force, Moment

BINS = 7
"""Hats over the range of a variable."""
SURROGATES = 150
"""Residuals that mean nothing, drawn to calibrate the hats."""
SLOW = 0.05
"""Share of a speed that is seldom exceeded over which dry friction turns its sign."""
SIZE = 1e-4
"""Strength of a simulated hat as a share of a typical force: its response is linear there."""
TYPICAL = {"point": 2.0, "linear": 5.0, "rotary": 0.5}
"""A typical force of each kind of system: m/s^2, N, N m."""

AGAINST = 0
"""Direction of a hat: against the motion, in proportion to speed."""
DRY = 1
"""Against the motion, whatever the speed."""
ALONG = 2
"""Along the first axis; the others follow."""

TIME = 0
"""Variable of a hat: time."""
SPEED = 1
"""Speed."""
POSITION = 2
"""The first coordinate; the others follow."""


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
        strength, variable, centre, width, direction, slow = c
        axes = moment.x.shape[1]
        variables = [moment.t, moment.speed, *(moment.x[:, k, None] for k in range(axes))]
        # The lanes of one call differ in what a hat follows, and every lane has exactly one.
        value = sum(np.where(variable == i, one, 0.0) for i, one in enumerate(variables))
        # Off, a hat has no width either, and must not divide by it.
        reach = np.maximum(width, 1e-12)
        distance = np.abs(value - centre) / reach
        height = np.maximum(1.0 - distance, 0.0)  # (1)
        # Smooth in the speed, so that no step has to be shortened where the motion turns.
        dry = -moment.v / (moment.speed + np.maximum(slow, 1e-9))
        ways = [-moment.v, dry, *(np.eye(axes)[axis] for axis in range(axes))]
        chosen = sum(np.where(direction == i, way, 0.0) for i, way in enumerate(ways))
        result: Array = strength * height * chosen
        return result


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
        return has_structure(self.p_value, self.chance, self.loud)


def probes(kind: type[Simulated]) -> list[type[Effect]]:
    """The effects that stand for forces of any shape on a simulator of this kind."""
    return [JointHat] if kind.has_model else [Hat]


def remains(models: Models, model: Model) -> Remains:
    """Test what a fitted model leaves.

    Args:
        models: among which the model is.
        model: the model.
    """
    world, stated = models.world, models.stated
    quick = unasked(models, model)
    if not any(probe.name in world.slots for probe in (Hat, JointHat)):
        return quick
    world.watch.look("a force of any shape")
    known = models.force_of_any_shape(model)
    level = level_of(bool(stated.all()))
    # The innovations are linear in such a force; where they show one, it is simulated.
    if known is not None and known[0] > level:
        return Remains(known[0], known[1], quick.excess, quick.loud, level)
    model = models.exact(model)
    directions = hats(world, model)
    if not directions.probes:
        return quick
    residual = models.residual(model.fit)
    test = ScoreTest(model.fit, directions, models.seen, models.weights(model))
    rng = models.drawing("structure", model.names)
    scores = calibrated(
        test,
        residual,
        lambda count: surrogates(residual, models.seen, count, rng, left=test.left),
        SURROGATES,
    )
    promise = scores.score - scores.chance
    where = scores.effects[int(np.argmax(promise))]
    return Remains(scores.p_value, where, quick.excess, quick.loud, level)


def unasked(models: Models, model: Model) -> Remains:
    """What a fitted model leaves by its size alone, no force of any shape asked."""
    sigma = model.likelihood.sigma
    # A channel without samples has no sigma, and leaves nothing.
    left = np.where(np.isfinite(sigma), sigma, 0.0)
    excess = left / models.noise.sigma
    channels = []
    for c, name in enumerate(models.world.channels):
        error = _error(models, model, c)
        if is_loud(excess[c], error, models.stated[c]):
            channels.append(name)
    return Remains(1.0, "", excess, tuple(channels))


def _error(models: Models, model: Model, channel: int) -> float:
    """Standard error of a channel's sigma, as a share of it: fewer samples count where noise
    remembers.
    """
    # At a correlation of one the formula knows nothing, and every channel would be quiet.
    phi = min(abs(float(model.likelihood.phi[channel])), 0.99)
    count = max(int(models.seen[:, :, channel].sum()), 2)
    square = phi * phi
    variance = (1.0 + square) / (1.0 - square) / (2.0 * count)
    return float(np.sqrt(variance))  # (2)


def hats(world: World, model: Model) -> Directions:
    """What hats over every recorded variable would change about a model."""
    probes, size = hat_probes(world)
    names = [JointHat.name if JointHat.name in world.slots else Hat.name] * len(probes)
    added = [(name, probe.c) for name, probe in zip(names, probes, strict=True)]
    changed = changes_by(world, model.fit, added)
    values = np.nan_to_num(np.moveaxis(changed, 0, -1)) / size
    # A hat where no run ever is changes nothing, and would be a column of zeros.
    acting = np.flatnonzero(np.abs(values).max(axis=(0, 1, 2)) > 0)
    return Directions(tuple(probes[i] for i in acting), values[..., acting])


def hat_probes(world: World) -> tuple[list[Probe], float]:
    """Hats over every recorded variable, and the strength that they have.

    One label for a family: its hats are one hypothesis, and act together.
    """
    size = SIZE * TYPICAL[world.simulator.system.kind]
    probes = []
    for label, low, high, coefficients in _shapes(world, size):
        # At this spacing each hat reaches to the centres of its neighbours.
        width = (high - low) / (BINS - 1)
        for centre in np.linspace(low, high, BINS):
            _, c = coefficients(centre, width)
            probes.append(Probe(label, group=0, place=0, c=c, signed=True))
    return probes, size


Shape = Callable[[float, float], tuple[str, Array]]
"""A hat of a family by its centre and width: the effect's name, and its coefficients."""


def _shapes(world: World, size: float) -> Iterator[tuple[str, float, float, Shape]]:
    """Families of hats: the label, the range of the variable, and what makes one of them."""
    if JointHat.name in world.slots:
        for joint in joint_families(world, SLOW):
            yield joint.label, joint.low, joint.high, partial(_on_joint, joint, size)
        return
    slow = SLOW * _fastest(world)
    for family in _families(world):
        yield family.label, family.low, family.high, partial(_anywhere, family, size, slow)


def _on_joint(family: JointFamily, size: float, centre: float, width: float) -> tuple[str, Array]:
    follows = family.joint, family.variable, centre, width, family.direction, family.slow
    return JointHat.name, np.array([size, *follows])


def _anywhere(
    family: _Family, size: float, slow: float, centre: float, width: float
) -> tuple[str, Array]:
    return Hat.name, np.array([size, family.variable, centre, width, family.direction, slow])


class _Family(NamedTuple):
    """Hats over the range of one variable, with one direction."""

    label: str
    variable: int
    direction: int
    low: float
    high: float


def _families(world: World) -> Iterator[_Family]:
    """Every family of hats that the recording can show."""
    yield from _over_time(world)
    yield from _over_positions(world)
    yield from _over_speed(world)


def _over_time(world: World) -> Iterator[_Family]:
    durations = []
    for track in world.tracks:
        times = track.scenario.times
        durations.append(float(times[-1] - times[0]))
    longest = max(durations)
    for axis, name in enumerate(world.simulator.system.coordinates):
        if name in world.channels:
            yield _Family(f"time, along {name}", TIME, ALONG + axis, 0.0, longest)
    yield _Family("time, against the motion", TIME, AGAINST, 0.0, longest)


def _over_positions(world: World) -> Iterator[_Family]:
    system = world.simulator.system
    # What bounces flies free: there is nothing that it slides on, and its height comes last.
    free, last = system.bounces, len(system.coordinates) - 1
    for axis, name in enumerate(system.coordinates):
        if name not in world.channels:
            continue
        values = world.observed[:, :, world.channels.index(name)]
        low, high = (float(v) for v in np.nanquantile(values, [0.01, 0.99]))
        if not high > low:
            continue
        position = POSITION + axis
        if not (free and axis == last):
            along = f"position {name}, along {system.coordinates[last]}"
            yield _Family(along, position, ALONG + last, low, high)
        yield _Family(f"position {name}, against the motion", position, AGAINST, low, high)
        if not free:
            yield _Family(f"position {name}, dry", position, DRY, low, high)


def _over_speed(world: World) -> Iterator[_Family]:
    speed = _fastest(world)
    if speed > 0:
        yield _Family("speed, against the motion", SPEED, AGAINST, 0.0, speed)
    if speed > 0 and not world.simulator.system.bounces:
        yield _Family("speed, dry", SPEED, DRY, 0.0, speed)


def _fastest(world: World) -> float:
    """A speed that is seldom exceeded, from the recorded coordinates."""
    squares = []
    for name in world.simulator.system.coordinates:
        if name not in world.channels:
            continue
        c = world.channels.index(name)
        rates = [np.zeros(1)]
        for track in world.tracks:
            if len(track.observed) > 3:
                # Every third sample: differences of neighbours are mostly noise.
                step = np.diff(track.scenario.times[::3])
                rates.append(np.diff(track.observed[::3, c]) / step)
        squares.append(np.square(np.concatenate(rates)))
    # A system whose coordinates are not recorded has no speed to lay hats over.
    if not squares:
        return 0.0
    speed = np.nanquantile(sum(squares), 0.98)
    return float(np.sqrt(speed))
