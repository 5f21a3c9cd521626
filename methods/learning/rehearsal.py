"""Training data of learned tuners: several simulations in each of many scenarios."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from methods.base import Array, Practice, Scene

_LEAST = 2
"""Scenarios; from one alone nobody learns what scenarios differ in."""


class Rehearsal(NamedTuple):
    """Training simulations: several in each scenario.

    Attributes:
        parameters: (scenarios, each, dim), unit cube.
        observations: (scenarios, each, T, C), SI units.
        lengths: samples of each run.
        scenes: what is known of each scenario.
        unspoilt: the simulations before noise was added; None where none was.
    """

    parameters: Array
    observations: Array
    lengths: tuple[int, ...]
    scenes: tuple[Scene, ...]
    unspoilt: Rehearsal | None = None

    @property
    def pure(self) -> Rehearsal:
        """The simulations without noise."""
        return self if self.unspoilt is None else self.unspoilt

    @property
    def flat(self) -> Array:
        """All observations (scenarios * each, T, C), one after another."""
        return self.observations.reshape(-1, *self.observations.shape[2:])

    def spoilt(self, noise: Array, rng: np.random.Generator) -> Rehearsal:
        """The same with white noise of standard deviations (C,) added."""
        errors = noise * rng.standard_normal(self.observations.shape)
        # the proposed side of a network sees simulations, so they are kept as they were
        return self._replace(observations=self.observations + errors, unspoilt=self.pure)


class TooFewError(ValueError):
    """A training budget that does not last for what is learned from it."""


def uniform(simulator: Practice, rng: np.random.Generator, count: int) -> Array:
    """Points (count, dim) drawn evenly from the training range."""
    return simulator.sample(rng, count)


def rehearse(
    simulator: Practice,
    rng: np.random.Generator,
    budget: int,
    scenarios: int,
    each: int,
    drawn: Callable[[Practice, np.random.Generator, int], Array] = uniform,
) -> Rehearsal:
    """Simulate `each` points, drawn by `drawn`, in each of `scenarios` scenarios, fewer scenarios
    if the budget is small.

    Raises:
        TooFewError: the budget does not last for two scenarios.
    """
    # whole scenarios only: pairs are made within one
    count = min(scenarios, budget // each)
    if count < _LEAST:
        raise TooFewError(
            f"{budget} training simulations are fewer than two scenarios of {each} need"
        )
    parameters = []
    observations = []
    scenes = []
    for _ in range(count):
        points = drawn(simulator, rng, each)
        simulated = simulator.simulate(rng, points)
        # a scenario with a failed simulation goes as a whole: arrays need as many in each
        if np.isfinite(simulated).all():
            parameters.append(points)
            observations.append(simulated)
            scenes.append(simulator.scene)
    if len(parameters) < _LEAST:
        raise ValueError(
            f"of {count} training scenarios, {len(parameters)} could be simulated; "
            f"at least {_LEAST} are needed"
        )
    lengths = tuple(simulator.lengths)
    return Rehearsal(np.array(parameters), np.array(observations), lengths, tuple(scenes))
