"""Proposes the experiment that would tell two explanations apart: where their predictions differ
most.

A T-optimal design over a few changes that an experimenter can make (A. C. Atkinson, V. V. Fedorov,
Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57), the rival's parameters held at what these
data made of them. Of a run x with T samples of C channels the two models differ by

    apart(x) = sqrt(mean over t, c of ((y_model - y_rival) / sigma_c)^2)                       (1)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bench.gap.model.models import Model, Models
from bench.gap.model.tracks import Track
from bench.gap.model.world import World
from sims.base import Array, Scenario

TELLING = 2.0
"""Two models that differ by less than this many sigmas, RMS, would not be told apart by one more
run.
"""
STARTS = (0.3, 2.0, -1.0)
"""Shares of an initial state that are tried in its place."""
AT_REST = 0.05
"""An initial state below this has no share worth a try; the numbers above are taken as they are."""
LOWEST = 1.0
"""Height in metres from which what bounces is let go, at least."""
INPUTS = (0.3, 3.0)
"""Shares of an input that are tried in its place."""


@dataclass(frozen=True)
class Experiment:
    """What to record next.

    Attributes:
        says: a sentence.
        change: by name, what differs from the first run that was fitted: seconds, an initial state,
            the share of an input; None where no run is proposed.
        apart: how far apart the two models then are in units of the noise, RMS; None likewise.
    """

    says: str
    change: Mapping[str, float] | None = None
    apart: float | None = None

    def document(self) -> dict[str, Any]:
        """As in verdict.json."""
        if self.change is None or self.apart is None:
            return {"says": self.says}
        return {"says": self.says, "change": dict(self.change), "apart": self.apart}


class _Run(NamedTuple):
    """A run that could be recorded."""

    says: str
    change: dict[str, float]
    scenario: Scenario
    states: Array


def next_experiment(models: Models, model: Model, rival: Model) -> Experiment:
    """What to record next to tell a model from a rival.

    Args:
        models: among which both are.
        model: the one that stands.
        rival: what would explain the same.
    """
    world = models.world
    says = ""
    change: dict[str, float] = {}
    largest = 0.0
    for run in _runs(world):
        apart = _apart(world, run, model, rival, models.noise.sigma)
        # A run on which one of the simulations fails proposes nothing.
        if np.isfinite(apart) and apart > largest:
            says, change, largest = run.says, run.change, apart
    # Effects that both have are no matter of dispute.
    names = set(model.names)
    rivals = set(rival.names)
    mine = " and ".join(sorted(names - rivals))
    other = " and ".join(sorted(rivals - names))
    if largest < TELLING:
        return Experiment(_no_run(world, mine, other), {}, largest)
    says = f"{says}: there {mine} and {other} differ by {largest:.3g} times the noise"
    return Experiment(says, change, largest)


def _no_run(world: World, mine: str, other: str) -> str:
    """What to do where no run of this kind would tell."""
    channels = [channel.name for channel in world.kind.channels]
    unseen = ", ".join(name for name in channels if name not in world.channels)
    instead = "measure one of the causes directly"
    # What another sensor sees may differ where these agree.
    if unseen:
        instead = f"record {unseen} besides"
    return (
        f"No run of this kind would tell {mine} from {other}: "
        f"their predictions agree within the noise; {instead}"
    )


def _runs(world: World) -> Iterator[_Run]:
    """Runs like the first one, with more or less of what an experimenter has in hand."""
    # Of runs that tell as much the first one is proposed.
    track = world.tracks[0]
    yield _longer(track)
    yield from _elsewhere(world, track)
    yield from _driven(track)


def _longer(track: Track) -> _Run:
    times = track.scenario.times
    later = times[1:] - times[0]
    twice = np.concatenate([times, times[-1] + later])
    inputs = {}
    for name, signal in track.scenario.inputs.items():
        # The inputs are given once more from the beginning.
        inputs[name] = np.concatenate([signal, signal[1:]])
    scenario = replace(track.scenario, times=twice, inputs=inputs)
    seconds = float(twice[-1] - twice[0])
    change = {"seconds": seconds}
    return _Run("Record twice as long", change, scenario, track.guess)


def _elsewhere(world: World, track: Track) -> Iterator[_Run]:
    """Started from elsewhere, one state at a time."""
    system = world.simulator.system
    height = len(system.coordinates) - 1
    named = zip(world.states, _units(world), strict=True)
    for place, (name, unit) in enumerate(named):
        above_ground = system.bounces and place == height
        for share in STARTS:
            # Nothing is let go below the ground.
            if above_ground and share < 0:
                continue
            states = track.guess.copy()
            value = float(states[place])
            moving = abs(value) > AT_REST
            value = share * value if moving else share
            if above_ground:
                value = max(value, LOWEST)
            states[place] = value
            says = f"Start with {name} = {value:.3g} {unit}"
            yield _Run(says, {name: value}, track.scenario, states)


def _driven(track: Track) -> Iterator[_Run]:
    """Driven more or less, one input at a time."""
    for name, signal in track.scenario.inputs.items():
        for share in INPUTS:
            inputs = {**track.scenario.inputs, name: share * signal}
            size = "smaller" if share < 1 else "larger"
            says = f"Make the input {name} {size}, {share:g} times what it was"
            scenario = replace(track.scenario, inputs=inputs)
            yield _Run(says, {name: share}, scenario, track.guess)


def _units(world: World) -> list[str]:
    """Units of the states: of coordinates, of their rates, of what else there is."""
    system = world.simulator.system
    units = {channel.name: channel.unit for channel in world.kind.channels}
    lengths = [units.get(name, "m") for name in system.coordinates]
    rates = [f"{unit}/s" for unit in lengths]
    # Behind the rates an own system may have more, in any unit.
    further = system.rates[len(lengths) :]
    others = [units.get(name, "SI") for name in further]
    return [*lengths, *rates, *others]


def _apart(world: World, run: _Run, model: Model, rival: Model, sigma: Array) -> float:
    """How far apart two models are on a run, (1)."""
    both = [model.fit.theta, rival.fit.theta]
    # Freed constants are fitted with the parameters, and reach the simulator as constants.
    places = world.base[world.own :]
    theta = np.delete(np.stack(both), places, axis=1)
    names = [parameter.name for parameter in world.freed]
    scenarios = []
    for fitted in both:
        values = fitted[places].tolist()
        freed = dict(zip(names, values, strict=True))
        constants = {**run.scenario.constants, **freed}
        scenarios.append(replace(run.scenario, constants=constants))

    # One lane of a call for each model, both from the same initial states.
    initial = {}
    for name, value in zip(world.states, run.states.tolist(), strict=True):
        initial[name] = np.full(2, value)
    mine, other = world.simulator.simulate_lanes(theta, scenarios, initial)
    world.simulations += 2
    apart = (mine - other) / sigma
    return float(np.sqrt(np.square(apart).mean()))  # (1)
