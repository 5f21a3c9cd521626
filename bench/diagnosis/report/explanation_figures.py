"""Figures of an explanation: the run with the largest gap, where the gap is, and the candidates.

They are readable in print without colour: before is dashed with open squares, and after is solid
with filled circles. Each figure is rendered as PNG, and as PDF and SVG if vector graphics are
requested (`bench.figures.figure_files`). Texts from files are never parsed as mathematics.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.report.candidate_figure import draw_candidates_figure
from bench.diagnosis.report.cause_text import list_place_marks, select_shown_candidates
from bench.diagnosis.report.figure_panels import (
    BASE_MODEL_LINE,
    EXTENDED_MODEL_LINE,
    LONGEST_NAME,
    MAX_OUTLINED_DOTS,
    RunView,
    decimate,
    draw_gap_location_panel,
    draw_profile_panel,
    format_profile_label,
    format_selected_run,
    get_legend_entries,
    has_extended_model,
    place_names,
    select_gap_locations,
    select_informative_profiles,
    select_worst_run,
    shorten_label,
)
from bench.diagnosis.report.joint_figure import draw_joint_figure, is_robot
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.wording import sanitise
from bench.figures import style
from bench.figures.figure_files import is_pdf_wanted
from bench.figures.robot_figure import compute_joint_positions, draw_robot_figure
from bench.figures.style import NOISE_BAND_GREY, ZERO_LINE_GREY, make_panel_grid
from bench.figures.text_layout import count_max_lines, measure_text_width
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
"""Resolution of the PNG files in dots per inch; the page shows them at about two thirds of their
size.
"""
_WIDTHS = {1: 8.6, 2: 10.0, 3: 12.5}
"""Width of the overview in inches, by the number of channels."""
_HEADING_OFFSET = 0.22
"""Distance from the upper edge to the middle of a heading, in inches."""
_HEADING_SIZE = 11.0
"""Maximum font size of a heading, in points."""
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.usetex": False,
    # Names come from files, where a dollar sign must not start mathematics.
    "text.parse_math": False,
    # Unhinted letters are as wide as their outlines, by which margins are measured; hinting would
    # take a fifth of the time of drawing.
    "text.hinting": "none",
}


def list_figure_names(report: DiagnosisReportData) -> tuple[str, ...]:
    """List the names of the figures for which there are data."""
    is_available = {
        "robot": report.robot is not None,
        "overview": True,
        "where": bool(select_gap_locations(report.gap_locations)),
        "candidates": bool(select_shown_candidates(report)),
    }
    return tuple(name for name, available in is_available.items() if available)


def draw_figure(report: DiagnosisReportData, name: str) -> Figure:
    """Draw one figure.

    Args:
        report: Report data.
        name: One of `list_figure_names`.

    Raises:
        InputError: There is no figure of that name.
    """
    figure_names = list_figure_names(report)
    if name not in figure_names:
        raise make_unknown_name_error("figure", name, figure_names)
    with _apply_style():
        figure = _FIGURE_FUNCTIONS[name](report)
        # Ticks take their style from the settings that are active when they are first drawn.
        figure.draw_without_rendering()
    return figure


class RenderedFigure(NamedTuple):
    """Rendered figure as the bytes of its files.

    Attributes:
        png: PNG file.
        pdf: PDF file; None if no PDF is requested.
        svg: SVG file; None if no PDF is requested.
        joint_positions: For a robot, its joints: name, and position as shares of width and height
            from the upper left corner.
    """

    png: bytes
    pdf: bytes | None
    svg: bytes | None
    joint_positions: tuple[tuple[str, float, float], ...] = ()


def render_figures(report: DiagnosisReportData) -> dict[str, RenderedFigure]:
    """Draw all figures and render their files, by name."""
    with _apply_style():
        # The settings must stay active, because text is laid out again when a figure is written.
        figures = {name: _FIGURE_FUNCTIONS[name](report) for name in list_figure_names(report)}
        rendered = {}
        for name, figure in figures.items():
            png, pdf = style.render_png_and_pdf(figure, DPI)
            rendered[name] = RenderedFigure(
                png, pdf, style.render_svg(figure) if is_pdf_wanted() else None
            )
        if report.robot is not None and "robot" in rendered:
            positions = tuple(
                compute_joint_positions(
                    figures["robot"],
                    report.robot,
                    get_extreme_pose(report, select_worst_run(report)),
                )
            )
            rendered["robot"] = rendered["robot"]._replace(joint_positions=positions)
        return rendered


@contextmanager
def _apply_style() -> Iterator[None]:
    """Apply the style settings while figures are drawn or written."""
    from matplotlib import rc_context

    with rc_context(_STYLE), warnings.catch_warnings():
        # A title may be in any script; characters that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph")
        yield


def get_extreme_pose(report: DiagnosisReportData, view: RunView) -> dict[str, float]:
    """Return recorded joint positions at the sample of a run that is farthest from its start.

    Args:
        report: Report data.
        view: Run to use.
    """
    joints, columns = [], []
    for c, channel in enumerate(report.channels):
        kind, _, joint = channel.name.partition(".")
        values = view.data_split.observed[view.row, :, c]
        if kind == "q" and np.isfinite(values).any():
            joints.append(joint)
            columns.append(np.nan_to_num(values, nan=float(values[np.isfinite(values)][0])))
    if not joints:
        return {}
    motion = np.stack(columns)
    distances = np.square(motion - motion[:, :1]).sum(axis=0)
    return dict(zip(joints, motion[:, int(np.argmax(distances))].tolist(), strict=True))


def _draw_robot(report: DiagnosisReportData) -> Figure:
    """Draw the robot in the extreme pose of the run that is shown."""
    if report.robot is None:
        raise InputError(f"{report.path}: no robot was recorded")
    return draw_robot_figure(
        report.robot, get_extreme_pose(report, select_worst_run(report)), list_place_marks(report)
    )


def _draw_overview(report: DiagnosisReportData) -> Figure:
    """Draw the run with the largest residual: each channel over time, and its residual below.

    For a robot, the figure of `joint_figure` is drawn instead.
    """
    view = select_worst_run(report)
    if is_robot(report):
        return draw_joint_figure(report, view)
    count = len(view.channels)
    size = (_WIDTHS[count], 5.2)
    figure, axes = make_panel_grid(2, count, size, layout=None, sharex=True, height_ratios=(3, 2))
    for column, c in enumerate(view.channels):
        _draw_signal(axes[0][column], axes[1][column], report, view, c)
    selection = (
        f"; {count} of {len(report.channels)} channels" if count < len(report.channels) else ""
    )
    samples = view.count_samples()
    title = f"{format_selected_run(report, view)} ({samples} samples{selection})"
    figure.suptitle(title, fontsize=11, y=0.985)
    # The columns differ only in the channel, so they share one legend.
    handles, labels = axes[0][0].get_legend_handles_labels()
    band_handles, band_labels = axes[1][0].get_legend_handles_labels()
    figure.legend(
        [*handles, *band_handles], [*labels, *band_labels], loc="lower center", ncols=4, fontsize=9
    )
    left_margin = 0.75 / figure.get_figwidth()
    figure.subplots_adjust(
        left=left_margin, right=0.985, top=0.92, bottom=0.165, hspace=0.1, wspace=0.2
    )
    return figure


def _draw_signal(
    signal_axis: Axes, residual_axis: Axes, report: DiagnosisReportData, view: RunView, c: int
) -> None:
    """Draw the measured and simulated signal of a channel, and the residual below it."""
    channel, split = report.channels[c], view.data_split
    times = split.times[view.row]
    # Arrays are padded after the end of a shorter run.
    signals = [a[view.row, : len(times), c] for a in (split.observed, split.before, split.after)]
    rows = decimate(signals[0])
    t = times[rows]
    measured, before, after = (signal[rows] for signal in signals)

    size = 3.6 if rows.size < 250 else 2.6
    marks: dict[str, Any] = {"color": "black", "markersize": size, "markeredgewidth": 0}
    # Thousands of vector outlines would dominate the file size.
    marks["rasterized"] = rows.size > MAX_OUTLINED_DOTS
    signal_axis.plot(t, measured, "o", label="measured", zorder=4, **marks)
    base_label = "simulated before (tuned)" if has_extended_model(report) else "simulated (tuned)"
    signal_axis.plot(t, before, label=base_label, zorder=3, **BASE_MODEL_LINE)
    noise, band = 2 * channel.sigma, "±2σ: 95 % of the noise"
    residual_axis.axhspan(-noise, noise, color=NOISE_BAND_GREY, linewidth=0, label=band, zorder=0)
    residual_axis.axhline(0, color=ZERO_LINE_GREY, linewidth=0.6, zorder=1)
    residual_axis.plot(t, measured - before, zorder=3, **{**BASE_MODEL_LINE, "linewidth": 1.0})
    if has_extended_model(report):
        # The wide curve is behind: where both agree, "before" is visible as dashes on it.
        signal_axis.plot(
            t, after, label="simulated after", zorder=2, **{**EXTENDED_MODEL_LINE, "linewidth": 3.2}
        )
        residual_axis.plot(
            t, measured - after, zorder=2, **{**EXTENDED_MODEL_LINE, "linewidth": 0.8}
        )

    signal_axis.set_ylabel(shorten_label(channel.name, channel.unit, 14))
    residual_axis.set_ylabel(shorten_label("residual", channel.unit))
    residual_axis.set_xlabel("time [s]; residual: measured − simulated")
    signal_axis.margins(x=0.01)
    for axis in (signal_axis, residual_axis):
        axis.locator_params(nbins=6)
    # Noise must not fill the panel: its band should look narrow.
    _extend_axis(residual_axis, 3 * channel.sigma)


def _extend_axis(axis: Axes, size: float) -> None:
    """Extend a vertical axis to at least this size on both sides of zero."""
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, -size), max(high, size))


class _FigureLayout(NamedTuple):
    """Figure layout in inches, so that margins do not change with the figure size.

    Attributes:
        figure: Figure that is laid out.
        width: Width in inches.
        height: Height in inches.
    """

    figure: Figure
    width: float
    height: float

    def across(self, inches: float) -> float:
        """Convert a distance from the left edge in inches to a share of the width."""
        return inches / self.width

    def up(self, inches: float) -> float:
        """Convert a distance from the lower edge in inches to a share of the height."""
        return inches / self.height

    def heading(self, inches: float, text: str) -> None:
        """Write a heading at a distance from the left edge, in a font size that fits.

        Args:
            inches: Distance from the left edge.
            text: Text of the heading.
        """
        # Hinting makes letters wider on the page than their outlines.
        available_width = self.width - inches - 0.3
        size = _HEADING_SIZE * min(1.0, available_width / measure_text_width([text], _HEADING_SIZE))
        y = 1 - self.up(_HEADING_OFFSET)
        self.figure.text(self.across(inches), y, text, fontsize=size, va="center")


_MIN_NAMES_WIDTH = 1.9
"""Minimum width for the names of places, in inches."""
_PROFILES_AFTER = 4.1
"""Distance from the end of the names of places to the profiles, in inches."""


def _draw_residual_locations(report: DiagnosisReportData) -> Figure:
    """Draw the gap locations on the left, and the most informative profiles on the right."""
    locations, profiles = (
        select_gap_locations(report.gap_locations),
        select_informative_profiles(report.profiles),
    )
    rows = min(2, len(profiles))
    columns = -(-len(profiles) // 2)
    names = place_names(locations)
    left_margin = max(_MIN_NAMES_WIDTH, 0.25 + measure_text_width(names, _STYLE["font.size"]))
    profiles_from = left_margin + _PROFILES_AFTER
    # A single column of profiles is wider than one of several columns.
    width = left_margin + 3.3 + (3.1 * columns if columns != 1 else 4.4)
    row_height = 0.27 + 0.13 * (count_max_lines(names) - 1)
    # Variables of robots have long names, which need several lines below the panels.
    label_height = 0.15 * (
        count_max_lines([format_profile_label(profile) for profile in profiles]) - 1
    )
    height = max(2.6 + row_height * len(locations), 1.5 + (1.9 + label_height) * rows)
    figure, axes = make_panel_grid(1, 1, (width, height), layout=None)
    layout, axis = _FigureLayout(figure, width, height), axes[0, 0]
    axis.set_position((left_margin / width, 1.0 / height, 3.1 / width, 1 - 1.4 / height))
    draw_gap_location_panel(axis, locations, report)
    layout.heading(0.15, "Where the gap is")
    figure.legend(
        *get_legend_entries(axis), loc="lower left", ncols=2, fontsize=8.5, columnspacing=1.0
    )
    if not profiles:
        return figure

    channels = {profile.channel for profile in profiles}
    channel_text = (
        f" of {sanitise(profiles[0].channel, LONGEST_NAME)}" if len(channels) == 1 else ""
    )
    layout.heading(profiles_from, f"Residual{channel_text} against other variables")
    note = "means in bins, bars: ±2 standard errors; residual: measured − simulated"
    figure.text(layout.across(profiles_from), layout.up(0.2), note, fontsize=8.5, va="center")
    grid = figure.add_gridspec(
        rows,
        columns,
        left=layout.across(profiles_from),
        right=1 - layout.across(0.12),
        bottom=layout.up(0.85 + label_height),
        top=1 - layout.up(0.5),
        hspace=0.45 + 0.6 * label_height,
        wspace=0.42,
    )
    units = {c.name: c.unit for c in report.channels}
    for i, profile in enumerate(profiles):
        axis = figure.add_subplot(grid[i // columns, i % columns])
        unit = units.get(profile.channel, "1")
        draw_profile_panel(
            axis, profile, unit, has_extended_model(report), one_channel=len(channels) == 1
        )
    return figure


_FIGURE_FUNCTIONS: Mapping[str, Callable[[DiagnosisReportData], Figure]] = {
    "robot": _draw_robot,
    "overview": _draw_overview,
    "where": _draw_residual_locations,
    "candidates": draw_candidates_figure,
}
