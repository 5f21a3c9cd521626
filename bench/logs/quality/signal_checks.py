"""Check signals: quantisation, saturation, standstill, and samples that repeat the previous one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.logs.quality.clock_checks import LOST_SAMPLE_SHARE_THRESHOLD
from bench.logs.quality.quality_finding import SIGNIFICANCE_SIGMAS, QualityFinding
from sims.core.noise_estimation import estimate_noise
from sims.core.simulator import Array, Channel, Simulator
from sims.core.user_messages import append_unit, join_first_names
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

QUANTISATION_SHARE_THRESHOLD = 0.02
"""Smallest reported quantisation step, as a fraction of the signal's range."""
MIN_SATURATED_SAMPLES = 5
"""Minimum number of consecutive samples at the end of a range that counts as saturation."""
CLIPPING_STEP_THRESHOLD = 2.5
"""Minimum jump of a signal into or out of saturation, in quantisation steps."""
MIN_SATURATED_SHARE = 0.005
"""Smallest reported share of samples at a saturated end."""
MIN_STANDSTILL_SHARE = 0.5
"""Smallest reported share of samples at standstill."""
WINDOW_SAMPLES = 20
"""Number of samples of a window in which a signal is judged to move or stand still."""
MOTION_THRESHOLD_SIGMAS = 6.0
"""Smallest range within a window that counts as motion, in standard deviations of noise.

Noise alone has a range of 3.7 standard deviations on average.
"""

FAST_SIGNAL_STEPS = 5.0
"""Smallest change of a signal per sample that counts as fast motion, in quantisation steps.

A signal that changes this fast does not repeat its value by coincidence.
"""


