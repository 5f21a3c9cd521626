"""Background image of a fixed camera without the ball, and its camera noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sims.core.medians import compute_nan_median
from sims.core.noise_estimation import SIGMA_PER_MEDIAN
from sims.core.simulator import Array
from sims.vision.ball_renderer import RgbImage

MAX_BACKGROUND_FRAMES = 25
"""Maximum number of frames whose median is the background."""
_HIDDEN_RADII = 1.3
"""Distance around a ball's centre at which it hides the background with its soft edge, in radii."""
_HIDDEN_MARGIN_PIXELS = 3
"""Additional margin around a ball that compression affects, pixels."""
_LARGEST_OF_THREE_RATIO = 1.5
"""Assumed ratio of the largest of three noise magnitudes to a single one."""


def select_frames(moved: Array) -> list[int]:
    """Select the frames whose median is the background: at even intervals of accumulated motion.

    Frames at even intervals of time would mostly show a ball that comes to rest, which would then
    be part of the median.

    Args:
        moved: (n,) mean change from the previous frame, grey levels.

    Returns:
        Sorted numbers of at most `MAX_BACKGROUND_FRAMES` frames.
    """
    count = len(moved)
    # Each frame counts a little, so that frames are also selected from a film without motion.
    min_motion = 1e-3 * moved.sum() / max(1, count)
    accumulated = np.cumsum(moved + min_motion + 1e-12)
    targets = np.linspace(accumulated[0], accumulated[-1], min(MAX_BACKGROUND_FRAMES, count))
    # A target that rounding has raised must not select the next frame.
    frame_numbers = np.searchsorted(accumulated, targets - 1e-12).clip(0, count - 1)
    return sorted(set(frame_numbers.tolist()))


def compute_median_background(pictures: list[RgbImage]) -> RgbImage:
    """Return the pixelwise median of pictures."""
    stack = np.stack(pictures)
    half_count = len(stack) // 2
    # A partition finds the middle without sorting, and keeps integer grey levels.
    stack.partition(half_count, axis=0)
    result: RgbImage = stack[half_count].copy()
    return result


def compute_masked_background(
    pictures: list[RgbImage],
    balls: list[list[tuple[float, float, float]]],
    previous: RgbImage,
    shaded: NDArray[np.bool_] | None = None,
) -> RgbImage:
    """Return the pixelwise median of pictures without the objects that hide the background.

    Args:
        pictures: n pictures (height, width, 3).
        balls: Circles (u, v, radius) of the objects in each picture, pixels.
        previous: Previous estimate of the background, the median of all pictures. It is kept where
            the background is never hidden, or hidden in all pictures.
        shaded: Mask (n, height, width) of shadows that also hide it; None for none.
    """
    height, width = previous.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    empty_masks = np.zeros((len(pictures), height, width), bool)
    hidden = empty_masks if shaded is None else shaded.copy()
    for mask, circles in zip(hidden, balls, strict=True):
        for u, v, radius in circles:
            distances = np.hypot(columns - u, rows - v)
            mask |= distances < _HIDDEN_RADII * radius + _HIDDEN_MARGIN_PIXELS
    is_partly_hidden = hidden.any(axis=0) & ~hidden.all(axis=0)
    # (n, pixels, 3): only the pixels that are hidden in some pictures.
    colours = np.stack(pictures)[:, is_partly_hidden].astype(np.float32)
    visible_colours = np.where(hidden[:, is_partly_hidden, None], np.nan, colours)
    result = previous.copy()
    if is_partly_hidden.any():
        median = compute_nan_median(visible_colours)
        # Add half a grey level, because the conversion to integers truncates.
        result[is_partly_hidden] = (median + 0.5).astype(np.uint8)
    return result


def estimate_camera_noise(pictures: list[RgbImage], background: RgbImage) -> float:
    """Estimate the camera noise from pictures in which little differs from the background.

    Most pixels show the background, so the median difference from it is due to noise.

    Args:
        pictures: Pictures (height, width, 3).
        background: Background (height, width, 3).

    Returns:
        Standard deviation of the noise of a colour, grey levels.
    """
    # About eight pictures suffice, because each has many pixels.
    stride = max(1, len(pictures) // 8)
    largest_differences = [
        _compute_largest_difference(picture, background) for picture in pictures[::stride]
    ]
    median = np.median(np.stack(largest_differences))
    # The largest of three colours differs more than a single one.
    return float(SIGMA_PER_MEDIAN * median / _LARGEST_OF_THREE_RATIO)


def _compute_largest_difference(picture: RgbImage, background: RgbImage) -> NDArray[np.int16]:
    """Return for each pixel the largest absolute difference of the three colours, (height, width).

    Args:
        picture: picture with the ball, (height, width, 3).
        background: picture without it, (height, width, 3).
    """
    # Differences of unsigned integers would wrap around.
    signed = picture.astype(np.int16)
    differences = np.abs(signed - background)
    result: NDArray[np.int16] = differences.max(axis=2)
    return result
