"""Track the ball in a film, and write the track as a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.logs import ball_heights
from sims.core.files import check_absent
from sims.core.plain_values import LENGTH_RANGE
from sims.core.simulator import InputError, make_read_only
from sims.recording.recording import Recording, Run
from sims.recording.recording_writer import write_recording
from sims.systems.ball import BallSystem
from sims.vision.ball_tracker import BallTrack, estimate_roughness, track_ball
from sims.vision.pinhole_camera import (
    get_camera_file_path,
    read_camera_file,
)
from sims.vision.video_files import VideoFile

_TABLE_DIGITS = 9
"""Number of significant digits in the table, finer than a pixel's noise."""


class TrackingResult(NamedTuple):
    """Result of tracking a film.

    Attributes:
        notes: Notes for the user, to be shown first.
        frames: Number of recorded frames.
        frames_with_ball: Number of these frames that show the ball.
        scale_method: Method by which heights in metres were found.
        noise_pixels: 1 sigma of one sample in pixels.
        noise: 1 sigma of a height in metres.
        lines: The result as text.
    """

    notes: tuple[str, ...]
    frames: int
    frames_with_ball: int
    scale_method: str
    noise_pixels: float
    noise: float
    lines: tuple[str, ...]

    def to_document(self) -> dict[str, Any]:
        """Return the result as a JSON document, as `simgap track --json` prints it."""
        return {
            "frames": self.frames,
            "frames_with_ball": self.frames_with_ball,
            "metres_from": self.scale_method,
            "noise_pixels": self.noise_pixels,
            "noise_metres": self.noise,
            "notes": self.notes,
        }


TrackFigureWriter = Callable[
    [BallTrack, ball_heights.BallHeights, slice, str], tuple[bytes, bytes | None]
]
"""Draws a track, its heights, the recorded frames and a title, as a PNG and a PDF or None."""


def track_film(
    video: Path,
    out: Path,
    draw: TrackFigureWriter,
    diameter: float | None = None,
    fps: float | None = None,
    scale: str | None = None,
    pdf: bool = False,
) -> TrackingResult:
    """Track the ball in a film, and write a recording of its height and a figure of the track.

    The ball is tracked in pixels, its path is converted to heights in metres, frames before the
    release are left out, and the noise is estimated. Either all files are written or none.

    Args:
        video: Path of the film.
        out: Path NAME.csv of the new recording; description and figure are written next to it.
        draw: Function that draws the figure (`figures.ball_track_figure.render_track_figure`) and
            returns it as a PNG and, if requested, a PDF.
        diameter: Diameter of the ball, m.
        fps: Frames per second, instead of the file's time stamps.
        scale: "camera", "diameter" or "fall"; None for the best available one.
        pdf: Whether `draw` makes a PDF, too.

    Returns:
        Counts of frames, noise, and notes and lines to show to the user.

    Raises:
        InputError: The film cannot be tracked or the files cannot be written; one line.
    """
    if out.suffix != ".csv":
        raise InputError(f"{out}: expected a name that ends in .csv")
    png_path, pdf_path = out.with_suffix(".png"), out.with_suffix(".pdf")
    # Check this before the work, since tracking a film takes a while.
    check_absent([out, out.with_suffix(".toml"), png_path, *([pdf_path] if pdf else [])])
    if diameter is not None and not LENGTH_RANGE[0] <= diameter <= LENGTH_RANGE[1]:
        expected = f"more than 0 m, from {LENGTH_RANGE[0]:g} to {LENGTH_RANGE[1]:g} m"
        raise InputError(f"ball diameter {diameter:g}: expected {expected}")

    film = VideoFile(video, fps)
    try:
        track = track_ball(film)
        heights = _convert_to_heights(track, video, diameter, scale)
    except InputError as error:
        # Some error messages already name the film, others do not.
        text = str(error)
        raise InputError(text if text.startswith(str(video)) else f"{video}: {text}") from None

    first, last = ball_heights.find_release_frame(track), int(track.visible_frames[-1])
    kept_frames = slice(first, last + 1)
    notes = [*film.notes, *track.notes, *heights.notes]
    if first > track.visible_frames[0]:
        until = f"the ball is held until {track.times[first]:.2f} s"
        notes.append(f"{until}; earlier frames are left out")
    noise = _estimate_height_noise(track, heights, kept_frames)

    # The recording and its figures are published together, so that none exists without the others.
    png, pdf_content = draw(track, heights, kept_frames, f"{video.name}: {heights.method}")
    figure_contents = {png_path: png}
    if pdf_content is not None:
        figure_contents[pdf_path] = pdf_content
    recording = _build_recording(track, heights, noise, kept_frames, video)
    write_recording(out, recording, BallSystem, digits=_TABLE_DIGITS, extra_files=figure_contents)

    count = int(np.isfinite(heights.z[kept_frames]).sum())
    frames = kept_frames.stop - kept_frames.start
    lines = (
        f"{out}: {count} of {frames} frames with the ball, z in metres {heights.method}",
        f"noise of one sample: {track.noise:.2g} px, {1e3 * noise:.2g} mm",
        f"{png_path}: the track",
    )
    return TrackingResult(
        tuple(notes), frames, count, heights.method, float(track.noise), noise, lines
    )


