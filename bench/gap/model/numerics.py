"""Is it the simulator's own step? How far a robot's simulation is from its own fine motion, and
which step and integrator mend that.

A model file states a time step and an integrator, and they are part of what it says: a motion that
is stepped too coarsely is early by about half a step, or blows up where a servo is stiff. With q(h)
the motion at a step h, a scheme is trusted as a reference where halving its step hardly changes it;
where none is, the first-order error of an implicit one is taken out (L. F. Richardson, 1911,
doi:10.1098/rsta.1911.0009):

    q = 2 q(h / 2) - q(h)                                                                      (1)
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from sims.base import Array
from sims.robot.numerics import Numerics
from sims.robot.simulator import RobotSimulator

MATTERS = 0.2
"""RMS error in units of the noise from which the step is asked about."""
MENDED = 0.1
"""RMS error below which a setting is taken to mend it."""
ROUGH = 0.7
"""The same where far more is left to explain; what remains of it is taken out when that is done
(`bench.gap.model.tangents`).
"""
LESS = 4.0
"""And this many times smaller than that of the file's own step."""
WITHIN = 0.05
"""But no larger than this share of what the model leaves."""
TRUSTED = 0.03
"""RMS change by halving the step below which a scheme is a reference."""
FINEST = 10
"""Parts of the model's own step that are tried at most."""
ROBUST = "implicitfast"
"""The integrator that stiff servos do not blow up."""
RUNS = 2
"""Runs that are looked at: a step that is too coarse is so in all of them."""


class Finer(NamedTuple):
    """How the robot should be stepped.

    Attributes:
        kind: its simulator, stepped so.
        own: step and integrator of the file.
        numerics: those that mend it.
        error: RMS error of the file's own numerics in units of the noise.
        rest: the same of those that mend it.
    """

    kind: type[RobotSimulator]
    own: Numerics
    numerics: Numerics
    error: float
    rest: float

    def suits(self, left: float) -> bool:
        """Whether its step is fine enough for a model that leaves so much, RMS in units of the
        noise.
        """
        return self.rest < max(MENDED, WITHIN * left)


def finer(world: World, noise: Noise) -> Iterator[Finer]:
    """Steps and integrators that follow the robot's own fine motion, the cheapest first, where the
    file's do not; none where they do.

    Args:
        world: the runs, of a robot.
        noise: of each channel.
    """
    kind = world.kind
    assert issubclass(kind, RobotSimulator)
    motions = _Motions(world, noise, kind)
    own = kind.numerics
    reference = motions.reference(own)
    if reference is None:
        return
    error = motions.apart(motions.of(own), reference)
    if not error > MATTERS:
        return
    for numerics in _settings(own):
        rest = motions.apart(motions.of(numerics), reference)
        if rest < max(MENDED, min(ROUGH, error / LESS)):
            yield Finer(kind.stepped_by(numerics), own, numerics, error, rest)


def _settings(own: Numerics) -> Iterator[Numerics]:
    """Steps and integrators in the order of what they cost."""
    step, integrator = own
    cost = {"RK4": 3.3}
    tried = []
    for parts in (1, 2, 5, FINEST):
        for name in dict.fromkeys((integrator, ROBUST, "RK4")):
            if (parts, name) != (1, integrator):
                tried.append((parts * cost.get(name, 1.0), parts, name))
    for _, parts, name in sorted(tried, key=lambda entry: entry[0]):
        yield Numerics(step / parts, name)


class _Motions:
    """The first runs as the robot makes them with any numerics, each simulated once."""

    def __init__(self, world: World, noise: Noise, kind: type[RobotSimulator]) -> None:
        self._world, self._kind, self._noise = world, kind, noise
        self._tracks = world.tracks[:RUNS]
        self._seen: dict[Numerics, Array] = {}

    def of(self, numerics: Numerics) -> Array:
        """(R, T, C), NaN behind the end of a shorter run."""
        if numerics not in self._seen:
            self._seen[numerics] = self._simulated(numerics)
        return self._seen[numerics]

    def _simulated(self, numerics: Numerics) -> Array:
        world = self._world
        kind = self._kind.stepped_by(numerics)
        simulator = kind(world.recording.constants, world.channels)
        count = len(self._tracks)
        theta = np.tile(world.nominal()[: world.own], (count, 1))
        states = dict(zip(world.states, world.guess[:count].T, strict=True))
        scenarios = [track.scenario for track in self._tracks]
        world.simulations += count
        return simulator.simulate_lanes(theta, scenarios, states)

    def reference(self, own: Numerics) -> Array | None:
        """The robot's fine motion; None where nothing converges."""
        for parts in (1, 2, 5):
            coarse, fine = (self.of(Numerics(own.timestep / n, "RK4")) for n in (parts, 2 * parts))
            if self.apart(coarse, fine) < TRUSTED:
                return fine
        for parts in (2, 5):
            pairs = []
            for n in (parts, 2 * parts):
                coarse, fine = (self.of(Numerics(own.timestep / k, ROBUST)) for k in (n, 2 * n))
                pairs.append(2.0 * fine - coarse)  # (1)
            if self.apart(*pairs) < TRUSTED:
                return pairs[1]
        return None

    def apart(self, one: Array, other: Array) -> float:
        """RMS in units of the noise over the samples that both have; infinite where one fails."""
        there = [np.isfinite(track.observed) for track in self._tracks]
        squares = []
        for run, seen in enumerate(there):
            apart = (one[run, : len(seen)] - other[run, : len(seen)]) / self._noise.sigma
            squares.append(np.square(apart[seen]))
        size = float(np.sqrt(np.concatenate(squares).mean()))
        return size if np.isfinite(size) else float("inf")
