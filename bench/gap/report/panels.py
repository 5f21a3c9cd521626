"""Panels of the figures: places and profiles of the gap; and the look that all figures share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.figures.style import BLUE, CHANCE, INK, JOIN, VERMILION, ZERO
from bench.figures.text_layout import break_name
from bench.gap.report.story import Place, Profile, Story
from bench.gap.report.words import clean, labelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_RUNS = 8
"""Runs that are shown, the worst."""
MOST_PLACES = 10
"""Channels that are shown, and phases, the worst of each."""
MOST_PROFILES = 4
MOST_LETTERS = 26
"""Of the name of a variable or of a channel."""
LONGEST_NAME = 64
"""Of the name of a run or channel among the places."""
_NAME_LINE = 32
"""Longest line of such a name, in characters."""
SHORT = 9
"""Letters of a unit beside a panel."""
BEFORE: Mapping[str, Any] = {"color": VERMILION, "linestyle": (0, (5, 2)), "linewidth": 1.3}
"""Curves of the tuned base model: dashed, to be told apart in grey."""
AFTER: Mapping[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.5}
"""Curves of the extended model."""
OPEN: Mapping[str, Any] = {
    "marker": "s",
    "markersize": 6,
    "markerfacecolor": "white",
    "color": VERMILION,
}
"""Marks of the tuned base model: open squares, to be told apart in grey."""
FILLED: Mapping[str, Any] = {"marker": "o", "markersize": 5.5, "color": BLUE}
"""Marks of the extended model."""
_SPAN_FOR_LOG = 8.0
"""Factor between the largest and the least value from which on an axis is logarithmic."""
_FLOOR = "1: noise floor"
_ALONE = "what noise alone gives"
_WIDEST = 0.9
"""Longest bar of chance to either side of 1, so that it ends before 0."""
_NEXT = 1.0
"""Distance of a row of places from the one above."""
_NEXT_KIND = 2.1
"""Distance of the first row of another kind, with room for its heading."""
_FIRST = 1.0
"""Where the first row stands."""


def label(name: object, unit: str = "1", most: int = 30) -> str:
    """A text from a file, perhaps with its unit, short enough for a label."""
    return labelled(clean(name, most), clean(unit, 12))


def changed(story: Story) -> bool:
    """Whether there is an extended model to show beside the base model."""
    return bool(story.verdict.causes)


def chosen_places(places: Sequence[Place]) -> list[Place]:
    """Runs, channels and phases to show: the worst of each, in the order in which they were."""
    result: list[Place] = []
    # A part that nothing was recorded in has no size.
    usable = [p for p in places if np.isfinite(p.before) and p.samples > 0]
    for kind, most in (("run", MOST_RUNS), ("channel", MOST_PLACES), ("phase", MOST_PLACES)):
        there = [p for p in usable if p.kind == kind]
        worst = sorted(there, key=lambda p: -p.before)[:most]
        # Not sorted by size: a reader looks for the third run behind the second.
        result += [p for p in there if p in worst]
    return result


def places_panel(axis: Axes, places: Sequence[Place], story: Story) -> None:
    """Dots by run, channel and phase, with the stretch that noise alone would give."""
    rows = _rows_of(axis, places)
    # The RMS of n samples of noise scatters by 1 / sqrt(2 n) about 1; drawn are two sigmas.
    noise = [min(2 / (2 * p.samples) ** 0.5, _WIDEST) for p in places]
    ones = np.ones(len(rows))
    axis.errorbar(ones, rows, xerr=noise, fmt="none", ecolor=CHANCE, elinewidth=7, label=_ALONE)
    axis.axvline(1.0, color=INK, linewidth=1.0, linestyle=":", label=_FLOOR)
    squares = [p.before for p in places]
    dots = [p.after for p in places]
    if changed(story):
        axis.hlines(rows, dots, squares, color=JOIN, linewidth=0.9)
        axis.plot(dots, rows, linestyle="", label="after", **FILLED)
    name = "before" if changed(story) else "simulated (tuned)"
    axis.plot(squares, rows, linestyle="", label=name, **OPEN)
    drawn = [*squares, *dots] if changed(story) else squares
    # The noise floor belongs into view, whatever the sizes.
    _decades(axis, [*drawn, 1.0])
    axis.set_yticks(rows, place_names(places), linespacing=1.05)
    axis.set_ylim(rows[-1] + 0.7, -0.1)
    axis.set_xlabel("RMS of the residual, in units of the noise")


def place_names(places: Sequence[Place]) -> list[str]:
    """Name each place with its number of samples, in as many lines as that needs."""
    names = [f"{clean(place.label, LONGEST_NAME)} ({place.samples})" for place in places]
    return [break_name(name, _NAME_LINE) for name in names]


def _rows_of(axis: Axes, places: Sequence[Place]) -> list[float]:
    """The height of each place, downwards; writes a heading above the first of each kind."""
    rows: list[float] = []
    for i, place in enumerate(places):
        new = i == 0 or places[i - 1].kind != place.kind
        if not rows:
            rows.append(_FIRST)
        else:
            rows.append(rows[-1] + (_NEXT_KIND if new else _NEXT))
        if new:
            axis.text(
                -0.035,
                rows[-1] - 0.85,
                f"by {place.kind} (samples)",
                transform=axis.get_yaxis_transform(),
                ha="right",
                va="center",
                fontsize=8.5,
                weight="bold",
            )
    return rows


def in_order(axis: Axes) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend in the order in which a reader meets them."""
    handles, labels = axis.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    order = ("before", "simulated (tuned)", "after", _FLOOR, _ALONE)
    present = [name for name in order if name in by_label]
    return [by_label[name] for name in present], present


