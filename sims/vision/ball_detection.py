"""Detect round objects that differ from the background, with subpixel accuracy.

Pixels that differ are grouped to connected regions. A circle is fitted to the edge of each region.
The edge is located along rays from the centre where the difference has fallen to half of its value
inside: there the ball covers half of a pixel, whatever its colour. Rays that meet other things (a
shadow, the picture's edge, a patch of similar colour) are outliers of the circle and are ignored; a
region in which too few rays agree is not a ball.

`make_detector` estimates the background of a film and makes its detector.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.vision import background_model, circle_fit
from sims.vision.ball_renderer import RgbImage
from sims.vision.circle_fit import Circle
from sims.vision.video_files import import_package

_RAY_COUNT = 36
"""Number of rays, evenly spaced over the full circle, along which an edge is located."""
_MIN_REGION_AREA = 6
"""Minimum area of a region in pixels; smaller ones are noise."""
_MIN_THRESHOLD = 12.0
"""Minimum threshold of the difference in grey levels, because compression adds noise."""
_MIN_RAY_AGREEMENT = 0.6
"""Minimum fraction of the rays that must agree on a circle."""
_GOOD_RAY_AGREEMENT = 0.85
"""Fraction of agreeing rays below which a fit from arcs is also tried, as shadows bias circles."""
_MAX_REGIONS = 4
"""Maximum number of regions per picture that are measured, the largest first."""
_MIN_RAY_RADIUS = 2.5
"""Radius in pixels below which a region is too small for rays."""
_MAX_EDGE_ITERATIONS = 3
"""Maximum number of iterations of edge location and circle fit."""
_CONVERGED_PIXELS = 0.02
"""Change of a circle in pixels below which the iteration ends."""
_RAY_SAMPLE_SPACING = 0.25
"""Spacing of samples along a ray, pixels."""
_UNSHADED_RIM_PIXELS = 5
"""Width in pixels of the line around a region in which nothing is treated as shadow."""
_SURROUNDINGS_RADII = 1.6
"""Distance from the centre at which a region's surroundings are sampled, in radii."""
_SHADOW_FACTOR_RANGE = (0.25, 0.97)
"""Range of brightness factors of shadow; darker is an object, lighter is noise."""
_MAX_SHADOW_DEVIATION = 6.0
"""Maximum deviation of the colours from a common factor for shadow, grey levels."""
_PADDING_VALUE = -1000.0
"""Value for pixels outside the picture, far below every difference."""
_MIN_REFIT_RAY_SHARE = 0.4
"""Smallest share of rays with an edge point from which a centre is refitted."""
_RAY_SHARES = (0.7, 1.5)
"""Beginning and end of the rays, as shares of the approximate radius."""
_RAY_MARGIN = 2
"""Distance, in pixels, by which a ray begins earlier and ends later, for small balls."""
_INNER_SHARES = (0.5, 0.7)
"""Part of a ray just inside the edge, as shares of the radius."""
_INNER_MARGINS = (3.5, 1.3)
"""Distances of this part from the edge, in pixels, for large balls.

The blur of the edge does not reach it.
"""
_MIN_BRIGHTNESS_LEVELS = 1.5
"""Brightness difference, in detection levels, from which brightness replaces the worst colour."""
_MIN_BRIGHTNESS_SHARE = 0.7
"""Smallest share of the worst colour's difference at which brightness replaces it."""
_MIN_EDGE_LEVELS = 0.4
"""Smallest half height of an edge, and smallest difference of a small ball's pixel, in levels."""
_SMALL_BALL_MARGIN = 2.5
"""Distance from the edge of a small ball, in pixels, within which pixels are summed."""
_CENTRE_PATCH_SHARE = 0.4
"""Half width of the patch that shows the colour of a ball, as a share of its radius."""

_COMPARED_FRAMES = 8
"""Approximate number of frames on which both treatments of shadows are compared."""

_MIN_SHADOW_REMOVAL_RATIO = 0.8
"""Minimum ratio of the ray agreement with and without shadow removal at which it is used."""

_MIN_EMPTY_FRAMES = 3
"""Minimum number of frames without an object that prove that it is in the background estimate."""