def check_quantisation(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find channels whose quantisation exceeds their motion or their specified noise.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        One finding for each such channel.
    """
    for channel, signals in _iterate_channels(recording, kind):
        step = estimate_noise(signals).step  # 0 without quantisation
        values = np.concatenate([values for _, values in signals])
        spread = float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() else 0.0
        stated_noise = recording.noise.get(channel.name)
        # A rounding error is uniformly distributed over a step; its standard deviation follows.
        rounding = step / 12**0.5
        step_text = append_unit(f"{step:.3g}", channel.unit)
        rounding_text = append_unit(f"{rounding:.2g}", channel.unit)
        if step and stated_noise is not None and stated_noise < rounding / 2:
            yield QualityFinding(
                "quantisation",
                f"{channel.name} has steps of {step_text}, whose rounding error alone is "
                f"{rounding_text}, but the stated noise is {stated_noise:.2g}",
                f"state noise = {rounding:.2g} or more",
            )
        elif step > QUANTISATION_SHARE_THRESHOLD * spread > 0:
            yield QualityFinding(
                "quantisation",
                f"{channel.name} has steps of {step_text}, {step / spread:.0%} of its range",
                "use a larger motion or a finer sensor: changes smaller than a step are hardly "
                "visible",
            )


def check_saturation(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find channels that are cut off at an end of their range, and commands at their limits.

    A channel is cut off if it jumps to its extreme value and stays there for several samples. A
    signal that is just at rest there is not.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        One finding for each saturated end and each limited command.
    """
    for channel, signals in _iterate_channels(recording, kind):
        for sign, word in ((1.0, "highest"), (-1.0, "lowest")):
            # With a reversed sign, the lowest value is the highest one.
            values = [
                sign * run_values for _, run_values in signals if np.isfinite(run_values).any()
            ]
            if not values:
                continue
            extreme = max(float(np.nanmax(run_values)) for run_values in values)
            # A change by a few quantisation steps is no jump.
            min_jump = CLIPPING_STEP_THRESHOLD * estimate_noise(signals).step
            saturated_count = sum(
                _count_saturated_samples(run_values, extreme, min_jump) for run_values in values
            )
            total = sum(run_values.size for run_values in values)
            # If every run may just rest at this value, nothing shows that the signal is cut off.
            if saturated_count > MIN_SATURATED_SHARE * total and not all(
                _is_resting_value(run_values, extreme) for run_values in values
            ):
                value_text = append_unit(f"{sign * extreme:.4g}", channel.unit)
                yield QualityFinding(
                    "saturation",
                    f"{channel.name} stays at its {word} value, {value_text}, "
                    f"in {saturated_count / total:.1%} of the samples",
                    "a sensor or joint at its limit carries no information: leave these samples "
                    "empty, or stay away from the limit",
                )
    yield from _find_saturated_commands(recording, kind)


def _find_saturated_commands(
    recording: Recording, kind: type[Simulator]
) -> Iterator[QualityFinding]:
    """Find commands of a robot that are often at or beyond the range of their actuator.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: class of the simulator; only robots specify ranges.
    """
    if not kind.has_model:
        return
    robot: Any = kind
    for actuator in robot.robot.actuators:
        name = f"u.{actuator.name}"
        if actuator.range is None or name not in recording.runs[0].inputs:
            continue
        low, high = actuator.range
        values = np.concatenate([run.inputs[name] for run in recording.runs])
        share = float(np.mean((values <= low) | (values >= high)))
        if share > MIN_SATURATED_SHARE:
            yield QualityFinding(
                "saturation",
                f"{name} is at or beyond its range, {low:.4g} to {high:.4g}, in {share:.1%} of "
                "the samples",
                "a larger command has no further effect: reduce the command, or correct the range",
            )


def check_standstill(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find coordinates that move in few samples or never, and so show little of their dynamics.

    Each run is divided into windows of `WINDOW_SAMPLES` samples. A coordinate moves in a window if
    its range there clearly exceeds the noise and the quantisation step.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        At most two findings: coordinates that never move, and coordinates that seldom move.
    """
    if not issubclass(kind, SystemSimulator):
        return
    still_channels, seldom_moving = [], []
    positions = set(kind.system.coordinates)
    for channel, signals in _iterate_channels(recording, kind):
        if channel.name not in positions:
            continue
        noise = estimate_noise(signals)
        min_motion = MOTION_THRESHOLD_SIGMAS * max(
            np.nan_to_num(noise.sigma), noise.step, 1e-9 * channel.scale
        )
        moving = np.concatenate([_find_moving_windows(values, min_motion) for _, values in signals])
        share = 1.0 - float(moving.mean()) if moving.size else 0.0
        if share == 1.0:
            still_channels.append(channel.name)
        elif share > MIN_STANDSTILL_SHARE:
            seldom_moving.append(f"{channel.name} ({share:.0%})")
    if still_channels:
        yield QualityFinding(
            "stillness",
            f"{join_first_names(still_channels)} never moves",
            "its dynamics cannot be identified: move it, or leave its joint out",
        )
    if seldom_moving:
        yield QualityFinding(
            "stillness",
            f"{join_first_names(seldom_moving)} of the samples are at rest",
            "friction, damping and inertia are visible only in motion: move during more of the "
            "recording",
        )


def _iterate_channels(
    recording: Recording, kind: type[Simulator]
) -> Iterator[tuple[Channel, list[tuple[Array, Array]]]]:
    """Yield each recorded channel with its times (T,) and values (T,) in every run.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: simulator class, which declares the channels.
    """
    for channel in kind.channels:
        signals = [
            (run.times, run.channels[channel.name])
            for run in recording.runs
            if channel.name in run.channels
        ]
        if signals:
            yield channel, signals


def _count_saturated_samples(values: Array, extreme: float, min_jump: float) -> int:
    """Count samples in saturated stretches of at least `MIN_SATURATED_SAMPLES` samples.

    In a stretch the signal keeps its extreme value. The signal must jump into or out of it: a
    quantised signal that reverses at its end changes by one step only, and is not saturated.

    Args:
        values: (T,) signal.
        extreme: its smallest or largest value.
        min_jump: smallest change into or out of a saturated stretch, in the unit of the signal.
    """
    is_extreme = np.concatenate([[False], values == extreme, [False]]).astype(np.int8)
    # Changes of the mask alternate: begin and end of each stretch.
    edges = np.flatnonzero(np.diff(is_extreme))
    # Each stretch is values[begin:end]. With one more value in front, values[begin - 1] is
    # padded_values[begin], and values[end] is padded_values[end + 1].
    begin, end = edges[::2], edges[1::2]
    padded_values = np.concatenate([[extreme], values, [extreme]])
    jumps = np.fmax(
        np.abs(padded_values[begin] - extreme), np.abs(padded_values[end + 1] - extreme)
    )
    lengths = end - begin
    return int(lengths[(lengths >= MIN_SATURATED_SAMPLES) & (jumps > min_jump)].sum())


def _is_resting_value(values: Array, extreme: float) -> bool:
    """Return whether a run may rest at an extreme value: it begins or ends there, or never has it.

    Args:
        values: (T,) signal of the run, NaN where missing.
        extreme: smallest or largest value of all runs.
    """
    recorded_values = values[np.isfinite(values)]
    if not (recorded_values == extreme).any():
        return True
    return bool(recorded_values[0] == extreme or recorded_values[-1] == extreme)


def _find_moving_windows(values: Array, min_motion: float) -> Array:
    """Return for each window of `WINDOW_SAMPLES` samples of a run whether the signal moves in it.

    A shorter run is one window. Windows without a sample are left out.

    Args:
        values: (T,) signal of the run, NaN where missing.
        min_motion: smallest range within a window that counts as motion, in the unit of the signal.
    """
    count = values.size // WINDOW_SAMPLES
    if not count:
        return np.array([bool(np.nanmax(values) - np.nanmin(values) > min_motion)])
    windows = values[: count * WINDOW_SAMPLES].reshape(count, WINDOW_SAMPLES)
    windows = windows[np.isfinite(windows).any(axis=1)]
    is_moving: Array = (np.nanmax(windows, axis=1) - np.nanmin(windows, axis=1)) > min_motion
    return is_moving


def check_repeated_samples(recording: Recording) -> Iterator[QualityFinding]:
    """Find samples that repeat the previous one in every channel although the system moves.

    Such samples were not measured anew, and look like a delay. A run counts if it has significantly
    more of them than its quantisation causes by coincidence.

    Args:
        recording: Recording to check.
    """
    repeated_count, sample_count, runs = 0, 0, []
    for run in recording.runs:
        count, expected = _count_stale_samples(run)
        # A count of independent events has the standard deviation sqrt(expected) (Poisson).
        if count > expected + SIGNIFICANCE_SIGMAS * np.sqrt(max(expected, 1.0)):
            repeated_count += count
            runs.append(run.name)
        sample_count += run.times.size
    if repeated_count > LOST_SAMPLE_SHARE_THRESHOLD * sample_count:
        yield QualityFinding(
            "clock",
            f"{repeated_count} samples ({repeated_count / sample_count:.1%}) repeat the one before "
            f"in every channel while it moves, in {join_first_names(runs)}",
            "leave these rows out: a value that is one interval old looks like a delay",
        )


def _count_stale_samples(run: Run) -> tuple[int, float]:
    """Count samples that repeat the previous one in every channel although the system moves fast.

    The system moves fast at a sample if some channel changes by at least `FAST_SIGNAL_STEPS`
    quantisation steps directly before or after it. Such a repetition is rarely a coincidence.

    Args:
        run: recorded run with its channels.

    Returns:
        The count, and the count to expect by coincidence, from the noise alone. It is estimated
        from the samples that change by one step at most: with N channels, each of which changes by
        -1, 0 or 1 step with equal probability, one in 3^N of them repeats everything.
    """
    signals = [values for values in run.channels.values() if np.isfinite(values).sum() > 3]
    if not signals or run.times.size < 4:
        return 0, 0.0
    # (N, T - 1) changes of the channels; NaN where a sample is missing.
    changes = np.array([_count_quantisation_steps(values) for values in signals])
    neighbour_changes = np.maximum(np.abs(changes[:, :-2]), np.abs(changes[:, 2:]))
    is_moving = (
        np.nan_to_num(np.max(neighbour_changes, axis=0, initial=0.0), nan=0.0) >= FAST_SIGNAL_STEPS
    )
    # A missing sample may be a repetition, but does not count as a change by one step.
    is_unchanged = (np.nan_to_num(changes, nan=0.0) == 0).all(axis=0)
    is_stale = is_unchanged[1:-1] & is_moving
    is_nearly_unchanged = (np.abs(np.nan_to_num(changes, nan=9.0)) < 1.5).all(axis=0)
    is_nearly_stale = is_nearly_unchanged[1:-1] & is_moving
    # Of the changes by one step at most, one in 3^N is a repetition: 1 / (3^N - 1) of the others.
    one_step_count = int(is_nearly_stale.sum()) - int(is_stale.sum())
    return int(is_stale.sum()), one_step_count / max(3.0 ** len(signals) - 1.0, 1.0)


def _count_quantisation_steps(values: Array) -> Array:
    """Return the (T - 1,) changes of a signal in units of its smallest change, rounded.

    The smallest change of a quantised signal is its quantisation step. Changes by rounding errors
    do not count.

    Args:
        values: (T,) samples, NaN where missing.
    """
    changes = np.diff(values)
    sizes = np.abs(changes[np.isfinite(changes)])
    nonzero_sizes = sizes[sizes > 1e-9 * np.max(sizes, initial=0.0)]
    if not nonzero_sizes.size:
        return np.zeros_like(changes)
    # Without quantisation the smallest change is tiny, so that any motion is many steps.
    return np.asarray(np.round(changes / nonzero_sizes.min()), dtype=np.float64)
