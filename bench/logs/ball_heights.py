"""Convert the track of a ball to heights in metres.

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

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError
from sims.vision.ball_tracker import BallTrack
from sims.vision.pinhole_camera import FilmDescription

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


def estimate_height_noise(times: Array, z: Array) -> float:
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
