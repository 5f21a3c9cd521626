"""Proposes the experiment that would tell two explanations apart: where their predictions differ
most.

A T-optimal design over a few changes that an experimenter can make (A. C. Atkinson, V. V. Fedorov,
Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57), the rival's parameters held at what these
data made of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bench.gap.model.models import Model, Models
from bench.gap.model.world import World
from sims.base import Array, Scenario

TELLING = 2.0
"""Two models that differ by less than this many sigmas, RMS, would not be told apart by one more
run.
"""


def next_experiment(models: Models, model: Model, rival: Model) -> dict[str, Any]:
    """What to record next: a sentence, the change, and how far apart the two models then are in
    units of the noise.
    """
    world = models.world
    best: tuple[float, str, dict[str, Any]] = (0.0, "", {})
    for says, change, scenario, states in _changes(world):
        apart = _apart(world, scenario, states, model, rival, models.noise.sigma)
        if np.isfinite(apart) and apart > best[0]:
            best = apart, says, change
    added = [
        " and ".join(sorted({*m.names} - {*o.names})) for m, o in ((model, rival), (rival, model))
    ]
    if best[0] < TELLING:
        shown = ", ".join(c.name for c in world.kind.channels if c.name not in world.channels)
        other = f"record {shown} besides" if shown else "measure one of the causes directly"
        agree = f"No run of this kind would tell {added[0]} from {added[1]}: their predictions agree within the noise"
        return {"says": f"{agree}; {other}", "change": {}, "apart": best[0]}
    says = f"{best[1]}: there {added[0]} and {added[1]} differ by {best[0]:.3g} times the noise"
    return {"says": says, "change": best[2], "apart": best[0]}


def _changes(world: World) -> Iterator[tuple[str, dict[str, Any], Scenario, Array]]:
    """Runs like the first one, with more or less of what an experimenter has in hand."""
    track = world.tracks[0]
    times = track.scenario.times
    longer = np.concatenate([times, times[-1] + (times[1:] - times[0])])
    longest = {n: np.concatenate([u, u[1:]]) for n, u in track.scenario.inputs.items()}
    yield (
        "Record twice as long",
        {"seconds": float(longer[-1] - longer[0])},
        replace(track.scenario, times=longer, inputs=longest),
        track.guess,
    )
    for name, unit in ((n, u) for n, u in zip(world.states, _units(world), strict=True)):
        place = world.states.index(name)
        for share in (0.3, 2.0, -1.0):
            states = track.guess.copy()
            states[place] = share * states[place] if abs(states[place]) > 0.05 else share
            if (
                world.simulator.system.bounces
                and place == len(world.simulator.system.coordinates) - 1
            ):
                if share < 0:
                    continue
                states[place] = max(states[place], 1.0)
            yield (
                f"Start with {name} = {states[place]:.3g} {unit}",
                {name: float(states[place])},
                track.scenario,
                states,
            )
    for name, signal in track.scenario.inputs.items():
        for share in (0.3, 3.0):
            inputs = {**track.scenario.inputs, name: share * signal}
            says = f"Make the input {name} {'smaller' if share < 1 else 'larger'}, {share:g} times what it was"
            yield says, {name: share}, replace(track.scenario, inputs=inputs), track.guess


def _units(world: World) -> list[str]:
    system = world.simulator.system
    units = {channel.name: channel.unit for channel in world.kind.channels}
    lengths = [units.get(name, "m") for name in system.coordinates]
    rates = [f"{unit}/s" for unit in lengths]
    rates += [units.get(name, "SI") for name in system.rates[len(lengths) :]]
    return [*lengths, *rates]


def _apart(
    world: World, scenario: Scenario, states: Array, model: Model, rival: Model, sigma: Array
) -> float:
    theta = np.delete(np.stack([model.fit.theta, rival.fit.theta]), world.base[world.own :], axis=1)
    freed = [p.name for p in world.freed]
    scenarios = [
        replace(scenario, constants={**scenario.constants, **dict(zip(freed, fitted, strict=True))})
        for fitted in (m.fit.theta[world.own : world.base.size].tolist() for m in (model, rival))
    ]
    initial = {
        name: np.full(2, value) for name, value in zip(world.states, states.tolist(), strict=True)
    }
    seen = world.simulator.simulate_lanes(theta, scenarios, initial)
    world.simulations += 2
    return float(np.sqrt(np.square((seen[0] - seen[1]) / sigma).mean()))
