"""The figures of an explanation: the run with the largest gap, where the gap is, the candidates.

Made for print and for grey: before is dashed with open squares, after solid with filled circles,
beside their colours. Each figure is written as PNG and PDF. Texts from files are never read as
mathematics.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.gap.report.account import sides
from bench.gap.report.panels import (
    AFTER,
    BAND,
    BEFORE,
    changed,
    chosen_places,
    gains_panel,
    in_order,
    label,
    places_panel,
    profile_panel,
    ranked,
    scores_panel,
    standings,
    telling,
)
from bench.gap.report.story import Side, Story
from sims.base import Array, InputError, unknown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 130
MOST_POINTS, MOST_CHANNELS = 3000, 3
_WIDTHS = {1: 8.6, 2: 10.0, 3: 12.5}
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.usetex": False,
    "text.parse_math": False,  # names come from files
}


def names(story: Story) -> tuple[str, ...]:
    """The figures that a story has: without places or candidates there is nothing to draw of them."""
    there = {
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
    makers = {"overview": _overview, "where": _where, "candidates": _candidates}
    with _style():
        made = makers[name](story)
        # Ticks take their looks from the settings of the moment that they are first needed.
        made.draw_without_rendering()
    return made


def png(story: Story, name: str) -> bytes:
    """One figure as the bytes of a PNG file."""
    file = BytesIO()
    with _style():
        _save_png(figure(story, name), file)
    return file.getvalue()


def draw(story: Story, folder: Path) -> list[Path]:
    """Draw what there is to see into `folder`, each figure as PNG and PDF; returns the files, PNG
    before PDF.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    paths = []
    with _style():
        for name in names(story):
            paths += _save(figure(story, name), folder, name)
    return paths


@contextmanager
def _style() -> Iterator[None]:
    from matplotlib import rc_context

    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a title may be in any script
        yield


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _save_png(figure, paths[0])
        figure.savefig(paths[1], metadata={"CreationDate": None})
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    return paths


def _save_png(figure: Figure, file: Path | BytesIO) -> None:
    figure.savefig(file, format="png", dpi=DPI, pil_kwargs={"compress_level": 3})


class Shot(NamedTuple):
    """The run that is shown: its side, its row, whether it is held out, and its channels, the worst
    first.
    """

    side: Side
    row: int
    held_out: bool
    channels: list[int]


def worst(story: Story) -> Shot:
    """The run with the largest gap in units of the noise, a held-out one if there is any."""
    side = sides(story)[-1]
    sigma = np.array([c.sigma for c in story.channels])
    squares = ((side.observed - side.before) / sigma) ** 2
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # a run or channel without a sample has no mean
        row = int(np.argmax(np.nan_to_num(np.nanmean(squares, axis=(1, 2)))))
        by_channel = np.nan_to_num(np.nanmean(squares[row], axis=0))
    channels = np.argsort(-by_channel, kind="stable")[:MOST_CHANNELS]
    return Shot(side, row, side is story.held_out, sorted(int(c) for c in channels))


def _overview(story: Story) -> Figure:
    shot = worst(story)
    count = len(shot.channels)
    figure, axes = _canvas(2, count, (_WIDTHS[count], 5.2), sharex=True, height_ratios=(3, 2))
    for column, c in enumerate(shot.channels):
        _signal(axes[0][column], axes[1][column], story, shot, c)
    samples = int(np.isfinite(shot.side.observed[shot.row]).any(axis=1).sum())
    kind = "held-out run" if shot.held_out else "run"
    how = "that fits worst" if story.verdict["verdict"] == "adequate" else "with the largest gap"
    some = f"; {count} of {len(story.channels)} channels" if count < len(story.channels) else ""
    title = f"The {kind} {how}: {label(shot.side.names[shot.row])} ({samples} samples{some})"
    figure.suptitle(title, fontsize=11, y=0.985)
    handles, labels = axes[0][0].get_legend_handles_labels()
    band, its_label = axes[1][0].get_legend_handles_labels()
    figure.legend([*handles, *band], [*labels, *its_label], loc="lower center", ncols=4, fontsize=9)
    left = 0.75 / figure.get_figwidth()
    figure.subplots_adjust(left=left, right=0.985, top=0.92, bottom=0.165, hspace=0.1, wspace=0.2)
    return figure


