"""Guesses of the initial states of recorded runs, and the runs prepared with them for fitting.

A guess is the value and slope of the first samples, the mean of the readings of a joint at rest, or
a start height from which a ball does not land.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from sims.core.simulator import Array, Scenario
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

INITIAL_GUESS_SAMPLES = 8
"""Number of samples at the start of a run from which its initial state is guessed."""
MIN_SAMPLES_FOR_PARABOLA = 5
"""Minimum number of samples to fit a parabola; with fewer samples a line is fitted."""
MIN_SAMPLES_FOR_SLOPE = 3
"""Minimum number of samples to estimate a slope; with fewer samples it would be mostly noise."""
MIN_RESTING_READINGS = 10
"""Minimum number of readings whose mean is the position of a joint that rests."""
MAX_RESTING_DEVIATION = 3.0
"""Maximum excess of the scatter of readings at rest, in its standard deviations."""
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
        run: recorded run: times, channels, inputs, and specified initial values (`run.initial`).
        recording: recording that contains the run, with its constants.
        simulator: simulator that observes the recorded channels.
        states: names of the initial states that a fit may estimate, in the order of the result.
    """
    columns = [run.channels[c.name] for c in simulator.channels]
    # Constants of a run are valid only in this run.
    constants = {**recording.constants, **run.constants}
    guesses = _guess_initial_states(run, simulator)
    # Names of states that a fit does not estimate: they are specified, or no channel shows them.
    fixed = {*run.initial, *_find_unobserved_states(simulator)}
    # Initial values that are not states of the system, such as the pose of a floating base, are the
    # same in all simulations of the run. They are stated, or follow from closed loops.
    other_names = {*run.initial, *simulator.system.floating_state_units}.difference(states)
    other_initial_values = {name: guesses[name] for name in sorted(other_names)}
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


def take_first_samples(scenario: Scenario, samples: int) -> Scenario:
    """Return a scenario with all its signals cut to the first samples.

    Args:
        scenario: the scenario.
        samples: number of samples to keep.
    """
    if samples >= scenario.times.size:
        return scenario
    inputs = {name: signal[:samples] for name, signal in scenario.inputs.items()}
    off_masks = {name: mask[:samples] for name, mask in scenario.off.items()}
    return replace(scenario, times=scenario.times[:samples], inputs=inputs, off=off_masks)


def _find_unobserved_states(simulator: SystemSimulator) -> set[str]:
    """Return the states (coordinate and rate) of coordinates that no recorded channel shows.

    They keep their defaults, because the data cannot determine them.

    Args:
        simulator: simulator with the recorded channels.
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


def _guess_initial_states(run: Run, simulator: SystemSimulator) -> dict[str, float]:
    """Return a guess of each initial state by name, from which fits start.

    In order of preference it is the stated value, an estimate from the first samples of the
    recorded coordinate or rate, or the default of the simulator. A ball whose height is not
    recorded starts so high that it does not land. The states of a robot's kinematic loops are made
    consistent.

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
    # The height is the last coordinate of a system that bounces.
    if system.bounces and system.coordinates[-1] not in run.channels:
        values[system.coordinates[-1]] = _estimate_start_height(run, simulator)
    # Specified values override every guess.
    values.update(run.initial)
    # Measured and specified joints stay, and the others of a loop are moved.
    return system.close_loops(values, {*run.channels, *run.initial})


def estimate_initial_value_and_slope(times: Array, values: Array) -> tuple[float, float]:
    """Estimate value and slope at the first time from a parabola through the first samples.

    They are guesses of the initial position and velocity, from which fits start. With 3 or 4
    samples a line is used; with 1 or 2, the first value and slope zero; with none, zero.

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
    # Coefficients of ascending powers.
    value, slope, *_ = np.polynomial.polynomial.polyfit(t / scale, y, degree)
    return float(value), float(slope / scale)


def _estimate_start_height(run: Run, simulator: SystemSimulator) -> float:
    """Return a start height in metres from which the ball does not land during the run.

    It is used if the height is not recorded, because impacts can then not be identified.

    Args:
        run: the run; its constant ``gravity`` (m/s²) replaces that of the simulator.
        simulator: simulator of the ball.
    """
    constant = simulator.constant_values.get("gravity", DEFAULT_GRAVITY)
    gravity = float(run.constants.get("gravity", constant))
    seconds = float(run.times[-1] - run.times[0])
    # Height lost by a fast downward throw, and by twice the fall gravity * seconds² / 2.
    return DEFAULT_START_HEIGHT + MAX_UNKNOWN_FALL_SPEED * seconds + gravity * seconds**2


def estimate_resting_position(readings: Array, sigma: float) -> float | None:
    """Estimate the position of a joint that rests at the beginning of a run.

    It rests as long as the readings scatter about their mean no more than the noise does. The mean
    is that of the first half of these readings, since a slow beginning of motion shows late.

    Args:
        readings: (T,) recorded positions; NaN where there are none.
        sigma: standard deviation of their noise.

    Returns:
        The mean of the readings at rest; None if the joint does not rest for more than `2 *
        MIN_RESTING_READINGS` readings.
    """
    recorded = readings[np.isfinite(readings)]
    counts = np.arange(1, recorded.size + 1)
    # Relative to the first reading, in units of the noise. `[:1]` instead of `[0]`, because there
    # may be no readings.
    scaled = (recorded - recorded[:1]) / sigma
    # Sums of squares about the mean of the first n = 1, 2, ... readings. At rest they are
    # chi-squared, with mean n - 1 and standard deviation of about sqrt(2 n).
    squares = np.cumsum(scaled**2) - np.cumsum(scaled) ** 2 / counts
    moves = squares > counts - 1 + MAX_RESTING_DEVIATION * np.sqrt(2.0 * counts)
    # A single wrong reading among the first few is no motion.
    moves[: 2 * MIN_RESTING_READINGS] = False
    # Number of readings before the first one that shows motion.
    resting_count = int(np.argmax(moves)) if moves.any() else recorded.size
    if resting_count <= 2 * MIN_RESTING_READINGS:
        return None
    return float(recorded[: resting_count // 2].mean())
