"""Track the ball in a film, convert its track to heights in metres, and write a recording.

If the camera is known, heights follow exactly. Otherwise: along the straight line of a vertical
fall the inverse depth, and so the ball's radius r in pixels, is linear in the position s in the
image, and height is a projective function of s. Together they leave one unknown factor S:

    z = radius + S (s_ground - s) / r(s)                (1)

For a level camera, S is the ball's radius in metres. A camera that looks down sees heights
shortened, but not the ball, so S is larger; then S follows from the fall itself, since the second
derivative of z must be -g.

With q = s / r(s), and since r is linear in s, (1) becomes, except for a constant factor that the
unknown S absorbs (g is gravity):

    z = radius + S (q_ground - q)                       (2)
    q'' = g / S in flight                               (3)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.core.files import check_absent
from sims.core.noise_estimation import estimate_roughness
from sims.core.number_limits import LENGTH_RANGE
from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.recording import Recording, Run
from sims.recording.recording_writer import write_recording
from sims.systems.ball import BallSystem
from sims.vision.ball_tracker import BallTrack, track_ball
from sims.vision.pinhole_camera import (
    FilmDescription,
    get_camera_file_path,
    read_camera_file,
)
from sims.vision.video_files import VideoFile

DEFAULT_GRAVITY = 9.81
"""Gravity assumed for a film, m/s^2."""
_MIN_FLIGHT_FRAMES = 7
"""Minimum number of frames of a flight; fewer do not determine a parabola."""
_MIN_FLIGHT_EXTENT = 0.3
"""Minimum extent of a flight, in ball radii, or in metres for heights."""
_MIN_HOLD_SECONDS = 0.25
"""Minimum duration in seconds for which a ball is held before its release."""
_REPORTED_SCALE_DIFFERENCE = 0.05
"""Relative difference between the scales from the fall and the diameter that is reported."""
_BOUNCE_SEARCH_SECONDS = 0.1
"""Time in seconds around the end of a flight and the start of the next in which they may meet."""
_REWEIGHTED_FITS = 3
"""Number of reweighted line fits to the radius after the first, unweighted fit."""

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


@dataclass(frozen=True)
class BallHeights:
    """Heights of a ball's centre over time.

    Attributes:
        z: (n,) heights in metres.
        radius: Radius of the ball in metres.
        method: Method by which heights were found.
        notes: Notes for the user.
    """

    z: Array
    radius: float
    method: str
    notes: tuple[str, ...] = ()


TrackFigureWriter = Callable[[BallTrack, BallHeights, slice, str], tuple[bytes, bytes | None]]
"""Draws a track, its heights, the recorded frames and a title, as a PNG and a PDF or None."""


class _Flight(NamedTuple):
    """A flight between bounces.

    Attributes:
        curve: Coefficients of its parabola, highest power first.
        begin: Time of its first frame, s.
        end: Time of its last frame, s.
        weight: Inverse variance of its curvature, up to a constant factor.
    """

    curve: Array
    begin: float
    end: float
    weight: float


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

    first, last = find_release_frame(track), int(track.visible_frames[-1])
    # Frames of the recording: from the release to the last one that shows the ball.
    kept_frames = slice(first, last + 1)
    notes = [*film.notes, *track.notes, *heights.notes]
    # The ball is visible earlier, but held by a hand.
    if first > track.visible_frames[0]:
        until = f"the ball is held until {track.times[first]:.2f} s"
        notes.append(f"{until}; earlier frames are left out")
    noise = _estimate_sample_noise(track, heights, kept_frames)

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


def _convert_to_heights(
    track: BallTrack, video: Path, diameter: float | None, scale: str | None
) -> BallHeights:
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
        return compute_heights_by_camera(track, read_camera_file(camera_file))
    if scale == "diameter" and diameter is None:
        raise InputError("scale diameter: expected the ball's diameter in metres")
    return compute_heights_by_scale(track, diameter, scale)


def compute_heights_by_camera(track: BallTrack, filmed: FilmDescription) -> BallHeights:
    """Compute heights with the known camera of the film.

    Args:
        track: Track of the ball in the image.
        filmed: Camera, radius and horizontal position of the ball.

    Raises:
        InputError: The camera's image has another aspect ratio than the film.
    """
    camera = filmed.camera
    (width, height), (film_width, film_height) = camera.size, track.size
    if width * film_height != height * film_width:
        sizes = f"the camera's picture has {camera.size} px, the film {track.size}"
        raise InputError(f"{sizes}; expected the same shape")
    # The film may have been resized, so the camera is resized with it.
    camera = replace(camera, size=track.size)
    z = camera.estimate_heights(
        np.stack([track.u, track.v], axis=1), filmed.x, filmed.y, filmed.radius
    )
    return BallHeights(z, filmed.radius, "through the known camera")


def compute_heights_by_scale(
    track: BallTrack, diameter: float | None, scale: str | None
) -> BallHeights:
    """Compute heights without a camera, scaled by the ball's diameter or by the fall.

    The heights are z = radius + S (q_ground - q) (2), where q is the position along the fall
    (downwards positive) divided by the ball's radius, both in pixels. The unknown factor S is the
    known radius in metres, which holds for a level camera, or the factor with which the ball falls
    at g. If both are known but differ, a note says so.

    Args:
        track: Track of the ball in the image.
        diameter: Diameter of the ball in metres; None to scale by the fall.
        scale: "fall" to scale by the fall although a diameter is given; any other value leaves the
            choice to `diameter`.

    Raises:
        InputError: The film does not show what the method needs.
    """
    q = _compute_fall_position(track) / _smooth_radius(track)
    flights = _fit_free_flights(track.times, q)
    q_ground = _estimate_ground_position(track, q, flights)
    factor_by_fall = _compute_gravity_scale(flights)
    notes = []
    if diameter is None or scale == "fall":
        if factor_by_fall is None:
            raise InputError(
                "the scale is unknown: no flight of this film shows gravity clearly; "
                "give the ball's diameter"
            )
        factor = factor_by_fall
        method = f"scaled by the fall (gravity {DEFAULT_GRAVITY:g} m/s²; drag would bias the scale)"
        # Without a diameter, assume the radius that a level camera would give.
        radius = diameter / 2 if diameter else factor
    else:
        factor = radius = diameter / 2
        method = "scaled by the ball's diameter, for a horizontal camera"
        # Relative difference of the two scales.
        difference = 0.0 if factor_by_fall is None else factor_by_fall / factor - 1
        if abs(difference) > _REPORTED_SCALE_DIFFERENCE:
            notes.append(
                f"the fall gives {difference:+.0%} for all heights: the camera is tilted, "
                "or gravity is not 9.81 m/s²; the scale 'fall' uses the fall"
            )
    z = radius + factor * (q_ground - q)  # Equation (2).
    return BallHeights(z, radius, method, tuple(notes))


def _compute_fall_position(track: BallTrack) -> Array:
    """Return the position (T,) along the line of the fall, downwards positive, in pixels.

    A camera may be rolled, so the line need not be vertical in the image. It is the direction in
    which the centres of the ball vary most.

    Args:
        track: Centres (u, v) of the ball in the T frames.

    Raises:
        InputError: The line is less than 30 degrees from the horizontal.
    """
    visible_frames = track.visible_frames
    points = np.stack([track.u[visible_frames], track.v[visible_frames]], axis=1)
    middle = points.mean(axis=0)
    # The line of the fall is the first principal axis of the points; v counts downwards.
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    axis = axes[0] if axes[0][1] >= 0 else -axes[0]
    # The axis has length one, so 0.5 is the sine of 30 degrees.
    if axis[1] < 0.5:
        raise InputError(
            "the ball moves across the picture rather than down; expected a drop filmed upright"
        )
    result: Array = (np.stack([track.u, track.v], axis=1) - middle) @ axis
    return result


def _smooth_radius(track: BallTrack) -> Array:
    """Smooth the radius (T,) of the ball in pixels, as a linear function of its position.

    Along a straight fall, the inverse depth and so the radius is linear in the position. The
    outline in a single frame is too noisy, so a line is fitted to the radii of all frames. It is
    fitted several times; frames far from the previous line get a small weight.

    Args:
        track: Centres and radii of the ball in the frames.
    """
    fall_position, visible_frames = _compute_fall_position(track), track.visible_frames
    positions, radii = fall_position[visible_frames], track.radius[visible_frames]
    line = np.polyfit(positions, radii, 1)
    for _ in range(_REWEIGHTED_FITS):
        deviations = np.abs(radii - np.polyval(line, positions))
        # A frame whose outline is far off, as at an impact, gets a small weight.
        typical_deviation = max(float(np.median(deviations)), 1e-9)
        line = np.polyfit(positions, radii, 1, w=1 / (1 + (deviations / typical_deviation) ** 2))
    # The line may cross zero outside the frames that show the ball; a radius may not. So it is at
    # least 0.3 of its median.
    result: Array = np.maximum(np.polyval(line, fall_position), 0.3 * float(np.median(radii)))
    return result


def _fit_free_flights(times: Array, q: Array) -> list[_Flight]:
    """Divide the motion of the ball at its bounces, and fit a parabola to each free flight.

    A bounce is a frame in which the ball is lower than in the frames next to it. The parts between
    bounces that are too short, or do not fit a parabola, are left out.

    Args:
        times: (T,) times of the frames, s.
        q: (T,) position downwards, in ball radii or metres; NaN where the ball was not detected.

    Returns:
        The flights in order: parabola q(t), times of the first and last frame, and weight.
    """
    visible_frames = np.flatnonzero(np.isfinite(q))
    last_index = len(visible_frames) - 1
    # q counts downwards: the ball is lowest where q is largest. Bounces and the two ends are
    # indices into visible_frames.
    bounces = [
        i
        for i in range(1, last_index)
        if q[visible_frames[i - 1]] < q[visible_frames[i]] >= q[visible_frames[i + 1]]
    ]
    flights = []
    for begin, end in pairwise([0, *bounces, last_index]):
        # The frame of the bounce itself belongs to no flight.
        first = begin if begin == 0 else begin + 1
        last = end if end == last_index else end - 1
        flight_frames = visible_frames[first : last + 1]
        if len(flight_frames) < _MIN_FLIGHT_FRAMES or np.ptp(q[flight_frames]) < _MIN_FLIGHT_EXTENT:
            continue
        flight_times = times[flight_frames]
        curve, squared_residuals, *_ = np.polyfit(flight_times, q[flight_frames], 2, full=True)
        # NumPy returns no residual if the points do not determine the parabola.
        scatter = np.sqrt(squared_residuals[0] / len(flight_times)) if len(squared_residuals) else 0
        # A motion that is not a parabola is not a flight, but a hand, a roll or another ball.
        # Admitted are 5 % of the extent, and 0.02 for errors of the outline.
        if scatter < 0.05 * np.ptp(q[flight_frames]) + 0.02:
            # The variance of a parabola's curvature goes as 1 / (n T^4), for n samples in T.
            weight = len(flight_times) * float(flight_times[-1] - flight_times[0]) ** 4
            flights.append(_Flight(curve, flight_times[0], flight_times[-1], weight))
    return flights


def _compute_gravity_scale(flights: list[_Flight]) -> float | None:
    """Return the factor S for which the flights fall with gravity; None without a falling flight.

    S converts positions q, in ball radii and downwards positive, to metres: q'' = g / S (3). The
    mean of q'' over all flights is weighted by the accuracy of each flight.

    Args:
        flights: parabolas q(t) of the flights; the first coefficient is q'' / 2.
    """
    falling_flights = [flight for flight in flights if flight.curve[0] > 0]
    if not falling_flights:
        return None
    accelerations = [2 * flight.curve[0] for flight in falling_flights]  # q''
    mean = np.average(accelerations, weights=[flight.weight for flight in falling_flights])
    return float(DEFAULT_GRAVITY / mean)  # Equation (3): q'' = g / S.


def _estimate_ground_position(track: BallTrack, q: Array, flights: list[_Flight]) -> float:
    """Return the position q, in ball radii, at which the ball touches the ground.

    It is where two successive flights meet: the bounce itself falls between two frames, so the
    parabolas of the flights before and after it are extended until they intersect. The median over
    all bounces is returned. If no two flights meet, it is the 99.5 % quantile of the positions,
    about the lowest one.

    Args:
        track: the tracked ball, with the times of the frames.
        q: (T,) position downwards, in ball radii; NaN where the ball was not detected.
        flights: fitted flights in order.
    """
    crossings = []
    for earlier, later in pairwise(flights):
        intersection_times = np.roots(earlier.curve - later.curve)
        # Two parabolas have up to two intersections: the bounce, and one outside both flights.
        begin, end = earlier.end - _BOUNCE_SEARCH_SECONDS, later.begin + _BOUNCE_SEARCH_SECONDS
        # Roots with a smaller imaginary part are real up to rounding.
        bounce_times = [
            t.real for t in intersection_times if abs(t.imag) < 1e-9 and begin < t.real < end
        ]
        if bounce_times:
            crossings.append(float(np.polyval(earlier.curve, bounce_times[0])))
    if crossings:
        return float(np.median(crossings))
    # A quantile instead of the maximum ignores frames with tracking errors.
    return float(np.nanpercentile(q, 99.5)) if len(track.visible_frames) else 0.0


def find_release_frame(track: BallTrack) -> int:
    """Find the frame at which the ball begins to move; the first one unless it is held before.

    A hand may hold the ball at the beginning of the film. It counts as held if it stays for at
    least `_MIN_HOLD_SECONDS`.

    Args:
        track: Centres of the ball in the frames of a film.
    """
    fall_position, visible_frames = _compute_fall_position(track), track.visible_frames
    # Five frames, so that an error in one of them does not matter.
    start = float(np.median(fall_position[visible_frames[:5]]))
    # Motion up to a pixel, or four standard deviations of the noise, is a trembling hand or an
    # error of the outline, not a fall.
    is_moved = np.abs(fall_position[visible_frames] - start) > max(1.0, 4 * track.noise)
    first = int(visible_frames[0])
    if not is_moved.any():
        return first
    release = int(visible_frames[np.argmax(is_moved)])
    hold_seconds = track.times[release] - track.times[first]
    return first if hold_seconds < _MIN_HOLD_SECONDS else release


def _estimate_sample_noise(track: BallTrack, heights: BallHeights, part: slice) -> float:
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
                _estimate_flight_noise(track.times[part], heights_of_part),
                0.0,
            ]
        )
    )
    if noise > 0:
        return noise
    # A few frames give neither estimate: use the noise in pixels. The ratio of the radius in metres
    # to the median radius in pixels converts it.
    return track.noise * heights.radius / float(np.nanmedian(track.radius))


def _estimate_flight_noise(times: Array, z: Array) -> float:
    """Estimate the height noise from the residuals of a cubic fitted to each flight.

    A cubic can represent gravity and a drag. White noise estimated from neighbouring samples alone
    would miss the errors of a slowly changing outline, which last for several samples.

    Args:
        times: (n,) times, s.
        z: (n,) heights, m.

    Returns:
        Standard deviation (1 sigma) in m; NaN without a flight.
    """
    squares, degrees_of_freedom = 0.0, 0
    # Flights are fitted to positions that count downwards.
    for flight in _fit_free_flights(times, -z):
        is_in_flight = (times >= flight.begin) & (times <= flight.end) & np.isfinite(z)
        t = times[is_in_flight] - flight.begin
        if len(t) > _MIN_FLIGHT_FRAMES:
            cubic = np.polyfit(t, z[is_in_flight], 3)
            squares += float(np.sum((z[is_in_flight] - np.polyval(cubic, t)) ** 2))
            # Four coefficients are fitted.
            degrees_of_freedom += len(t) - 4
    return float(np.sqrt(squares / degrees_of_freedom)) if degrees_of_freedom else float("nan")


def _build_recording(
    track: BallTrack,
    heights: BallHeights,
    noise: float,
    part: slice,
    video: Path,
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
    constants = {"radius": heights.radius, "gravity": DEFAULT_GRAVITY}
    extra_units = dict.fromkeys(pixels, "px")
    return Recording(Path(), BallSystem.name, title, constants, {"z": noise}, (run,), extra_units)
