"""The figures of an explanation: the run with the largest gap, where the gap is, the candidates.

Made for print and for grey: before is dashed with open squares, after solid with filled circles,
beside their colours. Each figure is rendered as PNG, and as PDF and SVG where vector graphics are
asked for (`bench.figures.formats`). Texts from files are never read as mathematics.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.figures import style
from bench.figures.formats import is_pdf_wanted
from bench.figures.robot import joints_in, robot_figure
from bench.figures.style import BAND, ZERO, blank
from bench.figures.text_layout import most_lines, text_width
from bench.gap.report.candidates_figure import candidates_figure
from bench.gap.report.joints import by_joint, joints_figure
from bench.gap.report.panels import (
    AFTER,
    BEFORE,
    LONGEST_NAME,
    changed,
    chosen_places,
    in_order,
    label,
    place_names,
    places_panel,
    profile_label,
    profile_panel,
    telling,
)
from bench.gap.report.places import marks
from bench.gap.report.ranking import ranked
from bench.gap.report.shots import MOST_OUTLINES, Shot, kept, worst
from bench.gap.report.story import Story
from bench.gap.report.words import clean
from sims.base import InputError, unknown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
"""Dots an inch of the PNG files, which the page shows at about two thirds of their size."""
_WIDTHS = {1: 8.6, 2: 10.0, 3: 12.5}
"""Inches by the number of channels."""
_HEADING = 0.22
"""Inches from the upper edge to the middle of a heading."""
_HEADING_SIZE = 11.0
"""Size of its letters at most, in points."""
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.usetex": False,
    # Names come from files: a dollar sign in one is a dollar sign.
    "text.parse_math": False,
}


def names(story: Story) -> tuple[str, ...]:
    """The figures that a story has: without places or candidates there is nothing to draw."""
    there = {
        "robot": story.robot is not None,
        "overview": True,
        "where": bool(chosen_places(story.places)),
        "candidates": bool(ranked(story)),
    }
    return tuple(name for name, drawn in there.items() if drawn)


def figure(story: Story, name: str) -> Figure:
    """One figure.

    Raises:
        InputError: the story has none of that name.
    """
    known = names(story)
    if name not in known:
        raise unknown("figure", name, known)
    with _styled():
        drawn = _MAKERS[name](story)
        # Ticks take their looks from the settings of the moment in which they are first needed.
        drawn.draw_without_rendering()
    return drawn


class Printed(NamedTuple):
    """One figure as the bytes of its files; of a robot's where its joints are: names with shares of
    its width and height from above left. `pdf` and `svg` are None where no PDF is asked for.
    """

    png: bytes
    pdf: bytes | None
    svg: bytes | None
    spots: tuple[tuple[str, float, float], ...] = ()


def printed(story: Story) -> dict[str, Printed]:
    """Draw every figure that a story has, and render its files; by name."""
    with _styled():
        # Within the settings: text is laid out once more when a figure is written.
        figures = {name: _MAKERS[name](story) for name in names(story)}
        made = {}
        for name, drawn in figures.items():
            png, pdf = style.printed(drawn, DPI)
            made[name] = Printed(png, pdf, style.svg(drawn) if is_pdf_wanted() else None)
        if story.robot is not None and "robot" in made:
            where = tuple(joints_in(figures["robot"], story.robot, pose(story, worst(story))))
            made["robot"] = made["robot"]._replace(spots=where)
        return made


@contextmanager
def _styled() -> Iterator[None]:
    """The settings of these figures, for as long as they are made or written."""
    from matplotlib import rc_context

    with rc_context(_STYLE), warnings.catch_warnings():
        # A title may be in any script; what the font lacks is drawn as a box.
        warnings.filterwarnings("ignore", message="Glyph")
        yield


def pose(story: Story, shot: Shot) -> dict[str, float]:
    """Positions of joints where a run is furthest from its beginning; those that were recorded."""
    joints, columns = [], []
    for c, channel in enumerate(story.channels):
        kind, _, joint = channel.name.partition(".")
        values = shot.side.observed[shot.row, :, c]
        if kind == "q" and np.isfinite(values).any():
            joints.append(joint)
            columns.append(np.nan_to_num(values, nan=float(values[np.isfinite(values)][0])))
    if not joints:
        return {}
    motion = np.stack(columns)
    far = np.square(motion - motion[:, :1]).sum(axis=0)
    return dict(zip(joints, motion[:, int(np.argmax(far))].tolist(), strict=True))


def _robot(story: Story) -> Figure:
    """The robot in the run that is shown, bent as far as it is there."""
    if story.robot is None:
        raise InputError(f"{story.path}: no robot was recorded")
    return robot_figure(story.robot, pose(story, worst(story)), marks(story))


def _overview(story: Story) -> Figure:
    shot = worst(story)
    if by_joint(story):
        return joints_figure(story, shot)
    count = len(shot.channels)
    size = (_WIDTHS[count], 5.2)
    figure, axes = blank(2, count, size, layout=None, sharex=True, height_ratios=(3, 2))
    for column, c in enumerate(shot.channels):
        _signal(axes[0][column], axes[1][column], story, shot, c)
    # A sample counts once, however many channels it has.
    samples = int(np.isfinite(shot.side.observed[shot.row]).any(axis=1).sum())
    kind = f"{story.validation_run} run" if shot.held_out else "run"
    how = "that fits worst" if story.verdict.verdict == "adequate" else "with the largest gap"
    some = f"; {count} of {len(story.channels)} channels" if count < len(story.channels) else ""
    title = f"The {kind} {how}: {label(shot.side.names[shot.row])} ({samples} samples{some})"
    figure.suptitle(title, fontsize=11, y=0.985)
    # One legend for all: the columns differ in the channel alone.
    handles, labels = axes[0][0].get_legend_handles_labels()
    band, its_label = axes[1][0].get_legend_handles_labels()
    figure.legend([*handles, *band], [*labels, *its_label], loc="lower center", ncols=4, fontsize=9)
    left = 0.75 / figure.get_figwidth()
    figure.subplots_adjust(left=left, right=0.985, top=0.92, bottom=0.165, hspace=0.1, wspace=0.2)
    return figure


def _signal(above: Axes, below: Axes, story: Story, shot: Shot, c: int) -> None:
    """One channel: measured and simulated, and under it what the simulation leaves."""
    channel, side = story.channels[c], shot.side
    times = side.times[shot.row]
    # Behind the end of a shorter run there is nothing.
    signals = [a[shot.row, : len(times), c] for a in (side.observed, side.before, side.after)]
    rows = kept(signals[0])
    t = times[rows]
    measured, before, after = (signal[rows] for signal in signals)

    size = 3.6 if rows.size < 250 else 2.6
    marks: dict[str, Any] = {"color": "black", "markersize": size, "markeredgewidth": 0}
    # Thousands of outlines would be most of a page.
    marks["rasterized"] = rows.size > MOST_OUTLINES
    above.plot(t, measured, "o", label="measured", zorder=4, **marks)
    tuned = "simulated before (tuned)" if changed(story) else "simulated (tuned)"
    above.plot(t, before, label=tuned, zorder=3, **BEFORE)
    noise, band = 2 * channel.sigma, "±2σ: 95 % of the noise"
    below.axhspan(-noise, noise, color=BAND, linewidth=0, label=band, zorder=0)
    below.axhline(0, color=ZERO, linewidth=0.6, zorder=1)
    below.plot(t, measured - before, zorder=3, **{**BEFORE, "linewidth": 1.0})
    if changed(story):
        # Wide and behind: where both agree, before is seen dashed upon after.
        above.plot(t, after, label="simulated after", zorder=2, **{**AFTER, "linewidth": 3.2})
        below.plot(t, measured - after, zorder=2, **{**AFTER, "linewidth": 0.8})

    above.set_ylabel(label(channel.name, channel.unit, 14))
    below.set_ylabel(label("residual", channel.unit))
    below.set_xlabel("time [s]; residual: measured − simulated")
    above.margins(x=0.01)
    for axis in (above, below):
        axis.locator_params(nbins=6)
    # Noise fills no panel: its band must be seen as narrow.
    _at_least(below, 3 * channel.sigma)


def _at_least(axis: Axes, size: float) -> None:
    """Widen a vertical axis to so much to either side of zero."""
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, -size), max(high, size))


class _Sheet(NamedTuple):
    """A figure laid out in inches, so that margins stay as they are while it grows.

    Attributes:
        figure: what is laid out.
        width: of it.
        height: of it.
    """

    figure: Figure
    width: float
    height: float

    def across(self, inches: float) -> float:
        """A distance from the left as a share of the width."""
        return inches / self.width

    def up(self, inches: float) -> float:
        """A distance from below as a share of the height."""
        return inches / self.height

    def heading(self, inches: float, text: str) -> None:
        """Write a heading that begins so far from the left, in letters that are small enough."""
        room = self.width - inches - 0.1
        size = _HEADING_SIZE * min(1.0, room / text_width([text], _HEADING_SIZE))
        y = 1 - self.up(_HEADING)
        self.figure.text(self.across(inches), y, text, fontsize=size, va="center")


_NAMES = 1.9
"""Least room for the names of places, in inches."""
_PROFILES_AFTER = 4.1
"""Inches from the end of these names to the profiles."""


def _where(story: Story) -> Figure:
    """Left the places, right the profiles that tell most."""
    places, profiles = chosen_places(story.places), telling(story.profiles)
    rows = min(2, len(profiles))
    columns = -(-len(profiles) // 2)
    names = place_names(places)
    left = max(_NAMES, 0.25 + text_width(names, _STYLE["font.size"]))
    profiles_from = left + _PROFILES_AFTER
    # A single column of profiles gets more width than one of several.
    width = left + 3.3 + (3.1 * columns if columns != 1 else 4.4)
    row = 0.27 + 0.13 * (most_lines(names) - 1)
    # Variables of robots have long names, in several lines below their panels.
    more = 0.15 * (most_lines([profile_label(profile) for profile in profiles]) - 1)
    height = max(2.6 + row * len(places), 1.5 + (1.9 + more) * rows)
    figure, axes = blank(1, 1, (width, height), layout=None)
    sheet, axis = _Sheet(figure, width, height), axes[0, 0]
    axis.set_position((left / width, 1.0 / height, 3.1 / width, 1 - 1.4 / height))
    places_panel(axis, places, story)
    sheet.heading(0.15, "Where the gap is")
    figure.legend(*in_order(axis), loc="lower left", ncols=2, fontsize=8.5, columnspacing=1.0)
    if not profiles:
        return figure

    channels = {profile.channel for profile in profiles}
    of = f" of {clean(profiles[0].channel, LONGEST_NAME)}" if len(channels) == 1 else ""
    sheet.heading(profiles_from, f"What the residual{of} follows: means in bins")
    note = "residual: measured − simulated; bars: ±2 standard errors"
    figure.text(sheet.across(profiles_from), sheet.up(0.2), note, fontsize=8.5, va="center")
    grid = figure.add_gridspec(
        rows,
        columns,
        left=sheet.across(profiles_from),
        right=1 - sheet.across(0.12),
        bottom=sheet.up(0.85 + more),
        top=1 - sheet.up(0.5),
        hspace=0.45 + 0.6 * more,
        wspace=0.42,
    )
    units = {c.name: c.unit for c in story.channels}
    for i, profile in enumerate(profiles):
        axis = figure.add_subplot(grid[i // columns, i % columns])
        unit = units.get(profile.channel, "1")
        profile_panel(axis, profile, unit, changed(story), one_channel=len(channels) == 1)
    return figure


_MAKERS: Mapping[str, Callable[[Story], Figure]] = {
    "robot": _robot,
    "overview": _overview,
    "where": _where,
    "candidates": candidates_figure,
}
