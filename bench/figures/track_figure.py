"""Draw a ball track: the detected positions in the scene, and its height over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.figures.style import BLUE, RECORDED_PART_GREY, RUST, make_panel_grid, render_png_and_pdf
from bench.logs.ball_heights import BallHeights
from sims.core.simulator import Array
from sims.vision.ball_renderer import RgbImage
from sims.vision.ball_tracker import BallTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAX_OUTLINES = 6
"""Number of ball outlines that are drawn, evenly spaced along its path."""
_DPI = 140
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
    """
    figure = draw_track_figure(track, heights, part, title)
    return render_png_and_pdf(figure, _DPI)


def draw_track_figure(track: BallTrack, heights: BallHeights, part: slice, title: str) -> Figure:
    """Draw the track in the scene, and height and radius over time.

    Args:
        track: Track of the ball, px.
        heights: Heights of its centre, m.
        part: Frames that are recorded.
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
    visible_count, frames = int(np.isfinite(track.u).sum()), len(track.times)
    # A film's name must not be read as mathematics.
    figure.suptitle(f"{title}\n{visible_count} of {frames} frames", parse_math=False, fontsize=10)
    return figure


def _draw_scene(axis: Axes, track: BallTrack) -> None:
    """Draw the track on the background with some outlines, on white for dark scenes."""
    from matplotlib.patches import Circle

    axis.imshow(_overlay_balls(track), interpolation="nearest")
    axis.plot(track.u, track.v, "-", color="white", linewidth=2.4)
    axis.plot(track.u, track.v, ".-", color=_DETECTED_COLOUR, linewidth=0.8, markersize=2.5)
    for k in _choose_frames(track):
        middle = (track.u[k], track.v[k])
        for colour, width in (("black", 1.6), ("white", 0.8)):
            outline = Circle(middle, track.radius[k], fill=False, color=colour, linewidth=width)
            axis.add_patch(outline)
    axis.set(xlabel="u [px]", ylabel="v [px]", title="the track; circles: outlines found")


def _draw_over_time(axis: Axes, track: BallTrack, part: slice, values: Array, label: str) -> None:
    """Draw a quantity of the ball (T,) over time, with marks where the ball was not detected.

    `part` selects the recorded frames, which have a grey background. The marks are at 2 % of the
    height of the panel.
    """
    times, is_missing = track.times, ~np.isfinite(track.u)
    axis.axvspan(times[part][0], times[part][-1], color=RECORDED_PART_GREY, linewidth=0)
    axis.plot(times, values, ".-", color=_DETECTED_COLOUR, markersize=3, linewidth=0.7)
    foot = np.full(is_missing.sum(), 0.02)
    transform = axis.get_xaxis_transform()
    axis.plot(
        times[is_missing], foot, "|", color=_MISSING_COLOUR, markersize=7, transform=transform
    )
    axis.set(xlabel="time [s]", ylabel=label)
    axis.spines[["top", "right"]].set_visible(False)


def _choose_frames(track: BallTrack) -> list[int]:
    """Return the indices of a few frames with the ball, evenly spaced along its path."""
    visible = track.visible_frames.tolist()
    steps = np.hypot(np.diff(track.u[visible]), np.diff(track.v[visible]))
    path_length = np.concatenate([[0.0], np.cumsum(steps)])
    # Evenly along the path, not in time: outlines of a slow ball would cover each other.
    indices = np.searchsorted(path_length, np.linspace(0, path_length[-1], _MAX_OUTLINES)).clip(
        0, len(visible) - 1
    )
    return [visible[i] for i in np.unique(indices)]


def _overlay_balls(track: BallTrack) -> RgbImage:
    """Return the background with the balls of a few frames copied into it."""
    picture = track.background.copy()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    # Only the disc of the ball is copied from each stored frame.
    for k, frame in track.pictures.items():
        if 0 <= k < len(track.u) and np.isfinite(track.u[k]):
            ball = np.hypot(u - track.u[k], v - track.v[k]) <= track.radius[k]
            picture[ball] = frame[ball]
    return picture
