"""The figures of a bounce shot: success by ball and method, how far shots were off, and shots as
planned and flown.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.figures.style import save
from bench.problem.experiment import Experiment
from bench.shot.deal import Deal
from bench.shot.settings import Settings
from bench.shot.table import ALL
from bench.shot.throw import Throw, throw
from bench.shot.tune import AFTER, EXPLAINED, NOMINAL, Model
from sims.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GROUPS = {"untuned": ("#7F7F7F", "s"), "tuned": ("#0072B2", "o"), "extended": ("#D55E00", "D")}
_WORDS = {
    "untuned": "untuned simulator",
    "tuned": "restitution tuned to one recorded drop",
    "extended": "simulator extended by explain from the same drop",
}


def draw(
    folder: Path,
    experiment: Experiment,
    settings: Settings,
    dealt: Sequence[Deal],
    kept: Mapping[str, Any],
    rows: pd.DataFrame,
    lines: pd.DataFrame,
) -> list[Path]:
    """Draw all into `folder`/figures; returns the PNG files."""
    import matplotlib

    matplotlib.use("Agg")
    made = [
        save(folder, "success", _success(experiment, lines)),
        save(folder, "off", _off(settings, rows)),
    ]
    found = examples(dealt, kept, rows)
    if found:
        made.append(save(folder, "shots", _shots(settings, found, kept)))
    return made


def group_of(method: str) -> str:
    """Untuned, tuned or extended."""
    if method == NOMINAL:
        return "untuned"
    return "extended" if method == EXPLAINED or method.endswith(AFTER) else "tuned"


def label_of(method: str) -> str:
    """A method as figures name it."""
    return "explain's own fit" if method == EXPLAINED else method


def _canvas(
    width: float, height: float, rows: int, columns: int, **more: Any
) -> tuple[Figure, Any]:
    from matplotlib import pyplot as plt

    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, **more)


def _success(experiment: Experiment, lines: pd.DataFrame) -> Figure:
    """Left the share of hits over all balls; right hits of shots and the interval, ball by ball."""
    methods = list(lines["method"].unique())
    balls = [ball for ball in lines["ball"].unique() if ball != ALL]
    figure, ((left, right),) = _canvas(
        11.5, 1.6 + 0.42 * len(methods), 1, 2, sharey=True, gridspec_kw={"width_ratios": [1, 1.9]}
    )
    over = lines[lines["ball"] == ALL].set_index("method")
    for place, method in enumerate(methods):
        colour, marker = _GROUPS[group_of(method)]
        rate, low, high = (100 * float(over.loc[method, c]) for c in ("rate", "low", "high"))
        left.plot([low, high], [place, place], color=colour, linewidth=2)
        left.plot(rate, place, marker=marker, color=colour, markersize=7)
        near = 0 < rate < 0.5 or 99.5 <= rate < 100  # not rounded to none or all
        told = f"{rate:.{1 if near else 0}f}"
        left.annotate(
            told, (rate, place), xytext=(0, 6), textcoords="offset points", ha="center", fontsize=8
        )
    left.set(xlim=(-2, 104), xlabel="shots through the hoop, all balls [%]")
    left.set_yticks(range(len(methods)), [label_of(m) for m in methods])
    left.invert_yaxis()
    left.grid(visible=True, axis="x", linewidth=0.4, alpha=0.5)
    left.spines[["top", "right"]].set_visible(False)
    for line in lines[lines["ball"] != ALL].to_dict("records"):
        x, y, rate = balls.index(line["ball"]), methods.index(line["method"]), float(line["rate"])
        right.add_patch(_cell(x, y, rate))
        told = (
            f"{line['hits']}/{line['shots']}   {100 * line['low']:.0f}–{100 * line['high']:.0f} %"
        )
        right.text(
            x,
            y,
            told,
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if rate < 0.45 else "black",
        )
    right.set(xlim=(-0.5, len(balls) - 0.5), ylim=(len(methods) - 0.5, -0.5))
    right.set_xticks(range(len(balls)), balls, fontsize=9)
    right.xaxis.tick_top()
    right.tick_params(length=0)
    right.spines[:].set_visible(False)
    _legend(figure, [m for m in _GROUPS if m in {group_of(x) for x in methods}])
    counts = sorted(set(lines.loc[lines["ball"] != ALL, "shots"].tolist()))
    shots = "–".join(str(n) for n in (counts if len(counts) == 1 else (counts[0], counts[-1])))
    told = f"shots of each ball: {shots}, each with a ball and a recorded drop of its own"
    figure.suptitle(
        f"{experiment.title or experiment.name}\n{told}; bars and ranges: 95 % (Wilson)",
        fontsize=10,
    )
    return figure


def _cell(x: int, y: int, rate: float) -> Any:
    from matplotlib.patches import Rectangle

    shade = 0.25 + 0.72 * rate
    return Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, color=(shade, shade, shade), linewidth=0)


def _legend(figure: Figure, groups: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=_GROUPS[g][0], marker=_GROUPS[g][1], label=_WORDS[g]) for g in groups
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(groups), fontsize=8, frameon=False
    )


def _off(settings: Settings, rows: pd.DataFrame) -> Figure:
    """Left where shots met the hoop's plane; right the distance between planned and flown path.
    Boxes: quartiles.
    """
    methods = list(rows["method"].unique())
    figure, ((left, right),) = _canvas(11.5, 1.6 + 0.42 * len(methods), 1, 2, sharey=True)
    for place, method in enumerate(methods):
        part = rows[rows["method"] == method]
        colour, _ = _GROUPS[group_of(method)]
        _box(left, 100 * part["off"].dropna().to_numpy(), place, colour)
        _box(right, 100 * part["prediction_error"].dropna().to_numpy(), place, colour)
    radius = 100 * settings.hoop_radius
    left.axvspan(-radius, radius, color="#000000", alpha=0.08, linewidth=0)
    left.axvline(0, color="#444444", linewidth=0.8)
    left.set_xlabel(
        "where shots met the hoop's plane, from its centre [cm]\ngrey: the hoop; beyond 6 of its radii not shown"
    )
    left.set_xlim(-6 * radius, 6 * radius)
    right.set_xlabel("mean distance between planned and flown path [cm]")
    right.set_xscale("log")
    right.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    right.minorticks_off()
    left.set_yticks(range(len(methods)), [label_of(m) for m in methods])
    left.invert_yaxis()
    for axis in (left, right):
        axis.grid(visible=True, axis="x", which="both", linewidth=0.3, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    _legend(figure, [m for m in _GROUPS if m in {group_of(x) for x in methods}])
    shots, balls = rows["shot"].nunique(), rows["ball"].nunique()
    told = "box: quartiles and median, whiskers: 5 % and 95 %, dots: shots outside"
    figure.suptitle(
        f"How far off: {shots} shots of {balls} kinds of ball by every method\n{told}", fontsize=10
    )
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
    by = {one.name: one for one in dealt}
    tuned = [m for m in rows["method"].unique() if group_of(m) == "tuned"]
    if not tuned:
        return []
    first = next((m for m in ("tunenet-vision", "tunenet") if m in tuned), tuned[0])
    shown = [m for m in (NOMINAL, first, EXPLAINED) if (rows["method"] == m).any()]
    wide = rows.pivot(index="shot", columns="method", values="off")[shown].abs().dropna()
    if wide.empty:
        return []
    missed = rows[(rows["method"] == NOMINAL) & (rows["hit"].astype(float) == 0)]["shot"]
    telling = wide[wide.index.isin(missed)]
    telling = wide if telling.empty else telling
    typical = (telling[first] - wide[first].median()).abs().idxmin()
    worst = wide[first].idxmax()
    return [(by[str(name)], shown) for name in dict.fromkeys((typical, worst)) if name in kept]


def _shots(
    settings: Settings, found: list[tuple[Deal, list[str]]], kept: Mapping[str, Any]
) -> Figure:
    columns = max(len(shown) for _, shown in found)
    figure, axes = _canvas(4.1 * columns, 0.9 + 3.1 * len(found), len(found), columns)
    for row, (dealt, shown) in enumerate(found):
        models = {model["method"]: Model(**model) for model in kept[dealt.name]["models"]}
        throws = {method: throw(dealt, settings, models[method]) for method in shown}
        top = max(float(np.nanmax(t.flown[:, 2])) for t in throws.values()) + 0.1
        for column, method in enumerate(shown):
            shot_panel(
                axes[row, column], dealt, label_of(method), models[method], throws[method], top
            )
        axes[row, 0].set_ylabel(f"{dealt.name}\nheight [m]")
    for axis in axes[-1]:
        axis.set_xlabel("distance [m]")
    axes[0, 0].legend(loc="upper right", fontsize=8, frameon=False)
    told = "Above a usual shot, of those that the untuned simulator missed if any; below the worst of the tuned."
    figure.suptitle("Planned in the simulator, flown in the world", fontsize=11)
    figure.supxlabel(textwrap.fill(told, 140), fontsize=7.5)
    return figure


def shot_panel(axis: Axes, dealt: Deal, method: str, model: Model, made: Throw, top: float) -> None:
    """Incline, hoop, planned and flown path of one shot; the flown path is the last line."""
    scene, reach = dealt.scene, dealt.scene.hoop_x + 4 * dealt.scene.hoop_radius
    slope = np.array([-0.25, min(0.55 * scene.hoop_x, 0.45)])
    axis.fill_between(slope, -slope * np.tan(scene.angle), -0.35, color="#BBBBBB", linewidth=0)
    rim = [scene.hoop_x - scene.hoop_radius, scene.hoop_x + scene.hoop_radius]
    axis.plot(
        rim, [scene.hoop_z] * 2, color="black", linewidth=3, solid_capstyle="butt", label="hoop"
    )
    for path, style, name in (
        (made.planned, {"color": "#0072B2", "linestyle": (0, (4, 2))}, "planned"),
        (made.flown, {"color": "#D55E00", "linestyle": "-"}, "flown"),
    ):
        shown = path[: end_of(path, scene.hoop_z - 0.12)]
        axis.plot(shown[:, 0], shown[:, 2], linewidth=1.7, label=name, **style)
    result = "hit" if made.hit else "miss"
    axis.set_title(
        f"{method}: {result}, {100 * made.off:+.0f} cm\nrestitution {model.restitution:.2f}",
        fontsize=9,
    )
    axis.set(xlim=(-0.25, reach), ylim=(-0.35, top), aspect="equal")
    axis.spines[["top", "right"]].set_visible(False)


def end_of(path: Array, height: float) -> int:
    """Index of the sample at which a path is below a height after its bounce."""
    z = path[:, 2]
    risen = np.concatenate([[False], np.logical_or.accumulate(z[1:] > z[:-1])])
    below = np.flatnonzero(risen & (z < height) & (np.concatenate([[0], np.diff(z)]) < 0))
    return int(below[0]) if below.size else len(z)
