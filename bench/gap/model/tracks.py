"""A recorded run as a fit meets it: the scenario, the observations, and a guess of how it began."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.gap.model.noise import Mask
from sims.base import Array, Scenario
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated

FIRST = 8
"""Samples at the beginning of a run from which its initial state is guessed."""
BENT = 5
"""Samples from which a parabola is laid through them; through fewer a line."""
STRAIGHT = 3
"""Samples from which there is a slope at all: with fewer it is all noise."""
CLEAR = 10.0
"""Height in metres at which a ball begins whose height is not recorded, besides what its run needs
not to land.
"""
FASTEST = 100.0
"""Speed in m/s at which such a ball may fall all the time, as its own is not known."""


@dataclass(frozen=True)
class Track:
    """One recorded run.

    Attributes:
        name: the run's name.
        scenario: what the simulator is given; its initial states are guesses where they are not
            stated.
        observed: (T, C) SI units, NaN where missing.
        guess: (s,) initial states, stated or guessed from the first samples.
        known: (s,) which of them are not to be estimated: stated, or of a coordinate that is not
            recorded.
    """

    name: str
    scenario: Scenario
    observed: Array
    guess: Array
    known: Mask

    @property
    def seconds(self) -> float:
        """How long it takes."""
        times = self.scenario.times
        return float(times[-1] - times[0])


def tracked(
    run: Run,
    recording: Recording,
    simulator: Simulated,
    states: Sequence[str],
) -> Track:
    """A run of a recording, for a simulator that observes its channels and has these states."""
    columns = [run.channels[c.name] for c in simulator.channels]
    # a run's own constants hold in it alone
    constants = {**recording.constants, **run.constants}
    guesses = _guessed(run, simulator)
    fixed = {*run.initial, *_hidden(simulator)}
    # what is none of the states, as the pose of what floats, is no lane's own
    begun = {name: value for name, value in run.initial.items() if name not in states}
    return Track(
        name=run.name,
        scenario=Scenario(
            run.times, begun, run.inputs, constants, run.linear, run.offset, run.before, run.off
        ),
        observed=np.stack(columns, axis=1),
        guess=np.array([guesses[name] for name in states]),
        known=np.array([name in fixed for name in states]),
    )


def _guessed(run: Run, simulator: Simulated) -> dict[str, float]:
    """Initial states by name: stated, else from the first samples, else their defaults."""
    system = simulator.system
    values = dict(simulator.states)
    # not strict: behind the coordinates' rates, an own system may have other states
    for coordinate, rate in zip(system.coordinates, system.rates, strict=False):
        if coordinate in run.channels:
            values[coordinate], values[rate] = beginning(run.times, run.channels[coordinate])
    # a rate that is recorded itself is known better than by a slope
    for rate in system.rates:
        if rate in run.channels:
            values[rate] = beginning(run.times, run.channels[rate])[0]
    if system.bounces and system.coordinates[-1] not in run.channels:
        values[system.coordinates[-1]] = _aloft(run, simulator)
    # what is stated overrules every guess
    values.update(run.initial)
    return values


def _aloft(run: Run, simulator: Simulated) -> float:
    """A height in metres from which nothing lands in this run: where the height above the ground is
    not recorded, no impact can be told.
    """
    constant = simulator.constant_values.get("gravity", 9.81)
    gravity = float(run.constants.get("gravity", constant))
    seconds = float(run.times[-1] - run.times[0])
    # twice what gravity takes away, and what a fast throw downwards does
    return CLEAR + FASTEST * seconds + gravity * seconds**2


def _hidden(simulator: Simulated) -> set[str]:
    """States of coordinates that nothing recorded has to do with: taken to be at their defaults."""
    system, shown = simulator.system, {c.name for c in simulator.channels}
    hidden = set()
    pairs = zip(system.coordinates, system.rates, strict=False)
    for axis, (coordinate, rate) in enumerate(pairs):
        about = {coordinate, rate, f"accel_{coordinate}"}
        # biases and springs act on the primary coordinate: it is never taken to be still
        if axis != system.primary and not about & shown:
            hidden |= {coordinate, rate}
    return hidden


def first_of(scenario: Scenario, samples: int) -> Scenario:
    """The first samples of a scenario."""
    if samples >= scenario.times.size:
        return scenario
    inputs = {name: signal[:samples] for name, signal in scenario.inputs.items()}
    off = {name: mask[:samples] for name, mask in scenario.off.items()}
    return replace(scenario, times=scenario.times[:samples], inputs=inputs, off=off)


def beginning(times: Array, values: Array) -> tuple[float, float]:
    """Value and slope at the first instant, from a parabola through the first samples that are
    there.
    """
    seen = np.isfinite(values)
    t = times[seen][:FIRST] - times[0]
    y = values[seen][:FIRST]
    if t.size == 0:
        return 0.0, 0.0
    if t.size < STRAIGHT:
        return float(y[0]), 0.0
    # powers of time between 0 and 1, whatever the sampling, are well conditioned
    scale = float(t[-1]) or 1.0
    degree = 1 if t.size < BENT else 2
    coefficients = np.polynomial.polynomial.polyfit(t / scale, y, degree)
    value, slope = coefficients[:2]
    return float(value), float(slope / scale)
