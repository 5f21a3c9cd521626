"""Draw the track of a filmed ball: in the scene, and its height and radius over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import render_png_and_pdf
from bench.figures.style import BLUE, RECORDED_PART_GREY, RUST
from bench.logs.ball_heights_from_film import BallHeights
from sims.core.simulator import Array
from sims.vision.ball_renderer import RgbImage
from sims.vision.ball_tracker import BallTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_MAX_OUTLINES = 6
"""Number of ball outlines that are drawn, evenly spaced along its path."""
_TRACK_DPI = 140
_DETECTED_COLOUR = BLUE
_MISSING_COLOUR = RUST


def render_track_figure(
    track: BallTrack, heights: BallHeights, part: slice, title: str
) -> tuple[bytes, bytes | None]:
    """Render the figure of a track as PNG, and as PDF if requested.

    Args:
        track: Track of the ball, px.
        heights: Heights of its centre, m.
        part: Frames that are recorded.
        title: Title above the figure.

    Returns:
        The bytes of the PNG file, and those of the PDF file or None.
    """
    figure = draw_track_figure(track, heights, part, title)
    return render_png_and_pdf(figure, _TRACK_DPI)


def draw_track_figure(track: BallTrack, heights: BallHeights, part: slice, title: str) -> Figure:
    """Draw the track in the scene, and height and radius over time.

    Args:
        track: Track of the ball, px.
        heights: Heights of its centre, m.
        part: Frames that the recording has.
        title: Title above the figure.
    """
    figure, axes = make_panel_grid(1, 3, (13, 4.3), gridspec_kw={"width_ratios": (1, 1.2, 1.2)})
    scene, height_axis, radius_axis = axes[0]
    _draw_scene(scene, track)
    _draw_over_time(height_axis, track, part, heights.z, "height of the centre z [m]")
    _draw_over_time(radius_axis, track, part, track.radius, "radius [px]")
    height_axis.axhline(heights.radius, color="black", linewidth=0.6, linestyle=":")
    height_axis.set_title("dotted: ball on the ground", fontsize=9)
    radius_axis.set_title("grey: recorded; marks at the bottom: no ball detected", fontsize=9)
    # The position is NaN in frames without a ball.
    visible_count, frames = int(np.isfinite(track.u).sum()), len(track.times)
    # A film's name must not be read as mathematics.
    figure.suptitle(f"{title}\n{visible_count} of {frames} frames", parse_math=False, fontsize=10)
    return figure


def _draw_scene(axis: Axes, track: BallTrack) -> None:
    """Draw the track of the ball's centre on the scene, with its outline in a few frames.

    Lines have a light edge, so that they are visible on dark scenes too.
    """
    from matplotlib.patches import Circle

    axis.imshow(_overlay_balls(track), interpolation="nearest")
    axis.plot(track.u, track.v, "-", color="white", linewidth=2.4)
    axis.plot(track.u, track.v, ".-", color=_DETECTED_COLOUR, linewidth=0.8, markersize=2.5)
    for frame in _choose_frames(track):
        middle = (track.u[frame], track.v[frame])
        for colour, width in (("black", 1.6), ("white", 0.8)):
            outline = Circle(middle, track.radius[frame], fill=False, color=colour, linewidth=width)
            axis.add_patch(outline)
    axis.set(xlabel="u [px]", ylabel="v [px]", title="the track; circles: outlines found")


def _draw_over_time(axis: Axes, track: BallTrack, part: slice, values: Array, label: str) -> None:
    """Draw a quantity of the ball over time, with marks where the ball was not detected.

    Args:
        axis: axes to draw on.
        track: the tracked ball.
        part: recorded frames, which have a grey background.
        values: (T,) quantity.
        label: label of the vertical axis.
    """
    times, is_missing = track.times, ~np.isfinite(track.u)
    axis.axvspan(times[part][0], times[part][-1], color=RECORDED_PART_GREY, linewidth=0)
    axis.plot(times, values, ".-", color=_DETECTED_COLOUR, markersize=3, linewidth=0.7)
    # Vertically, this transform counts in shares of the height of the panel.
    foot = np.full(is_missing.sum(), 0.02)
    transform = axis.get_xaxis_transform()
    axis.plot(
        times[is_missing], foot, "|", color=_MISSING_COLOUR, markersize=7, transform=transform
    )
    axis.set(xlabel="time [s]", ylabel=label)
    axis.spines[["top", "right"]].set_visible(False)


def _choose_frames(track: BallTrack) -> list[int]:
    """Return the indices of a few frames with the ball, evenly spaced along its path.

    Args:
        track: Track of the ball, with its centre (u, v) in each frame.
    """
    visible_frames = track.visible_frames.tolist()
    steps = np.hypot(np.diff(track.u[visible_frames]), np.diff(track.v[visible_frames]))
    path_lengths = np.concatenate([[0.0], np.cumsum(steps)])
    # Evenly along the path, not in time: outlines of a slow ball would cover each other.
    wanted_lengths = np.linspace(0, path_lengths[-1], _MAX_OUTLINES)
    indices = np.searchsorted(path_lengths, wanted_lengths).clip(0, len(visible_frames) - 1)
    return [visible_frames[index] for index in np.unique(indices)]


def _overlay_balls(track: BallTrack) -> RgbImage:
    """Return the background with the balls of a few frames copied into it.

    Args:
        track: Track with the background and the stored pictures of a few frames.
    """
    picture = track.background.copy()
    # Row v and column u of each pixel.
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    for index, frame in track.pictures.items():
        # A frame without a detected ball has no position.
        if 0 <= index < len(track.u) and np.isfinite(track.u[index]):
            distances = np.hypot(u - track.u[index], v - track.v[index])
            is_ball = distances <= track.radius[index]
            picture[is_ball] = frame[is_ball]
    return picture
