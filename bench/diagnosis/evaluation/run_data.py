"""Recorded runs prepared for fitting, their time scale, and a cache of their simulations.

With T the duration of the longest run and h the shortest sample interval:

* a delay or a lag is plausible up to T / 20, and a fit may move it up to T: longer ones look
  constant within a run;
* a decay time constant is at most `MAX_DECAY_FACTOR` T;
* a frequency is at most 1 / (2 h), the Nyquist frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from sims.core.simulator import Array, Parameter, Scenario
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

INITIAL_GUESS_SAMPLES = 8
"""Number of samples at the start of a run from which its initial state is guessed."""
MIN_SAMPLES_FOR_PARABOLA = 5
"""Minimum number of samples to fit a parabola; with fewer samples a line is fitted."""
MIN_SAMPLES_FOR_SLOPE = 3
"""Minimum number of samples to estimate a slope; with fewer samples it would be mostly noise."""
DEFAULT_START_HEIGHT = 10.0
"""Start height in metres of a ball without a recorded height.

It is added to the height that the ball needs so that it does not land during its run.
"""
MAX_UNKNOWN_FALL_SPEED = 100.0
"""Maximum assumed fall speed in m/s of a ball whose height and speed are not recorded."""
DEFAULT_GRAVITY = 9.81
"""Gravity of a system that does not declare it, m/s²."""


@dataclass(frozen=True)
class RunData:
    """One recorded run.

    Attributes:
        name: name of the run.
        scenario: input of the simulator.
        observed: (T, C) observations in SI units, NaN where missing.
        initial_state_guess: (s,) initial states, specified or guessed from the first samples.
        known_state_mask: (s,) whether a state is not estimated, because it is specified or because
            no recorded channel depends on its coordinate.
    """

    name: str
    scenario: Scenario
    observed: Array
    initial_state_guess: Array
    known_state_mask: Mask

    @property
    def duration(self) -> float:
        """Duration of the run in seconds."""
        times = self.scenario.times
        return float(times[-1] - times[0])


def prepare_run(
    run: Run,
    recording: Recording,
    simulator: SystemSimulator,
    states: Sequence[str],
) -> RunData:
    """Prepare a run of a recording for a simulator: inputs, observations and initial states.

    Args:
        run: recorded run: times, channels and inputs.
        recording: recording that contains the run, with its constants.
        simulator: simulator that observes the recorded channels.
        states: names of the initial states.
    """
    columns = [run.channels[c.name] for c in simulator.channels]
    # Constants of a run are valid only in this run.
    constants = {**recording.constants, **run.constants}
    guesses = _guess_initial_states(run, simulator)
    fixed = {*run.initial, *_find_unobserved_states(simulator)}
    # Initial values that are not states of the system, such as the pose of a floating base, are not
    # part of a batch element.
    other_initial_values = {
        name: value for name, value in run.initial.items() if name not in states
    }
    return RunData(
        name=run.name,
        scenario=Scenario(
            times=run.times,
            initial=other_initial_values,
            inputs=run.inputs,
            constants=constants,
            linear=run.linear,
            offset=run.offset,
            before=run.before,
            off=run.off,
        ),
        observed=np.stack(columns, axis=1),
        initial_state_guess=np.array([guesses[name] for name in states]),
        known_state_mask=np.array([name in fixed for name in states]),
    )


def _guess_initial_states(run: Run, simulator: SystemSimulator) -> dict[str, float]:
    """Return a guess of each initial state by name, from which fits start.

    In order of preference it is the stated value, the value of a recorded rate, an estimate from
    the first samples of a coordinate, or the default of the simulator.

    Args:
        run: recorded run: times, channels and inputs.
        simulator: simulator with the default initial states.
    """
    system = simulator.system
    values = dict(simulator.states)
    # Not strict, because a user-defined system may have states in addition to coordinates and
    # rates.
    for coordinate, rate in zip(system.coordinates, system.rates, strict=False):
        if coordinate in run.channels:
            values[coordinate], values[rate] = estimate_initial_value_and_slope(
                run.times, run.channels[coordinate]
            )
    # A recorded rate is more accurate than a slope.
    for rate in system.rates:
        if rate in run.channels:
            values[rate] = estimate_initial_value_and_slope(run.times, run.channels[rate])[0]
    if system.bounces and system.coordinates[-1] not in run.channels:
        values[system.coordinates[-1]] = _estimate_start_height(run, simulator)
    # Specified values override every guess.
    values.update(run.initial)
    return system.close_loops(values, {*run.channels, *run.initial})


def _estimate_start_height(run: Run, simulator: SystemSimulator) -> float:
    """Return a start height in metres from which the ball does not land during the run.

    If the height is not recorded, impacts cannot be identified.

    Args:
        run: the run; its constant ``gravity`` (m/s²) replaces that of the simulator.
        simulator: simulator of the ball.
    """
    constant = simulator.constant_values.get("gravity", DEFAULT_GRAVITY)
    gravity = float(run.constants.get("gravity", constant))
    seconds = float(run.times[-1] - run.times[0])
    # Allow for twice the fall due to gravity and for a fast downward throw.
    return DEFAULT_START_HEIGHT + MAX_UNKNOWN_FALL_SPEED * seconds + gravity * seconds**2


def _find_unobserved_states(simulator: SystemSimulator) -> set[str]:
    """Return the states of coordinates that no recorded channel shows.

    They keep their defaults, because the data cannot determine them.

    Args:
        simulator: Simulator with the recorded channels.
    """
    system, recorded_channels = simulator.system, {c.name for c in simulator.channels}
    unobserved_states = set()
    pairs = zip(system.coordinates, system.rates, strict=False)
    for axis, (coordinate, rate) in enumerate(pairs):
        related_channels = {coordinate, rate, f"accel_{coordinate}"}
        # Biases and springs act on the primary coordinate, so its states are always estimated.
        if axis != system.primary and not related_channels & recorded_channels:
            unobserved_states |= {coordinate, rate}
    return unobserved_states


def take_first_samples(scenario: Scenario, samples: int) -> Scenario:
    """Return a scenario cut to its first samples.

    Args:
        scenario: the scenario.
        samples: number of samples to keep.
    """
    if samples >= scenario.times.size:
        return scenario
    inputs = {name: signal[:samples] for name, signal in scenario.inputs.items()}
    off_masks = {name: mask[:samples] for name, mask in scenario.off.items()}
    return replace(scenario, times=scenario.times[:samples], inputs=inputs, off=off_masks)


def estimate_initial_value_and_slope(times: Array, values: Array) -> tuple[float, float]:
    """Estimate value and slope at the first time from a parabola through the first samples.

    They are guesses of the initial position and velocity, from which fits start. With few samples a
    line is used, and with fewer the first value and slope zero.

    Args:
        times: (T,) times, s.
        values: (T,) samples, NaN where missing.

    Returns:
        The value and the slope; 0 where there are too few samples.
    """
    is_available = np.isfinite(values)
    t = times[is_available][:INITIAL_GUESS_SAMPLES] - times[0]
    y = values[is_available][:INITIAL_GUESS_SAMPLES]
    if t.size == 0:
        return 0.0, 0.0
    if t.size < MIN_SAMPLES_FOR_SLOPE:
        return float(y[0]), 0.0
    # Scaling time to [0, 1] keeps its powers well conditioned at any sample rate.
    scale = float(t[-1]) or 1.0
    degree = 1 if t.size < MIN_SAMPLES_FOR_PARABOLA else 2
    coefficients = np.polynomial.polynomial.polyfit(t / scale, y, degree)
    value, slope = coefficients[:2]
    return float(value), float(slope / scale)


MAX_DELAY_SHARE = 0.05
"""Maximum plausible delay or lag, as a share of the duration of the longest run."""
MAX_DECAY_FACTOR = 3.0
"""Maximum decay time constant, as a multiple of the duration of the longest run."""
FREQUENCY_RANGE_RATIO = 100.0
"""Ratio of the highest to the lowest plausible frequency if the sampling limits the highest one."""


def adapt_to_time_scale(parameter: Parameter, longest: float, spacing: float) -> Parameter:
    """Return a coefficient with a plausible range that fits the time scale of a recording.

    The range of an effect is for typical recordings of seconds. A slow recording can show longer
    delays and decays, and one with few samples shows only low frequencies. Coefficients without a
    time in their unit are returned as they are.

    Args:
        parameter: coefficient, with the range that its effect states.
        longest: duration of the longest run, s.
        spacing: shortest sample interval, s; 0 if unknown.
    """
    low, high = parameter.bounds
    if is_instant(parameter):
        return parameter
    if parameter.unit == "s":
        if low > 0:
            high = max(high, MAX_DECAY_FACTOR * longest)
        else:
            # A delay may have either sign, so both ends are scaled by the same factor.
            factor = max(1.0, MAX_DELAY_SHARE * longest / high)
            low, high = factor * low, factor * high
    elif parameter.unit == "Hz" and spacing > 0 and 0.5 / spacing < high:
        high = 0.5 / spacing
        low = min(low, high / FREQUENCY_RANGE_RATIO)
    if (low, high) == parameter.bounds:
        return parameter
    nominal = min(max(parameter.nominal, low), high)
    return replace(parameter, nominal=nominal, bounds=(low, high), training=None)


def is_instant(coefficient: Parameter) -> bool:
    """Return whether a coefficient is a time on the clock of the recording."""
    return coefficient.name.endswith(".instant")


CACHE_BYTES = 64 << 20
"""Maximum memory for the cached results of one `World`, in bytes; the oldest are dropped first."""


class SimulationCache:
    """Observations (T, C) of batch elements, cached by their inputs, with a memory limit.

    A fit simulates a trial, accepts it, and then needs it again as the centre of finite
    differences; starts are compared before they are fitted. A third of the simulations of a robot
    are such repetitions.
    """

    def __init__(self) -> None:
        self._held: dict[bytes, Array] = {}
        self._bytes = 0

    def missing(self, keys: Sequence[bytes]) -> list[int]:
        """Return the indices of elements that are not cached; of equal ones only the first."""
        first = {key: place for place, key in reversed(list(enumerate(keys)))}
        return sorted(place for key, place in first.items() if key not in self._held)

    def fill(
        self, keys: Sequence[bytes], places: Sequence[int], results: Array, out: Array
    ) -> None:
        """Store new results, and write those of all elements, new and cached, to an output array.

        The oldest results are removed if the memory limit is exceeded.

        Shapes: T samples, C channels.

        Args:
            keys: keys of all elements, as passed to `missing`.
            places: indices of the elements that `missing` returned.
            results: (N, T, C) results of these elements.
            out: (L, T, C) output array for the results of all elements.
        """
        new_results = {keys[place]: row for place, row in zip(places, results, strict=True)}
        for place, key in enumerate(keys):
            out[place] = new_results[key] if key in new_results else self._held[key]
        for key, row in new_results.items():
            # Store a copy: a view would keep the results of a whole call in memory.
            self._held[key] = row.copy()
            self._bytes += row.nbytes
        while self._bytes > CACHE_BYTES:
            self._bytes -= self._held.pop(next(iter(self._held))).nbytes
