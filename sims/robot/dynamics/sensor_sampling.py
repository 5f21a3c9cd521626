"""Recorded samples of a channel, interpolated between steps, with sensor effects, and their times.

Between two steps of length h, with values a, b and slopes a', b' at their ends, a position at the
fraction s of the step is

    y = (1 + 2s)(1 - s)^2 a + s(1 - s)^2 h a' + s^2 (3 - 2s) b - s^2 (1 - s) h b'               (1)

the cubic Hermite interpolant (C. de Boor, A Practical Guide to Splines, 1978, chapter 4). A reading
with unknown slope is interpolated linearly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Sensor, Signal
from sims.core.simulator import Array
from sims.effects.sensor_effects import apply_sensor_effects, needs_every_step
from sims.engines.time_grid import is_active
from sims.robot.dynamics.run_batches import RobotRunBatch

TIME_TOLERANCE_SHARE = 1e-6
"""Tolerance, as a share of a step, within which a time counts as the end of a step."""
MAX_DURATION_FACTOR, MAX_EXTRA_SECONDS = 1.1, 0.2
"""Maximum simulated time after the last time stamp if sensors sample early.

A run is simulated for at most `MAX_DURATION_FACTOR` times its duration plus `MAX_EXTRA_SECONDS`
seconds.
"""


def sample_readings(
    values: Array,
    slopes: Array | None,
    step: float,
    times: Array,
    sensors: ActiveEffects,
    clock: float = 0.0,
) -> Array:
    """Compute the recorded readings (L, T) of a channel, including sensor effects.

    1. Shift the times at which samples are taken (effects such as a delay or a drifting clock), and
       interpolate the values there.
    2. Where a filter acts, replace them by samples of the filtered signal.
    3. Change each reading (effects such as a bias or a gain).

    Shapes: L batch elements, S steps, T samples. Effects have K coefficients each, (K, L, 1), and
    are inactive in batch elements where all of them are zero.

    Args:
        values: (L, S + 1) values at the start and at the end of each step.
        slopes: (L, S + 1) time derivatives of the values; None if unknown.
        step: step length in seconds.
        times: (T,) recorded time stamps in seconds since the start.
        sensors: effects on this channel in the order in which a signal passes them.
        clock: first recorded time stamp in seconds, on which effects such as a drift depend.
    """
    # 1. Sample times.
    batch_size, count = values.shape
    step_ends = step * np.arange(count)
    instants = np.broadcast_to(times, (batch_size, times.size))
    for effect, c in sensors:
        assert isinstance(effect, Sensor)
        if type(effect).times is not Sensor.times:  # The effect shifts times.
            instants = np.where(is_active(c), effect.times(c, instants), instants)
    # Before the start and after the end of the simulation, the values there are read.
    instants = np.clip(instants, 0.0, step_ends[-1])
    result = _interpolate(values, slopes, step, instants)
    # 2. Filters. They need the signal at all steps, not only at the samples.
    filtered_elements, filters = _select_active_filters(sensors)
    if filtered_elements.size:
        grid = np.broadcast_to(step_ends, (filtered_elements.size, count))
        step_lengths = np.diff(grid, axis=1, prepend=0.0)
        filtered = apply_sensor_effects(
            filters, values[filtered_elements], step_lengths, grid, clock
        )
        # The slope of a filtered signal is unknown.
        result[filtered_elements] = _interpolate(filtered, None, step, instants[filtered_elements])
    # 3. Changes of readings.
    return apply_effects_to_readings(result, times, sensors, clock)


def apply_effects_to_readings(
    readings: Array, times: Array, sensors: ActiveEffects, clock: float = 0.0
) -> Array:
    """Apply sensor effects that act on each sample alone, without filters and time shifts.

    An effect is evaluated only for the batch elements in which it is active.

    Shapes: L batch elements, T samples.

    Args:
        readings: (L, T) readings; changed in place.
        times: (T,) recorded time stamps in seconds since the start.
        sensors: effects on this channel in the order in which a signal passes them.
        clock: first recorded time stamp in seconds.

    Returns:
        The changed readings (L, T).
    """
    stamps = np.broadcast_to(times, readings.shape)
    for effect, c in sensors:
        assert isinstance(effect, Sensor)
        # Filters are not applied here. Effects that do not override `read` only shift times.
        if effect.filters or type(effect).read is Sensor.read:
            continue
        active_elements = np.flatnonzero(is_active(c))
        # The step lengths of the signal are zero: only filters need them.
        signal = Signal(
            values=readings[active_elements],
            steps=np.zeros_like(readings[active_elements]),
            start=readings[active_elements, :1],
            times=stamps[active_elements],
            clock=clock,
        )
        readings[active_elements] = effect.read(c[:, active_elements], signal)
    return readings


def find_sample_steps(step: float, times: Array, count: int) -> NDArray[np.intp] | None:
    """Find the steps at whose ends the samples are taken.

    If all samples are at ends of steps, values can be read without interpolation.

    Args:
        step: step length in seconds.
        times: (T,) times of T samples in seconds since the start.
        count: number of step ends, including the start.

    Returns:
        (T,) indices of the step ends; None if any sample is between two of them.
    """
    position_in_steps = np.clip(times / step, 0.0, count - 1.0)
    nearest = np.rint(position_in_steps)
    is_at_step_end = bool((np.abs(position_in_steps - nearest) < TIME_TOLERANCE_SHARE).all())
    return nearest.astype(np.intp) if is_at_step_end else None


def list_last_read_times(work: RobotRunBatch) -> Array:
    """Return the last time at which a sensor is read in a run, in seconds since its start.

    The simulation must last until then. Without effects on sensors it is the last time stamp. If
    an effect makes the clock of the recording slow, the true time is later.

    Args:
        work: batch elements of the run, with their active effects.

    Returns:
        An array (1,) with the time, which is at most `MAX_DURATION_FACTOR` times the last time
        stamp plus `MAX_EXTRA_SECONDS`.
    """
    last_stamp = float(work.times[-1])
    latest = last_stamp
    for effect, c in work.acting:
        if isinstance(effect, Sensor):
            # True times of the last stamp in all n batch elements, (n, 1).
            true_times = effect.times(c, np.full(c[0].shape, last_stamp))
            latest = max(latest, float(np.max(true_times)))
    # Implausible values that a fit tries must not cost thousands of steps.
    return np.array([min(latest, MAX_DURATION_FACTOR * last_stamp + MAX_EXTRA_SECONDS)])


def preserves_time(sensors: ActiveEffects) -> bool:
    """Return whether the readings depend on the value at the sample time alone."""
    sensor_effects = [e for e, _ in sensors if isinstance(e, Sensor)]
    return all(type(e).times is Sensor.times and not e.filters for e in sensor_effects)


def _select_active_filters(sensors: ActiveEffects) -> tuple[NDArray[np.intp], ActiveEffects]:
    """Return the batch elements with an active filter, and the filters restricted to them.

    Args:
        sensors: sensor effects with K coefficients for L batch elements, (K, L, 1); those that
            filter nothing are ignored.

    Returns:
        Indices (n,) of the n batch elements, and the filters with coefficients (K, n, 1).
    """
    filters = tuple((e, c) for e, c in sensors if needs_every_step(e))
    if not filters:
        return np.zeros(0, np.intp), ()
    is_filtered = [is_active(c)[:, 0] for _, c in filters]
    batch_indices = np.flatnonzero(np.any(is_filtered, axis=0))
    return batch_indices, tuple((e, c[:, batch_indices]) for e, c in filters)


def _interpolate(values: Array, slopes: Array | None, step: float, instants: Array) -> Array:
    """Interpolate a channel between the ends of S steps, at T times of each of L batch elements.

    Without slopes, the values are interpolated linearly. Otherwise, with values a, b and slopes
    a', b' at the ends of a step of length h, the value at the fraction s of the step is the cubic
    Hermite polynomial (1)

        (1 + 2s)(1 - s)^2 a + s(1 - s)^2 h a' + s^2 (3 - 2s) b - s^2 (1 - s) h b'

    Args:
        values: (L, S + 1) values at the start and at the ends of the steps.
        slopes: (L, S + 1) derivatives per second; None if they are unknown.
        step: step length in seconds.
        instants: (L, T) times in seconds since the first value.

    Returns:
        Values (L, T).
    """
    position_in_steps = instants / step
    nearest = np.rint(position_in_steps)
    is_at_step_end = np.abs(position_in_steps - nearest) < TIME_TOLERANCE_SHARE
    if is_at_step_end.all():
        stored: Array = np.take_along_axis(values, nearest.astype(np.intp), axis=1)
        return stored
    # A sample at the end of a step returns the stored value bit for bit, whatever times other batch
    # elements use.
    position_in_steps = np.where(is_at_step_end, nearest, position_in_steps)
    last_step = values.shape[1] - 2  # S + 1 values belong to the steps 0 to S - 1
    below = np.clip(np.floor(position_in_steps), 0, max(last_step, 0)).astype(np.intp)
    s = position_in_steps - below
    a = np.take_along_axis(values, below, axis=1)
    b = np.take_along_axis(values, below + 1, axis=1)
    if slopes is None:
        linear: Array = a + s * (b - a)
        return linear
    start_change = step * np.take_along_axis(slopes, below, axis=1)  # h a'
    end_change = step * np.take_along_axis(slopes, below + 1, axis=1)  # h b'
    rest = 1.0 - s
    # (1)
    cubic: Array = (
        (1.0 + 2.0 * s) * rest * rest * a
        + s * rest * rest * start_change
        + s * s * (3.0 - 2.0 * s) * b
        - s * s * rest * end_change
    )
    return cubic
