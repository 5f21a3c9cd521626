"""Link the detections in many frames to paths, one path for each moving object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sims.core.simulator import Array
from sims.vision.ball_detection import BallDetection

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
        """Predict the position in a frame by linear extrapolation.

        With a single detection there is no velocity; then the ball may be up to 4 radii and
        10 pixels away.

        Args:
            frame: Number of the frame.

        Returns:
            Position (u, v), and the maximum distance of a detection from it, which allows for a
            bounce; pixels.
        """
        last = self.detections[-1]
        u, v = last.u, last.v
        # A single detection has no direction.
        if len(self.detections) < 2:
            return u, v, 4 * last.radius + 10
        previous = self.detections[-2]
        gap = self.frames[-1] - self.frames[-2]
        du = (u - previous.u) / gap
        dv = (v - previous.v) / gap
        frame_gap = frame - self.frames[-1]
        # Twice the distance covered: an object that reverses is that far from its prediction.
        speed = float(np.hypot(du, dv))
        reach = 2 * speed * frame_gap + last.radius + 2
        return u + du * frame_gap, v + dv * frame_gap, reach

    def compute_distance(self, frame: int, detection: BallDetection) -> float:
        """Return the distance of a detection from this path as a fraction of the allowed one.

        Position, radius and colour count; the result is infinite for another object. Colour
        separates a ball from its shadow where they meet and the shadow continues as the ball moved
        before.

        Args:
            frame: Number of the frame.
            detection: Detection in that frame.
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
        """Return the difference of a colour from that of the path as a fraction of the tolerance.

        The tolerance allows for light and compression.

        Args:
            colour: Red, green, blue, grey levels.
            contrast: Contrast with the background of the object of that colour, grey levels.
        """
        # The smaller the ball, the more of it is mixed with the background.
        tinge = _COLOUR_TOLERANCE * (1.0 + _CHROMA_BLUR_PIXELS / self.detections[-1].radius)
        tolerance = max(
            tinge,
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
        """Evidence for the path: length of edge on circles beyond chance level, in pixels.

        A count of frames alone would prefer a permanent remnant of shadow to a ball.
        """
        return sum(
            (detection.ray_agreement - _RANDOM_RAY_AGREEMENT) * detection.radius
            for detection in self.detections
        )


def link_detections(pictures: Sequence[Sequence[BallDetection]]) -> list[TrackedPath]:
    """Link detections to paths, the best path first; short paths are left out.

    Args:
        pictures: Detections in each frame.
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
        for k, detection in enumerate(detections):
            if k not in used_detections:
                path = TrackedPath()
                path.append(frame, detection)
                active_paths.append(path)
    paths = [path for path in finished_paths + active_paths if len(path.frames) >= _MIN_PATH_FRAMES]
    # Objects that do not move come last, regardless of their evidence.
    return sorted(paths, key=lambda path: -path.evidence * (path.travel > path.radius))


def _extend_paths(
    active_paths: Sequence[TrackedPath], frame: int, detections: Sequence[BallDetection]
) -> set[int]:
    """Append each detection in a frame to the path that it fits best, nearest pairs first.

    Args:
        active_paths: Paths that may continue.
        frame: Number of the frame.
        detections: Detections in that frame.

    Returns:
        Numbers of the detections that were appended.
    """
    pairs = []
    for i, path in enumerate(active_paths):
        for k, detection in enumerate(detections):
            distance = path.compute_distance(frame, detection)
            if np.isfinite(distance):
                pairs.append((distance, i, k))
    paths: set[int] = set()
    used_detections: set[int] = set()
    # Nearest pairs first: a path gets one detection, and a detection one path.
    for _, i, k in sorted(pairs):
        if i in paths or k in used_detections:
            continue
        paths.add(i)
        used_detections.add(k)
        active_paths[i].append(frame, detections[k])
    return used_detections


def merge_continuations(paths: Sequence[TrackedPath]) -> tuple[TrackedPath, list[TrackedPath]]:
    """Merge the first path with those that continue it after it was lost from view.

    Args:
        paths: Paths, the best first.

    Returns:
        The merged path, and the other paths.
    """
    main = paths[0]
    other_paths = []
    frames = list(main.frames)
    detections = list(main.detections)
    low, high = _RADIUS_RATIO_RANGE
    for path in paths[1:]:
        # A ball is in one place: a detection in the same frame is another object.
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
        line: Points (n, 2) that determine the line.
        points: Points (m, 2).
    """
    middle = line.mean(axis=0)
    # The last axis is perpendicular to the line: along it, the points differ least.
    _, _, axes = np.linalg.svd(line - middle, full_matrices=False)
    distances = (points - middle) @ axes[-1]
    return float(np.median(np.abs(distances)))
