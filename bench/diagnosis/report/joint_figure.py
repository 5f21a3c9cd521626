"""Figure of one run, joint by joint for a robot and else channel by channel.

Each row shows the measured and simulated motion, and next to it the residual of each recorded
quantity in units of its noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.report.cause_and_value_text import (
    QUANTITY_LABELS,
    format_number,
    sanitise,
    shorten_label,
)
from bench.diagnosis.report.diagnosed_places import list_marked_joints, list_place_marks
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.run_selection import RunView, format_selected_run, select_worst_run
from bench.figures.figure_layout import make_panel_grid
from bench.figures.label_text import POINTS, break_name, measure_text_width
from bench.figures.signal_thinning import thin_signal
from bench.figures.style import (
    BASE_MODEL_LINE,
    BLUE,
    CAPTION_GREY,
    EXTENDED_MODEL_LINE,
    NEUTRAL_MARK,
    NOISE_BAND_GREY,
    ZERO_LINE_GREY,
)
from sims.core.root_mean_square import compute_rms

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_SAMPLES = 3000
"""Maximum number of samples drawn of a run; of a longer run the extremes of each part are drawn."""
MAX_OUTLINED_DOTS = 1000
"""Maximum number of dots drawn as vector outlines; more dots are rasterised in vector files too."""
MAX_JOINTS = 10
"""Maximum number of rows; those with the largest residuals are shown."""
MIN_RESIDUAL_AXIS_SIGMAS = 4.0
"""Minimum half-height of a residual panel in noise standard deviations, so that noise does not fill
the panel.
"""
RESIDUAL_AXIS_QUANTILE = 0.999
"""Quantile of the residuals that fits into a panel, so that a single outlier does not flatten the
others.
"""
_ROW_HEIGHTS = {1: 2.6, 2: 1.9, 3: 1.5, 4: 1.25, 5: 1.1}
"""Height of a row in inches, by the number of rows."""
_MIN_ROW_HEIGHT = 1.0
NAMED_JOINT_MARKER = "▸"
"""Marker before the name of a diagnosed joint, visible in print without colour too."""
LONGEST_NAME = 64
"""Maximum number of characters of the name of a joint or sensor."""
_NAME_LINE_LENGTH = 18
"""Maximum number of characters per line of the name of a joint or sensor."""
_NAME_SIZE = 9.5
"""Font size of the names of joints and sensors, in points."""
_NAME_GAP_INCHES = 0.85
"""Space between names and panels in inches, for ticks and units."""
_TOP_MARGIN_INCHES, _BOTTOM_MARGIN_INCHES = 0.75, 0.95
"""Space above and below the rows, in inches."""


class JointRow(NamedTuple):
    """Row of the figure: a joint or a sensor.

    Attributes:
        name: Name of the joint or sensor.
        motion_channel: Index of the channel whose motion is shown.
        channels: Indices of its channels, by quantity.
    """

    name: str
    motion_channel: int
    channels: Mapping[str, int]


def is_robot(report: DiagnosisReportData) -> bool:
    """Return whether the channels are those of a robot."""
    return report.robot is not None and len(list_joint_rows(report)) > 0


def list_joint_rows(report: DiagnosisReportData) -> list[JointRow]:
    """List a row for each joint, in the order of the channels, then one for each other channel.

    Channels are named ``quantity.joint``, such as ``q.elbow`` for its position. A row has all
    channels of its joint; its motion is the position, or else the velocity or torque. Other
    channels are sensors.

    Args:
        report: Report data.
    """
    joints: dict[str, dict[str, int]] = {}
    sensors = []
    for channel_index, channel in enumerate(report.channels):
        quantity, _, name = channel.name.partition(".")
        if quantity in QUANTITY_LABELS and name:
            joints.setdefault(name, {})[quantity] = channel_index
        else:
            # The residual of a sensor is in the first column.
            channels = {_get_first_quantity(report): channel_index}
            sensors.append(JointRow(channel.name, channel_index, channels))
    rows = []
    for name, channels in joints.items():
        # `QUANTITY_LABELS` has position, velocity and torque in this order.
        motion_channel = next(channels[q] for q in QUANTITY_LABELS if q in channels)
        rows.append(JointRow(name, motion_channel, channels))
    return rows + sensors


def _get_first_quantity(report: DiagnosisReportData) -> str:
    """Return the quantity of the first residual column, which also holds those of sensors."""
    return next(iter(_list_quantities(report)), "q")


def _list_quantities(report: DiagnosisReportData) -> list[str]:
    """Return the recorded quantities of joints, such as position and velocity, in a fixed order."""
    recorded_quantities = {channel.name.partition(".")[0] for channel in report.channels}
    return [quantity for quantity in QUANTITY_LABELS if quantity in recorded_quantities]


def draw_run_figure(report: DiagnosisReportData) -> Figure:
    """Draw the run with the largest residual: motion and residuals of each joint in a row.

    A system that is not a robot has a row for each channel. Of many rows, those with the largest
    residuals are selected. The first column of panels shows the motion, and each further one the
    residuals of one quantity, such as position, in a common scale. Names of joints that the
    diagnosis names are highlighted.

    Args:
        report: Report data.
    """
    view = select_worst_run(report)
    rows = _select_worst_rows(report, view)
    quantities = [name for name in QUANTITY_LABELS if any(name in row.channels for row in rows)]
    row_height = _ROW_HEIGHTS.get(len(rows), _MIN_ROW_HEIGHT)
    named_joints = {mark.name for mark in list_place_marks(report)} | list_marked_joints(report)
    names = [_format_row_name(row, row.name in named_joints) for row in rows]
    # Widths in inches: names, the panel of motion (5.15), and each panel of residuals (2.6), with
    # their margins.
    names_width = max(1.95, 0.12 + measure_text_width(names, _NAME_SIZE, "bold") + _NAME_GAP_INCHES)
    width = names_width + 5.15 + 2.6 * len(quantities)
    height = _TOP_MARGIN_INCHES + _BOTTOM_MARGIN_INCHES + row_height * len(rows)
    # A panel of motion is 1.4 times as wide as one of residuals.
    ratios = (4.2, *[3.0] * len(quantities))
    figure, axes = make_panel_grid(
        len(rows), len(ratios), (width, height), layout=None, sharex=True, width_ratios=ratios
    )
    for row, (motion_panel, *residual_panels) in zip(rows, axes, strict=True):
        _draw_motion(motion_panel, report, view, row, row.name in named_joints)
        for panel, quantity in zip(residual_panels, quantities, strict=True):
            if quantity in row.channels:
                _draw_residual(panel, report, view, row.channels[quantity])
            else:
                panel.set_axis_off()
    for column, quantity in enumerate(quantities, start=1):
        _unify_scale(axes[:, column], view, rows, quantity)
        label = f"residual of {QUANTITY_LABELS[quantity]}" if is_robot(report) else "residual"
        axes[0, column].set_title(f"{label} [σ]", fontsize=9.5, loc="left")
    axes[0, 0].set_title("measured and simulated", fontsize=9.5, loc="left")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
        # The narrow columns have little space for tick labels, which may be long.
        panel.locator_params(axis="x", nbins=4)
    _add_title_and_legend(figure, axes, report, view, rows, names_width)
    return figure


def _select_worst_rows(report: DiagnosisReportData, view: RunView) -> list[JointRow]:
    """Select the rows with the largest residuals, in their original order.

    Args:
        report: content of the report.
        view: run to show: its part of the data, and its index there.
    """
    rows = list_joint_rows(report)

    def gap(row: JointRow) -> float:
        """Return the largest RMS residual of a channel of the row with the base model."""
        return max(
            _compute_residual_rms(view, channel_index, "before")
            for channel_index in row.channels.values()
        )

    worst_rows = sorted(rows, key=gap, reverse=True)[:MAX_JOINTS]
    return [row for row in rows if row in worst_rows]


def _compute_residual_rms(view: RunView, channel_index: int, model: str) -> float:
    """Return the RMS residual of a channel in this run in noise units; 0 without samples.

    Args:
        view: run to show.
        channel_index: index of the channel.
        model: ``before`` for the base model, ``after`` for the extended one.
    """
    residual = view.compute_residual(model, channel_index)
    finite = residual[np.isfinite(residual)]
    return compute_rms(finite) if finite.size else 0.0


def _draw_motion(
    panel: Axes, report: DiagnosisReportData, view: RunView, row: JointRow, is_named: bool
) -> None:
    """Draw the measured and simulated motion of a joint, with its name at the left.

    Long signals are thinned to their extremes, so that no peak disappears.

    Args:
        panel: axes to draw on.
        report: content of the report.
        view: run to show: its part of the data, and its index there.
        row: the joint or sensor, with the index of the channel that shows its motion.
        is_named: whether the diagnosis names the joint; its name is then highlighted.
    """
    channel = report.channels[row.motion_channel]
    shown_samples = thin_signal(view.get_samples("observed", row.motion_channel), MAX_SAMPLES)
    measured, before, after = (
        view.get_samples(name, row.motion_channel)[shown_samples]
        for name in ("observed", "before", "after")
    )
    shown_times = view.times[shown_samples]
    size = 4.0 if shown_samples.size < 250 else 3.4  # points: smaller dots for many samples
    panel.plot(
        shown_times,
        measured,
        "o",
        color="black",
        markersize=size,
        markeredgewidth=0,
        label="measured",
        zorder=1,
        rasterized=shown_samples.size > MAX_OUTLINED_DOTS,
    )
    base_label = "simulated before (tuned)" if report.has_extended_model else "simulated (tuned)"
    panel.plot(shown_times, before, label=base_label, zorder=3, **BASE_MODEL_LINE)
    if report.has_extended_model:
        # Where the curves agree, "before" is visible as dashes on "after", and "after" on the dots.
        panel.plot(shown_times, after, label="simulated after", zorder=2, **EXTENDED_MODEL_LINE)
    quantity, _, joint = channel.name.partition(".")
    symbol = quantity if joint and quantity in QUANTITY_LABELS else ""
    panel.set_ylabel(shorten_label(symbol, channel.unit, 14), fontsize=8)
    panel.annotate(
        _format_row_name(row, is_named),
        (0, 0.5),
        (-0.72 * POINTS, 0),  # 0.72 inches to the left of the panel
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=_NAME_SIZE,
        weight="bold",
        color=BLUE if is_named else NEUTRAL_MARK,
        annotation_clip=False,
    )
    panel.margins(x=0.01)
    panel.locator_params(axis="y", nbins=4)
    panel.tick_params(labelsize=8)


def _format_row_name(row: JointRow, is_named: bool) -> str:
    """Format the name of a joint or sensor in short lines.

    Args:
        row: the joint or sensor.
        is_named: whether the verdict names it; it is then marked.
    """
    name = break_name(sanitise(row.name, LONGEST_NAME), _NAME_LINE_LENGTH)
    return f"{NAMED_JOINT_MARKER} {name}" if is_named else name


def _draw_residual(
    panel: Axes, report: DiagnosisReportData, view: RunView, channel_index: int
) -> None:
    """Draw the residuals of a channel in units of its noise, with the RMS of each model above.

    The models are the base model and, if there are causes, the extended one. A band marks two
    standard deviations of the noise.

    Args:
        panel: axes to draw on.
        report: content of the report.
        view: run to show: its part of the data, and its index there.
        channel_index: index of the channel.
    """
    panel.axhspan(
        -2, 2, color=NOISE_BAND_GREY, linewidth=0, label="±2σ: 95 % of the noise", zorder=0
    )
    panel.axhline(0, color=ZERO_LINE_GREY, linewidth=0.6, zorder=1)
    models = ("before", "after") if report.has_extended_model else ("before",)
    for model in models:
        residual = view.compute_residual(model, channel_index)
        shown_samples = thin_signal(residual, MAX_SAMPLES)
        line_style = {**BASE_MODEL_LINE, "linewidth": 1.0, "zorder": 3}
        if model == "after":
            line_style = {**EXTENDED_MODEL_LINE, "linewidth": 0.8, "zorder": 2}
        line_style["rasterized"] = shown_samples.size > MAX_OUTLINED_DOTS
        panel.plot(view.times[shown_samples], residual[shown_samples], **line_style)
    rms_texts = [
        format_number(_compute_residual_rms(view, channel_index, model), 2) for model in models
    ]
    panel.text(
        1.0,
        1.02,
        " → ".join(rms_texts),
        transform=panel.transAxes,
        ha="right",
        va="bottom",
        fontsize=8.5,
        weight="bold",
        color=NEUTRAL_MARK,
    )
    panel.margins(x=0.01)
    panel.locator_params(axis="y", nbins=4)
    panel.tick_params(labelsize=8)


def _unify_scale(
    panels: Sequence[Axes], view: RunView, rows: Sequence[JointRow], quantity: str
) -> None:
    """Give the residuals of one quantity (a column) the same scale, to compare joints.

    The scale contains nearly all residuals of the base model; a quantile leaves out single peaks.

    Args:
        panels: axes of the column.
        view: run to show: its part of the data, and its index there.
        rows: joints and sensors of the figure.
        quantity: the quantity, such as ``q``.
    """
    limit = MIN_RESIDUAL_AXIS_SIGMAS
    for row in rows:
        if quantity in row.channels:
            residual = np.abs(view.compute_residual("before", row.channels[quantity]))
            finite = residual[np.isfinite(residual)]
            if finite.size:
                # 8 % above the quantile, so that its samples do not touch the edge.
                limit = max(limit, 1.08 * float(np.quantile(finite, RESIDUAL_AXIS_QUANTILE)))
    for panel in panels:
        panel.set_ylim(-limit, limit)


def _add_title_and_legend(
    figure: Figure,
    axes: Any,
    report: DiagnosisReportData,
    view: RunView,
    rows: Sequence[JointRow],
    names_width: float,
) -> None:
    """Add title, legend and margins to the figure of joints.

    The legend has the curves of the motion and the band of the noise.

    Args:
        figure: figure of Matplotlib.
        axes: array of its axes: motion, then residuals of each quantity.
        report: content of the report.
        view: the run that is shown.
        rows: joints and sensors of the figure.
        names_width: width of the names at the left of the panels, in inches.
    """
    width, height = figure.get_size_inches().tolist()
    total = len(list_joint_rows(report))
    rows_text, order_text = "channels", ""
    if is_robot(report):
        rows_text, order_text = "joints and sensors", ", joint by joint"
    selection = f"; the worst {len(rows)} of {total} {rows_text}" if len(rows) < total else ""
    selected_run = format_selected_run(report, view)
    title = f"{selected_run}{order_text} ({view.count_samples()} samples{selection})"
    figure.suptitle(title, fontsize=11, x=0.012, ha="left", y=1 - 0.2 / height, va="center")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    with warnings.catch_warnings():
        # The first row may have no panel in this column, so the legends of all rows are read;
        # Matplotlib warns of a panel without entries.
        warnings.simplefilter("ignore", UserWarning)
        residual_legends = [panel.get_legend_handles_labels() for panel in axes[:, 1]]
    # The band of the noise is the only entry, and the same in all rows: the first one is used.
    band_handles, band_labels = next(
        (legend for legend in residual_legends if any(legend)), ([], [])
    )
    figure.legend(
        [*handles, *band_handles],
        [*labels, *band_labels],
        loc="lower center",
        # The legend is 0.22 inches above the lower edge.
        bbox_to_anchor=(0.5, 0.22 / height),
        ncols=4,
        fontsize=9,
    )
    rms_text = "before → after" if report.has_extended_model else "its size"
    note = f"residual: measured − simulated; above each its RMS in σ, {rms_text}"
    figure.text(0.5, 0.14 / height, note, fontsize=8, ha="center", va="center", color=CAPTION_GREY)
    figure.subplots_adjust(
        left=names_width / width,
        right=1 - 0.12 / width,
        top=1 - _TOP_MARGIN_INCHES / height,
        bottom=_BOTTOM_MARGIN_INCHES / height,
        hspace=0.3,
        wspace=0.19,
    )
