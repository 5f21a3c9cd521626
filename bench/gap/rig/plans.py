"""Runs that could be recorded next, in the rig's own terms: which command of which form and size,
about which level, from where, with which load, at which rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.gap.model.world import World
from bench.gap.rig.stated_limits import UNLIMITED, stated_limits
from bench.problem.signals import signal
from sims.base import Array, Scenario

SIZES = (1.0, 2.0, 0.4)
"""Of the largest command recorded so far."""
SHARES = (1.0, 1.4, 2.0, -1.0, 0.6, 0.3)
"""Of where a coordinate began so far, from where it is let go."""
LEVELS = (0.5, -0.5)
"""Of the largest command, about which a command may go instead of its middle."""
COARSER = (2, 4)
"""Stamps that are one: a command that is held, or goes straight, for so much longer."""
FEWEST = 40
"""Samples that a run has at least."""
STEADY = 0.05
"""Rate of a coordinate, in its unit a second, below which a run began at rest."""
AT_REST = 0.05
"""Where a coordinate began, below which it has no share worth a try."""
PUSHED = 0.2
"""Share of a run after which what was pushed is let go."""
HELD = 6
"""Levels of a run of holds."""


@dataclass(frozen=True)
class Plan:
    """What to do, in words and numbers.

    Attributes:
        driven: inputs that are driven; none where it is let go.
        form: of their command, in words.
        size: of it, of the largest so far.
        level: about which it goes, of the largest so far from its middle.
        states: to begin with, by name, where they differ from the first run's, at rest.
        constants: by name, which load, length or gain: one of those recorded so far.
        coarser: stamps so far that are one now.
    """

    driven: tuple[str, ...] = ()
    form: str = ""
    size: float = 1.0
    level: float = 0.0
    states: tuple[tuple[str, float], ...] = ()
    constants: tuple[tuple[str, float], ...] = ()
    coarser: int = 1


@dataclass(frozen=True)
class Run:
    """A plan with its commands and its initial state."""

    plan: Plan
    says: str
    scenario: Scenario
    states: Array


class Rig:
    """What was recorded so far as what can be done again, otherwise.

    Args:
        world: of the runs so far.
        seconds: how long the next may last.
    """

    def __init__(self, world: World, seconds: float) -> None:
        self.world, self.seconds = world, seconds
        self.old = world.tracks[0].scenario
        self.step = float(np.median(np.diff(self.old.times)))
        self.largest, self.rest = {}, {}
        for name in self.old.inputs:
            signals = [track.scenario.inputs[name] for track in world.tracks]
            middle = float(np.median(np.concatenate(signals)))
            self.largest[name] = max(float(np.abs(values - middle).max()) for values in signals)
            self.rest[name] = middle
        self.driven = tuple(name for name in self.old.inputs if self.largest[name] > 0)
        self.limits = stated_limits(world)
        self.begin = self._begin()

    def _begin(self) -> Array:
        """Where the first run began, at rest (nobody can throw a robot) and within joint ranges."""
        states = self.world.tracks[0].guess.copy()
        rates = set(self.world.simulator.system.rates)
        for i, name in enumerate(self.world.states):
            states[i] = 0.0 if name in rates else self._reachable(name, float(states[i]))
        return states

    def _reachable(self, name: str, value: float) -> float:
        """The value of a state within the joint's range."""
        return float(np.clip(value, *self.limits.positions.get(name, UNLIMITED)))

    # -- plans

    def basic(self) -> Iterator[Plan]:
        """Every form and size, one input at a time and all together; and let go from elsewhere."""
        for state in self._beginnings():
            yield Plan(states=(state,))
        groups = [(name,) for name in self.driven]
        for driven in [*groups, self.driven] if len(groups) > 1 else groups:
            for size in SIZES:
                for form in FORMS:
                    yield Plan(driven, form, size)

    def variants(self, plan: Plan) -> Iterator[Plan]:
        """A plan with one thing changed."""
        for name, value in self._beginnings():
            yield replace(plan, states=tuple((dict(plan.states) | {name: value}).items()))
        for name, values in self._knobs().items():
            rest = tuple(pair for pair in plan.constants if pair[0] != name)
            for value in values:
                yield replace(plan, constants=(*rest, (name, value)))
        if plan.driven:
            for level in LEVELS:
                yield replace(plan, level=level)
            for size in SIZES:
                yield replace(plan, size=size)
        for coarser in COARSER:
            if self.seconds / (self.step * coarser) >= FEWEST:
                yield replace(plan, coarser=coarser)

    def _beginnings(self) -> Iterator[tuple[str, float]]:
        """Each coordinate farther from rest, and as fast as it began so far."""
        system, world = self.world.simulator.system, self.world
        unseen = {world.states[i] for i in np.flatnonzero(world.known.all(axis=0))}
        for name in system.coordinates:
            base = float(self.begin[world.states.index(name)])
            values = [share * base if abs(base) > AT_REST else share for share in SHARES]
            # Beyond its range a joint begins at the end of it, which need not be tried twice.
            reachable = dict.fromkeys(self._reachable(name, value) for value in values)
            for value in reachable if name not in unseen else ():
                yield name, value
        if world.kind.has_model:
            return
        for name in system.rates:
            fastest = float(np.abs(world.guess[:, world.states.index(name)]).max())
            for value in (fastest, -fastest) if fastest > STEADY and name not in unseen else ():
                yield name, value

    def _knobs(self) -> dict[str, list[float]]:
        """Constants that differed between runs, and what they were: these can be had."""
        values: dict[str, set[float]] = {}
        for run in self.world.runs:
            for name, value in run.constants.items():
                values.setdefault(name, set()).add(value)
        return {name: sorted(own) for name, own in values.items() if len(own) > 1}

    # -- runs

    def run(self, plan: Plan) -> Run:
        """The commands of a plan."""
        times = np.arange(0.0, self.seconds, self.step * plan.coarser)
        inputs = {
            name: self._limited(name, np.full(times.size, self.rest[name]))
            for name in self.old.inputs
        }
        states = self.begin.copy()
        limited = []
        for number, name in enumerate(plan.driven):
            own = plan.size * _command(plan.form, times, self.step, np.random.default_rng(number))
            wanted = self.rest[name] + self.largest[name] * (own + plan.level)
            inputs[name] = self._limited(name, wanted)
            limited += [name] if (inputs[name] != wanted).any() else []
        for name, value in plan.states:
            states[self.world.states.index(name)] = value
        constants = {**self.old.constants, **dict(plan.constants)}
        scenario = replace(self.old, times=times, inputs=inputs, constants=constants)
        return Run(plan, self._says(plan, inputs, limited), scenario, states)

    def _limited(self, name: str, values: Array) -> Array:
        """A command within the limits of its actuator and its joint."""
        return np.asarray(np.clip(values, *self.limits.commands.get(name, UNLIMITED)))

    def _says(self, plan: Plan, inputs: Mapping[str, Array], limited: Sequence[str]) -> str:
        if plan.driven:
            what = plan.driven[0] if len(plan.driven) == 1 else "all inputs"
            text = f"{what}: {plan.form}, {plan.size:g} times as large as so far"
        else:
            text = "let it go"
        if plan.level:
            middles = [f"{name} = {np.median(inputs[name]):.3g}" for name in plan.driven]
            text += f", about {', '.join(middles)}"
        for name in limited:
            low, high = self.limits.commands[name]
            text += f", {name} limited to {low:.4g} to {high:.4g}"
        begins = [f"{name} = {value:.3g}" for name, value in plan.states]
        text += f", from {', '.join(begins)}" if begins else ""
        if plan.constants:
            text += ", with " + ", ".join(f"{name} = {value:.4g}" for name, value in plan.constants)
        if plan.coarser > 1:
            text += f", commands and samples {1.0 / (self.step * plan.coarser):.4g} times a second"
        return text


