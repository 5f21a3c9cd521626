"""Find the cuts of a film, and its longest part without a cut."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sims.core.simulator import Array, InputError
from sims.vision.ball_renderer import RgbImage

_SURVEY_PIXELS = 5_000
"""Approximate number of pixels per picture used in the first pass."""
_MIN_CUT_SHARE = 0.5
"""Fraction of pixels that change where the film is cut or the camera moves."""
_COMPRESSION_NOISE = 4
"""Grey levels of compression noise in addition to the camera noise, which the median estimates."""
_MIN_PIXEL_CHANGE = 12
"""Change in grey levels above which a pixel counts as changed; smaller ones are noise or shadow."""


@dataclass(frozen=True)
class FrameSurvey:
    """Result of a first pass over the frames.

    Attributes:
        times: (n,) times of the frames, s.
        moved: (n,) mean change from the previous frame, grey levels.
        cuts: Numbers of the frames that begin a new shot.
        size: Width and height of the picture, px.
    """

    times: Array
    moved: Array
    cuts: tuple[int, ...]
    size: tuple[int, int]

    def list_shots(self) -> list[tuple[int, int]]:
        """Return the first frame and the end (exclusive) of each shot between cuts."""
        edges = [0, *self.cuts, len(self.times)]
        # Consecutive cuts have no shot between them.
        return [(a, b) for a, b in pairwise(edges) if b > a]


def survey_frames(frames: Iterable[tuple[float, RgbImage]]) -> FrameSurvey:
    """Measure the motion in each frame of a film, and find its cuts, at low resolution.

    Both follow from the change of the pixels from frame to frame. At a cut, most pixels change.

    Args:
        frames: Time in seconds and picture (height, width, 3) of each frame.

    Raises:
        InputError: The size of the picture changes.
    """
    times = []
    motions = []
    cuts = []
    frame_size = 0, 0
    previous_frame = None
    for frame_index, (time, picture) in enumerate(frames):
        height, width, _ = picture.shape
        if frame_index and (width, height) != frame_size:
            expected = f"{frame_size[0]} x {frame_size[1]} px as before"
            raise InputError(f"frame {frame_index}: expected {expected}, found another size")
        frame_size = width, height
        pixel_stride = max(1, int((height * width / _SURVEY_PIXELS) ** 0.5))
        thinned = picture[::pixel_stride, ::pixel_stride].astype(np.int16)
        # The first frame is compared with itself: no motion.
        reference_frame = thinned if previous_frame is None else previous_frame
        # Largest change of the three colours of each pixel.
        change = np.abs(thinned - reference_frame).max(axis=2)
        if np.mean(change > _MIN_PIXEL_CHANGE) > _MIN_CUT_SHARE:
            cuts.append(frame_index)
            # The whole picture has changed, and no ball has moved.
            change[:] = 0
        times.append(time)
        # Ignore small changes: noise would make a static picture look busy.
        median_change = np.median(change)
        excess = change - 2 * median_change - _COMPRESSION_NOISE
        motions.append(float(np.maximum(excess, 0).mean()))
        previous_frame = thinned
    return FrameSurvey(np.array(times), np.array(motions), tuple(cuts), frame_size)


MIN_FRAMES = 5
"""Minimum number of frames that must show the ball."""


def find_longest_shot(survey: FrameSurvey, notes: list[str]) -> tuple[int, int]:
    """Return the first frame and the end (exclusive) of the longest part without a cut.

    If the film has cuts, a note says which part is used.

    Args:
        survey: result of the first pass over the frames.
        notes: remarks for the user, extended in place.

    Raises:
        InputError: the part has too few frames.
    """
    shots = survey.list_shots()
    first_frame, end_frame = max(shots, key=lambda shot: shot[1] - shot[0])
    if len(shots) > 1:
        cuts = ", ".join(f"{survey.times[cut_frame]:.2f} s" for cut_frame in survey.cuts[:5])
        span = f"{survey.times[first_frame]:.2f} to {survey.times[end_frame - 1]:.2f} s"
        notes.append(
            f"the film is cut or the camera moves (at {cuts}); "
            f"only the longest part is tracked, {span}"
        )
    if end_frame - first_frame < MIN_FRAMES:
        raise InputError(
            f"expected at least {MIN_FRAMES} frames without a cut, found {end_frame - first_frame}"
        )
    return first_frame, end_frame
