"""Interactive chart of measured and simulated motion, by run and channel, and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil, floor, isfinite, log10
from typing import NamedTuple

import numpy as np

from bench.diagnosis.report.cause_and_value_text import (
    QUANTITY_LABELS,
    format_label,
    format_number,
    format_unit,
    sanitise,
)
from bench.diagnosis.report.joint_figure import is_robot, list_joint_rows
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.run_selection import RunView, rank_runs
from bench.figures.label_text import shorten_name
from bench.figures.signal_thinning import select_extreme_samples
from bench.figures.style import BLACK, BLUE, VERMILION, MarkStyle, make_mark_style
from bench.pages.chart import Axis, AxisSpan, Panel, Series, TooltipLine
from bench.pages.page_table import Table
from sims.core.simulator import Array

MOTION_TABLE_NAME = "motion"
"""Name of the table, and of the chart."""
MAX_ROWS = 30_000
"""Maximum number of samples on the page, over all runs and channels; the file stays below 3 MB."""
MIN_ROWS_PER_CHANNEL = 500
"""Minimum number of samples per channel and run; if that is too many, runs are left out."""
MAX_INITIAL_CHANNELS = 8
"""Maximum number of channels that are visible at first: those with the largest gap."""
NOISE_RESOLUTION = 100.0
"""Resolution of written values, as the noise divided by this number."""
MEASURED_STYLE = make_mark_style(BLACK, (), "o")
BASE_MODEL_STYLE = make_mark_style(VERMILION, (5.0, 2.0))
EXTENDED_MODEL_STYLE = make_mark_style(BLUE)
_MIN_HALF_HEIGHT = 3.0
"""Minimum half-height of a residual panel in noise standard deviations, so that noise does not fill
the panel.
"""
_MOTION_HEIGHT, _RESIDUAL_HEIGHT, _SIDE_BY_SIDE_HEIGHT = 250, 190, 190
"""Heights in pixels: of a motion panel and of a residual panel below it, and of both side by side.
"""


class MotionTable(NamedTuple):
    """Table of the chart, with its runs and the number of omitted runs.

    Attributes:
        frame: Table with one row per sample, as text.
        runs: Runs of the chart, the worst first, but the run of the printed figure before all
            others.
        part_count: Number of parts of the longest run of which the extremes are shown; 0 if all
            samples are shown.
        longest: Number of samples of the longest run.
        absent: Number of runs that are not shown.
    """

    frame: Table
    runs: tuple[RunView, ...]
    part_count: int
    longest: int
    absent: int


def build_motion_table(report: DiagnosisReportData) -> MotionTable:
    """Build the table of samples that the interactive chart shows.

    About `MAX_ROWS` rows are divided among the runs and channels. If there are too many runs, those
    with the smallest residuals are left out; if runs have too many samples, only the extremes of
    short parts are shown.

    Args:
        report: content of the report, with the measured and simulated runs.

    Returns:
        The table with its runs, the number of parts of a run (0 if all samples are shown), the
        samples of the longest run, and the number of runs that are left out.
    """
    runs = rank_runs(report)
    channel_count = len(report.channels)
    shown_runs = runs[: max(1, MAX_ROWS // (MIN_ROWS_PER_CHANNEL * channel_count))]
    samples_per_run = max(MIN_ROWS_PER_CHANNEL, MAX_ROWS // (len(shown_runs) * channel_count))
    columns: dict[str, list[str]] = {}
    for run in shown_runs:
        for channel_index in range(channel_count):
            for name, cells in _format_rows(report, run, channel_index, samples_per_run).items():
                columns.setdefault(name, []).extend(cells)
    # No run is divided into parts if all its samples are shown: then the number of parts is 0.
    longest_run = max(len(run.times) for run in shown_runs)
    part_count = _count_parts(report, samples_per_run) if longest_run > samples_per_run else 0
    return MotionTable(
        frame=Table(columns),
        runs=tuple(shown_runs),
        part_count=part_count,
        longest=longest_run,
        absent=len(runs) - len(shown_runs),
    )


def _format_run_title(report: DiagnosisReportData, run: RunView) -> str:
    """Format the label of a run: its name, whether it is held out, and its RMS residual."""
    split_note = ""
    if run.held_out:
        split_note = ", left out" if report.cross_validated else ", held out"
    return f"{sanitise(run.name, 40)}{split_note}: RMS residual {format_number(run.gap, 2)} σ"


def _count_parts(report: DiagnosisReportData, max_rows: int) -> int:
    """Return the number of parts into which a long run is divided for the chart.

    In each part the minimum and maximum of each signal are kept.

    Args:
        report: content of the report; with an extended model there are three signals instead of
            two.
        max_rows: maximum number of samples of a run in the chart.
    """
    signal_count = 3 if report.has_extended_model else 2
    return max(1, max_rows // (2 * signal_count))


def _format_rows(
    report: DiagnosisReportData, run: RunView, channel_index: int, max_rows: int
) -> dict[str, list[str]]:
    """Format the samples of a channel of a run as columns of text, by name, for the chart's table.

    If there are more than `max_rows` samples, only the extremes of short parts are kept. Residuals
    are in units of the noise.

    Args:
        report: content of the report.
        run: the run with its data.
        channel_index: index of the channel.
        max_rows: maximum number of samples.
    """
    channel, times = report.channels[channel_index], run.times
    models = ("before", "after") if report.has_extended_model else ("before",)
    observed = run.get_samples("observed", channel_index)
    simulated = [run.get_samples(model, channel_index) for model in models]
    residuals = [run.compute_residual(model, channel_index) for model in models]
    shown = np.arange(len(times))
    if len(times) > max_rows:
        shown = select_extreme_samples([observed, *residuals], _count_parts(report, max_rows))
    # As many decimals as the noise divided by `NOISE_RESOLUTION` needs; 9 if it is unknown.
    value_decimals = 9
    if channel.sigma > 0:
        value_decimals = int(np.clip(ceil(log10(NOISE_RESOLUTION / channel.sigma)), 0, 15))
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    # A thousandth of a step shows whether time stamps have jitter.
    time_decimals = int(np.clip(3 - floor(log10(step)), 0, 9)) if step > 0 else 6
    return {
        "run": [sanitise(run.name, 80)] * len(shown),
        "channel": [sanitise(channel.name, 80)] * len(shown),
        "t": _format_numbers(times[shown], time_decimals),
        "measured": _format_numbers(observed[shown], value_decimals),
        **{
            model: _format_numbers(values[shown], value_decimals)
            for model, values in zip(models, simulated, strict=True)
        },
        **{
            f"residual_{model}": _format_numbers(values[shown], 2)
            for model, values in zip(models, residuals, strict=True)
        },
    }


def _format_numbers(values: Array, digits: int) -> list[str]:
    """Format numbers with at most this many decimals; empty for missing values.

    Args:
        values: (T,) numbers, NaN where missing.
        digits: maximum number of decimals.
    """
    texts = [f"{value:.{digits}f}" if isfinite(value) else "" for value in values.tolist()]
    return [text.rstrip("0").rstrip(".") if "." in text else text for text in texts]


class MotionChart(NamedTuple):
    """Content of the chart.

    Attributes:
        table: Table of the chart.
        panels: Motion and residual of each channel of each run.
        columns: Number of panels side by side.
        sides: Position of motion and residual, in words.
        toggles: Facets whose panels are switched on and off.
        off: Values of toggles that are initially off.
    """

    table: MotionTable
    panels: list[Panel]
    columns: int
    sides: tuple[str, str]
    toggles: tuple[str, ...]
    off: Mapping[str, tuple[str, ...]]


def make_motion_chart(report: DiagnosisReportData) -> MotionChart:
    """Make the chart with its table.

    The chart shows measured and simulated channels over time, and their residual; readers select
    the run and the channels. With several channels, motion and residual are placed side by side.

    Args:
        report: Data of the report.
    """
    table, places = build_motion_table(report), _list_switches(report)
    is_wide = len(places) > 2 or is_robot(report)
    panels: list[Panel] = []
    for run in table.runs:
        for facets, channel_index in places:
            # Facets are the values of the switches by which readers show a panel.
            all_facets = {"run": _format_run_title(report, run), **facets}
            panels += _make_panels(report, run, channel_index, all_facets, is_wide)
    toggles = ("joint", "quantity") if is_robot(report) else ("channel",)
    return MotionChart(
        table=table,
        panels=panels,
        columns=2 if is_wide else 1,
        sides=("Left", "Right") if is_wide else ("Above", "Below"),
        toggles=toggles,
        off={toggles[0]: _list_hidden(report, places, toggles[0])},
    )


def _list_switches(report: DiagnosisReportData) -> list[tuple[dict[str, str], int]]:
    """Return the switches of each channel, by which readers show and hide its panels.

    A robot has two switches, joint and quantity (position, velocity, ...); sensors are a quantity
    of their own. Other systems have one switch, the channel.

    Args:
        report: Data of the report.

    Returns:
        Labels by which a panel is switched on, and the index of its channel.
    """
    if not is_robot(report):
        return [({"channel": sanitise(c.name, 40)}, i) for i, c in enumerate(report.channels)]
    places = []
    for row in list_joint_rows(report):
        for quantity, channel_index in row.channels.items():
            prefix, _, _ = report.channels[channel_index].name.partition(".")
            # The name of a sensor does not begin with a quantity.
            label = QUANTITY_LABELS[quantity] if prefix in QUANTITY_LABELS else "sensor"
            facets = {"joint": sanitise(row.name, 40), "quantity": label}
            places.append((facets, channel_index))
    return places


def _list_hidden(
    report: DiagnosisReportData, places: Sequence[tuple[dict[str, str], int]], toggle: str
) -> tuple[str, ...]:
    """Return the channels or joints that are hidden at first, if there are many.

    Those with the largest residuals stay visible, until `MAX_INITIAL_CHANNELS` channels are
    visible; at least one joint stays visible, however many channels it has.

    Args:
        report: content of the report, with the residual of each channel.
        places: facets of each channel (labels by which it is switched on), and its index.
        toggle: facet whose values are hidden, such as ``joint``.
    """
    if len(places) <= MAX_INITIAL_CHANNELS:
        return ()
    gap_by_channel = {
        location.label: location.before
        for location in report.gap_locations
        if location.kind == "channel"
    }
    gaps_by_name: dict[str, list[float]] = {}
    for facets, channel_index in places:
        gap = gap_by_channel.get(report.channels[channel_index].name, 0.0)
        gaps_by_name.setdefault(facets[toggle], []).append(gap)
    remaining = MAX_INITIAL_CHANNELS
    visible_names: set[str] = set()
    # A joint whose channels exceed the remaining number is skipped; a smaller one may still fit.
    for name in sorted(gaps_by_name, key=lambda name: max(gaps_by_name[name]), reverse=True):
        channel_count = len(gaps_by_name[name])
        if not visible_names or channel_count <= remaining:
            visible_names.add(name)
            remaining -= channel_count
    return tuple(name for name in gaps_by_name if name not in visible_names)


def _make_panels(
    report: DiagnosisReportData,
    run: RunView,
    channel_index: int,
    facets: dict[str, str],
    is_wide: bool,
) -> tuple[Panel, Panel]:
    """Make two panels of one channel of a run: its motion, and its residual in noise units.

    Both panels read their columns from the motion table of the page, by run and channel. The
    residual panel has a band of two standard deviations of the noise; for robots its scale is
    common to all joints.

    Args:
        report: content of the report.
        run: the run with its data.
        channel_index: index of the channel.
        facets: values of the switches that show these panels.
        is_wide: whether the panels are side by side.
    """
    channel = report.channels[channel_index]
    selection = {
        "run": sanitise(run.name, 80),
        "channel": sanitise(channel.name, 80),
    }
    extended = report.has_extended_model
    series = [Series("measured", "measured", MEASURED_STYLE, selection, draw="points", under=True)]
    residuals = [Series("simulated before", "residual_before", BASE_MODEL_STYLE, selection)]
    if extended:
        series.append(Series("simulated after", "after", EXTENDED_MODEL_STYLE, selection))
        residuals.insert(
            0, Series("simulated after", "residual_after", EXTENDED_MODEL_STYLE, selection)
        )
    series.append(Series("simulated before", "before", BASE_MODEL_STYLE, selection))
    time_axis = Axis("time [s]", scales=("linear",))
    name = sanitise(channel.name, 40)
    # For the joints of a robot, a common scale makes residuals comparable.
    quantity = facets.get("quantity", name)
    residual_axis = Axis(
        f"residual of {quantity} [σ]",
        scales=("linear",),
        holds=(-_MIN_HALF_HEIGHT, _MIN_HALF_HEIGHT),
    )
    value_axis = Axis(
        format_label(shorten_name(sanitise(channel.name), 24), channel.unit), scales=("linear",)
    )
    noise_band = (AxisSpan(-2.0, 2.0, "±2σ: 95 % of the noise", along="y"),)
    tooltip_lines = _make_tooltip_lines(format_unit(channel.unit), channel.sigma, extended)
    motion_height, residual_height = _MOTION_HEIGHT, _RESIDUAL_HEIGHT
    if is_wide:
        motion_height = residual_height = _SIDE_BY_SIDE_HEIGHT
    motion_panel = Panel(
        title=name,
        table=MOTION_TABLE_NAME,
        x="t",
        series=tuple(series),
        across=time_axis,
        up=value_axis,
        facets=facets,
        tells=tooltip_lines,
        height=motion_height,
    )
    residual_panel = replace(
        motion_panel,
        title=f"{name}: residual",
        series=tuple(residuals),
        up=residual_axis,
        spans=noise_band,
        height=residual_height,
    )
    return motion_panel, residual_panel


def _make_tooltip_lines(unit: str, sigma: float, extended: bool) -> tuple[TooltipLine, ...]:
    """Return the values that the chart shows at the cursor.

    They are the signals in `unit`, and the residuals both in that unit and in units of the noise.

    Args:
        unit: unit of the channel.
        sigma: standard deviation of its noise.
        extended: whether there is an extended model.
    """

    def residual(label: str, column: str, style: MarkStyle) -> TooltipLine:
        # A residual in σ times `sigma` has the unit of the channel.
        return TooltipLine(label, column, "σ", style, sigma, unit)

    tooltip_lines = [
        TooltipLine("measured", "measured", unit, MEASURED_STYLE),
        TooltipLine("before", "before", unit, BASE_MODEL_STYLE),
    ]
    if extended:
        tooltip_lines.append(TooltipLine("after", "after", unit, EXTENDED_MODEL_STYLE))
    tooltip_lines.append(residual("residual before", "residual_before", BASE_MODEL_STYLE))
    if extended:
        tooltip_lines.append(residual("residual after", "residual_after", EXTENDED_MODEL_STYLE))
    return tuple(tooltip_lines)