_SAME_CENTRE_SHARE = 0.3
"""Distance of the centres of two circles at rest that are one object, as a share of the radius."""

_SAME_RADIUS_RATIOS = (0.7, 1.4)
"""Ratios of the radii of two circles between which they may be one object."""

GreyLevels: TypeAlias = NDArray[np.float32]
"""Grey levels, or positions in pixels."""
Mask: TypeAlias = NDArray[np.bool_]


class BallDetection(NamedTuple):
    """Detected ball.

    Attributes:
        u: Horizontal position of the centre, pixels.
        v: Vertical position of the centre, pixels.
        radius: Radius of the outline, pixels.
        ray_agreement: Fraction of the rays that agree on the circle.
        scatter: RMS distance of the agreeing edge points from the circle, pixels.
        edges: Edge points (n, 2) to which the circle was fitted; none for a ball of a few pixels.
        colour: Mean colour at the centre, grey levels.
        contrast: Difference of that colour from the background, grey levels.
        is_ghost: Whether it is a ball or shadow in the background image that the picture lacks.
    """

    u: float
    v: float
    radius: float
    ray_agreement: float
    scatter: float
    edges: Array = np.empty((0, 2))
    colour: tuple[float, ...] = (0.0, 0.0, 0.0)
    contrast: float = 0.0
    is_ghost: bool = False

    def refit_with_radius(self, radius: float) -> BallDetection:
        """Return the detection with its centre refitted for a radius known from other pictures.

        If shade hides a part of the edge, a fit with free radius shifts both centre and radius;
        here only the centre is fitted. The detection is returned unchanged if the edge points are
        too few or do not determine a centre, or the fit moves to the edge of another object.

        Args:
            radius: Known radius, pixels.
        """
        # Too few edge points, such as none of a ball of a few pixels.
        if len(self.edges) < _MIN_REFIT_RAY_SHARE * _RAY_COUNT:
            return self
        centre = circle_fit.fit_centre(self.edges, (self.u, self.v), radius)
        # So far away, the circle follows the edge of another object.
        if centre is None or np.hypot(centre[0] - self.u, centre[1] - self.v) > 0.5 * radius:
            return self
        return self._replace(u=centre[0], v=centre[1])


