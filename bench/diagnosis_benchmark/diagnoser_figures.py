"""Figures of a comparison of diagnosers, readable in print and in greyscale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.diagnosis_benchmark.result_tables import PRIMARY_METRIC, TableRow, index_by_diagnoser
from bench.figures import style

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
TARGET_FALSE_ALARM_RATE = 0.01
"""Maximum acceptable fraction of false alarms, drawn as a reference line."""


def get_line_style(name: str, order: Sequence[str]) -> dict[str, Any]:
    """Return colour, marker and line style of a diagnoser, by its position in the order.

    Args:
        name: name of the diagnoser.
        order: names of all diagnosers.
    """
    place = list(order).index(name)
    return {
        "color": style.get_colour(place),
        "marker": style.get_marker(place),
        "linestyle": style.get_line_style(place),
        "label": name,
    }


def draw_leaderboard(table: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw diagnosed single causes against false alarms; the best position is top left.

    Args:
        table: table of all metrics.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 1, (7.6, 4.8))
    axis: Axes = axes[0][0]
    alarms = index_by_diagnoser(table, "false alarms")
    named_shares = index_by_diagnoser(table, PRIMARY_METRIC)
    for name in order:
        x, y = alarms[name], named_shares[name]
        line_style = {**get_line_style(name, order), "linestyle": "none"}
        axis.errorbar(
            100 * x["share"],
            100 * y["share"],
            xerr=_compute_error_bars(x),
            yerr=_compute_error_bars(y),
            markersize=7,
            linewidth=1.0,
            elinewidth=1.0,
            capsize=2.5,
            **line_style,
        )
    axis.axvline(
        100 * TARGET_FALSE_ALARM_RATE,
        color=style.CAPTION_GREY,
        linewidth=0.9,
        linestyle=(0, (2, 2)),
    )
    axis.set_xscale("symlog", linthresh=2.0)
    axis.set_xlim(-0.15, 110)
    ticks = [0, 1, 2, 5, 10, 20, 50, 100]
    axis.set_xticks(ticks, [f"{tick}" for tick in ticks])
    axis.set_ylim(-3, 103)
    axis.set_xlabel("false alarms where nothing is hidden [%]")
    axis.set_ylabel("single causes named [%]")
    style.style_axis(axis)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    clean_count, single_count = (
        max(int(v["of"]) for v in part.values()) for part in (alarms, named_shares)
    )
    style.add_caption(
        figure,
        f"{clean_count} recordings with nothing hidden, {single_count} with one effect of at least "
        "one noise. Named: alone or in a set of at most two, equivalent effects being one. Bars: "
        "95 % (Clopper-Pearson, Wilson). Dashes: 1 % of false alarms.",
        letters=16,
    )
    return figure


def draw_power(frame: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the fractions of causes diagnosed and detected, against the size of the effect.

    Args:
        frame: table of the power.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 2, (9.6, 4.4), sharey=True)
    for axis, metric, metric_title in zip(
        axes[0],
        ("named", "seen"),
        ("named (set of at most two)", "gap detected"),
        strict=True,
    ):
        part = frame[frame["metric"] == metric]
        for place, name in enumerate(order):
            diagnoser_rows = part[part["diagnoser"] == name].sort_values("size")
            if diagnoser_rows.empty:
                continue
            # Shifted sideways, so that the error bars of the diagnosers do not overlap.
            x = diagnoser_rows["size"].to_numpy() * (1 + 0.025 * (place - (len(order) - 1) / 2))
            y, low, high = (
                100 * diagnoser_rows[key].to_numpy() for key in ("share", "low", "high")
            )
            axis.errorbar(
                x,
                y,
                yerr=np.maximum([y - low, high - y], 0.0),
                linewidth=1.3,
                elinewidth=0.7,
                capsize=1.8,
                markersize=5,
                **get_line_style(name, order),
            )
        sizes = sorted(part["size"].unique())
        axis.set_xscale("log")
        axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axis.minorticks_off()
        axis.set_ylim(-3, 103)
        axis.set_xlabel("size of the hidden effect [noises]")
        axis.set_title(metric_title, fontsize=10)
        style.style_axis(axis)
    axes[0][0].set_ylabel("share of recordings [%]")
    axes[0][1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    counts = frame[(frame["metric"] == "named") & (frame["diagnoser"] == order[0])]
    case_counts = ", ".join(
        f"{int(n)} at {s:g}" for s, n in counts.sort_values("size")[["size", "of"]].to_numpy()
    )
    style.add_caption(
        figure,
        f"Recordings with one hidden effect: {case_counts} noises. Bars: 95 % (Wilson). Compare "
        "with the false alarms: a diagnoser that always alarms detects everything.",
        letters=16,
    )
    return figure


def draw_outcomes(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the outcomes of all recordings with one hidden effect, as stacked bars.

    Args:
        rows: one row per answer on a single effect.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 1, (8.6, 0.5 * len(order) + 2.2))
    axis: Axes = axes[0][0]
    places = np.arange(len(order))[::-1]
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
            places,
            widths,
            left=bar_starts,
            color=colour,
            edgecolor=style.NEUTRAL_MARK,
            linewidth=0.5,
            label=label,
        )
        for place, width, bar_start, count in zip(places, widths, bar_starts, counts, strict=True):
            # A narrower part has no room for its number.
            if width > 4:
                is_dark = colour in (style.BLACK, style.BLUE, style.VERMILION)
                axis.text(
                    bar_start + width / 2,
                    place,
                    str(count),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if is_dark else style.NEUTRAL_MARK,
                )
        bar_starts += widths
    axis.set_yticks(places, order)
    axis.set_xlim(0, 100)
    axis.set_xlabel("recordings with one hidden effect of at least one noise [%]")
    style.style_axis(axis)
    axis.grid(visible=False)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    figure.suptitle(title, fontsize=11)
    style.add_caption(figure, f"{total} recordings; numbers in bars count them.", letters=16)
    return figure


def draw_p_value_calibration(frame: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the fraction of clean recordings with a p-value at most a level, against the level.

    For a calibrated p-value, the fraction equals the level.

    Args:
        frame: calibration table.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 1, (6.8, 4.4))
    axis: Axes = axes[0][0]
    levels = sorted(frame["level"].unique())
    axis.plot(levels, levels, color=style.CAPTION_GREY, linewidth=0.9, linestyle=(0, (2, 2)))
    names = [name for name in order if (frame["diagnoser"] == name).any()]
    for place, name in enumerate(names):
        diagnoser_rows = frame[frame["diagnoser"] == name].sort_values("level")
        y, low, high = (diagnoser_rows[key].to_numpy() for key in ("share", "low", "high"))
        axis.errorbar(
            diagnoser_rows["level"].to_numpy() * (1 + 0.03 * (place - (len(names) - 1) / 2)),
            y,
            yerr=np.maximum([y - low, high - y], 0.0),
            linewidth=1.3,
            elinewidth=0.8,
            capsize=2,
            markersize=5,
            **get_line_style(name, order),
        )
    axis.set_xscale("log")
    axis.set_xticks(levels, [f"{level:g}" for level in levels])
    axis.minorticks_off()
    axis.set_ylim(-0.03, 1.03)
    axis.set_xlabel("level")
    axis.set_ylabel("share of recordings whose p is at most that")
    style.style_axis(axis)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    case_count = int(frame["of"].max())
    style.add_caption(
        figure,
        f"Up to {case_count} recordings with nothing hidden. Dashes: calibrated p-values. Below: "
        "conservative; above: too many alarms. Bars: 95 % (Clopper-Pearson).",
        letters=16,
    )
    return figure


def draw_cost(costs: pd.DataFrame, table: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw diagnosed single causes against the cost of an answer.

    Args:
        costs: table of the costs.
        table: table of all metrics.
        order: names of the diagnosers.
        title: title of the figure.
    """
    figure, axes = style.make_panel_grid(1, 2, (9.6, 4.2), sharey=True)
    named_shares = index_by_diagnoser(table, PRIMARY_METRIC)
    costs_by_diagnoser = index_by_diagnoser(costs)
    for axis, column, unit in zip(
        axes[0],
        ("simulations", "processor_seconds"),
        ("simulations for an answer", "processor time for an answer [s]"),
        strict=True,
    ):
        for name in order:
            y = named_shares[name]
            middle, high = (
                float(costs_by_diagnoser[name][f"{column}_{quantity}"])
                for quantity in ("median", "p95")
            )
            if not middle > 0:
                continue
            axis.errorbar(
                middle,
                100 * y["share"],
                xerr=[[0.0], [max(high - middle, 0.0)]],
                yerr=_compute_error_bars(y),
                markersize=7,
                elinewidth=0.9,
                capsize=2,
                **{**get_line_style(name, order), "linestyle": "none"},
            )
        axis.set_xscale("log")
        axis.set_ylim(-3, 103)
        axis.set_xlabel(unit)
        style.style_axis(axis)
    axes[0][0].set_ylabel("single causes named [%]")
    axes[0][1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    training_simulations = {n: int(costs_by_diagnoser[n]["training_simulations"]) for n in order}
    training_text = "; ".join(
        f"{name} was trained with {count:,} simulations".replace(",", " ")
        for name, count in training_simulations.items()
        if count
    )
    style.add_caption(
        figure,
        "Marks: median; bars to the right: 95 % of the answers; up and down: 95 % (Wilson). "
        + (f"{training_text}." if training_text else ""),
        letters=16,
    )
    return figure


def _compute_error_bars(line: TableRow) -> list[list[float]]:
    """Return the lower and upper length of an error bar, in per cent, as matplotlib expects them.

    Args:
        line: a fraction with the bounds of its interval: share, low and high, from 0 to 1.
    """
    share, low, high = (float(line[key]) for key in ("share", "low", "high"))
    return [[100 * max(share - low, 0.0)], [100 * max(high - share, 0.0)]]
