"""Fill the gaps of a sensor's channel from a simulation, through a map that is fitted between them.

A camera that stands still shows a motion x along a line as

    (1)  y = (a + b x) / (1 + c x)

(Hartley and Zisserman, Multiple View Geometry, 2004, chapter 2). Multiplied by the denominator it
is linear in the three numbers:

    (2)  y = a + b x - c x y
"""

from __future__ import annotations

import numpy as np

from methods.learning.input_features import FeatureConfig
from methods.tuner import Array, Task

_ITERATIONS = 15
"""Number of iterations of reweighted least squares."""
_MIN_SEEN_SAMPLES = 8
"""Minimum number of available samples for filling gaps."""
_CAUCHY_WIDTH = 2.0
"""Width of Cauchy's weight function, in median absolute residuals of the map."""
_MIN_CAUCHY_WIDTH = 1e-6
"""Minimum width of Cauchy's weight function, in standard deviations of the channel.

A closer agreement counts as exact.
"""
_MIN_DENOMINATOR = 0.1
"""Minimum denominator of (1).

A smaller one means that the pole of the map is near, where the motion reaches the camera.
"""


def fill_target_gaps(
    task: Task, simulated: Array, proposed: FeatureConfig, target: FeatureConfig
) -> Array:
    """Fill the gaps of the target's channels from a simulation, run by run.

    This is done only if the proposed side of the network reads one channel of the simulation.

    Shapes: T samples, C channels.

    Args:
        task: the task, with the observations of the target.
        simulated: (T, C) a simulation.
        proposed: configuration of the inputs of the proposed side, with its channels.
        target: configuration of the inputs of the target's side, with its channels.

    Returns:
        (T, C) observations of the target; only the channels that the network reads are filled.
    """
    # Simulation and target may have different channels, such as a position and its pixels.
    sensor = proposed.select_channels(simulated)
    filled = task.observed.copy()
    # With several channels of the simulation, the one that belongs to the sensor is not known.
    if sensor.shape[-1] != 1:
        return filled
    run_ends = np.cumsum(task.lengths)
    for first, end in zip(run_ends - task.lengths, run_ends, strict=True):
        # Slices of the copy are filled in place.
        for channel in target.select_channels(filled[first:end]).T:
            channel[:] = fill_gaps(channel, sensor[first:end, 0])
    return filled


def fill_gaps(channel: Array, simulated: Array) -> Array:
    """Fill the gaps of a sensor's channel from a simulation, through a fitted map between them.

    The map is y = (a + b x) / (1 + c x), as a camera maps a line (1). Its three numbers are fitted
    to the available samples in the linear form y = a + b x - c x y (2), and with Cauchy's weights,
    because an inaccurate model agrees with the sensor only in parts of a run.

    Args:
        channel: (T,) channel with NaN for missing samples.
        simulated: (T,) simulated values at the same times, of another sensor.

    Returns:
        (T,) channel without gaps; unchanged if there are too few samples or no such map.
    """
    is_present = np.isfinite(channel)
    if is_present.all() or is_present.sum() < _MIN_SEEN_SAMPLES:
        return channel
    # A simulation at rest does not determine the map.
    if not np.ptp(simulated[is_present]) > 0:
        return channel
    # Metres and pixels differ by orders of magnitude; scaling gives all columns of (2) equal
    # weight.
    x = _scale_like(simulated, simulated[is_present])
    y = _scale_like(channel, channel[is_present])
    design_matrix = np.stack([np.ones_like(x), x, -x * y], axis=1)[is_present]
    a, b, c = _fit_camera_line(design_matrix, y[is_present])
    denominator = 1 + c * x
    # A change of sign would put a part of the run behind the camera.
    if not (denominator > _MIN_DENOMINATOR).all():
        return channel
    scaled_values = (a + b * x) / denominator  # (1)
    # Back to the units of the channel.
    unscaled = scaled_values * float(channel[is_present].std()) + float(channel[is_present].mean())
    result: Array = np.where(is_present, channel, unscaled)
    return result


def _fit_camera_line(design_matrix: Array, values: Array) -> Array:
    """Fit a, b and c of y = a + b x - c x y robustly, the map of heights x to pixel rows y.

    It is the map y = (a + b x) / (1 + c x) of a camera, multiplied by its denominator. The method
    is iteratively reweighted least squares with Cauchy's weights, so that a few wrong samples do
    not spoil the fit.

    Args:
        design_matrix: (n, 3) regressors 1, x and -x y of n samples.
        values: (n,) pixel rows y.

    Returns:
        (3,) numbers a, b and c.
    """
    weights: Array = np.ones(len(design_matrix))
    coefficients: Array = np.zeros(3)
    for _ in range(_ITERATIONS):
        solution, *_ = np.linalg.lstsq(
            design_matrix * weights[:, None], values * weights, rcond=None
        )
        coefficients = solution.astype(np.float64)
        residual: Array = values - design_matrix @ coefficients
        width = max(_CAUCHY_WIDTH * float(np.median(np.abs(residual))), _MIN_CAUCHY_WIDTH)
        # This is the root of Cauchy's weight, because it multiplies both sides of the equation.
        weights = 1 / np.sqrt(1 + (residual / width) ** 2)
    return coefficients


def _scale_like(values: Array, reference: Array) -> Array:
    """Return values in standard deviations of `reference` from the mean of `reference`."""
    spread = float(reference.std())
    divisor = spread if spread > 0 else 1.0
    result: Array = (values - float(reference.mean())) / divisor
    return result