def _signal(above: Axes, below: Axes, story: Story, shot: Shot, c: int) -> None:
    """One channel: measured and simulated, and under it what the simulation leaves."""
    channel, side = story.channels[c], shot.side
    length = len(side.times[shot.row])
    measured, before, after = (
        a[shot.row, :length, c] for a in (side.observed, side.before, side.after)
    )
    rows = kept(measured)
    t, measured, before, after = (a[rows] for a in (side.times[shot.row], measured, before, after))
    size = 3.6 if rows.size < 250 else 2.6
    above.plot(
        t,
        measured,
        "o",
        color="black",
        markersize=size,
        markeredgewidth=0,
        label="measured",
        zorder=4,
    )
    tuned = "simulated before (tuned)" if changed(story) else "simulated (tuned)"
    above.plot(t, before, label=tuned, zorder=3, **BEFORE)
    below.axhspan(
        -2 * channel.sigma,
        2 * channel.sigma,
        color=BAND,
        linewidth=0,
        label="±2σ: 95 % of the noise",
        zorder=0,
    )
    below.axhline(0, color="#555555", linewidth=0.6, zorder=1)
    below.plot(t, measured - before, zorder=3, **{**BEFORE, "linewidth": 1.0})
    if changed(story):
        above.plot(t, after, label="simulated after", zorder=2, **{**AFTER, "linewidth": 3.2})
        below.plot(t, measured - after, zorder=2, **{**AFTER, "linewidth": 0.8})
    above.set_ylabel(label(channel.name, channel.unit, 14))
    below.set_ylabel(label("residual", channel.unit))
    below.set_xlabel("time [s]; residual: measured − simulated")
    above.margins(x=0.01)
    for axis in (above, below):
        axis.locator_params(nbins=6)
    _at_least(below, 3 * channel.sigma)


def kept(values: Array) -> Any:
    """Places of at most about `MOST_POINTS` samples that look the same: the least and largest of
    each stretch.
    """
    if values.size <= MOST_POINTS:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, MOST_POINTS // 2 + 1).astype(int)
    low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
    stretches = [*pairwise(edges)]
    chosen = [a + np.argmin(low[a:b]) for a, b in stretches] + [
        a + np.argmax(high[a:b]) for a, b in stretches
    ]
    return np.unique(chosen)


def _at_least(axis: Axes, size: float) -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, -size), max(high, size))


def _where(story: Story) -> Figure:
    places, profiles = chosen_places(story.places), telling(story.profiles)
    columns, rows = -(-len(profiles) // 2), min(2, len(profiles))
    width, tall = (
        5.2 + (3.1 * columns if columns != 1 else 4.4),
        max(2.6 + 0.27 * len(places), 1.5 + 1.9 * rows),
    )
    figure, axes = _canvas(1, 1, (width, tall))
    axis = axes[0][0]
    axis.set_position((1.9 / width, 1.0 / tall, 3.1 / width, 1 - 1.4 / tall))
    places_panel(axis, places, story)
    figure.text(0.15 / width, 1 - 0.22 / tall, "Where the gap is", fontsize=11, va="center")
    figure.legend(*in_order(axis), loc="lower left", ncols=2, fontsize=8.5, columnspacing=1.0)
    if not profiles:
        return figure
    figure.text(
        6.0 / width,
        1 - 0.22 / tall,
        "What it follows: mean residual in bins",
        fontsize=11,
        va="center",
    )
    note = "residual: measured − simulated; bars: ±2 standard errors"
    figure.text(6.0 / width, 0.2 / tall, note, fontsize=8.5, va="center")
    grid = figure.add_gridspec(
        rows,
        columns,
        left=6.0 / width,
        right=1 - 0.12 / width,
        bottom=0.85 / tall,
        top=1 - 0.5 / tall,
        hspace=0.45,
        wspace=0.42,
    )
    units = {c.name: c.unit for c in story.channels}
    for i, profile in enumerate(profiles):
        axis = figure.add_subplot(grid[i // columns, i % columns])
        profile_panel(axis, profile, units.get(profile.channel, "1"), changed(story))
    return figure


def _candidates(story: Story) -> Figure:
    found, total = ranked(story), len(story.verdict["candidates"])
    tall = 1.75 + 0.28 * len(found)
    figure, axes = _canvas(1, 2, (9.4, tall), sharey=True, width_ratios=(3, 2))
    scores_panel(axes[0][0], story, found)
    gains_panel(axes[0][1], story, found)
    some = f", the best {len(found)} of {total}" if len(found) < total else ""
    figure.text(0.015, 1 - 0.22 / tall, f"Candidate causes{some}", fontsize=11, va="center")
    figure.legend(*standings(story), loc="upper right", ncols=3, fontsize=8.5)
    figure.subplots_adjust(
        left=0.25, right=0.985, bottom=0.68 / tall, top=1 - 0.45 / tall, wspace=0.06
    )
    return figure


def _canvas(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, Sequence[Sequence[Axes]]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)