def _decades(axis: Axes, values: Sequence[float]) -> None:
    """A log axis with plain numbers where the values span much."""
    there = np.array([v for v in values if np.isfinite(v) and v > 0])
    if not there.size or there.max() / there.min() < _SPAN_FOR_LOG:
        axis.set_xlim(left=0)
        return
    axis.set_xscale("log")
    low = there.min() / 1.4
    high = there.max() * 1.4
    ticks = _ticks(low, high)
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    # Minor ticks of a short axis would be labelled too, in powers of ten.
    axis.set_xticks([], minor=True)
    axis.set_xlim(low, high)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two others, on a log axis."""
    # The more decades, the fewer numbers in each: labels must not touch.
    steps: tuple[int, ...] = (1,)
    if high / low < 200:
        steps = (1, 2, 5)
    elif high / low < 1000:
        steps = (1, 3)
    ticks = []
    for exponent in range(-6, 10):
        for step in steps:
            tick = step * 10.0**exponent
            if low <= tick <= high:
                ticks.append(tick)
    return ticks


def telling(profiles: Sequence[Profile]) -> list[Profile]:
    """The profiles in which the residual before stands out most, one for each variable before a
    second for any.
    """
    usable = [p for p in profiles if np.isfinite(_standing(p))]
    strongest_first = sorted(usable, key=lambda p: -_standing(p))
    variables = [p.variable for p in strongest_first]
    again = [name in variables[:i] for i, name in enumerate(variables)]
    # A stable sort by "seen before": first ones come first, each group by strength.
    order = np.argsort(again, kind="stable")
    return [strongest_first[i] for i in order[:MOST_PROFILES]]


def _standing(profile: Profile) -> float:
    """Mean square of the residual in standard errors, 1 by chance; NaN for too few bins."""
    there = np.isfinite(profile.before) & (profile.error > 0)
    if there.sum() < 2:
        return float("nan")
    return float(np.mean((profile.before[there] / profile.error[there]) ** 2))


def profile_label(profile: Profile) -> str:
    """Name a variable with its unit, in as many lines as that needs."""
    name = labelled(clean(profile.variable, LONGEST_NAME), clean(profile.unit, 12), LONGEST_NAME)
    return break_name(name, _NAME_LINE)


def profile_panel(
    axis: Axes, profile: Profile, unit: str, extended: bool, *, one_channel: bool = False
) -> None:
    """Draw the mean residual of a channel, with its unit, against a variable.

    Args:
        axis: where.
        profile: the residual in bins.
        unit: of the channel.
        extended: whether there is an extended model to draw.
        one_channel: whether all panels are of the same channel, which their heading names.
    """
    # Bins without a sample have no mean.
    there = np.isfinite(profile.before)
    centres = profile.centres[there]
    bars = 2 * profile.error[there]
    axis.axhline(0, color=ZERO, linewidth=0.6)
    looks = [(profile.before, {**BEFORE, **OPEN, "markersize": 4.5, "linewidth": 1.0})]
    if extended:
        looks.append((profile.after, {**AFTER, **FILLED, "markersize": 3.5, "linewidth": 1.2}))
    for values, look in looks:
        axis.errorbar(centres, values[there], yerr=bars, elinewidth=1.0, **look)
    axis.set_xlabel(profile_label(profile))
    what = "residual" if one_channel else f"residual of {clean(profile.channel, MOST_LETTERS)}"
    axis.set_ylabel(break_name(labelled(what, clean(unit, SHORT)), MOST_LETTERS))
    axis.locator_params(nbins=5)
