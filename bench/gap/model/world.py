"""The recorded runs as the simulator meets them: any parameters, effects and initial states, many
lanes in one call.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.gap.model.crew import Crew
from bench.gap.model.lane_cache import LaneCache
from bench.gap.model.noise import Mask
from bench.gap.model.time_scale import on_time_scale
from bench.gap.model.tracks import Track, first_of, tracked
from bench.gap.model.watch import Watch
from sims import effects as library
from sims.base import Array, InputError, Parameter, Scenario, unknown
from sims.engines import HIDING
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated
from sims.system import Effect, Input, Sensor, members_of

Indices = NDArray[np.intp]

LANE_SAMPLES = 400_000
"""Samples simulated in one call of the engine: beyond it more lanes cost memory and gain nothing.
"""
LEAST_LANES = 64
"""But so many lanes go together however long they are: the engine steps them side by side."""
PIECE = 80_000
"""The same where calls of compiled steps are pieces for several cores."""
FEWEST_LANES = 32
"""But so many lanes make a piece."""
TIME_STEP = 0.01
"""Longest step of the batch engine, seconds; it shortens its steps itself where motion or forces
ask for it.
"""
FINE_STEP = 0.0025
"""The same where a sensor filters: a filter takes what it reads for linear over each step, which an
impact is not.
"""
TURN = 0.14
"""Radians of an oscillation in a step of the batch engine: its phase is then off by 3e-6 of itself.
"""
PATIENCE = 4.0
"""A lane is given up that needs so many times the planned steps: all lanes of a call wait for the
slowest one.
"""
FREED = 5.0
"""A constant that is set free is searched from a fifth of its value to five times it."""


class World:
    """Some runs of a recording, and one simulator that has every effect at hand, off unless its
    coefficients say so.

    A vector theta (P,) holds the system's own parameters, constants set free, then all
    coefficients. A model is thus a sparse vector, and models, runs and finite differences share one
    call of the engine as lanes of it.

    Attributes:
        kind, recording, runs, engine, extra: as given.
        library: names of the effects at hand, without the extra ones.
        simulator: has them all; its channels are those recorded.
        own: number of the system's own parameters.
        freed: constants that are treated as parameters.
        parameters: (P,) what stands in theta.
        base: (b,) places of the own parameters and the freed constants.
        slots: places of each effect's coefficients.
        states: names of the initial states.
        tracks: the runs.
        lengths: (R,) their numbers of samples.
        observed: (R, T, C) SI units; NaN where missing, or behind the end of a run.
        known: (R, s) initial states that are not to be estimated.
        guess: (R, s) initial states, stated or guessed.
        longest: duration of the longest run, seconds.
        clock: the first and the last stamp of all runs, seconds.
        simulations: lanes simulated so far.
        watch: says when fits have to leave off; never, unless another is put here.
        correction: (R, T, C) what is added to all that is simulated, if anything is
            (`bench.gap.model.tangents`).
        derivatives: (R, T, C, s) by initial states, where they have been taken from a tangent.
        neighbourhoods: of runs of a robot, that were asked for last (`bench.gap.model.tangents`).
        simulated: what effects without a tangent change about them, by name and coefficients.
        followed: the runs of a robot as a filter follows them, if it does
            (`bench.gap.prediction_error.candidate_responses`).
        identified: (b,) base parameters of a robot that prediction errors identify; None where they
            identify none.
        state_prior: (s,) standard deviations of initial states about their guesses, where a filter
            follows a robot's runs.
        measured: of runs of a robot, states from readings alone
            (`bench.gap.prediction_error.measured_states`).
        crew: who simulates and fits; this process alone, unless another is put here.

    Args:
        kind: the simulator's class.
        recording: what was recorded.
        runs: which of its runs; all have the same length of padding afterwards.
        engine: the engine's name.
        extra: effects beside the registered library.
        free: constants to treat as parameters.
        candidates: names of the library's effects to have at hand; None for all that fit.

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
        self.kind = kind
        self.recording = recording
        self.engine = engine
        self.runs = tuple(runs)
        self.extra = tuple(extra)
        usable = library.library(kind.system)
        recorded = {*self.runs[0].channels, *(c.name for c in kind.inputs)}
        # an effect on a channel that nobody recorded shows nowhere
        shown = [
            name
            for name, effect in usable.items()
            if _shows(effect, recorded)
            and (effect.hook != "hidden" or kind.has_model or engine in HIDING)
        ]
        self.library = shown if candidates is None else list(candidates)
        self.simulator, self._fine = self._simulators()

        # theta in its three parts: own parameters, freed constants, coefficients
        system = self.simulator.system
        self.own = len(system.parameters)
        self.freed = [_freed(name, self.simulator, recording) for name in free]
        coefficients = self.simulator.parameters[self.own :]
        self.parameters: tuple[Parameter, ...] = (*system.parameters, *self.freed, *coefficients)
        self.base: Indices = np.arange(self.own + len(self.freed))
        self.slots = _slots(self.simulator, self.base.size)
        self._shifting, self._filtering = self._delaying()

        # the runs; a system without coordinates names its states itself
        self.states = [*system.coordinates, *system.rates] or list(kind.states)
        self.tracks: tuple[Track, ...] = tuple(
            tracked(run, recording, self.simulator, self.states) for run in runs
        )
        self.lengths: Indices = np.array([len(t.observed) for t in self.tracks])
        self.observed = self._padded()
        self.known: Mask = np.array([t.known for t in self.tracks])
        self.guess: Array = np.array([t.guess for t in self.tracks])
        self.longest = self._longest()
        self.parameters = self._on_time_scale()
        self.clock = self._clock()
        self._travels: dict[str, float] = {}
        self.derivatives: Array | None = None
        self.correction: Array | None = None
        self.neighbourhoods: dict[tuple[int, bytes, bytes], Any] = {}
        self.simulated: dict[tuple[str, bytes], Array] = {}
        self.followed: Any = None
        self.identified: Array | None = None
        self.state_prior: Array | None = None
        self.measured: dict[int, Mapping[int, Array]] = {}
        self.simulations = 0
        self._cache = LaneCache()
        self.watch = Watch()
        self.crew = Crew()
        self._parts: dict[float, list[Scenario]] = {}

    def _simulators(self) -> tuple[Simulated, Simulated]:
        """The simulator with all effects, and the same with the steps that a filter needs."""
        kind = self.kind
        effects: list[str | type[Effect]] = list(self.library)
        effects += [effect for effect in self.extra if effect.fits(kind.system)]
        # in the simulator's order, whatever that of the table's columns
        recorded = self.runs[0].channels
        observe = [c.name for c in kind.channels if c.name in recorded]
        usual: dict[str, Any] = {}
        fine: dict[str, Any] = {}
        # the other engines have steps of their own
        if self.engine == "batch":
            usual = {"time_step": TIME_STEP, "turn": TURN, "patience": PATIENCE}
            fine = {**usual, "time_step": FINE_STEP}

        def made(settings: dict[str, Any]) -> Simulated:
            constants = self.recording.constants
            return kind(constants, observe, engine=self.engine, effects=effects, **settings)

        return made(usual), made(fine)

    def _padded(self) -> Array:
        """(R, T, C) the observations of all runs, NaN behind the end of a shorter one."""
        shape = len(self.tracks), self.lengths.max(), len(self.channels)
        observed = np.full(shape, np.nan)
        for row, track in zip(observed, self.tracks, strict=True):
            row[: len(track.observed)] = track.observed
        return observed

    def _longest(self) -> float:
        """Seconds that the longest run takes."""
        # not zero: lengths of time are divided by it
        return max(track.seconds for track in self.tracks) or 1.0

    def _clock(self) -> tuple[float, float]:
        """The first and the last stamp."""
        stamps = [track.scenario.times for track in self.tracks]
        return min(float(t[0]) for t in stamps), max(float(t[-1]) for t in stamps)

    @property
    def spacing(self) -> float:
        """Seconds from sample to sample, of the run that is sampled most often."""
        gaps = [np.diff(track.scenario.times) for track in self.tracks]
        return min((float(np.median(gap)) for gap in gaps if gap.size), default=0.0)

    @property
    def travel(self) -> float:
        """The largest range of the primary coordinate in one run; 0 where it is not recorded."""
        system = self.simulator.system
        return self._range(system.coordinates[system.primary] if system.coordinates else "")

    def travel_of(self, effect: str) -> float:
        """The range of the coordinate that an effect acts on, in the run where it is largest; 0
        where it is not recorded.
        """
        return self._range(self._coordinate(effect))

    def ends_of(self, effect: str) -> tuple[float, float]:
        """The lowest and the highest value of the same over all runs; both 0 where it is not
        recorded.
        """
        name = self._coordinate(effect)
        if name not in self.channels:
            return 0.0, 0.0
        values = self.observed[:, :, self.channels.index(name)]
        return float(np.nanmin(values, initial=np.inf)), float(np.nanmax(values, initial=-np.inf))

    def _coordinate(self, effect: str) -> str:
        """The coordinate that an effect acts on; none in an own simulator that has none."""
        system = self.simulator.system
        coordinate = self.effects[effect].coordinate
        place = system.primary if coordinate is None else coordinate
        return system.coordinates[place] if system.coordinates else ""

    def _range(self, name: str) -> float:
        """The largest range of a channel in one run, found once; 0 where it is not recorded."""
        if name not in self._travels:
            self._travels[name] = self._travel(name)
        return self._travels[name]

    def _travel(self, name: str) -> float:
        if name not in self.channels:
            return 0.0
        values = self.observed[:, :, self.channels.index(name)]
        # A run without a sample of the channel has no range.
        values = values[np.isfinite(values).any(axis=1)]
        ranges = np.nanmax(values, axis=1) - np.nanmin(values, axis=1)
        return float(ranges.max(initial=0.0))

    def _delaying(self) -> tuple[Indices, Indices]:
        """Where coefficients stand that move instants, and that need every step: such lanes are
        simulated apart.
        """
        shifting: list[int] = []
        filtering: list[int] = []
        for effect in self.simulator.effects:
            places = self.places(effect.name)
            if _moves_instants(effect):
                shifting.extend(places)
            if effect.sharp or (isinstance(effect, Sensor) and effect.filters):
                filtering.extend(places)
        # the type matters where there is none: places of an empty list would be floats
        return np.array(shifting, dtype=np.intp), np.array(filtering, dtype=np.intp)

    def _on_time_scale(self) -> tuple[Parameter, ...]:
        """The parameters, with coefficients whose ranges suit the duration and the sampling of the
        runs.
        """
        first, spacing = self.base.size, self.spacing
        coefficients = self.parameters[first:]
        scaled = [on_time_scale(p, self.longest, spacing) for p in coefficients]
        return (*self.parameters[:first], *scaled)

    @property
    def channels(self) -> list[str]:
        """Names of the recorded channels, in the order of observations."""
        return [c.name for c in self.simulator.channels]

    @cached_property
    def effects(self) -> dict[str, Effect]:
        """Every effect at hand, by name."""
        return {effect.name: effect for effect in self.simulator.effects}

    @property
    def linear(self) -> bool:
        """Whether the simulator tells what small changes do, without simulating each of them."""
        return self.kind.has_model

    def places(self, effect: str) -> range:
        """Where an effect's coefficients stand in theta."""
        slot = self.slots[effect]
        return range(slot.start, slot.stop)

    def nominal(self) -> Array:
        """(P,) parameters at their nominal values, every effect off."""
        values = np.array([p.nominal for p in self.parameters])
        # a coefficient of zero is an effect that does not act, whatever its nominal size
        values[self.base.size :] = 0.0
        return values

    def counted(self, share: float) -> Mask:
        """(R, T, C) the samples that are there in the first share of each run."""
        numbers = np.arange(self.observed.shape[1])
        ends = np.ceil(share * self.lengths)
        first = numbers < ends[:, None]
        counted: Mask = np.isfinite(self.observed) & first[:, :, None]
        return counted

    def simulate(
        self,
        theta: Array,
        runs: Indices,
        states: Array,
        share: float = 1.0,
    ) -> Array:
        """Observations (L, T, C) of lanes.

        Args:
            theta: (L, P) parameters.
            runs: (L,) which runs they are in.
            states: (L, s) initial states.
            share: only this first share of each run is simulated; what is behind it, or behind the
                end of a shorter run, is NaN.
        """
        result = np.empty((len(theta), *self.observed.shape[1:]))
        if self.linear:
            lanes = zip(theta, runs.tolist(), states, strict=True)
            keys = [
                b"".join((repr((share, run)).encode(), own.tobytes(), begin.tobytes()))
                for own, run, begin in lanes
            ]
            new = self._cache.missing(keys)
            made = self._simulate(theta[new], runs[new], states[new], share)
            self._cache.fill(keys, new, made, result)
        else:
            # The slowest lane of a call sets the steps of all: in another call a lane differs in
            # its last digits.
            result = self._simulate(theta, runs, states, share)
        if self.correction is not None:
            result += self.correction[runs]
        return result

    def _simulate(self, theta: Array, runs: Indices, states: Array, share: float) -> Array:
        """Simulate lanes, uncorrected; arguments and result as those of `simulate`."""
        self.simulations += len(theta)
        _, length, channels = self.observed.shape
        result = np.empty((len(theta), length, channels))
        if not len(theta):
            return result

        # the slowest lane of a call sets its steps: those that need many do not go with the others
        kinds = self.kinds(theta)
        together = max(LEAST_LANES, LANE_SAMPLES // length)
        if self.apart:
            together = min(together, max(FEWEST_LANES, int(PIECE / (share * length))))
        parts, calls = [], []
        for kind in np.unique(kinds):
            lanes = np.flatnonzero(kinds == kind)
            for part in np.array_split(lanes, -(-lanes.size // together)):
                parts.append(part)
                calls.append((bool(kind >= 2), theta[part], runs[part], states[part], share))
        for number, simulated in self.crew.each(self, _simulated, calls):
            last = simulated.shape[1]
            result[parts[number], :last] = simulated
            result[parts[number], last:] = np.nan
        return result

    def over(self, runs: Sequence[Run]) -> World:
        """A world of other runs, cut or thinned from these: with the same parameters, the same
        grids of shapes, the same watch and crew.
        """
        other = World(
            self.kind,
            self.recording,
            runs,
            engine=self.engine,
            extra=self.extra,
            free=[p.name for p in self.freed],
            candidates=self.library,
        )
        # what is periodic goes on from piece to piece, and what is found in one is found in all
        other.longest = self.longest
        other.parameters = self.parameters
        other.clock = self.clock
        # found now: of pieces it would be another
        for name in self.channels:
            self._range(name)
        other._travels = self._travels
        other.watch = self.watch
        other.crew = self.crew
        return other

    def with_kind(self, kind: type[Simulated]) -> World:
        """Return a world of the same runs and parameters with another simulator of the same
        system.
        """
        other = World(
            kind,
            self.recording,
            self.runs,
            engine=self.engine,
            extra=self.extra,
            free=[p.name for p in self.freed],
            candidates=self.library,
        )
        other.parameters = self.parameters
        other.watch, other.crew = self.watch, self.crew
        other.followed, other.guess = self.followed, self.guess
        other.derivatives, other.identified = self.derivatives, self.identified
        other.state_prior = self.state_prior
        self.crew.join(other)
        return other

    def simulator_of(self, kind: type[Simulated]) -> Simulated:
        """Return another simulator of the same system with the same effects and channels."""
        effects: list[str | type[Effect]] = [*self.library, *self.extra]
        return kind(self.recording.constants, self.channels, effects=effects)

    def kinds(self, theta: Array) -> Indices:
        """(L,) which lanes of parameters (L, P) can be simulated together: those of one number."""
        active = theta != 0
        shifting = active[:, self._shifting].any(axis=1)
        filtering = active[:, self._filtering].any(axis=1)
        kinds: Indices = shifting + 2 * filtering
        return kinds

    @cached_property
    def apart(self) -> bool:
        """Whether lanes cost as much in several calls as in one: where steps are compiled."""
        if self.kind.has_model:
            return True
        if self.engine != "batch":
            return False
        # loaded when something is simulated: the compiler's package is not for free
        from sims.engines.compiled import machine

        return machine.machine() is not None

    def _scenarios(self, theta: Array, runs: Indices, share: float) -> list[Scenario]:
        """The first share of each lane's run, with the constants that its parameters (L, P) set."""
        if share not in self._parts:
            self._parts[share] = [
                first_of(t.scenario, int(np.ceil(share * len(t.observed)))) for t in self.tracks
            ]
        # lanes of one run share its scenario, which the simulator then prepares once
        scenarios = [self._parts[share][run] for run in runs]
        return [self._freed_in(one, own) for one, own in zip(scenarios, theta, strict=True)]

    def together(
        self, fine: bool, theta: Array, runs: Indices, states: Array, share: float
    ) -> Array:
        """Observations (L, T', C) of lanes of one kind, in one call of the engine.

        Args:
            fine: in the steps that a filter needs.
            theta: (L, P) as in `simulate`, and so the others.
            runs: (L,).
            states: (L, s).
            share: of each run.
        """
        simulator = self._fine if fine else self.simulator
        scenarios = self._scenarios(theta, runs, share)
        # to the simulator a freed constant is none of its parameters
        freed = np.arange(self.own, self.base.size)
        lanes = np.delete(theta, freed, axis=1)
        initial = dict(zip(self.states, states.T, strict=True))
        return simulator.simulate_lanes(lanes, scenarios, initial)

    def elsewhere(self, theta: Array, scenarios: Sequence[Scenario], states: Array) -> Array:
        """Observations (L, T, C) of lanes in any scenarios, NaN behind the end of a shorter one.

        Args:
            theta: (L, P).
            scenarios: (L,).
            states: (L, s).
        """
        self.simulations += len(theta)
        length = max(scenario.times.size for scenario in scenarios)
        result = np.full((len(theta), length, len(self.channels)), np.nan)
        together = max(FEWEST_LANES, LANE_SAMPLES // length)
        freed = np.arange(self.own, self.base.size)
        kinds = self.kinds(theta)
        for kind in np.unique(kinds):
            simulator = self._fine if kind >= 2 else self.simulator
            lanes = np.flatnonzero(kinds == kind)
            for part in np.array_split(lanes, -(-lanes.size // together)):
                own = [self._freed_in(scenarios[i], theta[i]) for i in part]
                initial = dict(zip(self.states, states[part].T, strict=True))
                seen = simulator.simulate_lanes(np.delete(theta[part], freed, 1), own, initial)
                result[part, : seen.shape[1]] = seen
        return result

    def _freed_in(self, scenario: Scenario, theta: Array) -> Scenario:
        """A scenario with the constants that parameters (P,) set."""
        if not self.freed:
            return scenario
        values = theta[self.own : self.base.size].tolist()
        freed = {p.name: value for p, value in zip(self.freed, values, strict=True)}
        return replace(scenario, constants={**scenario.constants, **freed})

    def watching(self, observe: Sequence[str], effects: Sequence[str]) -> Simulated:
        """A simulator of the same with other channels, and with these effects alone; close it."""
        own: list[str | type[Effect]] = [
            next((e for e in self.extra if e.name == name), name) for name in effects
        ]
        settings: dict[str, Any] = {}
        if self.engine == "batch":
            settings = {"time_step": TIME_STEP, "turn": TURN, "patience": PATIENCE}
        constants = self.recording.constants
        return self.kind(constants, list(observe), engine=self.engine, effects=own, **settings)

    def follow(self, followed: Any) -> None:
        """Take the runs of a robot as a filter follows them: where they begin, and what their first
        states change.

        Args:
            followed: `bench.gap.prediction_error.candidate_responses.FollowedRuns`.
        """
        self.followed = followed
        begun = followed.first_states()
        fine = np.isfinite(begun).all()
        self.guess = np.where(self.known | ~fine, self.guess, begun)
        self.derivatives = followed.state_sensitivities()
        self.state_prior = followed.state_prior()

    def close(self) -> None:
        """Give back what the engine holds."""
        self.simulator.close()
        self._fine.close()


def _shows(effect: type[Effect], recorded: set[str]) -> bool:
    """Whether the signals that an effect acts on are there; all of them, if it is a family."""
    members = members_of(effect)
    return all(not member.signal or member.signal in recorded for member in members)


def _simulated(world: World, *call: Any) -> Array:
    """A call of the engine, whoever makes it."""
    return world.together(*call)


def _freed(name: str, simulator: Simulated, recording: Recording) -> Parameter:
    """A constant as a parameter."""
    constants = {c.name: c for c in simulator.constants}
    if name not in constants:
        raise unknown(f"constant of system {simulator.name}", name, list(constants) or ["none"])
    value = simulator.constant_values[name]
    # its range is a multiple of its value, and a run's own value would overrule what is fitted
    if value == 0 or any(name in run.constants for run in recording.runs):
        raise InputError(
            f"free constant {name}: expected one that is not zero and the same in every run"
        )
    # sorted, as a constant may be negative
    low, high = sorted((value / FREED, value * FREED))
    constant = constants[name]
    return Parameter(name, constant.unit, value, (low, high), says=constant.says)


def _slots(simulator: Simulated, first: int) -> dict[str, slice]:
    """Where each effect's coefficients stand, from the first place on."""
    slots = {}
    # in the simulator's order, which is that of its parameters
    for effect in simulator.effects:
        last = first + len(effect.on(simulator.system))
        slots[effect.name] = slice(first, last)
        first = last
    return slots


def _moves_instants(effect: Effect) -> bool:
    """Whether an effect reads signals at other instants than the scenario's."""
    for family in (Input, Sensor):
        if isinstance(effect, family) and type(effect).times is not family.times:
            return True
    return False