def _estimate_height_noise(
    track: BallTrack, heights: ball_heights.BallHeights, part: slice
) -> float:
    """Estimate 1 sigma of a height, m: the larger of the scatter of neighbours and of flights.

    Neighbouring frames show fast noise; the deviations from smooth flights show slow errors, too.

    Args:
        track: the tracked ball, with the times of the frames.
        heights: heights of the ball, m, NaN where it was not detected.
        part: frames that are recorded.
    """
    heights_of_part = heights.z[part]
    noise = float(
        np.nanmax(
            [
                estimate_roughness(heights_of_part),
                ball_heights.estimate_height_noise(track.times[part], heights_of_part),
                0.0,
            ]
        )
    )
    if noise > 0:
        return noise
    # A few frames give neither estimate: use the noise in pixels, scaled by the median radius.
    return track.noise * heights.radius / float(np.nanmedian(track.radius))


def _convert_to_heights(
    track: BallTrack, video: Path, diameter: float | None, scale: str | None
) -> ball_heights.BallHeights:
    """Convert the track of the ball from pixels to heights in metres.

    There are three scales, the best one first: a calibrated camera whose file lies next to the
    film, the known diameter of the ball, and the acceleration of free fall.

    Args:
        track: position and radius of the ball in each frame, pixels.
        video: path of the film.
        diameter: diameter of the ball in metres, if it is known.
        scale: "camera", "diameter" or "fall"; None for the best one available.

    Returns:
        Height of the ball in each frame, its radius, and how they were found.

    Raises:
        InputError: the film does not show what the scale needs, or the scale "diameter" is
            requested without a diameter.
    """
    camera_file = get_camera_file_path(video)
    if scale == "camera" or (scale is None and camera_file.is_file()):
        return ball_heights.compute_heights_by_camera(track, read_camera_file(camera_file))
    if scale == "diameter" and diameter is None:
        raise InputError("scale diameter: expected the ball's diameter in metres")
    return ball_heights.compute_heights_by_scale(track, diameter, scale)


def _build_recording(
    track: BallTrack, heights: ball_heights.BallHeights, noise: float, part: slice, video: Path
) -> Recording:
    """Build the recording: the height z of the ball (m), and its track in pixels as extra columns.

    Args:
        track: position and radius of the ball in each frame, pixels.
        heights: height of the ball in each frame, m.
        noise: standard deviation of z, m.
        part: frames to record, those after the release of the ball.
        video: path of the film, for the title.
    """
    pixels = {"u": track.u, "v": track.v, "radius_px": track.radius}
    run = Run(
        "1",
        make_read_only(track.times[part]),
        channels={"z": make_read_only(heights.z[part])},
        inputs={},
        constants={},
        initial={},
        held_out=False,
        extra={name: make_read_only(values[part]) for name, values in pixels.items()},
    )
    title = f"{video.name}, tracked; z {heights.method}"
    constants = {"radius": heights.radius, "gravity": ball_heights.DEFAULT_GRAVITY}
    extra_units = dict.fromkeys(pixels, "px")
    return Recording(Path(), BallSystem.name, title, constants, {"z": noise}, (run,), extra_units)
