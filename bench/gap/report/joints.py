"""The motion of a robot joint by joint: a row each with what was measured and simulated, and beside
it what the simulations leave of each recorded quantity, in units of its noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.figures.style import BAND, BLUE, INK, SOFT, ZERO, blank
from bench.figures.text_layout import break_name, text_width
from bench.gap.report.panels import AFTER, BEFORE, changed, label
from bench.gap.report.places import marks
from bench.gap.report.shots import MOST_OUTLINES, Shot, kept
from bench.gap.report.story import Story
from bench.gap.report.words import FAMILY, clean, number
from sims.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_JOINTS = 10
"""Rows that are shown, the worst."""
QUANTITIES: Mapping[str, str] = {"q": "position", "qd": "velocity", "tau": "torque"}
"""Of a joint, by the first part of a channel's name; a sensor's has a row of its own."""
LEAST = 4.0
"""Residuals are shown to at least so many sigmas: noise fills no panel."""
TALLEST = 0.999
"""Share of the residuals that a panel shows: a single wild sample must not flatten the rest."""
_HEIGHTS = {1: 2.6, 2: 1.9, 3: 1.5, 4: 1.25, 5: 1.1}
"""Inches of a row, by their number."""
_LEAST_HEIGHT = 1.0
POINTER = "▸"
"""Before the name of a joint that the verdict names: in grey, too, it stands out."""
LONGEST_NAME = 64
"""Characters of the name of a joint or sensor that are shown."""
_NAME_LINE = 18
"""Longest line of such a name, in characters."""
_NAME_SIZE = 9.5
"""Size of its letters, in points."""
_BESIDE_NAME = 0.85
"""Inches from the end of the names to the panels: ticks and units stand there."""
_HEAD, _FOOT = 0.75, 0.95
"""Inches above and below the rows."""


class Row(NamedTuple):
    """A joint or a sensor: its name, the channel whose motion is shown, and its channels by
    quantity.
    """

    name: str
    shown: int
    channels: Mapping[str, int]


def by_joint(story: Story) -> bool:
    """Whether the channels are those of a robot."""
    return story.robot is not None and len(rows_of(story)) > 0


def rows_of(story: Story) -> list[Row]:
    """A row for each joint, in the order of the channels, then one for each sensor."""
    joints: dict[str, dict[str, int]] = {}
    sensors = []
    for c, channel in enumerate(story.channels):
        quantity, _, name = channel.name.partition(".")
        if quantity in QUANTITIES and name:
            joints.setdefault(name, {})[quantity] = c
        else:
            sensors.append(Row(channel.name, c, {_first(story): c}))
    rows = []
    for name, channels in joints.items():
        # The motion itself where it was recorded, else what comes nearest to it.
        shown = next(channels[q] for q in QUANTITIES if q in channels)
        rows.append(Row(name, shown, channels))
    return rows + sensors


def _first(story: Story) -> str:
    """The quantity of the first column of residuals, where sensors have theirs too."""
    return next(iter(_quantities(story)), "q")


def _quantities(story: Story) -> list[str]:
    there = {channel.name.partition(".")[0] for channel in story.channels}
    return [quantity for quantity in QUANTITIES if quantity in there]


def joints_figure(story: Story, shot: Shot) -> Figure:
    """The run joint by joint."""
    rows = _worst(story, shot)
    quantities = _quantities(story) or ["q"]
    height = _HEIGHTS.get(len(rows), _LEAST_HEIGHT)
    found = {mark.name for mark in marks(story)} | _joints_of_marks(story)
    names = [_row_name(row, row.name in found) for row in rows]
    left = max(1.95, 0.12 + text_width(names, _NAME_SIZE, "bold") + _BESIDE_NAME)
    width = left + 5.15 + 2.6 * len(quantities)
    size = (width, _HEAD + _FOOT + height * len(rows))
    ratios = (4.2, *[3.0] * len(quantities))
    figure, axes = blank(
        len(rows), len(ratios), size, layout=None, sharex=True, width_ratios=ratios
    )
    for row, panels in zip(rows, axes, strict=True):
        _motion(panels[0], story, shot, row, row.name in found)
        for panel, quantity in zip(panels[1:], quantities, strict=True):
            if quantity in row.channels:
                _residual(panel, story, shot, row.channels[quantity])
            else:
                panel.set_axis_off()
    for column, quantity in enumerate(quantities, start=1):
        _one_scale(axes[:, column], story, shot, rows, quantity)
        what = QUANTITIES[quantity]
        axes[0, column].set_title(f"residual of {what} [σ]", fontsize=9.5, loc="left")
    axes[0, 0].set_title("measured and simulated", fontsize=9.5, loc="left")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
        # The narrower column has no room for more; a late run has long numbers.
        panel.locator_params(axis="x", nbins=4)
    _finish(figure, axes, story, shot, rows, left)
    return figure


def _worst(story: Story, shot: Shot) -> list[Row]:
    """The rows to show, in their order: of very many the worst."""
    rows = rows_of(story)

    def gap(row: Row) -> float:
        return max(_size(story, shot, c, "before") for c in row.channels.values())

    worst = sorted(rows, key=gap, reverse=True)[:MOST_JOINTS]
    return [row for row in rows if row in worst]


def _size(story: Story, shot: Shot, c: int, which: str) -> float:
    """RMS of a channel's residual in this run, in units of its noise; 0 where nothing was seen."""
    left = _left(story, shot, c, which)
    there = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(there**2))) if there.size else 0.0


