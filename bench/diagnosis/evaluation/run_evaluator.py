"""Simulate recorded runs with any parameters, effects and initial states, as one large batch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.initial_state_guesses import (
    RunData,
    prepare_run,
    take_first_samples,
)
from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.search_control import SearchControl
from bench.diagnosis.evaluation.simulation_cache import SimulationCache
from bench.diagnosis.evaluation.time_scaled_ranges import adapt_to_time_scale
from sims import effects as library
from sims.core.effect import Effect, Input, Sensor, members_of
from sims.core.simulator import Array, InputError, Parameter, Scenario, make_unknown_name_error
from sims.effects.sensor_effects import needs_every_step
from sims.engines.engine_lookup import HIDDEN_STATE_ENGINES
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

Indices = NDArray[np.intp]

MAX_BATCH_SAMPLES = 400_000
"""Maximum number of samples simulated in one engine call.

Larger calls need more memory and are not faster.
"""
MIN_BATCH_SIZE = 64
"""Minimum batch size of an engine call, however long the runs; the engine steps it in parallel."""
MAX_CHUNK_SAMPLES = 80_000
"""Maximum number of samples per chunk if compiled steps are distributed over several cores."""
MIN_CHUNK_SIZE = 32
"""Minimum number of batch elements per chunk if work is distributed over several cores."""
MAX_TIME_STEP = 0.01
"""Maximum time step of the batch engine, in seconds.

The engine uses shorter steps where the motion or the forces require it.
"""
MAX_TIME_STEP_FILTERED = 0.0025
"""Maximum time step of the batch engine, in seconds, if a sensor filters its signal.

A filter treats its input as linear over each step, which an impact is not.
"""
MAX_PHASE_PER_STEP = 0.14
"""Maximum phase of an oscillation per step of the batch engine, in radians; relative error 3e-6."""
MAX_STEP_COUNT_FACTOR = 4.0
"""Maximum ratio of actual to planned steps before a batch element is abandoned.