def make_detector(pictures: list[RgbImage]) -> BallDetector:
    """Make a detector of balls, with a background estimated from some pictures.

    The background is first the median of the pictures. Twice, the objects are detected with it, and
    it is estimated again without the pixels that they hide. The detector removes shadows if about
    as many round objects are found with that as without.

    Args:
        pictures: Some pictures (height, width, 3) of the film.
    """
    background = background_model.compute_median_background(pictures)
    # Both treatments of shadows are compared on some of the pictures.
    stride = max(1, len(pictures) // _COMPARED_FRAMES)
    # Two passes: objects hidden by the first background are detected with the second.
    for _ in range(2):
        sigma = background_model.estimate_camera_noise(pictures, background)
        shadow_detector = BallDetector(background, sigma, shadows=True)
        plain_detector = BallDetector(background, sigma, shadows=False)
        # Ghosts show where the background still contains an object.
        shadow_detections = [shadow_detector.detect(p, ghosts=True) for p in pictures[::stride]]
        plain_detections = [plain_detector.detect(p, ghosts=True) for p in pictures[::stride]]
        # A ball of the ground's hue would be removed as shadow; then shadows must be tolerated.
        min_roundness = _MIN_SHADOW_REMOVAL_RATIO * _compute_roundness(plain_detections)
        if _compute_roundness(shadow_detections) >= min_roundness:
            detector, known_detections = shadow_detector, shadow_detections
        else:
            detector, known_detections = plain_detector, plain_detections
        detections = []
        for i, picture in enumerate(pictures):
            if i % stride == 0:
                detections.append(known_detections[i // stride])
            else:
                detections.append(detector.detect(picture, ghosts=True))
        hiding_circles = _list_hiding_circles(detections)
        shadow_masks = None
        if detector.shadows:
            # If a shadow of the background is missing in some pictures, these show the true
            # background; the shadow hides it in the others.
            is_lit = np.stack([detector.find_missing_shadow(picture) for picture in pictures])
            shadow_masks = ~is_lit & (is_lit.sum(axis=0) >= _MIN_EMPTY_FRAMES)
        background = background_model.compute_masked_background(
            pictures, hiding_circles, background, shadow_masks
        )
    return BallDetector(background, sigma, detector.shadows)


def _compute_roundness(pictures: list[list[BallDetection]]) -> float:
    """Return how round the detected objects are: the sum over pictures of the best ray agreement.

    The ray agreement of a detection is the fraction of rays from its centre that meet the edge on
    a circle.

    Args:
        pictures: Detections in each picture; ghosts (objects in the background image that the
            picture lacks) do not count.
    """
    return sum(
        max(
            (detection.ray_agreement for detection in detections if not detection.is_ghost),
            default=0.0,
        )
        for detections in pictures
    )


def _list_hiding_circles(detections: list[list[BallDetection]]) -> list[list[Circle]]:
    """Return the circles that hide the true background in each picture.

    They are the detected objects, and objects in the present estimate of the background: a ball
    that rests for most of the film, or its shadow, is part of the median. In pictures without it,
    it is detected as a ghost; these show the true background, and all others are hidden there.

    Args:
        detections: detections in each picture, including ghosts.
    """
    hiding_circles: list[list[Circle]] = []
    ghosts: list[list[Circle]] = []
    for picture_detections in detections:
        hiding_circles.append([(d.u, d.v, d.radius) for d in picture_detections if not d.is_ghost])
        ghosts.append([(d.u, d.v, d.radius) for d in picture_detections if d.is_ghost])
    for ghost in [circle for circles in ghosts for circle in circles]:
        # Whether the object is missing in each picture.
        are_without_object = [
            any(_is_same_object(ghost, circle) for circle in circles) for circles in ghosts
        ]
        # In one or two pictures it may be missed by mistake.
        if sum(are_without_object) < _MIN_EMPTY_FRAMES:
            continue
        for circles, is_without_object in zip(hiding_circles, are_without_object, strict=True):
            if not is_without_object:
                circles.append(ghost)
    return hiding_circles


def _is_same_object(a: Circle, b: Circle) -> bool:
    """Return whether two circles are the same object at rest.

    The distance of their centres (sum of both coordinates) may be `_SAME_CENTRE_SHARE` of the
    radius and half a pixel, and their radii may differ by `_SAME_RADIUS_RATIOS`.

    Args:
        a: centre and radius of one circle, pixels.
        b: centre and radius of the other one.
    """
    u, v, radius = a
    other_u, other_v, other_radius = b
    distance = abs(u - other_u) + abs(v - other_v)
    min_ratio, max_ratio = _SAME_RADIUS_RATIOS
    is_near = distance < _SAME_CENTRE_SHARE * other_radius + 0.5
    return is_near and min_ratio < radius / other_radius < max_ratio


class BallDetector:
    """Detector of round objects in pictures of one scene."""

    def __init__(self, background: RgbImage, sigma: float, shadows: bool) -> None:
        """Precompute what every frame is compared with.

        `level` is the difference, in grey levels, from which a pixel counts as changed.
        `_float_background` is the background as floats, `_background_brightness` its brightness,
        and `_background_square` its squared length in colour space, at least 1.

        Args:
            background: Scene without the ball.
            sigma: Standard deviation of the noise, grey levels.
            shadows: Whether regions that are only darker than the background are treated as shadow;
                wrong for a ball of the ground's own hue.
        """
        self.background = background
        self.sigma = sigma
        self.shadows = shadows
        # With six sigma, none of ten thousand pixels exceeds the threshold by noise alone.
        self.level = max(_MIN_THRESHOLD, 6 * sigma)
        self._float_background = background.astype(np.float32)
        cv2 = import_package("cv2")
        self._background_brightness = cv2.cvtColor(background, cv2.COLOR_RGB2GRAY)
        squares = (self._float_background * self._float_background).sum(axis=2)
        self._background_square = np.maximum(squares, 1.0)

    def detect(self, picture: RgbImage, ghosts: bool = False) -> list[BallDetection]:
        """Detect round objects in a picture, those in the largest regions first.

        Pixels that differ clearly from the background image are joined to regions, without shadows
        if `shadows` is set. A circle is then fitted to each of the largest regions.

        Args:
            picture: Picture (height, width, 3).
            ghosts: Whether to include objects that only the background image has, such as a ball
                that lay there in the frames from which the background was estimated.
        """
        cv2 = import_package("cv2")
        difference = self._compute_largest_difference(picture)
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        brightness = cv2.absdiff(grey, self._background_brightness)
        mask = (difference > self.level).astype(np.uint8)
        if not mask.any():
            return []
        if self.shadows:
            shadow_mask = self._compute_brightness_ratio(picture, mask) > 0
            mask[shadow_mask] = 0
            # Remove single pixels that remain from shadow and noise.
            kernel = np.ones((2, 2), np.uint8)
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)
        else:
            shadow_mask = np.zeros(mask.shape, bool)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        # The largest regions are those with the longest contours; the index avoids that contours of
        # equal length are compared. Contours of up to three pixels are too small for a ball.
        lengths = [(len(c), i) for i, c in enumerate(contours) if len(c) > 3]
        longest_contours = sorted(lengths, reverse=True)[:_MAX_REGIONS]
        detections = []
        for _, i in longest_contours:
            detection = self._measure_object(contours[i], (brightness, difference), shadow_mask)
            if detection is not None:
                detections.append(self._add_colour(detection, picture))
        if ghosts:
            return detections
        return [detection for detection in detections if not detection.is_ghost]

    def _add_colour(self, detection: BallDetection, picture: RgbImage) -> BallDetection:
        """Add to a detection its colour, its contrast, and whether it is a ghost.

        A ghost is an object in the background image that the picture lacks.

        Args:
            detection: the detection.
            picture: picture (height, width, 3).
        """
        centre_colour = _compute_centre_colour(picture, detection)
        background_colour = _compute_centre_colour(self.background, detection)
        surrounding_colour = _compute_surrounding_colour(picture, detection)
        background_surrounding = _compute_surrounding_colour(self.background, detection)
        contrast = float(np.abs(centre_colour - background_colour).max())
        is_ghost = self._is_ghost(
            (centre_colour, surrounding_colour), (background_colour, background_surrounding)
        )
        return detection._replace(
            colour=tuple(centre_colour.tolist()), contrast=contrast, is_ghost=is_ghost
        )

    def find_missing_shadow(self, picture: RgbImage) -> Mask:
        """Find where the background image has a shadow that the picture lacks.

        The background is a median over frames, so that a ball that rests long leaves its shadow in
        it. Regions with a missing shadow are lighter in the picture than in the background by the
        same factor in all colours, and do not stand out from their surroundings in the picture.

        Args:
            picture: Picture (height, width, 3).

        Returns:
            Mask (height, width) of these regions.
        """
        cv2 = import_package("cv2")
        mask = (self._compute_largest_difference(picture) > self.level).astype(np.uint8)
        lighter = (self._compute_brightness_ratio(picture, mask) > 1).astype(np.uint8)
        count, labels, statistics, _ = cv2.connectedComponentsWithStats(lighter)
        missing_shadow = np.zeros(mask.shape, bool)
        # Component 0 is the area between the others.
        for label in range(1, count):
            if statistics[label, cv2.CC_STAT_AREA] < _MIN_REGION_AREA:
                continue
            region_mask = (labels == label).astype(np.uint8)
            # The surroundings are a ring of unchanged pixels. One pixel between region and ring is
            # left out, since it is half one and half the other.
            grown_mask = cv2.dilate(region_mask, np.ones((3, 3), np.uint8))
            outer_mask = cv2.dilate(grown_mask, np.ones((5, 5), np.uint8))
            ring = (outer_mask > 0) & (grown_mask == 0) & (mask == 0)
            # A region without unchanged surroundings has nothing to be compared with.
            if not ring.any():
                continue
            is_inside = region_mask > 0
            picture_colours = _compute_median_colours(picture, is_inside, ring)
            background_colours = _compute_median_colours(self.background, is_inside, ring)
            # A pale ball is lighter, too, but it stands out in the picture.
            if self._is_ghost(picture_colours, background_colours):
                missing_shadow |= is_inside
        return missing_shadow

    def _is_ghost(
        self, picture_colours: tuple[Array, Array], background_colours: tuple[Array, Array]
    ) -> bool:
        """Return whether an object is in the background image and not in the picture.

        There it differs more from its surroundings than in the picture, by more than half of
        `level`, the difference in grey levels from which a pixel counts as changed.

        Args:
            picture_colours: Colours (3,) inside and around the object in the picture.
            background_colours: Colours (3,) at the same pixels of the background image.
        """
        inside, surroundings = picture_colours
        background_inside, background_surroundings = background_colours
        picture_contrast = float(np.abs(inside - surroundings).max())
        background_contrast = float(np.abs(background_inside - background_surroundings).max())
        return background_contrast > picture_contrast + self.level / 2

    def _compute_largest_difference(self, picture: RgbImage) -> NDArray[np.uint8]:
        """Return the largest difference from the background over the colours (height, width)."""
        cv2 = import_package("cv2")
        differences = cv2.absdiff(picture, self.background)
        red_green = cv2.max(differences[..., 0], differences[..., 1])
        result: NDArray[np.uint8] = cv2.max(red_green, differences[..., 2])
        return result

    def _compute_brightness_ratio(self, picture: RgbImage, mask: NDArray[np.uint8]) -> GreyLevels:
        """Return the factor between picture and background where it is the same in all colours.

        Args:
            picture: picture (height, width, 3).
            mask: (height, width) pixels that differ from the background.

        Returns:
            (height, width) factor: below 1 in shadow, above 1 where the picture lacks a shadow of
            the background, and 0 where the difference is not that of a shadow.
        """
        brightness_ratio = np.zeros(mask.shape, np.float32)
        rows, columns = np.nonzero(mask)
        colours = picture[rows, columns].astype(np.float32)
        background_colours = self._float_background[rows, columns]
        # Least squares over the three colours.
        product = (colours * background_colours).sum(axis=1)
        factor = product / self._background_square[rows, columns]
        deviations = np.abs(colours - factor[:, None] * background_colours).max(axis=1)
        # Relative to the lighter of both, where a shadow is missing.
        scaled_deviations = deviations / np.maximum(factor, 1)
        # Brightness of the darker of both relative to the lighter one.
        shadow_factor = np.minimum(factor, 1 / np.maximum(factor, 1e-3))
        darkest, lightest = _SHADOW_FACTOR_RANGE
        is_shadow = (shadow_factor > darkest) & (shadow_factor < lightest)
        # Shadow changes all colours by one factor; noise with standard deviation `sigma` is
        # tolerated.
        is_shadow &= scaled_deviations < max(_MAX_SHADOW_DEVIATION, 3 * self.sigma)
        brightness_ratio[rows, columns] = np.where(is_shadow, factor, 0)
        return brightness_ratio

    def _measure_object(
        self,
        contour: Any,
        differences: tuple[NDArray[np.uint8], ...],
        shade: Mask,
    ) -> BallDetection | None:
        """Measure the centre and the radius of the object inside a contour.

        The largest disc inside the contour gives a first estimate. The object is then measured in a
        window around it: by a circle through its edge, or if it has a few pixels only, by sums.

        Args:
            contour: Contour of the region.
            differences: Differences from the background (height, width): of brightness, and of the
                colour that differs most.
            shade: Mask of the shadow (height, width).

        Returns:
            The detection in the picture, without colours; None if the object is not round.
        """
        cv2 = import_package("cv2")
        left, top, width, height = cv2.boundingRect(contour)
        # An object that nearly fills the picture is not a ball in front of a background.
        if width * height < _MIN_REGION_AREA or max(width, height) > 0.9 * min(shade.shape):
            return None
        # The region with a border of one pixel.
        filled = np.zeros((height + 2, width + 2), np.uint8)
        offset = 1 - left, 1 - top
        cv2.drawContours(filled, [contour], -1, 1, -1, offset=offset)
        if int(filled.sum()) < _MIN_REGION_AREA:
            return None
        # The largest inscribed disc is the ball, even if a shadow is connected to it.
        distance_map = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
        row, column = np.unravel_index(int(distance_map.argmax()), distance_map.shape)
        radius = max(float(distance_map[row, column]), 1.0)
        # Centre of the disc in the picture, without the border.
        u = left + float(column) - 1
        v = top + float(row) - 1
        # In the window, shadow counts as background unless the region encloses it.
        half_size = int(2 * max(radius, 0.5 * max(width, height))) + 4
        u0 = max(0, int(u) - half_size)
        v0 = max(0, int(v) - half_size)
        window = np.s_[v0 : int(v) + half_size + 1, u0 : int(u) + half_size + 1]
        windows = np.stack([difference[window] for difference in differences]).astype(np.float32)
        # The edge itself, half ball and half background, must not be treated as shadow.
        shadow_mask = shade[window].astype(np.uint8)
        offset = -u0, -v0
        cv2.drawContours(shadow_mask, [contour], -1, 0, -1, offset=offset)
        cv2.drawContours(shadow_mask, [contour], -1, 0, _UNSHADED_RIM_PIXELS, offset=offset)
        windows[:, shadow_mask > 0] = 0
        # In a few pixels, rays do not find an edge. `windows[1]` is the colour that differs most.
        if radius < _MIN_RAY_RADIUS:
            return self._measure_small_ball(windows[1], u - u0, v - v0, radius, u0, v0)
        return self._fit_circle(windows, (u - u0, v - v0, radius), u0, v0)

    def _fit_circle(
        self,
        windows: GreyLevels,
        start: circle_fit.Circle,
        u0: int,
        v0: int,
    ) -> BallDetection | None:
        """Measure a ball by alternating between locating its edge and fitting a circle to it.

        Edge points are located along rays from the present centre, a robust circle is fitted to
        them, and this is repeated until the circle moves by less than `_CONVERGED_PIXELS`. If too
        few points are on the circle, a fit that starts from a circle through an arc is tried.

        Args:
            windows: (2, height, width) differences from the background around the region: of
                brightness, and of the colour that differs most.
            start: first estimate of centre and radius in pixels, in the window.
            u0: first column of the window in the picture.
            v0: first row of the window in the picture.

        Returns:
            The detection in the picture; None if too few rays agree on a circle.
        """
        u, v, radius = start
        is_on_circle = np.empty(0, bool)
        residuals = np.empty(0)
        edges = None
        for _ in range(_MAX_EDGE_ITERATIONS):
            edges = self._locate_edges(windows, u, v, radius)
            if edges is None:
                return None
            fitted = circle_fit.fit_circle(edges, (u, v, None))
            # With fewer rays on the circle, a shadow may bias the fit.
            is_good = (
                fitted is not None
                and circle_fit.find_inliers(fitted).sum() >= _GOOD_RAY_AGREEMENT * _RAY_COUNT
            )
            if not is_good:
                from_an_arc = circle_fit.fit_circle(edges, circle_fit.fit_arc(edges))
                fitted = circle_fit.select_better_fit(fitted, from_an_arc)
            if fitted is None:
                return None
            previous_circle = u, v, radius
            circle, residuals = fitted
            change = max(abs(new - old) for new, old in zip(circle, previous_circle, strict=True))
            u, v, radius = circle
            is_on_circle = circle_fit.find_inliers(fitted)
            if change < _CONVERGED_PIXELS:
                break
        # Share of all rays, also of those without an edge.
        agreement = float(is_on_circle.sum()) / _RAY_COUNT
        height, width = windows.shape[1:]
        # A centre outside the window belongs to an arc of a large object.
        is_within = -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
        if edges is None or agreement < _MIN_RAY_AGREEMENT or not is_within:
            return None
        scatter = float(np.sqrt(np.mean(residuals[is_on_circle] ** 2)))
        picture_edges = edges + np.array([u0, v0])
        return BallDetection(u + u0, v + v0, radius, agreement, scatter, picture_edges)

    def _locate_edges(self, windows: GreyLevels, u: float, v: float, radius: float) -> Array | None:
        """Locate the edge of a ball along rays from its centre, with subpixel accuracy.

        Along each ray, the edge is where the difference from the background falls to half of its
        value just inside the edge. That value is taken for each ray, because the brightness of a
        lit ball varies. The difference of brightness is used where it is large enough, because
        video files store colours at half the resolution; otherwise that of the worst colour.
        Thresholds are multiples of `level`, the difference from which a pixel counts as changed.

        Args:
            windows: (2, height, width) differences from the background: of brightness, and of the
                worst colour, which is the one that differs most.
            u: Horizontal position of the centre in the window, pixels.
            v: Vertical position of the centre in the window, pixels.
            radius: Approximate radius, pixels.

        Returns:
            (n, 2) edge points (u, v) in the window, for the n rays with an edge; None if they are
            less than half of the rays.
        """
        # Each ray is sampled between two distances around the expected edge, pixels.
        start = max(0.0, _RAY_SHARES[0] * radius - _RAY_MARGIN)
        end = _RAY_SHARES[1] * radius + _RAY_MARGIN
        distances = np.arange(start, end, _RAY_SAMPLE_SPACING, dtype=np.float32)
        cos, sin = _compute_ray_directions()
        # (rays, samples of a ray) positions.
        along_u = (u + cos * distances).astype(np.float32)
        along_v = (v + sin * distances).astype(np.float32)
        cv2 = import_package("cv2")
        # Differences along the rays.
        profiles = [
            cv2.remap(
                window,
                along_u,
                along_v,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=_PADDING_VALUE,
            )
            for window in windows
        ]
        # Samples just inside the edge, except those affected by its blur. Their median is the value
        # inside, for each ray.
        is_inner = distances > min(_INNER_SHARES[0] * radius, radius - _INNER_MARGINS[0])
        is_inner &= distances < max(_INNER_SHARES[1] * radius, radius - _INNER_MARGINS[1])
        median_index = int(is_inner.sum()) // 2
        inner_brightness, inner_colour = (
            np.partition(profile[:, is_inner], median_index, axis=1)[:, median_index]
            for profile in profiles
        )
        is_bright = inner_brightness > _MIN_BRIGHTNESS_LEVELS * self.level
        is_bright &= inner_brightness > _MIN_BRIGHTNESS_SHARE * inner_colour
        values = np.where(is_bright[:, None], *profiles)  # brightness, or else the worst colour
        half_level = 0.5 * np.where(is_bright, inner_brightness, inner_colour)
        # (rays, samples - 1): whether the edge is between a sample and the next one.
        is_crossing = values[:, 1:] < half_level[:, None]
        is_crossing &= values[:, :-1] >= half_level[:, None]
        # A dark patch further inside is not an edge.
        is_crossing[:, : int(np.flatnonzero(is_inner)[0])] = False
        # Take the first of several crossings.
        crossing_index = is_crossing.argmax(axis=1)
        rays = np.arange(_RAY_COUNT)
        value_before = values[rays, crossing_index]
        value_after = values[rays, crossing_index + 1]
        has_edge = is_crossing.any(axis=1) & (half_level > _MIN_EDGE_LEVELS * self.level)
        # A fall to the value for outside is the end of the picture, not of the ball.
        has_edge &= value_after > 0.5 * _PADDING_VALUE
        if has_edge.sum() < 0.5 * _RAY_COUNT:
            return None
        # Interpolate linearly between the two samples.
        fall = np.maximum(value_before - value_after, 1e-6)
        fraction = (value_before - half_level)[has_edge] / fall[has_edge]
        edge_distances = distances[crossing_index[has_edge]] + _RAY_SAMPLE_SPACING * fraction
        edge_u = u + cos[has_edge, 0] * edge_distances
        edge_v = v + sin[has_edge, 0] * edge_distances
        return np.stack([edge_u, edge_v], axis=1).astype(np.float64)

    def _measure_small_ball(
        self,
        window: GreyLevels,
        u: float,
        v: float,
        radius: float,
        u0: int,
        v0: int,
    ) -> BallDetection | None:
        """Measure a ball of a few pixels: centroid of the difference, and radius from its sum.

        Thresholds are multiples of `level`, the difference from which a pixel counts as changed.

        Args:
            window: (height, width) differences of the worst colour from the background, grey
                levels.
            u: approximate horizontal position of the centre in the window, pixels.
            v: approximate vertical position of the centre in the window, pixels.
            radius: approximate radius, pixels.
            u0: first column of the window in the picture.
            v0: first row of the window in the picture.

        Returns:
            The detection in the picture; None if the difference is too small.
        """
        height, width = window.shape
        rows, columns = np.mgrid[:height, :width]
        is_near = np.hypot(columns - u, rows - v) <= radius + _SMALL_BALL_MARGIN
        weights = np.where(is_near & (window > _MIN_EDGE_LEVELS * self.level), window, 0.0)
        total = float(weights.sum())
        # Difference of a pixel that the ball covers, robust against single pixels.
        peak = float(np.percentile(window[is_near], 90))
        if total <= 0 or peak < self.level:
            return None
        # A partly covered pixel differs in proportion: sums measure areas.
        area = total / max(peak, 1.0)
        if area < _MIN_REGION_AREA / 2:
            return None
        u = u0 + float((weights * columns).sum() / total)
        v = v0 + float((weights * rows).sum() / total)
        radius = float(np.sqrt(area / np.pi))
        # Without rays there is no agreement; assume that of the worst accepted circle, and a usual
        # distance of edge points from a circle.
        return BallDetection(u, v, radius, _MIN_RAY_AGREEMENT, scatter=0.2)


def _compute_median_colours(
    picture: RgbImage, object_mask: Mask, surroundings: Mask
) -> tuple[Array, Array]:
    """Return the median colours (3,) of an object and of its surroundings in a picture.

    Args:
        picture: picture (height, width, 3).
        object_mask: (height, width) pixels of the object.
        surroundings: (height, width) pixels around it.
    """
    inside_colour: Array = np.median(picture[object_mask], axis=0)
    outside_colour: Array = np.median(picture[surroundings], axis=0)
    return inside_colour, outside_colour


def _compute_centre_colour(picture: RgbImage, detection: BallDetection) -> Array:
    """Return the mean colour (3,) of a square patch at a detection's centre, in grey levels.

    Args:
        picture: picture (height, width, 3).
        detection: centre and radius of the ball.
    """
    side = 2 * max(1, int(_CENTRE_PATCH_SHARE * detection.radius)) + 1
    patch = import_package("cv2").getRectSubPix(picture, (side, side), (detection.u, detection.v))
    colour: Array = patch.reshape(-1, 3).mean(axis=0)
    return colour


def _compute_surrounding_colour(picture: RgbImage, detection: BallDetection) -> Array:
    """Return the median colour (3,) on a circle around a detection, in grey levels.

    It is the colour of the background, against which the contrast of the ball is measured.

    Args:
        picture: picture (height, width, 3).
        detection: centre and radius of the ball.
    """
    cos, sin = _compute_ray_directions()
    height, width = picture.shape[:2]
    circle_radius = _SURROUNDINGS_RADII * detection.radius
    median_index = _RAY_COUNT // 2
    # The pixels nearest to the circle.
    rows = (detection.v + circle_radius * sin[:, 0] + 0.5).astype(np.intp)
    columns = (detection.u + circle_radius * cos[:, 0] + 0.5).astype(np.intp)
    # Beyond the border, the outermost pixels are repeated.
    rows = rows.clip(0, height - 1)
    columns = columns.clip(0, width - 1)
    ranked = np.partition(picture[rows, columns], median_index, axis=0)
    colour: Array = ranked[median_index].astype(np.float64)
    return colour


@lru_cache(maxsize=1)
def _compute_ray_directions() -> tuple[Array, Array]:
    """Return the cosines and sines (rays, 1) of the ray directions."""
    angles = np.linspace(0, 2 * np.pi, _RAY_COUNT, endpoint=False)[:, None]
    return np.cos(angles), np.sin(angles)