def _left(story: Story, shot: Shot, c: int, which: str) -> Array:
    """(T,) the residual of a channel in units of its noise."""
    count = len(shot.side.times[shot.row])
    simulated = getattr(shot.side, which)
    left: Array = (shot.side.observed - simulated)[shot.row, :count, c] / story.channels[c].sigma
    return left


def _motion(panel: Axes, story: Story, shot: Shot, row: Row, found: bool) -> None:
    """Measured and simulated; the name of the joint beside it."""
    channel, side = story.channels[row.shown], shot.side
    times = side.times[shot.row]
    signals = [
        a[shot.row, : len(times), row.shown] for a in (side.observed, side.before, side.after)
    ]
    rows = kept(signals[0])
    measured, before, after = (signal[rows] for signal in signals)
    t = times[rows]
    size = 4.0 if rows.size < 250 else 3.4
    panel.plot(
        t,
        measured,
        "o",
        color="black",
        markersize=size,
        markeredgewidth=0,
        label="measured",
        zorder=1,
        rasterized=rows.size > MOST_OUTLINES,
    )
    tuned = "simulated before (tuned)" if changed(story) else "simulated (tuned)"
    panel.plot(t, before, label=tuned, zorder=3, **BEFORE)
    if changed(story):
        # Where all agree, before is seen dashed upon after, and that upon what was measured.
        panel.plot(t, after, label="simulated after", zorder=2, **AFTER)
    quantity = channel.name.partition(".")[0]
    symbol = quantity if quantity in QUANTITIES else ""
    panel.set_ylabel(label(symbol, channel.unit, 14), fontsize=8)
    panel.annotate(
        _row_name(row, found),
        (0, 0.5),
        (-0.72 * 72, 0),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=_NAME_SIZE,
        weight="bold",
        color=BLUE if found else INK,
        annotation_clip=False,
    )
    panel.margins(x=0.01)
    panel.locator_params(axis="y", nbins=4)
    panel.tick_params(labelsize=8)


def _row_name(row: Row, found: bool) -> str:
    """The name of a joint or sensor in short lines."""
    name = break_name(clean(row.name, LONGEST_NAME), _NAME_LINE)
    return f"{POINTER} {name}" if found else name


