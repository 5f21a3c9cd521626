"""Printed figures of a comparison of diagnosers, readable in greyscale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.diagnosis_benchmark.report_page.diagnoser_charts import build_chart_tables, make_charts
from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.figures import style
from bench.pages.chart_figure import draw_chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OUTCOME_STYLES = (
    ("right", style.BLACK, "named, alone"),
    ("set", style.BLUE, "in a set"),
    ("class", style.SKY_BLUE, "an equivalent one"),
    ("extra", style.ORANGE, "named, with another one"),
    ("wrong", style.VERMILION, "something else named"),
    ("unnamed", style.NOISE_BAND_GREY, "detected, not named"),
    ("missed", style.RECORDED_PART_GREY, "not detected"),
    ("undecided", style.RECORDED_PART_GREY, "unidentifiable"),
    ("failed", style.PURPLE, "no answer"),
)
"""Outcomes of single effects, the best first, with colour and legend text."""
_CHART_CAPTIONS = {
    "board": (
        "{clean_count} recordings with nothing hidden, {single_count} with one effect of at least "
        "one noise. Named: alone or in a set of at most two, equivalent effects being one. Bars: "
        "95 % intervals (Wilson). Dashes: 1 % of false alarms."
    ),
    "cost": "Marks: medians; bars: 95 % intervals (Wilson).",
    "power": (
        "Recordings with one hidden effect: {power_counts}. Bands: 95 % intervals (Wilson). "
        "Compare with the false alarms: a diagnoser that always alarms detects everything."
    ),
    "calibration": (
        "Up to {calibration_count} recordings with nothing hidden. Dashes: calibrated p-values. "
        "Below: conservative; above: too many alarms. Bands: 95 % intervals (Clopper-Pearson)."
    ),
}
"""Captions of the charts of the page that are also printed, by name."""
_SINGLE_PANEL_SIZE = (6.0, 4.0)
"""Width and height of the panel of a figure with one panel, in inches."""


def draw_chart_figures(data: DiagnoserReportData) -> dict[str, Figure]:
    """Draw the charts of the page that have data and a caption, by name.

    Args:
        data: the data of the report; its printed figures are not used.
    """
    tables = {**data.tables, **build_chart_tables(data)}
    charts, figures = make_charts(data), {}
    for name, caption in _CHART_CAPTIONS.items():
        if charts[name]:
            size = _SINGLE_PANEL_SIZE if len(charts[name]) == 1 else None
            figure, axes = draw_chart(charts[name], tables, size=size)
            entries = axes[0].get_legend_handles_labels()
            figure.legend(*entries, loc="outside right upper", fontsize=9, frameon=False)
            figure.suptitle(data.title, fontsize=11)
            style.add_caption(figure, caption.format(**data.counts), letters=16)
            figures[name] = figure
    return figures


def draw_outcomes(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the outcomes of all recordings with one hidden effect, as stacked bars.

    Args:
        rows: one row per answer on a single effect.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 1, (8.6, 0.5 * len(order) + 2.2))
    axis: Axes = axes[0][0]
    bar_positions = np.arange(len(order))[::-1]
    bar_starts = np.zeros(len(order))
    total = max(int((rows["diagnoser"] == name).sum()) for name in order)
    for outcome, colour, label in OUTCOME_STYLES:
        counts = [
            int(((rows["diagnoser"] == name) & (rows["outcome"] == outcome)).sum())
            for name in order
        ]
        if not any(counts):
            continue
        widths = 100.0 * np.array(counts) / max(total, 1)
        axis.barh(
            bar_positions,
            widths,
            left=bar_starts,
            color=colour,
            edgecolor=style.NEUTRAL_MARK,
            linewidth=0.5,
            label=label,
        )
        for bar_position, width, bar_start, count in zip(
            bar_positions, widths, bar_starts, counts, strict=True
        ):
            # A narrower part has no room for its number.
            if width > 4:
                is_dark = colour in (style.BLACK, style.BLUE, style.VERMILION)
                axis.text(
                    bar_start + width / 2,
                    bar_position,
                    str(count),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if is_dark else style.NEUTRAL_MARK,
                )
        bar_starts += widths
    axis.set_yticks(bar_positions, order)
    axis.set_xlim(0, 100)
    axis.set_xlabel("recordings with one hidden effect of at least one noise [%]")
    style.style_axis(axis)
    axis.grid(visible=False)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    figure.suptitle(title, fontsize=11)
    style.add_caption(figure, f"{total} recordings; numbers in bars count them.", letters=16)
    return figure
