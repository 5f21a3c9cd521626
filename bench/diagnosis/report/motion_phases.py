"""Phases of a motion: flight, impact, reversal, rest and saturated input, as masks of samples."""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array

REVERSAL_SPEED_SHARE = 0.05
"""Speed, as a share of the largest one, below which a motion counts as a reversal."""
REST_SPEED_SHARE = 0.01
"""Speed, as a share of the largest one, below which a motion counts as at rest if it lasts."""
MIN_CONSECUTIVE_SAMPLES = 5
"""Minimum number of consecutive samples for a lasting state."""
SATURATION_SHARE = 0.999
"""Share of its largest magnitude above which an input counts as saturated."""
IMPACT_MARGIN_SAMPLES = 2
"""Number of samples before and after an impact that belong to it."""


def detect_phases(evaluator: RunEvaluator, simulated: Array) -> dict[str, Mask]:
    """Detect phases of the motion as masks (R, T).

    They are flight, impact and at rest for a system that bounces; motion, reversal and at rest for
    others. A further phase, saturated input, may overlap with each of them. Without recorded
    coordinates there are no phases.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.
    """
    system = evaluator.simulator.system
    speed = compute_speeds(evaluator, simulated)
    if speed is None:
        return {}
    # The lower limit avoids a division by zero if nothing moves; then all is at rest.
    largest = max(float(np.nanmax(speed)), 1e-300)
    # The speed is also small for a moment where the motion reverses, so only a lasting state counts
    # as rest.
    is_at_rest = _find_lasting_stretches(speed < REST_SPEED_SHARE * largest)
    if system.bounces:
        impact = _find_impacts(evaluator, simulated) & ~is_at_rest
        masks = {"flight": ~impact & ~is_at_rest, "impact": impact, "at rest": is_at_rest}
    else:
        reversal = (speed < REVERSAL_SPEED_SHARE * largest) & ~is_at_rest
        masks = {"motion": ~reversal & ~is_at_rest, "reversal": reversal, "at rest": is_at_rest}
    saturated = _find_saturation(evaluator)
    if saturated.any():
        masks["saturated input"] = saturated
    return masks


def compute_speeds(evaluator: RunEvaluator, simulated: Array) -> Array | None:
    """Compute the speed (R, T) of the simulated motion along the recorded coordinates.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.

    Returns:
        Speed, 0 after the end of a run; None without recorded coordinates.
    """
    velocities = [
        compute_slopes(evaluator, simulated, name)
        for name in evaluator.simulator.system.coordinates
        if name in evaluator.channels
    ]
    if not velocities:
        return None
    speeds: Array = np.sqrt(np.nan_to_num(np.square(velocities).sum(axis=0)))
    return speeds


def compute_slopes(evaluator: RunEvaluator, simulated: Array, channel: str) -> Array:
    """Compute the time derivative (R, T) of a simulated channel; NaN after the end of a run.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        simulated: (R, T, C) simulated motion.
        channel: Name of the channel.
    """
    values = simulated[:, :, evaluator.channels.index(channel)]
    slopes = np.full_like(values, np.nan)
    for row, run_values, run_data in zip(slopes, values, evaluator.prepared_runs, strict=True):
        count = len(run_data.observed)
        # A single sample has no slope.
        if count > 1:
            row[:count] = np.gradient(run_values[:count], run_data.scenario.times)
    return slopes


def _find_lasting_stretches(mask: Mask) -> Mask:
    """Return where a mask is true for at least `MIN_CONSECUTIVE_SAMPLES` consecutive samples.

    Args:
        mask: (R, T) mask of the T samples of R runs.
    """
    lasting = np.zeros_like(mask)
    for row, lasting_row in zip(mask, lasting, strict=True):
        # With zeros at both ends, changes come in pairs: start and end of each interval.
        padded = np.concatenate([[0], row.astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(padded))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            lasting_row[begin:end] = end - begin >= MIN_CONSECUTIVE_SAMPLES
    return lasting


def _find_impacts(evaluator: RunEvaluator, simulated: Array) -> Mask:
    """Return the mask (R, T) of the samples around each minimum of the simulated height.

    A ball touches the ground there; a few samples on either side are included. The height is the
    last coordinate; nothing is marked if it is not recorded.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: the runs of a ball.
        simulated: (R, T, C) simulated channels.
    """
    name = evaluator.simulator.system.coordinates[-1]
    mask = np.zeros(simulated.shape[:2], dtype=bool)
    if name not in evaluator.channels:
        return mask
    height = simulated[:, :, evaluator.channels.index(name)]
    # After the end of a shorter run heights are NaN, which are never lowest points.
    previous_heights, heights, next_heights = height[:, :-2], height[:, 1:-1], height[:, 2:]
    with np.errstate(invalid="ignore"):
        # In a flat interval only the last sample counts, so that one impact is not counted twice.
        is_lowest = (heights <= previous_heights) & (heights < next_heights)
    is_lowest = np.pad(is_lowest, ((0, 0), (1, 1)))
    # Each lowest sample marks its neighbours on either side, too.
    for shift in range(-IMPACT_MARGIN_SAMPLES, IMPACT_MARGIN_SAMPLES + 1):
        mask |= np.roll(is_lowest, shift, axis=1)
    return mask


def _find_saturation(evaluator: RunEvaluator) -> Mask:
    """Return the mask (R, T) of samples at which the first input stays near its largest magnitude.

    It is all False for an input that is there most of the time, such as a constant or a square
    wave, which is not saturated.

    Shapes: R runs, T samples.

    Args:
        evaluator: Run evaluator of the recording.
    """
    mask = np.zeros(evaluator.observed.shape[:2], dtype=bool)
    for run_mask, run_data in zip(mask, evaluator.prepared_runs, strict=True):
        # Only the first input, if there is one.
        for signal in list(run_data.scenario.inputs.values())[:1]:
            size = np.abs(signal)
            largest = max(float(size.max()), 1e-300)
            run_mask[: signal.size] = (size >= SATURATION_SHARE * largest) & (size > 0)
    lasting = _find_lasting_stretches(mask)
    is_exceptional = lasting.mean() < 0.5
    return lasting if is_exceptional else np.zeros_like(mask)
