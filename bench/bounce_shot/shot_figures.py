"""Figures of a bounce-shot study: hits by ball and method, misses, and example shots."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.bounce_shot.drop_tuning import EXPLAIN_METHOD, EXPLAIN_SUFFIX, UNTUNED_METHOD
from bench.bounce_shot.hit_rate_table import ALL_BALLS
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_execution import ExampleShot, execute_example
from bench.bounce_shot.shot_geometry import ShotGeometry, find_descent_index
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.figures.figure_layout import add_trust_note, finish_chart, make_panel_grid
from bench.figures.figure_output import FigureFiles, render_all_formats
from bench.figures.style import (
    BLACK,
    BLUE,
    CAPTION_GREY,
    GREY,
    INCLINE_GREY,
    VERMILION,
    get_mark_style,
)
from bench.pages.chart import Axis, Panel, draw_chart, make_method_series
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

_MIN_DRAWN_DEPTH = 0.12
"""Distance below the hoop down to which paths are drawn, m."""


def draw_figures(
    experiment: Experiment,
    settings: ShotConfig,
    setups: Sequence[ShotSetup],
    stored: Mapping[str, Any],
    rows: pd.DataFrame,
    lines: pd.DataFrame,
) -> dict[str, FigureFiles]:
    """Draw the figures of the bounce-shot study: hit rates, misses, and example shots.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        setups: all shots.
        stored: stored results by name of the shot.
        rows: rows of shots.csv.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.

    Returns:
        Figures by name, in all formats; without "shots" if there is no example.
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
    # Width and height in inches, with the space for each kind of ball.
    size = (2.0 + 1.5 * len(panel.across.names), 4.2)
    figure, axes = draw_chart([replace(panel, title="")], {panel.table: table}, size=size)
    note = "each shot with a ball and a recorded drop of its own; bars: 95 % intervals (Wilson)"
    title = f"{experiment.title or experiment.name}\n{note}"
    return finish_chart(figure, axes[0], title, legend="outside right upper")


def make_success_panel(lines: pd.DataFrame) -> tuple[Panel, pd.DataFrame]:
    """Make the panel of a chart that shows the hit rate of each method by ball.

    Args:
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.

    Returns:
        The panel, and its table: the lines with the position of their ball on the horizontal axis
        as column ``place``.
    """
    # All balls together come first.
    balls = [ALL_BALLS, *(ball for ball in dict.fromkeys(lines["ball"]) if ball != ALL_BALLS)]
    places = {ball: place for place, ball in enumerate(balls)}
    methods = dict.fromkeys(lines["method"])
    styles = {method: get_mark_style(number) for number, method in enumerate(methods)}
    series = make_method_series(
        styles, "method", "rate", is_shifted=True, low="low", high="high", draw="points"
    )
    # Methods may have different numbers of shots, if some are missing.
    counts = lines.groupby("ball")["shots"].agg(["min", "max"]).astype(int)
    names = []
    for ball in balls:
        shot_counts = dict.fromkeys(counts.loc[ball].tolist())
        names.append(f"{ball}\nn={'–'.join(map(str, shot_counts))}")
    x_axis = Axis("ball; n shots of each method", names=tuple(names))
    # A margin of 0.03, so that marks at 0 and 1 are visible.
    y_axis = Axis("share of shots through the hoop", scales=("linear",), ends=(-0.03, 1.03))
    panel = Panel("Hits by ball", "success", "place", series, x_axis, y_axis)
    return panel, lines.assign(place=lines["ball"].map(places))


