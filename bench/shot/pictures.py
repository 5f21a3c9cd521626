"""The figures of a bounce shot: success by ball and method, how far shots were off, and shots as
planned and flown.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from bench.figures.style import (
    BLACK,
    BLUE,
    GREY,
    SLOPE,
    SOFT,
    VERMILION,
    Pictures,
    blank,
    mark,
    taken,
)
from bench.problem.experiment import Experiment
from bench.shot.deal import Deal
from bench.shot.settings import Settings
from bench.shot.table import ALL
from bench.shot.throw import Throw, throw
from bench.shot.tune import AFTER, EXPLAINED, NOMINAL, TunedModel
from sims.base import Array
from sims.shot.scene import ShotScene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GROUPS = {"untuned": (GREY, "s"), "tuned": (BLUE, "o"), "extended": (VERMILION, "D")}
"""Colour and marker of each group of methods."""
_WORDS = {
    "untuned": "untuned simulator",
    "tuned": "restitution tuned to one recorded drop",
    "extended": "simulator extended by explain from the same drop",
}
_REACH = 6
"""Radii of the hoop beyond which shots are not shown."""
_BELOW = 0.12
"""Metres below the hoop to which paths are drawn."""


def draw(
    experiment: Experiment,
    settings: Settings,
    dealt: Sequence[Deal],
    kept: Mapping[str, Any],
    rows: pd.DataFrame,
    lines: pd.DataFrame,
) -> dict[str, Pictures]:
    """All figures by name, as they are printed."""
    figures = {"success": success_figure(experiment, lines), "off": off_figure(settings, rows)}
    chosen = examples(dealt, kept, rows)
    if chosen:
        figures["shots"] = shots_figure(settings, chosen, kept)
    return {name: taken(mark(figure, experiment.trusted)) for name, figure in figures.items()}


def group_of(method: str) -> str:
    """Untuned, tuned or extended."""
    if method == NOMINAL:
        return "untuned"
    return "extended" if method == EXPLAINED or method.endswith(AFTER) else "tuned"


def label_of(method: str) -> str:
    """A method as figures name it."""
    return "explain's own fit" if method == EXPLAINED else method


def success_figure(experiment: Experiment, lines: pd.DataFrame) -> Figure:
    """Left the share of hits over all balls; right hits of shots and the interval, ball by ball.

    Args:
        experiment: what was compared.
        lines: of `bench.shot.table.table`.
    """
    methods = list(lines["method"].unique())
    size = (11.5, 1.6 + 0.42 * len(methods))
    figure, axes = blank(1, 2, size, sharey=True, gridspec_kw={"width_ratios": [1, 1.9]})
    _rates(axes[0, 0], lines, methods)
    _by_ball(axes[0, 1], lines, methods)
    _legend(figure, methods)
    counts = sorted(set(lines.loc[lines["ball"] != ALL, "shots"].tolist()))
    shots = "–".join(str(n) for n in (counts if len(counts) == 1 else (counts[0], counts[-1])))
    note = f"shots of each ball: {shots}, each with a ball and a recorded drop of its own"
    title = experiment.title or experiment.name
    figure.suptitle(f"{title}\n{note}; bars and ranges: 95 % (Wilson)", fontsize=10)
    return figure


def _rates(axis: Axes, lines: pd.DataFrame, methods: Sequence[str]) -> None:
    """Share of hits of each method over all balls, with its interval."""
    over = lines[lines["ball"] == ALL].set_index("method")
    for place, method in enumerate(methods):
        colour, marker = _GROUPS[group_of(method)]
        rate, low, high = (100 * float(over[c][method]) for c in ("rate", "low", "high"))
        axis.plot([low, high], [place, place], color=colour, linewidth=2)
        axis.plot(rate, place, marker=marker, color=colour, markersize=7)
        # Not rounded to none or all.
        near = 0 < rate < 0.5 or 99.5 <= rate < 100
        axis.annotate(
            f"{rate:.{1 if near else 0}f}",
            (rate, place),
            xytext=(0, 6),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    axis.set(xlim=(-2, 104), xlabel="shots through the hoop, all balls [%]")
    _methods_down(axis, methods)
    axis.grid(visible=True, axis="x", linewidth=0.4, alpha=0.5)
    axis.spines[["top", "right"]].set_visible(False)


def _by_ball(axis: Axes, lines: pd.DataFrame, methods: Sequence[str]) -> None:
    """Hits of shots, a cell each method and ball, the lighter the more."""
    balls = [ball for ball in lines["ball"].unique() if ball != ALL]
    for line in lines[lines["ball"] != ALL].to_dict("records"):
        x, y, rate = balls.index(line["ball"]), methods.index(line["method"]), float(line["rate"])
        axis.add_patch(_cell(x, y, rate))
        interval = f"{100 * line['low']:.0f}–{100 * line['high']:.0f} %"
        axis.text(
            x,
            y,
            f"{line['hits']}/{line['shots']}   {interval}",
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if rate < 0.45 else "black",
        )
    axis.set(xlim=(-0.5, len(balls) - 0.5), ylim=(len(methods) - 0.5, -0.5))
    axis.set_xticks(range(len(balls)), balls, fontsize=9)
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)


def _methods_down(axis: Axes, methods: Sequence[str]) -> None:
    axis.set_yticks(range(len(methods)), [label_of(m) for m in methods])
    axis.invert_yaxis()


def _cell(x: int, y: int, rate: float) -> Any:
    from matplotlib.patches import Rectangle

    shade = 0.25 + 0.72 * rate
    return Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, color=(shade, shade, shade), linewidth=0)


def _legend(figure: Figure, methods: Sequence[str]) -> None:
    """Groups that there are, below."""
    from matplotlib.lines import Line2D

    present = {group_of(method) for method in methods}
    handles = []
    for group, (colour, marker) in _GROUPS.items():
        if group in present:
            handles.append(Line2D([], [], color=colour, marker=marker, label=_WORDS[group]))
    columns = len(handles)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=8, frameon=False
    )


def off_figure(settings: Settings, rows: pd.DataFrame) -> Figure:
    """Left where shots met the hoop's plane; right the distance between planned and flown path.
    Boxes: quartiles.

    Args:
        settings: of the experiment.
        rows: of shots.csv.
    """
    methods = list(rows["method"].unique())
    figure, axes = blank(1, 2, (11.5, 1.6 + 0.42 * len(methods)), sharey=True)
    left, right = axes[0]
    for place, method in enumerate(methods):
        part = rows[rows["method"] == method]
        colour, _ = _GROUPS[group_of(method)]
        _box(left, 100 * part["off"].dropna().to_numpy(), place, colour)
        _box(right, 100 * part["prediction_error"].dropna().to_numpy(), place, colour)
    radius = 100 * settings.hoop_radius
    left.axvspan(-radius, radius, color=BLACK, alpha=0.08, linewidth=0)
    left.axvline(0, color=SOFT, linewidth=0.8)
    left.set_xlabel(
        "where shots met the hoop's plane, from its centre [cm]\n"
        f"grey: the hoop; beyond {_REACH} of its radii not shown"
    )
    left.set_xlim(-_REACH * radius, _REACH * radius)
    right.set_xlabel("mean distance between planned and flown path [cm]")
    right.set_xscale("log")
    right.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    right.minorticks_off()
    _methods_down(left, methods)
    for axis in (left, right):
        axis.grid(visible=True, axis="x", which="both", linewidth=0.3, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    _legend(figure, methods)
    shots, balls = rows["shot"].nunique(), rows["ball"].nunique()
    title = f"How far off: {shots} shots of {balls} kinds of ball by every method"
    note = "box: quartiles and median, whiskers: 5 % and 95 %, dots: shots outside"
    figure.suptitle(f"{title}\n{note}", fontsize=10)
    return figure


def _box(axis: Axes, values: Array, place: int, colour: str) -> None:
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


def examples(
    dealt: Sequence[Deal], kept: Mapping[str, Any], rows: pd.DataFrame
) -> list[tuple[Deal, list[str]]]:
    """A usual shot, if there is one that the untuned simulator missed, and the worst; and which
    methods to show.
    """
    by_name = {one.name: one for one in dealt}
    tuned = [m for m in rows["method"].unique() if group_of(m) == "tuned"]
    if not tuned:
        return []
    first = next((m for m in ("tunenet-vision", "tunenet") if m in tuned), tuned[0])
    shown = [m for m in (NOMINAL, first, EXPLAINED) if (rows["method"] == m).any()]
    # Only shots that all of them made can be shown side by side.
    wide = rows.pivot(index="shot", columns="method", values="off")[shown].abs().dropna()
    if wide.empty:
        return []
    missed = rows[(rows["method"] == NOMINAL) & (rows["hit"].astype(float) == 0)]["shot"]
    telling = wide[wide.index.isin(missed)]
    telling = wide if telling.empty else telling
    typical = (telling[first] - wide[first].median()).abs().idxmin()
    worst = wide[first].idxmax()
    return [(by_name[str(name)], shown) for name in dict.fromkeys((typical, worst)) if name in kept]


class Shown(NamedTuple):
    """What is shown of one shot.

    Attributes:
        models: by method.
        throws: by method.
        top: height in metres up to which all of it is seen.
    """

    models: dict[str, TunedModel]
    throws: dict[str, Throw]
    top: float


def thrown(
    settings: Settings, dealt: Deal, methods: Sequence[str], kept: Mapping[str, Any]
) -> Shown:
    """One shot, thrown again by each of the methods."""
    models = {model["method"]: TunedModel(**model) for model in kept[dealt.name]["models"]}
    throws = {method: throw(dealt, settings, models[method]) for method in methods}
    top = max(float(np.nanmax(t.flown[:, 2])) for t in throws.values()) + 0.1
    return Shown(models, throws, top)


def shots_figure(
    settings: Settings, chosen: Sequence[tuple[Deal, list[str]]], kept: Mapping[str, Any]
) -> Figure:
    """Shots as planned and as flown.

    Args:
        settings: of the experiment.
        chosen: as `examples` gives them, a row each.
        kept: what was kept of each shot.
    """
    columns = max(len(methods) for _, methods in chosen)
    size = (4.1 * columns, 0.9 + 3.1 * len(chosen))
    figure, axes = blank(len(chosen), columns, size)
    for row, (dealt, methods) in zip(axes, chosen, strict=True):
        shot = thrown(settings, dealt, methods, kept)
        for axis, method in zip(row, methods, strict=False):
            shot_panel(axis, dealt, method, shot)
        row[0].set_ylabel(f"{dealt.name}\nheight [m]")
    for axis in axes[-1]:
        axis.set_xlabel("distance [m]")
    axes[0, 0].legend(loc="upper right", fontsize=8, frameon=False)
    note = (
        "Above a usual shot, of those that the untuned simulator missed if any; "
        "below the worst of the tuned."
    )
    figure.suptitle("Planned in the simulator, flown in the world", fontsize=11)
    figure.supxlabel(textwrap.fill(note, 140), fontsize=7.5)
    return figure


def shot_panel(axis: Axes, dealt: Deal, method: str, shot: Shown) -> None:
    """Incline, hoop, planned and flown path of one shot; the flown path is the last line."""
    scene, flight = dealt.scene, shot.throws[method]
    slope = np.array([-0.25, min(0.55 * scene.hoop_x, 0.45)])
    axis.fill_between(slope, -slope * np.tan(scene.angle), -0.35, color=SLOPE, linewidth=0)
    rim = [scene.hoop_x - scene.hoop_radius, scene.hoop_x + scene.hoop_radius]
    level = [scene.hoop_z] * 2
    axis.plot(rim, level, color="black", linewidth=3, solid_capstyle="butt", label="hoop")
    for path, colour, line, name in (
        (flight.planned, BLUE, (0, (4, 2)), "planned"),
        (flight.flown, VERMILION, "-", "flown"),
    ):
        part = path[: end_of(path, scene)]
        axis.plot(part[:, 0], part[:, 2], linewidth=1.7, label=name, color=colour, linestyle=line)
    result = f"{'hit' if flight.hit else 'miss'}, {100 * flight.off:+.0f} cm"
    restitution = shot.models[method].restitution
    axis.set_title(f"{label_of(method)}: {result}\nrestitution {restitution:.2f}", fontsize=9)
    reach = scene.hoop_x + 4 * scene.hoop_radius
    axis.set(xlim=(-0.25, reach), ylim=(-0.35, shot.top), aspect="equal")
    axis.spines[["top", "right"]].set_visible(False)


def end_of(path: Array, scene: ShotScene) -> int:
    """Index of the sample at which a path is a little below the hoop after its bounce."""
    z = path[:, 2]
    # Before the bounce the ball falls through the same heights.
    risen = np.concatenate([[False], np.logical_or.accumulate(z[1:] > z[:-1])])
    falling = np.concatenate([[0], np.diff(z)]) < 0
    below = np.flatnonzero(risen & (z < scene.hoop_z - _BELOW) & falling)
    return int(below[0]) if below.size else len(z)
