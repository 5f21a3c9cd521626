"""Coordinates of intervals that a page draws as SVG on one scale."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

SCALE_WIDTH = 180.0
"""Width of the scale; the drawing is 200 wide, with margins for the marks."""
_MARGIN = 10.0


class DrawnInterval(NamedTuple):
    """An interval with its estimate, in the coordinates of the drawing.

    Attributes:
        kind: Class of the style sheet.
        value: Position of the estimate.
        low: Position of the lower end.
        high: Position of the upper end.
        y: Vertical position.
    """

    kind: str
    value: float
    low: float
    high: float
    y: int


class IntervalDrawing(NamedTuple):
    """Content of a drawing that is 200 wide.

    Attributes:
        rows: Intervals from top to bottom.
        height: Height of the drawing.
        radius: Radius of the estimates' marks.
        band: Left edge and width of the interval behind the others; None for none.
    """

    rows: tuple[DrawnInterval, ...]
    height: int
    radius: float
    band: tuple[float, float] | None = None


def draw_intervals(
    intervals: Sequence[tuple[str, float, float, float]],
    band: tuple[float, float] | None = None,
    distance: int = 14,
) -> IntervalDrawing | None:
    """Arrange intervals on one scale, which ends with the outermost of them, for a drawing in SVG.

    Args:
        intervals: Class of the style sheet, estimate, lower and upper end of each.
        band: Lower and upper end of an interval behind the others, clipped to the drawing.
        distance: Vertical distance between two intervals, in CSS pixels.

    Returns:
        The drawing; None if an end is not finite, or all of them are equal.
    """
    low = min(begin for _, _, begin, _ in intervals)
    high = max(end for _, _, _, end in intervals)
    numbers = [number for _, *numbers in intervals for number in numbers]
    if not all(map(isfinite, numbers)) or high <= low:
        return None
    scale = SCALE_WIDTH / (high - low)

    def to_pixels(value: float) -> float:
        """Return the horizontal position of a value, within the drawing, in CSS pixels."""
        return round(min(max(_MARGIN + (value - low) * scale, 0.0), SCALE_WIDTH + 2 * _MARGIN), 1)

    rows = tuple(
        DrawnInterval(
            kind,
            to_pixels(value),
            to_pixels(begin),
            to_pixels(end),
            # The middle of row i; the drawing has a margin of one pixel at the top and bottom.
            distance // 2 + 1 + distance * i,
        )
        for i, (kind, value, begin, end) in enumerate(intervals)
    )
    band_extent = None
    if band is not None:
        left, right = map(to_pixels, band)
        # A narrow band is drawn 1.5 pixels wide, so that it remains visible.
        band_extent = left, max(right - left, 1.5)
    height, mark_radius = distance * len(rows) + 2, distance / 4 + 0.5
    return IntervalDrawing(rows, height, mark_radius, band_extent)
