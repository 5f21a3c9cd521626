"""Track the ball through the frames of a film, and link detections to one path per object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sims.core.noise_estimation import NOISE_WINDOW_SAMPLES, estimate_roughness
from sims.core.simulator import Array, InputError
from sims.vision import background_model, film_cuts
from sims.vision.ball_detection import BallDetection, BallDetector, make_detector
from sims.vision.ball_renderer import RgbImage
from sims.vision.video_files import FrameCache

_MAX_MISSED_FRAMES = 15
"""Maximum number of consecutive frames in which an object may be missed."""
_RADIUS_RATIO_RANGE = (0.65, 1.55)
"""Range of the ratio of two radii of one object, which approaches the camera or is blurred."""
_MIN_PATH_FRAMES = 3
"""Minimum number of frames of a path; shorter ones are noise."""
_RANDOM_RAY_AGREEMENT = 0.5
"""Fraction of the rays that agree on a circle at random."""
_COLOUR_MEMORY_FRAMES = 20
"""Number of frames over which the colour of a path is averaged."""
_COLOUR_TOLERANCE = 25.0
"""Tolerance of the colour of an object, in grey levels."""
_CONTRAST_TOLERANCE_SHARE = 0.45
"""Tolerance of the colour of an object, as a fraction of its contrast with the background."""
_MAX_CONTINUATION_DISTANCE = 3
"""Maximum distance of a continuation from the line of a path, in median radii."""
_CHROMA_BLUR_PIXELS = 1.5
"""Width in pixels over which video files mix the colours of ball and background.