def _residual(panel: Axes, story: Story, shot: Shot, c: int) -> None:
    """What the simulations leave of a channel, with the size of each."""
    times = shot.side.times[shot.row]
    panel.axhspan(-2, 2, color=BAND, linewidth=0, label="±2σ: 95 % of the noise", zorder=0)
    panel.axhline(0, color=ZERO, linewidth=0.6, zorder=1)
    whiches = ("before", "after") if changed(story) else ("before",)
    for which in whiches:
        left = _left(story, shot, c, which)
        rows = kept(left)
        look = {**BEFORE, "linewidth": 1.0, "zorder": 3}
        if which == "after":
            look = {**AFTER, "linewidth": 0.8, "zorder": 2}
        look["rasterized"] = rows.size > MOST_OUTLINES
        panel.plot(times[rows], left[rows], **look)
    sizes = [number(_size(story, shot, c, which), 2) for which in whiches]
    panel.text(
        1.0,
        1.02,
        " → ".join(sizes),
        transform=panel.transAxes,
        ha="right",
        va="bottom",
        fontsize=8.5,
        weight="bold",
        color=INK,
    )
    panel.margins(x=0.01)
    panel.locator_params(axis="y", nbins=4)
    panel.tick_params(labelsize=8)


def _one_scale(
    panels: Sequence[Axes], story: Story, shot: Shot, rows: Sequence[Row], quantity: str
) -> None:
    """One scale for a column: where the gap is must be seen at a glance."""
    most = LEAST
    for row in rows:
        if quantity in row.channels:
            left = np.abs(_left(story, shot, row.channels[quantity], "before"))
            there = left[np.isfinite(left)]
            if there.size:
                most = max(most, 1.08 * float(np.quantile(there, TALLEST)))
    for panel in panels:
        panel.set_ylim(-most, most)


def joint_of(story: Story, kind: str, place: str) -> str:
    """The joint that a place belongs to: a channel's, an actuator's, a body's; empty where there is
    none, or no robot.
    """
    robot = story.robot
    if kind == "joint":
        return "" if place == FAMILY else clean(place, 40)
    if kind == "channel":
        quantity, _, name = place.partition(".")
        # A sensor has a row of its own.
        return clean(name if quantity in QUANTITIES and name else place, 40)
    if robot is None:
        return ""
    if kind == "actuator":
        return next((clean(a.joint or "", 40) for a in robot.actuators if a.name == place), "")
    if kind == "body":
        of = {body.id for body in robot.bodies if body.name == place}
        moved = [j.name for j in robot.joints if int(robot.compiled.jnt_bodyid[j.id]) in of]
        return clean(moved[0], 40) if moved else ""
    return ""


def _joints_of_marks(story: Story) -> set[str]:
    """Joints of the channels, actuators and bodies that the verdict names."""
    return {joint_of(story, mark.kind, mark.name) for mark in marks(story)}


def _finish(
    figure: Figure, axes: Any, story: Story, shot: Shot, rows: Sequence[Row], left: float
) -> None:
    """Title, legend and margins, in inches; the panels begin at `left`."""
    width, height = figure.get_size_inches().tolist()
    total = len(rows_of(story))
    some = f"; the worst {len(rows)} of {total} joints and sensors" if len(rows) < total else ""
    # A sample counts once, however many channels it has.
    samples = int(np.isfinite(shot.side.observed[shot.row]).any(axis=1).sum())
    kind = f"{story.validation_run} run" if shot.held_out else "run"
    how = "that fits worst" if story.verdict.verdict == "adequate" else "with the largest gap"
    title = f"The {kind} {how}, joint by joint: {label(shot.side.names[shot.row])}"
    title += f" ({samples} samples{some})"
    figure.suptitle(title, fontsize=11, x=0.012, ha="left", y=1 - 0.2 / height, va="center")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    with warnings.catch_warnings():
        # A column of residuals may have none in its first row.
        warnings.simplefilter("ignore", UserWarning)
        bands = [panel.get_legend_handles_labels() for panel in axes[:, 1]]
    band, its_label = next(((h, name) for h, name in bands if h), ([], []))
    figure.legend(
        [*handles, *band],
        [*labels, *its_label],
        loc="lower center",
        bbox_to_anchor=(0.5, 0.22 / height),
        ncols=4,
        fontsize=9,
    )
    before = "before → after" if changed(story) else "its size"
    note = f"residual: measured − simulated; above each its RMS in σ, {before}"
    figure.text(0.5, 0.14 / height, note, fontsize=8, ha="center", va="center", color=SOFT)
    figure.subplots_adjust(
        left=left / width,
        right=1 - 0.12 / width,
        top=1 - _HEAD / height,
        bottom=_FOOT / height,
        hspace=0.3,
        wspace=0.19,
    )
