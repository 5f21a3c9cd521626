"""Draw a recording over time, with a panel for each signal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import write_figure
from bench.figures.signal_thinning import thin_signal
from bench.figures.style import BLUE, HELD_OUT_GREY, RUN_SEPARATOR_GREY, RUST
from bench.logs.recording_summary import list_recorded_signals
from sims.core.simulator import Array, Simulator
from sims.core.user_messages import format_unit
from sims.recording.recording import Recording, Run

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
    figure, axes = make_panel_grid(len(signals), 1, (width, 1.2 + 2.0 * len(signals)), sharex=True)
    for axis, (channel, role) in zip(axes[:, 0], signals, strict=True):
        unit = "" if channel.unit == "1" else f" [{format_unit(channel.unit)}]"
        axis.set_ylabel(f"{channel.name}{unit}\n({role})")
        for part in placed_runs:
            run_signals = {**part.run.inputs, **part.run.channels}
            _draw_signal(axis, part, run_signals[channel.name])
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
        runs = [runs[index] for index in chosen_indices]
    durations = [float(run.times[-1] - run.times[0]) for run in runs]
    # The more runs, the smaller the gaps between them.
    gap = _RUN_GAP_SHARE * sum(durations) / max(1.0, len(runs) ** 0.5)
    begins = np.concatenate([[0.0], np.cumsum(np.array(durations) + gap)[:-1]])
    return [_PlacedRun(run, float(begin)) for run, begin in zip(runs, begins, strict=True)]


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
    is_missing = np.isnan(values)
    shown = thin_signal(values, _MAX_POINTS_PER_RUN)
    # A sample between two missing ones forms no line and needs a marker to be visible.
    has_markers = values.size <= _MAX_SAMPLES_WITH_MARKERS or is_missing.mean() > 0.2
    axis.plot(
        times[shown],
        values[shown],
        color=_HELD_OUT if part.run.held_out else _FITTING,
        linewidth=0.9,
        marker="." if has_markers else "",
        markersize=3,
        linestyle="-",
    )
    if is_missing.any():
        # Vertically, this transform counts in shares of the height of the panel.
        foot = np.full(is_missing.sum(), 0.02)
        transform = axis.get_xaxis_transform()
        axis.plot(times[is_missing], foot, "|", color="black", markersize=5, transform=transform)


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