def _draw_legend(figure: Figure, methods: Sequence[str]) -> None:
    """Draw the legend of the groups of methods that are drawn, below the figure.

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
    # All entries are in one row.
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False
    )


def draw_miss_figure(settings: ShotConfig, rows: pd.DataFrame) -> Figure:
    """Draw where shots met the hoop's plane (left) and the prediction error (right) as box plots.

    Each method has one row. Its colour shows its group: untuned, tuned, or extended by explain.

    Args:
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        rows: rows of shots.csv.
    """
    methods = list(rows["method"].unique())
    # Width and height in inches, with the space for each method.
    figure, axes = make_panel_grid(1, 2, (11.5, 1.6 + 0.42 * len(methods)), sharey=True)
    miss_axis, error_axis = axes[0]
    for index, method in enumerate(methods):
        rows_of_method = rows[rows["method"] == method]
        colour, _ = _GROUP_STYLES[get_method_group(method)]
        for axis, column in ((miss_axis, "off"), (error_axis, "prediction_error")):
            centimetres = 100 * rows_of_method[column].dropna().to_numpy()
            _draw_box_plot(axis, centimetres, index, colour)
    radius = 100 * settings.hoop_radius  # cm
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


def _draw_box_plot(axis: Axes, values: Array, position: int, colour: str) -> None:
    """Draw a horizontal box plot of one method: quartiles, median, and whiskers at 5 % and 95 %.

    Args:
        axis: axes to draw on.
        values: miss distances or prediction errors, cm, (n,); without values nothing is drawn.
        position: vertical position, the index of the method.
        colour: colour of the group of the method.
    """
    if not values.size:
        return
    axis.boxplot(
        values,
        positions=[position],
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

    The tuned method is TuneNet, or the first one without it. The typical shot is one that the
    untuned simulator missed, if there is one, with a miss distance of the tuned method closest to
    its median. Each is shown with the untuned simulator, the tuned method, and the fit of explain.

    Args:
        setups: all shots.
        stored: stored results by name of the shot.
        rows: rows of shots.csv.

    Returns:
        The shots, each with the methods to show; none without a tuned method.
    """
    setup_by_name = {setup.name: setup for setup in setups}
    methods = rows["method"].unique()
    tuned = [method for method in methods if get_method_group(method) == "tuned"]
    if not tuned:
        return []
    reference_method = next((m for m in ("tunenet-vision", "tunenet") if m in tuned), tuned[0])
    methods_shown = [m for m in (UNTUNED_METHOD, reference_method, EXPLAIN_METHOD) if m in methods]
    # Miss distances, m, of each shot (rows) by method (columns). Only shots with a result of all
    # shown methods can be compared.
    miss_distances = rows.pivot(index="shot", columns="method", values="off")[methods_shown].abs()
    miss_distances = miss_distances.dropna()
    if miss_distances.empty:
        return []
    reference_distances = miss_distances[reference_method]
    is_missed = (rows["method"] == UNTUNED_METHOD) & (rows["hit"].astype(float) == 0)
    candidates = reference_distances[reference_distances.index.isin(rows[is_missed]["shot"])]
    if candidates.empty:
        candidates = reference_distances
    typical_shot = (candidates - reference_distances.median()).abs().idxmin()
    worst_shot = reference_distances.idxmax()
    return [
        (setup_by_name[str(name)], methods_shown)
        for name in dict.fromkeys((typical_shot, worst_shot))
        if name in stored
    ]


def draw_shots_figure(
    settings: ShotConfig, examples: Sequence[tuple[ShotSetup, list[str]]], stored: Mapping[str, Any]
) -> Figure:
    """Draw example shots as planned and as flown: one row per shot, one column per method.

    Args:
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        examples: shots with the methods to show, the typical one first.
        stored: stored results by name of the shot.
    """
    columns = max(len(methods) for _, methods in examples)
    # Width and height in inches, with the space for each shot.
    size = (4.1 * columns, 0.9 + 3.1 * len(examples))
    figure, axes = make_panel_grid(len(examples), columns, size)
    for axes_of_row, (setup, methods) in zip(axes, examples, strict=True):
        shot = execute_example(settings, setup, methods, stored)
        # A shot may have fewer methods than there are columns.
        for axis, method in zip(axes_of_row, methods, strict=False):
            draw_shot_panel(axis, setup, method, shot)
        axes_of_row[0].set_ylabel(f"{setup.name}\nheight [m]")
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
    """Draw incline, hoop, planned and flown path of one shot, seen from the side.

    The flown path is the last line of the axes, so that an animation can change it.

    Args:
        axis: axes to draw on.
        setup: setup of the shot: its ball, drop, incline and hoop.
        method: label of the method.
        shot: executed shot with its paths by method.
    """
    scene, flight = setup.scene, shot.results[method]
    # Ends of the drawn incline in m: behind the release, and before the hoop.
    incline_x = np.array([-0.25, min(0.55 * scene.hoop_x, 0.45)])
    incline_z = -incline_x * np.tan(scene.angle)
    # Down to the lower end of the axis, -0.35 m.
    axis.fill_between(incline_x, incline_z, -0.35, color=INCLINE_GREY, linewidth=0)
    rim_x = [scene.hoop_x - scene.hoop_radius, scene.hoop_x + scene.hoop_radius]
    rim_z = [scene.hoop_z] * 2
    axis.plot(rim_x, rim_z, color="black", linewidth=3, solid_capstyle="butt", label="hoop")
    for path, colour, style, name in (
        (flight.planned, BLUE, (0, (4, 2)), "planned"),  # dashed
        (flight.flown, VERMILION, "-", "flown"),
    ):
        x, _, z = path[: find_path_end(path, scene)].T
        axis.plot(x, z, linewidth=1.7, label=name, color=colour, linestyle=style)
    result = f"{'hit' if flight.is_hit else 'miss'}, {100 * flight.miss_distance:+.0f} cm"
    restitution = shot.models[method].restitution
    axis.set_title(
        f"{get_method_label(method)}: {result}\nrestitution {restitution:.2f}", fontsize=9
    )
    right_limit = scene.hoop_x + 4 * scene.hoop_radius
    axis.set(xlim=(-0.25, right_limit), ylim=(-0.35, shot.top), aspect="equal")
    axis.spines[["top", "right"]].set_visible(False)


def find_path_end(path: Array, scene: ShotGeometry) -> int:
    """Return the number of samples to draw of a path.

    After its bounce, a path is drawn down to `_MIN_DRAWN_DEPTH` below the hoop.

    Args:
        path: positions, (T, 3), m.
        scene: incline and hoop.
    """
    return find_descent_index(path, scene.hoop_z - _MIN_DRAWN_DEPTH) + 1
