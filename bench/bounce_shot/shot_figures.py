"""Figures of a bounce-shot study: hits by ball and method, misses, and example shots."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.hit_rate_table import make_success_panel
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_execution import ExampleShot, execute_example
from bench.bounce_shot.shot_geometry import find_path_end
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.bounce_shot.tuned_shots import (
    EXPLAIN_METHOD,
    EXPLAIN_SUFFIX,
    UNTUNED_METHOD,
)
from bench.figures.figure_output import FigureFiles, render_all_formats
from bench.figures.style import (
    BLACK,
    BLUE,
    CAPTION_GREY,
    GREY,
    INCLINE_GREY,
    VERMILION,
    add_trust_note,
    make_panel_grid,
)
from bench.pages.chart_figure import draw_chart, finish_chart
from sims.core.simulator import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GROUP_STYLES = {"untuned": (GREY, "s"), "tuned": (BLUE, "o"), "extended": (VERMILION, "D")}
"""Colour and marker of each group of methods."""
_GROUP_LABELS = {
    "untuned": "untuned simulator",
    "tuned": "restitution tuned to one recorded drop",
    "extended": "simulator extended by explain from the same drop",
}
_MAX_MISS_RADII = 6
"""Range of the shown misses, in radii of the hoop."""


def draw_figures(
    experiment: Experiment,
    settings: ShotConfig,
    setups: Sequence[ShotSetup],
    stored: Mapping[str, Any],
    rows: pd.DataFrame,
    lines: pd.DataFrame,
) -> dict[str, FigureFiles]:
    """Draw the figures of the bounce-shot study.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        setups: all shots.
        stored: stored results by name of the shot.
        rows: rows of shots.csv.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.

    Returns:
        Printed figures by name.
    """
    figures = {
        "success": draw_success_figure(experiment, lines),
        "off": draw_miss_figure(settings, rows),
    }
    example_shots = select_example_shots(setups, stored, rows)
    if example_shots:
        figures["shots"] = draw_shots_figure(settings, example_shots, stored)
    return {
        name: render_all_formats(add_trust_note(figure, experiment.trusted))
        for name, figure in figures.items()
    }


def get_method_group(method: str) -> str:
    """Return the group of a method, which determines its colour: untuned, tuned or extended.

    Extended methods use the simulator with the effects that explain added.

    Args:
        method: label of the method.
    """
    if method == UNTUNED_METHOD:
        return "untuned"
    return "extended" if method == EXPLAIN_METHOD or method.endswith(EXPLAIN_SUFFIX) else "tuned"


def get_method_label(method: str) -> str:
    """Return the label of a method in figures."""
    return "explain's own fit" if method == EXPLAIN_METHOD else method


def draw_success_figure(experiment: Experiment, lines: pd.DataFrame) -> Figure:
    """Draw the hit rate of each method over all balls and by ball, as the chart of the page.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
    """
    panel, table = make_success_panel(lines)
    # Width and height in inches, with the space for each category.
    size = (2.0 + 1.5 * len(panel.across.names), 4.2)
    figure, axes = draw_chart([replace(panel, title="")], {panel.table: table}, size=size)
    note = "each shot with a ball and a recorded drop of its own; bars: 95 % intervals (Wilson)"
    title = f"{experiment.title or experiment.name}\n{note}"
    return finish_chart(figure, axes[0], title, legend="outside right upper")


def _draw_legend(figure: Figure, methods: Sequence[str]) -> None:
    """Draw the legend of the groups that occur, below the figure.

    Args:
        figure: figure of Matplotlib.
        methods: labels of the methods that are drawn.
    """
    from matplotlib.lines import Line2D

    present_groups = {get_method_group(method) for method in methods}
    handles = []
    for group, (colour, marker) in _GROUP_STYLES.items():
        if group in present_groups:
            handles.append(Line2D([], [], color=colour, marker=marker, label=_GROUP_LABELS[group]))
    columns = len(handles)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=8, frameon=False
    )


def draw_miss_figure(settings: ShotConfig, rows: pd.DataFrame) -> Figure:
    """Draw where shots met the hoop's plane (left) and the prediction error (right) as box plots.

    Each method has one row; its colour shows the kind of the method.

    Args:
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        rows: rows of shots.csv.
    """
    methods = list(rows["method"].unique())
    # Width and height in inches, with the space for each method.
    figure, axes = make_panel_grid(1, 2, (11.5, 1.6 + 0.42 * len(methods)), sharey=True)
    miss_axis, error_axis = axes[0]
    for place, method in enumerate(methods):
        part = rows[rows["method"] == method]
        colour, _ = _GROUP_STYLES[get_method_group(method)]
        _draw_box_plot(miss_axis, 100 * part["off"].dropna().to_numpy(), place, colour)
        _draw_box_plot(
            error_axis, 100 * part["prediction_error"].dropna().to_numpy(), place, colour
        )
    radius = 100 * settings.hoop_radius
    miss_axis.axvspan(-radius, radius, color=BLACK, alpha=0.08, linewidth=0)
    miss_axis.axvline(0, color=CAPTION_GREY, linewidth=0.8)
    miss_axis.set_xlabel(
        "where shots met the hoop's plane, from its centre [cm]\n"
        f"grey: the hoop; beyond {_MAX_MISS_RADII} of its radii not shown"
    )
    miss_axis.set_xlim(-_MAX_MISS_RADII * radius, _MAX_MISS_RADII * radius)
    error_axis.set_xlabel("mean distance between planned and flown path [cm]")
    error_axis.set_xscale("log")
    error_axis.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    error_axis.minorticks_off()
    # The first method is at the top.
    miss_axis.set_yticks(range(len(methods)), [get_method_label(m) for m in methods])
    miss_axis.invert_yaxis()
    for axis in (miss_axis, error_axis):
        axis.grid(visible=True, axis="x", which="both", linewidth=0.3, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    _draw_legend(figure, methods)
    shots, balls = rows["shot"].nunique(), rows["ball"].nunique()
    title = f"How far off: {shots} shots of {balls} kinds of ball by every method"
    note = "box: quartiles and median, whiskers: 5 % and 95 %, dots: shots outside"
    figure.suptitle(f"{title}\n{note}", fontsize=10)
    return figure


def _draw_box_plot(axis: Axes, values: Array, place: int, colour: str) -> None:
    """Draw a horizontal box plot of one method: quartiles, median, and whiskers at 5 % and 95 %.

    Args:
        axis: axes to draw on.
        values: miss distances or prediction errors, cm, (n,); without values nothing is drawn.
        place: vertical position, the number of the method.
        colour: colour of the group of the method.
    """
    if not values.size:
        return
    axis.boxplot(
        values,
        positions=[place],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.55,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.45, "edgecolor": colour},
        medianprops={"color": "black"},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": colour},
        whiskerprops={"color": colour},
        capprops={"color": colour},
    )


def select_example_shots(
    setups: Sequence[ShotSetup], stored: Mapping[str, Any], rows: pd.DataFrame
) -> list[tuple[ShotSetup, list[str]]]:
    """Select example shots: a typical one and the worst one of a tuned method.

    The typical one is a shot that the untuned simulator missed, if there is one.

    Args:
        setups: all shots.
        stored: stored results by name of the shot.
        rows: rows of shots.csv.

    Returns:
        The shots, each with the methods to show.
    """
    by_name = {setup.name: setup for setup in setups}
    tuned = [m for m in rows["method"].unique() if get_method_group(m) == "tuned"]
    if not tuned:
        return []
    reference_method = next((m for m in ("tunenet-vision", "tunenet") if m in tuned), tuned[0])
    methods_shown = [
        m for m in (UNTUNED_METHOD, reference_method, EXPLAIN_METHOD) if (rows["method"] == m).any()
    ]
    # Only shots with a result of all shown methods can be compared.
    miss_by_method = (
        rows.pivot(index="shot", columns="method", values="off")[methods_shown].abs().dropna()
    )
    if miss_by_method.empty:
        return []
    missed_shots = rows[(rows["method"] == UNTUNED_METHOD) & (rows["hit"].astype(float) == 0)][
        "shot"
    ]
    missed_by_untuned = miss_by_method[miss_by_method.index.isin(missed_shots)]
    missed_by_untuned = miss_by_method if missed_by_untuned.empty else missed_by_untuned
    typical_shot = (
        (missed_by_untuned[reference_method] - miss_by_method[reference_method].median())
        .abs()
        .idxmin()
    )
    worst_shot = miss_by_method[reference_method].idxmax()
    return [
        (by_name[str(name)], methods_shown)
        for name in dict.fromkeys((typical_shot, worst_shot))
        if name in stored
    ]


def draw_shots_figure(
    settings: ShotConfig, chosen: Sequence[tuple[ShotSetup, list[str]]], stored: Mapping[str, Any]
) -> Figure:
    """Draw example shots as planned and as flown.

    Args:
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        chosen: examples as returned by `select_example_shots`, one per row.
        stored: stored results by name of the shot.
    """
    columns = max(len(methods) for _, methods in chosen)
    # Width and height in inches, with the space for each shot.
    size = (4.1 * columns, 0.9 + 3.1 * len(chosen))
    figure, axes = make_panel_grid(len(chosen), columns, size)
    for row, (setup, methods) in zip(axes, chosen, strict=True):
        shot = execute_example(settings, setup, methods, stored)
        for axis, method in zip(row, methods, strict=False):
            draw_shot_panel(axis, setup, method, shot)
        row[0].set_ylabel(f"{setup.name}\nheight [m]")
    for axis in axes[-1]:
        axis.set_xlabel("distance [m]")
    axes[0, 0].legend(loc="upper right", fontsize=8, frameon=False)
    note = (
        "Top: a typical shot, one that the untuned simulator missed if there is one. "
        "Bottom: the worst shot of the tuned simulator."
    )
    figure.suptitle("Planned in the simulator, flown in the world", fontsize=11)
    figure.supxlabel(textwrap.fill(note, 140), fontsize=7.5)
    return figure


def draw_shot_panel(axis: Axes, setup: ShotSetup, method: str, shot: ExampleShot) -> None:
    """Draw incline, hoop, planned and flown path of one shot; the flown path is the last line.

    Args:
        axis: axes to draw on.
        setup: setup of the shot: its ball, drop, incline and hoop.
        method: name of the method.
        shot: executed example: a shot with the path that it took.
    """
    scene, flight = setup.scene, shot.results[method]
    # Ends of the drawn incline in m: behind the release, and before the hoop.
    slope = np.array([-0.25, min(0.55 * scene.hoop_x, 0.45)])
    # Down to the lower end of the axis, -0.35 m.
    axis.fill_between(slope, -slope * np.tan(scene.angle), -0.35, color=INCLINE_GREY, linewidth=0)
    rim = [scene.hoop_x - scene.hoop_radius, scene.hoop_x + scene.hoop_radius]
    level = [scene.hoop_z] * 2
    axis.plot(rim, level, color="black", linewidth=3, solid_capstyle="butt", label="hoop")
    for path, colour, line, name in (
        (flight.planned, BLUE, (0, (4, 2)), "planned"),
        (flight.flown, VERMILION, "-", "flown"),
    ):
        part = path[: find_path_end(path, scene)]
        axis.plot(part[:, 0], part[:, 2], linewidth=1.7, label=name, color=colour, linestyle=line)
    result = f"{'hit' if flight.is_hit else 'miss'}, {100 * flight.miss_distance:+.0f} cm"
    restitution = shot.models[method].restitution
    axis.set_title(
        f"{get_method_label(method)}: {result}\nrestitution {restitution:.2f}", fontsize=9
    )
    right_limit = scene.hoop_x + 4 * scene.hoop_radius
    axis.set(xlim=(-0.25, right_limit), ylim=(-0.35, shot.top), aspect="equal")
    axis.spines[["top", "right"]].set_visible(False)