FORMS: Mapping[str, str] = {
    "slow multisine": "multisine:1:{slow:g}:1",
    "fast multisine": "multisine:1:{middle:g}:{fast:g}",
    "chirp": "chirp:1:{slow:g}:{fast:g}",
    "steps of 0.5 s": "steps:1:0.5",
    "steps of 0.1 s": "steps:1:0.1",
    "slow sine": "sine:1:{slow:g}",
    "square wave of 1 Hz": "square:1:1",
    "square wave of 4 Hz": "square:1:4",
    "ramps up and down": "",
    "holds": "",
    "a push, then let go": "",
}
"""Commands of size one by what they are called; those that are no signal by a function each."""


def _command(form: str, times: Array, step: float, rng: np.random.Generator) -> Array:
    """(T,) a command of size one."""
    share = times / (times[-1] or 1.0)
    if form == "ramps up and down":
        return np.asarray(2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * share)))
    if form == "holds":
        # Levels that turn, each as far as it can from the one before, so that friction shows.
        levels = np.array([0.0, 1.0, -1.0, 0.5, -0.5, 0.25])
        return levels[np.minimum((share * HELD).astype(np.intp), HELD - 1)]
    if form == "a push, then let go":
        return np.where(share < PUSHED, 1.0, 0.0)
    seconds = float(times[-1])
    slow = min(max(1.0 / max(seconds, step), 0.1), 0.5)
    fast = max(min(8.0, 0.1 / step), 2.0 * slow)
    text = FORMS[form].format(slow=slow, middle=min(1.0, 0.5 * fast), fast=fast)
    return signal(text, times, rng)
