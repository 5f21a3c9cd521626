"""The recorded runs as the simulator meets them: any parameters, effects and initial states, many
lanes in one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims import effects as library
from sims.base import Array, InputError, Parameter, Scenario, unknown
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated
from sims.system import Effect, Input, Sensor

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

LANE_SAMPLES = 400_000
"""Samples simulated in one call of the engine: beyond it more lanes cost memory and gain nothing.
"""
TIME_STEP = 0.01
"""Longest step of the batch engine, seconds; it shortens its steps itself where motion or forces
ask for it.
"""
TURN, PATIENCE = 0.14, 4.0
"""Radians of an oscillation in a step of the batch engine: its phase is then off by 3e-6 of itself.
A lane is given up that needs so many times the planned steps."""
FINE_STEP = 0.0025
"""The same where a sensor filters: a filter takes what it reads for linear over each step, which an
impact is not.
"""
FREED = 5.0
"""A constant that is set free is searched from a fifth of its value to five times it."""


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


class World:
    """Some runs of a recording, and one simulator that has every effect at hand, off unless its
    coefficients say so.

    A vector theta (P,) holds the system's own parameters, constants set free, then all
    coefficients. `longest` is the duration of the longest run in seconds, `travel` the largest
    range of the primary coordinate in one run.

    Args:
        kind: the simulator's class.
        recording: what was recorded.
        runs: which of its runs; all have the same length of padding afterwards.
        engine: the engine's name.
        extra: effects beside the registered library.
        free: constants to treat as parameters.

    Raises:
        InputError: the simulator is no system that takes effects, a constant does not exist, or no
            channel is its own.
    """

    def __init__(
        self,
        kind: type[Simulated],
        recording: Recording,
        runs: Sequence[Run],
        engine: str | None = "batch",
        extra: Sequence[type[Effect]] = (),
        free: Sequence[str] = (),
        candidates: Sequence[str] | None = None,
    ) -> None:
        self.kind, self.recording, self.engine = kind, recording, engine
        self.runs, self.extra = tuple(runs), tuple(extra)
        usable = library.library(kind.system)
        names = list(usable) if candidates is None else list(candidates)
        self.library = names
        chosen: list[str | type[Effect]] = [*names, *(e for e in extra if e.fits(kind.system))]
        observe = [c.name for c in kind.channels if c.name in runs[0].channels]
        steps: tuple[dict[str, Any], ...] = ({}, {})
        if engine == "batch":
            pace = {"turn": TURN, "patience": PATIENCE}
            steps = {"time_step": TIME_STEP, **pace}, {"time_step": FINE_STEP, **pace}
        self.simulator, self._fine = (
            kind(recording.constants, observe, engine=engine, effects=chosen, **settings)
            for settings in steps
        )
        own = list(self.simulator.system.parameters)
        self.own = len(own)
        self.freed = [self._freed(name) for name in free]
        self.parameters: tuple[Parameter, ...] = (
            *own,
            *self.freed,
            *self.simulator.parameters[len(own) :],
        )
        self.base: Indices = np.arange(len(own) + len(self.freed))
        self.slots = self._slots()
        self.states = [*self.simulator.system.coordinates, *self.simulator.system.rates] or list(
            kind.states
        )
        self.tracks = tuple(self._track(run) for run in runs)
        self.lengths: Indices = np.array([len(t.observed) for t in self.tracks])
        self.observed = np.full((len(runs), self.lengths.max(), len(observe)), np.nan)
        for row, track in zip(self.observed, self.tracks, strict=True):
            row[: len(track.observed)] = track.observed
        self.known: Mask = np.array([t.known for t in self.tracks])
        self.guess: Array = np.array([t.guess for t in self.tracks])
        self.longest, self.travel = self._longest(), self._travel()
        self.simulations = 0
        self._parts: dict[float, list[Scenario]] = {}
        self._shifting, self._filtering = self._delaying()

    @property
    def channels(self) -> list[str]:
        """Names of the recorded channels, in the order of observations."""
        return [c.name for c in self.simulator.channels]

    def _longest(self) -> float:
        """Seconds that the longest run takes."""
        return max(float(t.scenario.times[-1] - t.scenario.times[0]) for t in self.tracks) or 1.0

    def _travel(self) -> float:
        """The range of the primary coordinate in the run where it is largest; 0 where it is not
        recorded.
        """
        system = self.simulator.system
        name = system.coordinates[system.primary] if system.coordinates else ""
        if name not in self.channels:
            return 0.0
        values = self.observed[:, :, self.channels.index(name)]
        return float(np.nan_to_num(np.nanmax(values, axis=1) - np.nanmin(values, axis=1)).max())

    @property
    def effects(self) -> dict[str, Effect]:
        """Every effect at hand, by name."""
        return {effect.name: effect for effect in self.simulator.effects}

    def nominal(self) -> Array:
        """(P,) parameters at their nominal values, every effect off."""
        values = np.array([p.nominal for p in self.parameters])
        values[self.base.size :] = 0.0
        return values

    def simulate(self, theta: Array, runs: Indices, states: Array, share: float = 1.0) -> Array:
        """Observations (L, T, C) of lanes with parameters (L, P), in runs (L,), from initial states
        (L, s).

        Only the first share of each run is simulated; what is behind it, or behind the end of a
        shorter run, is NaN.
        """
        self.simulations += len(theta)
        result = np.full((len(theta), self.observed.shape[1], self.observed.shape[2]), np.nan)
        active = theta != 0
        kinds = active[:, self._shifting].any(axis=1) + 2 * active[:, self._filtering].any(axis=1)
        for kind in np.unique(kinds):
            lanes = np.flatnonzero(kinds == kind)
            size = max(1, LANE_SAMPLES // result.shape[1])
            for begin in range(0, lanes.size, size):
                part = lanes[begin : begin + size]
                simulator = self._fine if kind >= 2 else self.simulator
                seen = self._simulated(simulator, theta[part], runs[part], states[part], share)
                result[part, : seen.shape[1]] = seen
        return result

    def counted(self, share: float) -> Mask:
        """(R, T, C) the samples that are there in the first share of each run."""
        first = np.arange(self.observed.shape[1]) < np.ceil(share * self.lengths)[:, None]
        counted: Mask = np.isfinite(self.observed) & first[:, :, None]
        return counted

    def _scenarios(self, share: float) -> list[Scenario]:
        """The first share of every run, made once."""
        if share not in self._parts:
            self._parts[share] = [
                first_of(t.scenario, int(np.ceil(share * len(t.observed)))) for t in self.tracks
            ]
        return self._parts[share]

    def _simulated(
        self, simulator: Simulated, theta: Array, runs: Indices, states: Array, share: float
    ) -> Array:
        whole = self._scenarios(share)
        scenarios = [whole[run] for run in runs]
        if self.freed:
            names = [p.name for p in self.freed]
            values = theta[:, self.own : self.own + len(names)].tolist()
            scenarios = [
                replace(s, constants={**s.constants, **dict(zip(names, row, strict=True))})
                for s, row in zip(scenarios, values, strict=True)
            ]
        lanes = np.delete(theta, np.arange(self.own, self.base.size), axis=1)
        return simulator.simulate_lanes(
            lanes, scenarios, dict(zip(self.states, states.T, strict=True))
        )

    def close(self) -> None:
        """Give back what the engine holds."""
        self.simulator.close()
        self._fine.close()

    def _freed(self, name: str) -> Parameter:
        constants = {c.name: c for c in self.kind.constants}
        if name not in constants:
            raise unknown(f"constant of system {self.kind.name}", name, list(constants) or ["none"])
        value = self.simulator.constant_values[name]
        if value == 0 or any(name in run.constants for run in self.recording.runs):
            raise InputError(
                f"--free {name}: expected a constant that is not zero and the same in every run"
            )
        low, high = sorted((value / FREED, value * FREED))
        return Parameter(name, constants[name].unit, value, (low, high), says=constants[name].says)

    def _slots(self) -> dict[str, slice]:
        slots, place = {}, self.base.size
        for effect in self.simulator.effects:
            count = len(effect.on(self.simulator.system))
            slots[effect.name] = slice(place, place + count)
            place += count
        return slots

    def _delaying(self) -> tuple[Indices, Indices]:
        """Where coefficients stand that move instants, and that need every step: such lanes are
        simulated apart.
        """
        found: tuple[list[int], list[int]] = ([], [])
        for effect in self.simulator.effects:
            places = range(*self.slots[effect.name].indices(len(self.parameters)))
            if (isinstance(effect, Input) and type(effect).times is not Input.times) or (
                isinstance(effect, Sensor) and type(effect).times is not Sensor.times
            ):
                found[0].extend(places)
            if isinstance(effect, Sensor) and effect.filters:
                found[1].extend(places)
        return np.array(found[0], dtype=np.intp), np.array(found[1], dtype=np.intp)

    def _track(self, run: Run) -> Track:
        observed = np.stack([run.channels[name] for name in self.channels], axis=1)
        guess, known = self._start(run)
        constants = {**self.recording.constants, **run.constants}
        scenario = Scenario(run.times, {}, run.inputs, constants)
        return Track(run.name, scenario, observed, guess, known)

    def _start(self, run: Run) -> tuple[Array, Mask]:
        """Initial states (s,), and which of them are stated: from the first samples where they are
        not.
        """
        system, defaults = self.simulator.system, self.kind.states
        values = dict(defaults)
        for coordinate, rate in zip(
            system.coordinates, system.rates, strict=False
        ):  # behind them: an own one's other states
            if coordinate in run.channels:
                values[coordinate], values[rate] = beginning(run.times, run.channels[coordinate])
        for rate in system.rates:
            if rate in run.channels:
                values[rate] = beginning(run.times, run.channels[rate])[0]
        self._lift(values, run)
        values.update(run.initial)
        known = [name in run.initial or name in self._hidden() for name in self.states]
        return np.array([values[name] for name in self.states]), np.array(known)

    def _hidden(self) -> set[str]:
        """States of coordinates that nothing recorded has to do with: taken to be at their
        defaults.
        """
        system, shown = self.simulator.system, self.channels
        hidden = set()
        for axis, (coordinate, rate) in enumerate(
            zip(system.coordinates, system.rates, strict=False)
        ):
            about = (coordinate, rate, f"accel_{coordinate}")
            if axis != system.primary and not any(name in shown for name in about):
                hidden |= {coordinate, rate}
        return hidden

    def _lift(self, values: dict[str, float], run: Run) -> None:
        """Where the height above the ground is not recorded, no impact can be told: begin too high
        for one.
        """
        system = self.simulator.system
        if not system.bounces or system.coordinates[-1] in run.channels:
            return
        gravity = float(
            run.constants.get("gravity", self.simulator.constant_values.get("gravity", 9.81))
        )
        seconds = float(run.times[-1] - run.times[0])
        values[system.coordinates[-1]] = 10.0 + 100.0 * seconds + gravity * seconds**2


def first_of(scenario: Scenario, samples: int) -> Scenario:
    """The first samples of a scenario."""
    if samples >= scenario.times.size:
        return scenario
    inputs = {name: signal[:samples] for name, signal in scenario.inputs.items()}
    return replace(scenario, times=scenario.times[:samples], inputs=inputs)


def beginning(times: Array, values: Array) -> tuple[float, float]:
    """Value and slope at the first instant, from a parabola through the first samples that are
    there.
    """
    seen = np.isfinite(values)
    t, y = times[seen][:_FIRST] - times[0], values[seen][:_FIRST]
    if t.size == 0:
        return 0.0, 0.0
    if t.size < 3:
        return float(y[0]), 0.0
    scale = float(t[-1]) or 1.0
    slope, value = np.polynomial.polynomial.polyfit(t / scale, y, 1 if t.size < 5 else 2)[1::-1]
    return float(value), float(slope / scale)


_FIRST = 8