Video files store colours at half the resolution.
"""
_SIMILAR_RADIUS_RATIOS = (0.4, 2.5)
"""Ratios of the radii of two moving objects between which they may be taken for each other."""

_MAX_RADIUS_DEVIATION = 0.2
"""Maximum relative deviation of a radius from the linear trend along its path."""
_REWEIGHTING_ITERATIONS = 10
"""Number of iterations of reweighted least squares."""
_MIN_RADIUS_UNCERTAINTY = 0.02
"""Lower limit of the uncertainty of a radius, in pixels."""


@dataclass
class TrackedPath:
    """Path of one object: frame numbers, detections and mean colour."""

    frames: list[int] = field(default_factory=list)
    detections: list[BallDetection] = field(default_factory=list)
    mean_colour: Array = field(default_factory=lambda: np.zeros(3))

    def append(self, frame: int, detection: BallDetection) -> None:
        """Append a detection, and update the mean colour.

        Args:
            frame: Number of the frame.
            detection: Detection in that frame.
        """
        # A plain mean at first, later an exponential one, because the light changes along the path.
        count = len(self.detections) + 1
        weight = 1.0 / min(count, _COLOUR_MEMORY_FRAMES)
        colour = np.array(detection.colour)
        self.mean_colour = (1.0 - weight) * self.mean_colour + weight * colour
        self.frames.append(frame)
        self.detections.append(detection)

    def predict(self, frame: int) -> tuple[float, float, float]:
        """Predict the position in a frame by linear extrapolation of the last two detections.

        A single detection shows no velocity; its position is returned, and the ball may be up to
        4 radii and 10 pixels away.

        Args:
            frame: Number of the frame.

        Returns:
            Position u and v, and the maximum distance of a detection from it, which allows for a
            bounce; pixels.
        """
        last = self.detections[-1]
        if len(self.detections) < 2:
            return last.u, last.v, 4 * last.radius + 10
        previous = self.detections[-2]
        frames_between = self.frames[-1] - self.frames[-2]
        # Velocity in pixels per frame.
        du = (last.u - previous.u) / frames_between
        dv = (last.v - previous.v) / frames_between
        frames_ahead = frame - self.frames[-1]
        # Twice the distance covered: an object that reverses is that far from its prediction.
        reach = 2 * float(np.hypot(du, dv)) * frames_ahead + last.radius + 2
        return last.u + du * frames_ahead, last.v + dv * frames_ahead, reach

    def compute_distance(self, frame: int, detection: BallDetection) -> float:
        """Return how far a detection is from continuing this path.

        It is the distance from the predicted position plus the difference from the mean colour,
        each as a fraction of the largest allowed one. Colour separates a ball from its shadow where
        they meet and the shadow continues as the ball moved before.

        Args:
            frame: Number of the frame.
            detection: Detection in that frame.

        Returns:
            Distance from 0 to 2; infinite if position, radius or colour are those of another
            object.
        """
        u, v, reach = self.predict(frame)
        position_distance = float(np.hypot(detection.u - u, detection.v - v)) / reach
        if position_distance > 1:
            return np.inf
        low, high = _RADIUS_RATIO_RANGE
        if not low < detection.radius / self.detections[-1].radius < high:
            return np.inf
        colour_distance = self.compute_colour_distance(detection.colour, detection.contrast)
        return position_distance + colour_distance if colour_distance <= 1 else np.inf

    def compute_colour_distance(self, colour: Sequence[float], contrast: float) -> float:
        """Return the difference of a colour from the mean colour of the path.

        It is the largest difference of the three colours as a fraction of a tolerance, which allows
        for changes of the light, for compression, and for a share of the larger contrast.

        Args:
            colour: Red, green and blue of an object, grey levels.
            contrast: Contrast of that object with the background, grey levels.
        """
        # The smaller the ball, the more of it is mixed with the background.
        min_tolerance = _COLOUR_TOLERANCE * (1.0 + _CHROMA_BLUR_PIXELS / self.detections[-1].radius)
        tolerance = max(
            min_tolerance,
            _CONTRAST_TOLERANCE_SHARE * contrast,
            _CONTRAST_TOLERANCE_SHARE * self.contrast,
        )
        differences = np.abs(self.mean_colour - colour)
        return float(differences.max()) / tolerance

    @property
    def contrast(self) -> float:
        """Contrast of the last detection with the background, grey levels."""
        return self.detections[-1].contrast

    @property
    def radius(self) -> float:
        """Median radius of the detections, pixels."""
        return float(np.median([s.radius for s in self.detections]))

    @property
    def places(self) -> Array:
        """Centres of the detections (n, 2), pixels."""
        return np.array([(s.u, s.v) for s in self.detections])

    @property
    def travel(self) -> float:
        """Extent of the path, as the diagonal of its bounding box in pixels."""
        spans = np.ptp(self.places, axis=0)
        return float(np.linalg.norm(spans))

    @property
    def evidence(self) -> float:
        """Evidence for the path: length of edge on circles beyond that of random edges, in pixels.

        It grows with the number, the roundness and the radius of the detections. A count of frames
        alone would prefer a permanent remnant of shadow to a ball.
        """
        return sum(
            (detection.ray_agreement - _RANDOM_RAY_AGREEMENT) * detection.radius
            for detection in self.detections
        )


def link_detections(pictures: Sequence[Sequence[BallDetection]]) -> list[TrackedPath]:
    """Link the detections in successive frames to paths, one for each object.

    A path ends if its object is missed in more than `_MAX_MISSED_FRAMES` successive frames. Paths
    of fewer than `_MIN_PATH_FRAMES` frames are left out.

    Args:
        pictures: Detections in each frame.

    Returns:
        Paths, the one with most evidence first; objects that hardly move come last.
    """
    finished_paths: list[TrackedPath] = []
    active_paths: list[TrackedPath] = []
    for frame, detections in enumerate(pictures):
        finished_paths += [
            path for path in active_paths if frame - path.frames[-1] > _MAX_MISSED_FRAMES
        ]
        active_paths = [
            path for path in active_paths if frame - path.frames[-1] <= _MAX_MISSED_FRAMES
        ]
        used_detections = _extend_paths(active_paths, frame, detections)
        # Each remaining detection begins a new path.
        for index, detection in enumerate(detections):
            if index not in used_detections:
                path = TrackedPath()
                path.append(frame, detection)
                active_paths.append(path)
    paths = [path for path in finished_paths + active_paths if len(path.frames) >= _MIN_PATH_FRAMES]
    # Most evidence first. An object that travels less than its radius counts as one without
    # evidence.
    return sorted(paths, key=lambda path: -path.evidence * (path.travel > path.radius))


def _extend_paths(
    active_paths: Sequence[TrackedPath], frame: int, detections: Sequence[BallDetection]
) -> set[int]:
    """Append each detection in a frame to the path that it fits best.

    All pairs of a path and a detection are taken in the order of their distance. A path gets at
    most one detection, and a detection is appended to at most one path.

    Args:
        active_paths: Paths that may continue, extended in place.
        frame: Number of the frame.
        detections: Detections in that frame.

    Returns:
        Indices of the detections that were appended.
    """
    # Distances of the detections that may be the object of a path.
    pairs = []
    for path_index, path in enumerate(active_paths):
        for detection_index, detection in enumerate(detections):
            distance = path.compute_distance(frame, detection)
            if np.isfinite(distance):
                pairs.append((distance, path_index, detection_index))
    extended_paths: set[int] = set()
    used_detections: set[int] = set()
    for _, path_index, detection_index in sorted(pairs):
        if path_index in extended_paths or detection_index in used_detections:
            continue
        extended_paths.add(path_index)
        used_detections.add(detection_index)
        active_paths[path_index].append(frame, detections[detection_index])
    return used_detections


def merge_continuations(paths: Sequence[TrackedPath]) -> tuple[TrackedPath, list[TrackedPath]]:
    """Merge the first path with those that continue it after it was lost from view.

    A path continues the first one if it has a similar radius and colour, lies near the straight
    line fitted to the first one, and has no frame in common with it: a ball is in one place at a
    time.

    Args:
        paths: Paths, the best first.

    Returns:
        The merged path, ordered by frames, and the other paths.
    """
    main = paths[0]
    other_paths = []
    frames = list(main.frames)
    detections = list(main.detections)
    low, high = _RADIUS_RATIO_RANGE
    for path in paths[1:]:
        is_disjoint = not set(path.frames) & set(frames)
        is_similar = low < path.radius / main.radius < high
        is_similar &= main.compute_colour_distance(path.mean_colour.tolist(), path.contrast) <= 1
        line_distance = _compute_median_distance(main.places, path.places)
        if is_disjoint and is_similar and line_distance < _MAX_CONTINUATION_DISTANCE * main.radius:
            frames += path.frames
            detections += path.detections
        else:
            other_paths.append(path)
    order = np.argsort(frames).tolist()
    merged_path = TrackedPath(
        [frames[i] for i in order],
        [detections[i] for i in order],
        main.mean_colour,
    )
    return merged_path, other_paths


def _compute_median_distance(line: Array, points: Array) -> float:
    """Return the median distance of points from the line fitted to other points.

    Args:
        line: Points (n, 2) that determine the line, pixels.
        points: Points (m, 2) whose distance is measured, pixels.
    """
    middle = line.mean(axis=0)
    # The last principal axis is perpendicular to the line: along it, the points differ least.
    _, _, axes = np.linalg.svd(line - middle, full_matrices=False)
    distances = (points - middle) @ axes[-1]
    return float(np.median(np.abs(distances)))


@dataclass(frozen=True)
class BallTrack:
    """Tracked ball.

    Attributes:
        times: (n,) times of the frames of one shot, s.
        u: (n,) horizontal position relative to the upper left pixel's centre, pixels; NaN in frames
            without a ball.
        v: (n,) position downwards, pixels.
        radius: (n,) radius of the ball's outline, pixels.
        noise: Standard deviation of u and v in pixels, estimated from the path.
        size: Width and height of the picture, pixels.
        notes: Remarks for the user, in sentences.
        background: Scene without the ball.
        pictures: Some of the frames, by number.
    """

    times: Array
    u: Array
    v: Array
    radius: Array
    noise: float
    size: tuple[int, int]
    notes: tuple[str, ...]
    background: RgbImage = field(repr=False)
    pictures: dict[int, RgbImage] = field(repr=False)

    @property
    def visible_frames(self) -> NDArray[np.intp]:
        """Numbers of the frames that show the ball."""
        return np.flatnonzero(np.isfinite(self.u))


def track_ball(frames: Iterable[tuple[float, RgbImage]]) -> BallTrack:
    """Track the ball that moves in front of a fixed camera.

    The steps are: find cuts and keep the longest part without one, estimate the background, detect
    round objects in each frame, link them to paths, and choose the path of the ball.

    Args:
        frames: Time in seconds and picture (height, width, 3) of each frame; iterated three times.

    Raises:
        InputError: No ball is found, or the part without a cut is too short.
    """
    frames = FrameCache(frames)
    survey = film_cuts.survey_frames(frames)
    notes: list[str] = []
    first_frame, end_frame = film_cuts.find_longest_shot(survey, notes)
    sample_frames = [
        first_frame + k for k in background_model.select_frames(survey.moved[first_frame:end_frame])
    ]
    sample_set = set(sample_frames)
    pictures = [picture for number, (_, picture) in enumerate(frames) if number in sample_set]
    detector = make_detector(pictures)
    # Detections in each frame of the part without a cut.
    detections = []
    for number, (_, picture) in enumerate(frames):
        if first_frame <= number < end_frame:
            detections.append(detector.detect(picture))
    paths = link_detections(detections)
    if not paths:
        raise InputError(
            _format_no_ball_message(end_frame - first_frame, sum(map(bool, detections)))
        )
    path, other_paths = merge_continuations(paths)
    # The fall of an object that hardly moves, or is seen in few frames, cannot be measured.
    if len(path.frames) < film_cuts.MIN_FRAMES or path.travel < path.radius:
        raise InputError(_format_no_ball_message(end_frame - first_frame, len(path.frames)))
    _note_other_objects(path, other_paths, notes)
    # Numbers of the frames count from the first frame of the part that is tracked.
    sample_pictures = {
        number - first_frame: picture
        for number, picture in zip(sample_frames, pictures, strict=True)
    }
    return _make_track(
        survey.times[first_frame:end_frame], path, survey.size, notes, detector, sample_pictures
    )


def _format_no_ball_message(frames: int, frames_with_objects: int) -> str:
    """Format the message that no ball was found.

    Args:
        frames: Number of frames.
        frames_with_objects: Number of frames with a round object.
    """
    observation = "nothing"
    if frames_with_objects:
        observation = f"something round in {frames_with_objects} of {frames} frames, but nothing"
    return (
        f"no ball found: {observation} that moves and stays round; "
        "film with a fixed camera and a ball unlike its background"
    )


def _note_other_objects(
    path: TrackedPath, other_paths: Sequence[TrackedPath], notes: list[str]
) -> None:
    """Add a note if a second object of similar size moves at the same time as the ball.

    It must appear in at least 8 frames and a quarter of the ball's frames, and travel more than its
    diameter. The user then knows that the tracker may have chosen the wrong object.

    Args:
        path: path of the ball.
        other_paths: paths of all other objects.
        notes: remarks for the user, extended in place.
    """
    frames = set(path.frames)
    for other_path in other_paths:
        shared_count = len(frames & set(other_path.frames))
        # A brief, small or resting object is not a second ball.
        is_simultaneous = shared_count >= max(8, 0.25 * len(path.frames))
        is_moving = other_path.travel > 2 * other_path.radius
        smallest, largest = _SIMILAR_RADIUS_RATIOS
        is_similar = smallest < other_path.radius / path.radius < largest
        if is_simultaneous and is_moving and is_similar:
            notes.append(
                f"a second ball, or its shadow, moves in {shared_count} of the same frames; "
                "the clearer one is tracked"
            )
            return


def _make_track(
    times: Array,
    path: TrackedPath,
    size: tuple[int, int],
    notes: list[str],
    detector: BallDetector,
    pictures: dict[int, RgbImage],
) -> BallTrack:
    """Make the track of the ball from its path, with noise estimate and notes.

    Centres are refitted with smoothed radii. Frames in which another object was measured have no
    position, since that is better than a wrong one.

    Args:
        times: (n,) times of the frames, s.
        path: Path of the ball.
        size: Width and height of the picture, pixels.
        notes: Remarks so far, extended in place.
        detector: Detector, which has the background.
        pictures: Some of the frames, by number.
    """
    u, v, radius = np.full((3, len(times)), np.nan)
    refined_detections, are_misfits = _refine_with_smooth_radius(path.detections)
    for frame, detection, is_misfit in zip(
        path.frames, refined_detections, are_misfits, strict=True
    ):
        if not is_misfit:
            u[frame], v[frame], radius[frame] = detection.u, detection.v, detection.radius
    missing_count = int(np.isnan(u).sum())
    if missing_count:
        notes.append(
            f"{missing_count} of {len(times)} frames show no measurable ball; their cells are empty"
        )
    noise = np.nan
    if len(times) > NOISE_WINDOW_SAMPLES:
        noise = max(estimate_roughness(u), estimate_roughness(v))
    # If the path is too short or at rest, use the distance of the edges from their circles.
    if not (np.isfinite(noise) and noise > 0):
        noise = float(np.median([detection.scatter for detection in path.detections]))
    return BallTrack(
        times,
        u,
        v,
        radius,
        noise,
        size,
        tuple(notes),
        detector.background,
        pictures,
    )


def _refine_with_smooth_radius(
    detections: list[BallDetection],
) -> tuple[list[BallDetection], list[bool]]:
    """Refit the centres with radii that change linearly along the path, as perspective implies.

    The linear trend of the radius is fitted by reweighted least squares. Few detections are
    returned unchanged.

    Returns:
        The refitted detections, and whether the radius of each deviates too much from the linear
        trend, which means that another object was measured.
    """
    if len(detections) < NOISE_WINDOW_SAMPLES:
        return detections, [False] * len(detections)
    centres = np.array([(detection.u, detection.v) for detection in detections])
    offsets = centres - centres.mean(axis=0)
    spread = np.maximum(np.ptp(centres, axis=0), 1.0)
    # Position along the path's main direction, about -1 to 1.
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    path_position = offsets @ axes[0] / spread.max()
    basis = np.stack([np.ones_like(path_position), path_position], axis=1)
    radius = np.array([s.radius for s in detections])
    weights = np.ones_like(radius)
    trend = np.zeros(2)
    for _ in range(_REWEIGHTING_ITERATIONS):
        weighted_basis = basis * weights[:, None]
        trend = np.linalg.lstsq(weighted_basis, radius * weights, rcond=None)[0]
        deviations = np.abs(radius - basis @ trend)
        # Weights with heavy tails: measurements of other objects must not affect the trend.
        width = max(float(np.median(deviations)), _MIN_RADIUS_UNCERTAINTY)
        weights = 1 / (1 + (deviations / width) ** 2)
    fitted = np.maximum(basis @ trend, 0.5)  # a trend may reach zero, a radius must not
    tolerance = np.maximum(_MAX_RADIUS_DEVIATION * fitted, 1.0)
    is_wrong = np.abs(radius - fitted) > tolerance
    refitted = [s.refit_with_radius(float(r)) for s, r in zip(detections, fitted, strict=True)]
    return refitted, is_wrong.tolist()
