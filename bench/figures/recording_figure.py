"""Draw a recording over time, and the track of a filmed ball."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.figures.figure_output import render_png_and_pdf, write_figure
from bench.figures.signal_thinning import thin_signal
from bench.figures.style import (
    BLUE,
    HELD_OUT_GREY,
    RECORDED_PART_GREY,
    RUN_SEPARATOR_GREY,
    RUST,
    make_panel_grid,
)
from bench.logs.ball_heights import BallHeights
from bench.logs.recording_summary import list_recorded_signals
from sims.core.plain_values import format_unit
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.vision.ball_renderer import RgbImage
from sims.vision.ball_tracker import BallTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


_MAX_DRAWN_RUNS = 40
"""Maximum number of runs that are drawn; of more, evenly spaced ones are drawn."""
_MAX_POINTS_PER_RUN = 4000
"""Maximum number of points per run; of a longer run the extremes of each part are drawn."""
_MAX_SAMPLES_WITH_MARKERS = 60
"""Maximum number of samples of a run for which each sample has a marker."""
_RUN_GAP_SHARE = 0.015
"""Gap between runs on the time axis, times the root of their number, over their total length."""
_DPI = 150
_FITTING = BLUE
_HELD_OUT = RUST


class _PlacedRun(NamedTuple):
    """A run on the common time axis, where its first sample is drawn at `begin`."""

    run: Run
    begin: float

    @property
    def times(self) -> Array:
        shifted: Array = self.run.times - self.run.times[0] + self.begin
        return shifted


def write_recording_figure(recording: Recording, kind: type[Simulator], folder: Path) -> list[Path]:
    """Write the figure of a recording into `folder` as PNG, and as PDF if requested.

    Args:
        recording: Recording to draw.
        kind: Simulator class of its system.
        folder: Folder to write.

    Returns:
        Paths of the files, named after the recording.

    Raises:
        InputError: The folder cannot be made or written to.
    """
    return write_figure(draw_recording_figure(recording, kind), folder / recording.path.stem, _DPI)


def draw_recording_figure(recording: Recording, kind: type[Simulator]) -> Figure:
    """Draw a recording with a panel for each input and channel.

    Args:
        recording: Recording to draw.
        kind: Simulator class of its system, which declares names and units.
    """
    signals = list_recorded_signals(recording, kind)
    placed_runs = _place_runs(recording.runs)
    # Width in inches: 0.8 for each run, between 9 and 16.
    width = float(np.clip(3 + 0.8 * len(placed_runs), 9, 16))
    # Width and height in inches, with the space for each signal.
    figure, axes = make_panel_grid(len(signals), 1, (width, 1.2 + 2.0 * len(signals)), sharex=True)
    for axis, (channel, role) in zip(axes[:, 0], signals, strict=True):
        unit = "" if channel.unit == "1" else f" [{format_unit(channel.unit)}]"
        axis.set_ylabel(f"{channel.name}{unit}\n({role})")
        for part in placed_runs:
            values = part.run.channels.get(channel.name)
            _draw_signal(axis, part, part.run.inputs[channel.name] if values is None else values)
    panels = list(axes[:, 0])
    _style_panels(panels, placed_runs)
    _draw_run_names(panels[0], placed_runs)
    _draw_title(panels[0], recording, placed_runs)
    figure.legend(
        handles=_make_mark_legend(recording, placed_runs),
        loc="outside lower center",
        ncols=3,
        fontsize=8,
        frameon=False,
    )
    return figure


def _place_runs(runs: Sequence[Run]) -> list[_PlacedRun]:
    """Place runs end to end with small gaps; of too many runs, use evenly spaced ones.

    Args:
        runs: Runs of a recording, each beginning at its own time.

    Returns:
        Runs with their start on the common time axis.
    """
    if len(runs) > _MAX_DRAWN_RUNS:
        chosen_indices = np.linspace(0, len(runs) - 1, _MAX_DRAWN_RUNS).round().astype(int)
        runs = [runs[i] for i in chosen_indices]
    # The more runs, the smaller the gaps between them.
    lengths = [float(run.times[-1] - run.times[0]) for run in runs]
    gap = _RUN_GAP_SHARE * sum(lengths) / max(1.0, len(runs) ** 0.5)
    starts = np.concatenate([[0.0], np.cumsum(np.array(lengths) + gap)[:-1]])
    return [_PlacedRun(run, float(start)) for run, start in zip(runs, starts, strict=True)]


def _draw_signal(axis: Axes, part: _PlacedRun, values: Array) -> None:
    """Draw one signal of one run at its position on the common time axis.

    Missing samples are marked at the foot; a held-out run is shaded.

    Args:
        axis: axes to draw on.
        part: the run, with its place on the time axis.
        values: (T,) signal, NaN where missing.
    """
    times = part.times
    if part.run.held_out:
        axis.axvspan(float(times[0]), float(times[-1]), color=HELD_OUT_GREY, linewidth=0)
    missing = np.isnan(values)
    shown = thin_signal(values, _MAX_POINTS_PER_RUN)
    t, y = times[shown], values[shown]
    # A sample between two missing ones forms no line and needs a marker to be visible.
    marked = values.size <= _MAX_SAMPLES_WITH_MARKERS or missing.mean() > 0.2
    colour = _HELD_OUT if part.run.held_out else _FITTING
    marker = "." if marked else ""
    axis.plot(t, y, color=colour, linewidth=0.9, marker=marker, markersize=3, linestyle="-")
    if missing.any():
        foot = np.full(missing.sum(), 0.02)
        transform = axis.get_xaxis_transform()
        axis.plot(times[missing], foot, "|", color="black", markersize=5, transform=transform)


def _style_panels(axes: Sequence[Axes], placed_runs: Sequence[_PlacedRun]) -> None:
    """Style the panels, and mark with dotted lines where each run after the first begins.

    Args:
        axes: panels from top to bottom; the last one gets the label of the time axis.
        placed_runs: the runs, with their places on the time axis.
    """
    for axis in axes:
        axis.grid(visible=True, axis="y", linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.01)
        for part in placed_runs[1:]:
            axis.axvline(part.begin, color=RUN_SEPARATOR_GREY, linewidth=0.5, linestyle=":")
    axes[-1].set_xlabel("time, runs end to end [s]; above: their names")


def _draw_run_names(axis: Axes, placed_runs: Sequence[_PlacedRun]) -> None:
    """Write the name of each run above the first panel, in the middle of the run.

    Args:
        axis: axes of the first panel.
        placed_runs: the runs, with their places on the time axis.
    """
    for part in placed_runs:
        middle = float(part.times[[0, -1]].mean())
        axis.annotate(
            part.run.name,
            (middle, 1.0),
            (0, 2),
            xycoords=axis.get_xaxis_transform(),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=8 if len(placed_runs) <= 20 else 6,
            annotation_clip=False,
        )


def _draw_title(axis: Axes, recording: Recording, placed_runs: Sequence[_PlacedRun]) -> None:
    total = len(recording.runs)
    selection = f", {len(placed_runs)} of {total} runs" if len(placed_runs) < total else ""
    axis.set_title(f"{recording.title}{selection}", fontsize=11, pad=16)


def _make_mark_legend(recording: Recording, placed_runs: Sequence[_PlacedRun]) -> list[Line2D]:
    """Make the legend entries for the marks that are present.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        placed_runs: the runs that are drawn.
    """
    from matplotlib.lines import Line2D

    marks = [Line2D([], [], color=_FITTING, label="for fitting")]
    if recording.held_out():
        marks.append(Line2D([], [], color=_HELD_OUT, label="held out (grey ground)"))
    if any(np.isnan(values).any() for part in placed_runs for values in part.run.channels.values()):
        gap = Line2D([], [], color="black", marker="|", linestyle="", label="missing sample")
        marks.append(gap)
    return marks


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
    """
    figure = draw_track_figure(track, heights, part, title)
    return render_png_and_pdf(figure, _TRACK_DPI)


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
    visible = track.visible_frames.tolist()
    steps = np.hypot(np.diff(track.u[visible]), np.diff(track.v[visible]))
    path_length = np.concatenate([[0.0], np.cumsum(steps)])
    # Evenly along the path, not in time: outlines of a slow ball would cover each other.
    indices = np.searchsorted(path_length, np.linspace(0, path_length[-1], _MAX_OUTLINES)).clip(
        0, len(visible) - 1
    )
    return [visible[i] for i in np.unique(indices)]


def _overlay_balls(track: BallTrack) -> RgbImage:
    """Return the background with the balls of a few frames copied into it.

    Args:
        track: Track with the background and the stored pictures of a few frames.
    """
    picture = track.background.copy()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    # Only the disc of the ball is copied from each stored frame.
    for frame_index, frame in track.pictures.items():
        if 0 <= frame_index < len(track.u) and np.isfinite(track.u[frame_index]):
            ball = (
                np.hypot(u - track.u[frame_index], v - track.v[frame_index])
                <= track.radius[frame_index]
            )
            picture[ball] = frame[ball]
    return picture