All elements of a call wait for the slowest one.
"""
FREED_CONSTANT_RANGE_FACTOR = 5.0
"""Range factor of a constant that is estimated: from value / 5 to value * 5."""


class IdentifiedParameters(NamedTuple):
    """Parameters of a robot that a filter identified by prediction errors.

    Attributes:
        base: (b,) base parameters.
        effects: coefficients (k,) of the effects that were identified with them, by name; empty if
            no effect is needed, or if some of what is missing stays unknown.
    """

    base: Array
    effects: Mapping[str, Array] = MappingProxyType({})


class RunEvaluator:
    """Simulates the runs of a recording for given parameters, effects and initial states.

    The simulator contains every available effect; an effect is off unless its coefficients are
    nonzero. A vector theta (P,) holds the base parameters of the system, the constants to estimate,
    and then the coefficients of all effects. A model is therefore a sparse vector, and models, runs
    and finite differences are simulated together as elements of one batch.

    Attributes:
        kind: class of the simulator, as given.
        recording: the recording, as given.
        runs: its runs that are used, as given.
        engine: name of the engine, as given.
        extra_effects: effects in addition to the library, as given.
        library: names of the available effects, without the extra ones.
        simulator: simulator with all available effects; its channels are the recorded ones.
        system_parameter_count: number of base parameters of the system.
        freed_constants: constants that are treated as parameters.
        parameters: (P,) description of each element of theta.
        base_indices: (b,) indices in theta of the base parameters and the estimated constants.
        coefficient_slices: slice of theta with the coefficients of each effect.
        state_names: names of the initial states.
        prepared_runs: the runs, prepared for fitting.
        lengths: (R,) number of samples of each run.
        observed: (R, T, C) observations in SI units; NaN where missing, or after the end of a run.
        known_state_mask: (R, s) whether an initial state is known, and so is not estimated.
        initial_state_guesses: (R, s) initial states, specified or guessed.
        longest_duration: duration of the longest run, in seconds.
        time_span: first and last time stamp of all runs, in seconds.
        simulation_count: number of batch elements simulated so far.
        search_control: search control that stops fits early; by default it never does.
        discretisation_correction: (R, T, C) correction added to all simulations, or None
            (`bench.diagnosis.evaluation.discretisation_error`).
        state_derivatives: (R, T, C, s) derivatives by the initial states if they come from a
            linearisation, else None.
        cached_linearisations: linearised robot runs that were used most recently
            (`bench.diagnosis.fitting.trajectory_derivatives`).
        cached_responses: responses to effects that have no linearisation, by name and coefficients.
        filtered_runs: the runs of a robot as followed by a state filter, or None
            (`bench.diagnosis.kalman.linearised_filter`).
        identified: parameters of a robot identified by prediction errors; None if there are none.
        state_prior: (s,) standard deviations of the initial states about their guesses, if a filter
            follows the runs of a robot; else None.
        is_in_contact: whether geoms of a robot touch, so that initial states were estimated by a
            nonlinear filter.
        measured_states: for runs of a robot, states estimated from readings alone
            (`bench.diagnosis.kalman.kinematic_smoother`).
        worker_pool: worker pool for simulations and fits; by default only this process.

    Raises:
        InputError: the simulator is not a system that accepts effects, a constant does not exist,
            or none of its channels is recorded.
    """

    def __init__(
        self,
        kind: type[SystemSimulator],
        recording: Recording,
        runs: Sequence[Run],
        engine: str | None = "batch",
        extra: Sequence[type[Effect]] = (),
        free: Sequence[str] = (),
        candidates: Sequence[str] | None = None,
    ) -> None:
        """Build the simulator with all observable effects, and prepare the runs as padded arrays.

        An effect is included if the recorded channels and inputs can show it. All of them are off
        unless their coefficients in theta are nonzero; theta is the vector of all parameters. The
        docstring of the class describes the attributes.

        Args:
            kind: class of the simulator.
            recording: recorded runs, with their channels, inputs and constants.
            runs: the runs of the recording to use; they are padded to equal length.
            engine: name of the engine.
            extra: effects in addition to the registered library.
            free: names of constants to treat as parameters.
            candidates: names of the library effects to include; None for all that are observable.
        """
        self.kind = kind
        self.recording = recording
        self.engine = engine
        self.runs = tuple(runs)
        self.extra_effects = tuple(extra)
        applicable_effects = library.list_effects_for(kind.system)
        recorded_signals = {*self.runs[0].channels, *(c.name for c in kind.inputs)}
        # An effect on a channel that is not recorded is not observable. Effects with hidden states,
        # such as backlash, need a robot simulator (`has_model`) or an engine that integrates these.
        observable_effects = [
            name
            for name, effect in applicable_effects.items()
            if _is_effect_observable(effect, recorded_signals)
            and (effect.hook != "hidden" or kind.has_model or engine in HIDDEN_STATE_ENGINES)
        ]
        self.library = observable_effects if candidates is None else list(candidates)
        self.simulator, self._fine_step_simulator = self._create_simulators()

        # Theta has three parts: base parameters, freed constants, coefficients.
        system = self.simulator.system
        self.system_parameter_count = len(system.parameters)
        self.freed_constants = [
            _make_freed_parameter(name, self.simulator, recording) for name in free
        ]
        coefficients = self.simulator.parameters[self.system_parameter_count :]
        self.parameters: tuple[Parameter, ...] = (
            *system.parameters,
            *self.freed_constants,
            *coefficients,
        )
        self.base_indices: Indices = np.arange(
            self.system_parameter_count + len(self.freed_constants)
        )
        self.coefficient_slices = _allocate_coefficients(self.simulator, self.base_indices.size)
        # Indices in theta of coefficients that shift sample times, and of those that need fine
        # steps.
        self._shifting_coefficients, self._fine_step_coefficients = (
            self._find_delaying_coefficients()
        )

        # Runs, padded to equal length. A system without coordinates provides the names of its
        # states itself.
        self.state_names = [*system.coordinates, *system.rates] or list(kind.states)
        self.prepared_runs: tuple[RunData, ...] = tuple(
            prepare_run(run, recording, self.simulator, self.state_names) for run in runs
        )
        self.lengths: Indices = np.array([len(t.observed) for t in self.prepared_runs])
        self.observed = self._pad_observations()
        self.known_state_mask: Mask = np.array([t.known_state_mask for t in self.prepared_runs])
        self.initial_state_guesses: Array = np.array(
            [t.initial_state_guess for t in self.prepared_runs]
        )
        self.longest_duration = self._get_longest_duration()
        # Ranges of delays and frequencies depend on the duration and the sample interval.
        self.parameters = self._scale_coefficient_ranges()
        self.time_span = self._get_time_span()
        self._channel_ranges: dict[str, float] = {}
        # What filters and linearisations of a robot provide later; empty until then.
        self.state_derivatives: Array | None = None
        self.discretisation_correction: Array | None = None
        self.cached_linearisations: dict[tuple[int, bytes, bytes], Any] = {}
        self.cached_responses: dict[tuple[str, bytes], Array] = {}
        self.filtered_runs: Any = None
        self.identified: IdentifiedParameters | None = None
        self.is_in_contact = False
        self.state_prior: Array | None = None
        self.measured_states: dict[int, Mapping[int, Array]] = {}
        # Simulation.
        self.simulation_count = 0
        self._cache = SimulationCache()
        self.search_control = SearchControl()
        self.worker_pool = ForkedWorkerPool()
        self._shortened_scenarios: dict[float, list[Scenario]] = {}

    def _create_simulators(self) -> tuple[SystemSimulator, SystemSimulator]:
        """Create the simulator with all available effects, and a copy with a finer time step.

        The copy simulates batch elements in which effects act that need fine steps, such as filters
        of sensors.

        Returns:
            The simulator with the usual time step, and the one with the fine step.
        """
        kind = self.kind
        effects: list[str | type[Effect]] = list(self.library)
        effects += [effect for effect in self.extra_effects if effect.fits(kind.system)]
        # Channels follow the order of the simulator, not that of the columns of the log.
        recorded_channels = self.runs[0].channels
        observe = [c.name for c in kind.channels if c.name in recorded_channels]
        default_settings = self._engine_settings
        # Engines other than the batch engine have no settings (an empty dictionary), so the copy
        # has the same steps.
        fine_settings = default_settings and {
            **default_settings,
            "time_step": MAX_TIME_STEP_FILTERED,
        }

        def make_simulator(settings: dict[str, Any]) -> SystemSimulator:
            """Create a simulator of the recorded channels with all effects."""
            constants = self.recording.constants
            return kind(constants, observe, engine=self.engine, effects=effects, **settings)

        return make_simulator(default_settings), make_simulator(fine_settings)

    @property
    def _engine_settings(self) -> dict[str, Any]:
        """Settings of the batch engine: its time step, and when it shortens steps or gives up.

        They are empty for other engines, which choose their steps themselves.
        """
        if self.engine != "batch":
            return {}
        return {
            "time_step": MAX_TIME_STEP,
            "turn": MAX_PHASE_PER_STEP,
            "patience": MAX_STEP_COUNT_FACTOR,
        }

    def _pad_observations(self) -> Array:
        """Return the observations (R, T, C) of all runs, NaN after the end of a shorter run."""
        shape = len(self.prepared_runs), self.lengths.max(), len(self.channels)
        observed = np.full(shape, np.nan)
        for row, run_data in zip(observed, self.prepared_runs, strict=True):
            row[: len(run_data.observed)] = run_data.observed
        return observed

    def _get_longest_duration(self) -> float:
        """Return the duration of the longest run, in seconds."""
        # A duration of zero is replaced, because times are divided by it.
        return max(run_data.duration for run_data in self.prepared_runs) or 1.0

    def _get_time_span(self) -> tuple[float, float]:
        """Return the first and the last time stamp of all runs."""
        stamps = [run_data.scenario.times for run_data in self.prepared_runs]
        return min(float(t[0]) for t in stamps), max(float(t[-1]) for t in stamps)

    @property
    def sample_interval(self) -> float:
        """Median sample interval of the run sampled most often, in seconds; 0 if unknown."""
        gaps = [np.diff(run_data.scenario.times) for run_data in self.prepared_runs]
        return min((float(np.median(gap)) for gap in gaps if gap.size), default=0.0)

    def get_effect_travel(self, effect: str) -> float:
        """Return the largest range within one run of the coordinate that an effect acts on.

        The range is 0 if the coordinate is not recorded.
        """
        return self._get_channel_range(self._get_effect_coordinate(effect))

    def get_coordinate_range(self, effect: str) -> tuple[float, float]:
        """Return the minimum and maximum, over all runs, of the coordinate that an effect acts on.

        Both are 0 if the coordinate is not recorded.
        """
        name = self._get_effect_coordinate(effect)
        if name not in self.channels:
            return 0.0, 0.0
        values = self.observed[:, :, self.channels.index(name)]
        # The initial values avoid an error of NumPy where all samples are missing.
        return float(np.nanmin(values, initial=np.inf)), float(np.nanmax(values, initial=-np.inf))

    def _get_effect_coordinate(self, effect: str) -> str:
        """Return the coordinate that an effect acts on; empty if there are no coordinates."""
        system = self.simulator.system
        coordinate = self.available_effects[effect].coordinate
        # Effects that name no coordinate act on the primary one of the system.
        index = system.primary if coordinate is None else coordinate
        return system.coordinates[index] if system.coordinates else ""

    def _get_channel_range(self, name: str) -> float:
        """Return the largest range of a channel within one run, cached; 0 if not recorded."""
        if name not in self._channel_ranges:
            self._channel_ranges[name] = self._compute_channel_range(name)
        return self._channel_ranges[name]

    def _compute_channel_range(self, name: str) -> float:
        """Compute the largest range (maximum minus minimum) of a channel within one run.

        It is 0 if the channel is not recorded.
        """
        if name not in self.channels:
            return 0.0
        values = self.observed[:, :, self.channels.index(name)]
        # A run without samples of the channel has no range.
        values = values[np.isfinite(values).any(axis=1)]
        ranges = np.nanmax(values, axis=1) - np.nanmin(values, axis=1)
        return float(ranges.max(initial=0.0))

    def _find_delaying_coefficients(self) -> tuple[Indices, Indices]:
        """Return the indices of coefficients that shift sample times or need fine steps.

        A delay shifts sample times. Filters of sensors and effects with a sharp transition
        (`Effect.sharp`) need fine steps. All elements of one engine call have the same time steps,
        so elements with such coefficients are simulated separately.

        Returns:
            The indices in theta of coefficients that shift sample times, and of those that need
            fine steps.
        """
        shifting_indices: list[int] = []
        fine_step_indices: list[int] = []
        for effect in self.simulator.effects:
            indices = self.get_coefficient_indices(effect.name)
            if _shifts_sample_times(effect):
                shifting_indices.extend(indices)
            if effect.sharp or needs_every_step(effect):
                fine_step_indices.extend(indices)
        # The type must be given, because an empty list would become an array of floats.
        return np.array(shifting_indices, dtype=np.intp), np.array(fine_step_indices, dtype=np.intp)

    def _scale_coefficient_ranges(self) -> tuple[Parameter, ...]:
        """Return the parameters with coefficient ranges for the time scale of the runs."""
        first, spacing = self.base_indices.size, self.sample_interval
        coefficients = self.parameters[first:]
        scaled = [adapt_to_time_scale(p, self.longest_duration, spacing) for p in coefficients]
        return (*self.parameters[:first], *scaled)

    @property
    def channels(self) -> list[str]:
        """Names of the recorded channels, in the order of the observations."""
        return [c.name for c in self.simulator.channels]

    @cached_property
    def available_effects(self) -> dict[str, Effect]:
        """Available effects by name."""
        return {effect.name: effect for effect in self.simulator.effects}

    @property
    def has_linearisation(self) -> bool:
        """True if the simulator provides linearised responses to small changes.

        At contacts they would be wrong, and finite differences of simulated runs are used.
        """
        return self.kind.has_model and not self.is_in_contact

    def get_coefficient_indices(self, effect: str) -> range:
        """Return the indices in theta of the coefficients of an effect."""
        coefficient_slice = self.coefficient_slices[effect]
        return range(coefficient_slice.start, coefficient_slice.stop)

    def get_nominal_theta(self) -> Array:
        """Return the parameters (P,) at their nominal values, with all effects off."""
        values = np.array([p.nominal for p in self.parameters])
        # An effect is off if its coefficients are zero, whatever their nominal values.
        values[self.base_indices.size :] = 0.0
        return values

    def get_sample_mask(self, share: float) -> Mask:
        """Return the mask (R, T, C) of available samples within the first share of each run."""
        sample_numbers = np.arange(self.observed.shape[1])
        sample_counts = np.ceil(share * self.lengths)
        is_in_share = sample_numbers < sample_counts[:, None]
        sample_mask: Mask = np.isfinite(self.observed) & is_in_share[:, :, None]
        return sample_mask

    def simulate(
        self,
        theta: Array,
        runs: Indices,
        states: Array,
        share: float = 1.0,
    ) -> Array:
        """Simulate recorded runs with a batch of parameters and initial states, in one call.

        Results of a robot are cached, because the search simulates some points repeatedly. The
        correction of the discretisation error is added, if there is one.

        Shapes: L batch elements, T samples, C channels, P parameters, s states of a run.

        Args:
            theta: (L, P) parameters.
            runs: (L,) index of the run of each batch element.
            states: (L, s) initial states.
            share: fraction of each run, from its beginning, that is simulated.

        Returns:
            Observations (L, T, C); NaN after the simulated share and after the end of a shorter
            run.
        """
        # Only robots without contact have a linearisation. Their batch elements are simulated
        # independently of each other, so that a cached result is exactly that of a repeated call.
        if self.has_linearisation:
            simulated = np.empty((len(theta), *self.observed.shape[1:]))
            elements = zip(theta, runs.tolist(), states, strict=True)
            # A key has all that the result depends on: share, run, parameters and initial states.
            keys = [
                b"".join(
                    (repr((share, run)).encode(), element_theta.tobytes(), initial_state.tobytes())
                )
                for element_theta, run, initial_state in elements
            ]
            missing_indices = self._cache.missing(keys)
            new_results = self._simulate_batch(
                theta[missing_indices], runs[missing_indices], states[missing_indices], share
            )
            self._cache.fill(keys, missing_indices, new_results, simulated)
        else:
            # Results are not cached here: the slowest element of a call sets the steps of all
            # elements, so an element differs in its last digits from call to call.
            simulated = self._simulate_batch(theta, runs, states, share)
        if self.discretisation_correction is not None:
            simulated += self.discretisation_correction[runs]
        return simulated

    def simulate_all_runs(self, theta: Array, states: Array, share: float = 1.0) -> Array:
        """Simulate every run with each of N sets of parameters.

        Shapes: R runs, T samples, C channels, P parameters, s states of a run.

        Args:
            theta: (N, P) sets of parameters.
            states: (N, R, s) initial states, or (R, s) for all sets.
            share: fraction of each run, from its beginning, that is simulated.

        Returns:
            Simulated channels (N, R, T, C); NaN after the simulated share.
        """
        sets, runs = len(theta), len(self.prepared_runs)
        states = np.broadcast_to(states, (sets, *self.initial_state_guesses.shape))
        simulated = self.simulate(
            np.repeat(theta, runs, axis=0),
            np.tile(np.arange(runs), sets),
            states.reshape(sets * runs, states.shape[2]),
            share,
        )
        return simulated.reshape(sets, runs, *simulated.shape[1:])

    def _simulate_batch(self, theta: Array, runs: Indices, states: Array, share: float) -> Array:
        """Simulate B batch elements in several engine calls, without cache and step correction.

        Elements that need the same time steps are simulated together, because the slowest element
        of a call sets its steps. Large groups are split, so that a call fits in memory and workers
        share the work.

        Shapes: T samples, C channels, P parameters, s states of a run.

        Args:
            theta: (B, P) parameters of each element.
            runs: (B,) index of the run that each element simulates.
            states: (B, s) initial states.
            share: fraction of each run, from its beginning, that is simulated.

        Returns:
            Simulated channels (B, T, C); NaN after the simulated share.
        """
        self.simulation_count += len(theta)
        _, length, channels = self.observed.shape
        simulated_runs = np.empty((len(theta), length, channels))
        if not len(theta):
            return simulated_runs

        max_batch_size = max(MIN_BATCH_SIZE, MAX_BATCH_SAMPLES // length)
        if self.is_cheap_to_split:
            max_batch_size = min(
                max_batch_size, max(MIN_CHUNK_SIZE, int(MAX_CHUNK_SAMPLES / (share * length)))
            )
        element_indices, calls = [], []
        for is_fine, elements in self._split_into_calls(theta, max_batch_size):
            element_indices.append(elements)
            calls.append((is_fine, theta[elements], runs[elements], states[elements], share))
        for number, simulated in self.worker_pool.map_unordered(
            self, RunEvaluator._simulate_runs, calls
        ):
            sample_count = simulated.shape[1]
            # The result of a single call over whole runs is complete, and need not be copied.
            if len(calls) == 1 and sample_count == length:
                return simulated
            simulated_runs[element_indices[number], :sample_count] = simulated
            simulated_runs[element_indices[number], sample_count:] = np.nan
        return simulated_runs

    def with_runs(self, runs: Sequence[Run]) -> RunEvaluator:
        """Return a `RunEvaluator` of other runs that were cut or thinned from these runs.

        It shares the parameters, the search control and the worker pool, and the durations and
        ranges from which the tried values of shape parameters, such as frequencies, are chosen.

        Args:
            runs: the other runs, such as segments of these.
        """
        evaluator = self._copy(self.kind, runs)
        # Periodic effects continue from segment to segment, and a value found in one segment holds
        # in all of them.
        evaluator.longest_duration = self.longest_duration
        evaluator.time_span = self.time_span
        # Ranges of the channels are those of these runs, because those of segments would differ.
        # Each call fills the cache, which the new evaluator then shares.
        for name in self.channels:
            self._get_channel_range(name)
        evaluator._channel_ranges = self._channel_ranges
        return evaluator

    def with_kind(self, kind: type[SystemSimulator]) -> RunEvaluator:
        """Return a run evaluator of the same runs with another simulator of the same system.

        Parameters keep their indices, so that fitted models can be compared between the simulators.
        What a filter has estimated, such as initial states, is taken over.

        Args:
            kind: simulator class, for example with another integrator.
        """
        evaluator = self._copy(kind, self.runs)
        evaluator.filtered_runs = self.filtered_runs
        evaluator.initial_state_guesses = self.initial_state_guesses
        evaluator.prepared_runs = self.prepared_runs
        evaluator.state_derivatives = self.state_derivatives
        evaluator.identified = self.identified
        evaluator.state_prior = self.state_prior
        evaluator.is_in_contact = self.is_in_contact
        self.worker_pool.register(evaluator)
        return evaluator

    def _copy(self, kind: type[SystemSimulator], runs: Sequence[Run]) -> RunEvaluator:
        """Return a run evaluator with the same parameters, search control and worker pool.

        Args:
            kind: class of its simulator.
            runs: its runs.
        """
        evaluator = RunEvaluator(
            kind,
            self.recording,
            runs,
            engine=self.engine,
            extra=self.extra_effects,
            free=[p.name for p in self.freed_constants],
            candidates=self.library,
        )
        evaluator.parameters = self.parameters
        evaluator.search_control, evaluator.worker_pool = self.search_control, self.worker_pool
        return evaluator

    def make_simulator(self, kind: type[SystemSimulator]) -> SystemSimulator:
        """Return another simulator of the same system with the same effects and channels."""
        effects: list[str | type[Effect]] = [*self.library, *self.extra_effects]
        return kind(self.recording.constants, self.channels, effects=effects)

    def group_compatible(self, theta: Array) -> Indices:
        """Return group numbers (L,), 0 to 3; batch elements of one group can share an engine call.

        Elements of one call have the same time steps. Groups 1 and 3 have effects that read signals
        at other times, such as delays; groups 2 and 3 have effects that need fine steps; group 0
        has neither.

        Shapes: P parameters.

        Args:
            theta: (L, P) parameters.
        """
        # An effect is active if any of its coefficients is not zero.
        is_active = theta != 0
        is_shifting = is_active[:, self._shifting_coefficients].any(axis=1)
        needs_fine_steps = is_active[:, self._fine_step_coefficients].any(axis=1)
        groups: Indices = is_shifting + 2 * needs_fine_steps
        return groups

    @property
    def is_cheap_to_split(self) -> bool:
        """True if splitting a batch into several calls costs no time, as with compiled steps."""
        return self.kind.has_model or self.engine == "batch"

    def _simulate_runs(
        self, is_fine: bool, theta: Array, runs: Indices, states: Array, share: float
    ) -> Array:
        """Simulate L batch elements of recorded runs in one engine call; runs in a worker.

        Shapes: T' samples of the simulated share, C channels, P parameters, s states of a run.

        Args:
            is_fine: whether to use the fine time step that filters need.
            theta: (L, P) parameters: those of the system, constants of the recording that are
                fitted, and coefficients of effects.
            runs: (L,) index of the run of each batch element.
            states: (L, s) initial states.
            share: each run is simulated from its start to this share of its duration, 0 to 1.

        Returns:
            Observations (L, T', C).
        """
        if share not in self._shortened_scenarios:
            self._shortened_scenarios[share] = [
                take_first_samples(run_data.scenario, int(np.ceil(share * len(run_data.observed))))
                for run_data in self.prepared_runs
            ]
        # Elements of one run share its scenario object, so the simulator prepares it only once.
        scenarios = [self._shortened_scenarios[share][run] for run in runs]
        return self._call_engine(is_fine, theta, scenarios, states)

    def _call_engine(
        self, is_fine: bool, theta: Array, scenarios: Sequence[Scenario], states: Array
    ) -> Array:
        """Simulate L batch elements in one engine call.

        Shapes: T samples of the longest scenario, C channels, P parameters, s states of a run.

        Args:
            is_fine: whether to use the fine time step that filters need.
            theta: (L, P) parameters of the system, freed constants (those that the fit estimates),
                and coefficients of effects, in this order.
            scenarios: (L,) input of each element.
            states: (L, s) initial states.

        Returns:
            Observations (L, T, C), NaN after the end of a shorter scenario.
        """
        simulator = self._fine_step_simulator if is_fine else self.simulator
        # A freed constant is fitted like a parameter, but passed to the simulator as a constant.
        freed_indices = np.arange(self.system_parameter_count, self.base_indices.size)
        return simulator.simulate_batch(
            np.delete(theta, freed_indices, axis=1),
            [self._set_freed_constants(*pair) for pair in zip(scenarios, theta, strict=True)],
            dict(zip(self.state_names, states.T, strict=True)),
        )

    def _split_into_calls(
        self, theta: Array, max_batch_size: int
    ) -> Iterator[tuple[bool, Indices]]:
        """Yield for each engine call whether it needs fine steps, and its batch elements.

        Elements are in one call only if they need the same time steps (`group_compatible`).

        Args:
            theta: (L, P) parameters of L batch elements.
            max_batch_size: maximum number of elements of a call.

        Yields:
            Whether the call needs fine steps, and the indices of its elements.
        """
        groups = self.group_compatible(theta)
        for group in np.unique(groups):
            elements = np.flatnonzero(groups == group)
            # The quotient is rounded up.
            call_count = -(-elements.size // max_batch_size)
            # Groups 2 and 3 need fine steps.
            for call_elements in np.array_split(elements, call_count):
                yield bool(group >= 2), call_elements

    def simulate_scenarios(
        self, theta: Array, scenarios: Sequence[Scenario], states: Array
    ) -> Array:
        """Simulate batch elements in scenarios that are not recorded, such as proposed experiments.

        As for recorded runs, elements that need the same time steps are simulated together, in
        calls that fit in memory.

        Shapes: T samples, C channels, P parameters, s states of a run.

        Args:
            theta: (L, P) parameters.
            scenarios: (L,) scenario of each element.
            states: (L, s) initial states.

        Returns:
            Observations (L, T, C), NaN after the end of a shorter scenario.
        """
        self.simulation_count += len(theta)
        length = max(scenario.times.size for scenario in scenarios)
        simulated = np.full((len(theta), length, len(self.channels)), np.nan)
        max_batch_size = max(MIN_CHUNK_SIZE, MAX_BATCH_SAMPLES // length)
        for is_fine, elements in self._split_into_calls(theta, max_batch_size):
            observations = self._call_engine(
                is_fine, theta[elements], [scenarios[i] for i in elements], states[elements]
            )
            simulated[elements, : observations.shape[1]] = observations
        return simulated

    def _set_freed_constants(self, scenario: Scenario, theta: Array) -> Scenario:
        """Return a scenario whose freed constants, those that a fit estimates, have fitted values.

        Shapes: P parameters.

        Args:
            scenario: input of the simulator.
            theta: (P,) parameters; the freed constants follow the parameters of the system.
        """
        if not self.freed_constants:
            return scenario
        values = theta[self.system_parameter_count : self.base_indices.size].tolist()
        freed_constants = {
            p.name: value for p, value in zip(self.freed_constants, values, strict=True)
        }
        return replace(scenario, constants={**scenario.constants, **freed_constants})

    def make_observing_simulator(
        self, observe: Sequence[str], effects: Sequence[str]
    ) -> SystemSimulator:
        """Return a simulator with other channels than the recorded ones, and given effects.

        It shows quantities that were not recorded, such as forces. The caller must close it.

        Args:
            observe: names of the channels.
            effects: names of the effects.
        """
        # Effects of the library are given by name, extra ones by class.
        effect_types: list[str | type[Effect]] = [
            next((e for e in self.extra_effects if e.name == name), name) for name in effects
        ]
        constants = self.recording.constants
        return self.kind(
            constants,
            list(observe),
            engine=self.engine,
            effects=effect_types,
            **self._engine_settings,
        )

    def follow(self, filtered_runs: Any) -> None:
        """Use the results of a state filter for the runs of a robot.

        The filter provides guesses, derivatives and prior standard deviations of the initial
        states. Known initial states keep their values, and all do if the filter diverged.

        Args:
            filtered_runs: filtered runs, a
                `bench.diagnosis.kalman.linearised_filter.FollowedRuns`.
        """
        self.filtered_runs = filtered_runs
        initial_states = filtered_runs.get_first_states()
        # A filter that diverged has NaN, and then none of its states is used.
        is_finite = np.isfinite(initial_states).all()
        self.initial_state_guesses = np.where(
            self.known_state_mask | ~is_finite, self.initial_state_guesses, initial_states
        )
        self._close_loops()
        self.state_derivatives = filtered_runs.compute_state_sensitivities()
        self.state_prior = filtered_runs.get_state_prior()

    def _close_loops(self) -> None:
        """Place unmeasured joints of loops with floating joints where the constraints put them.

        A loop is a closed chain of bodies, such as a four-bar linkage. The initial states of
        floating joints are not fitted, so they have to be consistent with the estimated velocities
        of the other joints.
        """
        system = self.simulator.system
        # Required floating states are those that no loop determines, so that a recording states
        # them. If all are required, there is nothing to place.
        if system.floating_state_units.keys() == system.required_state_units.keys():
            return
        prepared_runs = []
        guesses = self.initial_state_guesses.copy()
        for guess, run, prepared in zip(guesses, self.runs, self.prepared_runs, strict=True):
            scenario = prepared.scenario
            states = dict(scenario.initial)
            states.update(zip(self.state_names, guess.tolist(), strict=True))
            closed = system.close_loops(states, {*run.channels, *run.initial})
            # States that a fit estimates are in the guesses; the others are in the scenario.
            guess[:] = [closed[name] for name in self.state_names]
            initial = {name: closed[name] for name in scenario.initial}
            scenario = replace(scenario, initial=initial)
            prepared_runs.append(replace(prepared, scenario=scenario))
        self.initial_state_guesses, self.prepared_runs = guesses, tuple(prepared_runs)
        # Cached scenarios and the copies of this evaluator in workers have the old initial states.
        self._shortened_scenarios.clear()
        self.worker_pool.forget(self)

    def begin_at(self, states: Array, deviations: Array) -> None:
        """Use estimated initial states of a robot in contact, from a nonlinear filter.

        Known initial states keep their values. From now on, simulated runs are not linearised.

        Shapes: R runs, s states of a run.

        Args:
            states: (R, s) initial states.
            deviations: (s,) standard deviations of their errors.
        """
        self.initial_state_guesses = np.where(
            self.known_state_mask, self.initial_state_guesses, states
        )
        self.state_prior = deviations
        self.is_in_contact = True

    def close(self) -> None:
        """Release the resources of the engine."""
        self.simulator.close()
        self._fine_step_simulator.close()


def _is_effect_observable(effect: type[Effect], recorded_signals: set[str]) -> bool:
    """Return whether all signals that an effect (or effect family) acts on are recorded."""
    members = members_of(effect)
    return all(not member.signal or member.signal in recorded_signals for member in members)


def _make_freed_parameter(name: str, simulator: SystemSimulator, recording: Recording) -> Parameter:
    """Return a constant of the simulator as a parameter, so that it can be fitted.

    Args:
        name: name of the constant.
        simulator: simulator that has the constant.
        recording: recording, whose runs must not set the constant individually.

    Raises:
        InputError: the constant does not exist, is zero, or differs between runs.
    """
    constants = {c.name: c for c in simulator.constants}
    if name not in constants:
        raise make_unknown_name_error(
            f"constant of system {simulator.name}", name, list(constants) or ["none"]
        )
    value = simulator.constant_values[name]
    # The range is a multiple of the value, and a value set by a run would override the fitted
    # value.
    if value == 0 or any(name in run.constants for run in recording.runs):
        raise InputError(
            f"free constant {name}: expected a value that is not zero and equal in all runs"
        )
    # Sorted, because a constant may be negative.
    low, high = sorted((value / FREED_CONSTANT_RANGE_FACTOR, value * FREED_CONSTANT_RANGE_FACTOR))
    constant = constants[name]
    return Parameter(name, constant.unit, value, (low, high), says=constant.says)


def _allocate_coefficients(simulator: SystemSimulator, first: int) -> dict[str, slice]:
    """Return the slice of theta of each effect, starting at index `first`.

    Theta is the vector of all parameters: base parameters, then the coefficients of each effect.

    Args:
        simulator: simulator with all available effects.
        first: number of base parameters, which precede the coefficients.
    """
    slices = {}
    # Use the order of the simulator, which is the order of its parameters.
    for effect in simulator.effects:
        # `Effect.on` returns the coefficients that the effect has on this system.
        end = first + len(effect.on(simulator.system))
        slices[effect.name] = slice(first, end)
        first = end
    return slices


def _shifts_sample_times(effect: Effect) -> bool:
    """Return whether an effect reads signals at other times than those of the scenario.

    Such an effect, for example a delay, overrides the method `times` of its base class.
    """
    for base_class in (Input, Sensor):
        if isinstance(effect, base_class) and type(effect).times is not base_class.times:
            return True
    return False
