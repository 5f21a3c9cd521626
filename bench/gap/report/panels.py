"""Panels of the figures: places and profiles of the gap, candidates; and the look that all figures
share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.gap.report.story import Place, Profile, Story
from bench.gap.report.words import clean, labelled, name_of, number, probability

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_RUNS, MOST_PLACES, MOST_PROFILES, MOST_CANDIDATES = 8, 6, 4, 12
BEFORE: Mapping[str, Any] = {"color": "#D55E00", "linestyle": (0, (5, 2)), "linewidth": 1.3}
AFTER: Mapping[str, Any] = {"color": "#0072B2", "linestyle": "-", "linewidth": 1.5}
OPEN: Mapping[str, Any] = {
    "marker": "s",
    "markersize": 6,
    "markerfacecolor": "white",
    "color": "#D55E00",
}
FILLED: Mapping[str, Any] = {"marker": "o", "markersize": 5.5, "color": "#0072B2"}
_LOOKS: Mapping[str, Mapping[str, Any]] = {
    "found": {"facecolor": "#0072B2"},
    "found, but cannot be told apart": {"facecolor": "#56B4E9", "hatch": "///"},
    "not needed": {"facecolor": "#CFCFCF"},
}
GAIN = "gain on held-out runs"
BAND, _SPAN_FOR_LOG = "#CFCFCF", 8.0
_FLOOR, _ALONE = "1: noise floor", "what noise alone gives"


def label(name: object, unit: str = "1", most: int = 30) -> str:
    """A text from a file, perhaps with its unit, short enough for a label."""
    return labelled(clean(name, most), clean(unit, 12))


def changed(story: Story) -> bool:
    """Whether there is an extended model to show beside the base model."""
    return bool(story.verdict["causes"])


def chosen_places(places: Sequence[Place]) -> list[Place]:
    """Runs, channels and phases to show: the worst of each, in the order in which they were."""
    result: list[Place] = []
    for kind, most in (("run", MOST_RUNS), ("channel", MOST_PLACES), ("phase", MOST_PLACES)):
        there = [p for p in places if p.kind == kind and np.isfinite(p.before) and p.samples > 0]
        worst_first = sorted(there, key=lambda p: -p.before)[:most]
        result += [p for p in there if p in worst_first]
    return result


def places_panel(axis: Axes, places: Sequence[Place], story: Story) -> None:
    """Dots by run, channel and phase, with the stretch that noise alone would give."""
    rows: list[float] = []
    for i, place in enumerate(places):
        new = i == 0 or places[i - 1].kind != place.kind
        rows.append((rows[-1] if rows else -0.6) + (2.1 if new and rows else 1.6 if new else 1.0))
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
    noise = [min(2 / (2 * p.samples) ** 0.5, 0.9) for p in places]
    axis.errorbar(
        np.ones(len(rows)),
        rows,
        xerr=noise,
        fmt="none",
        ecolor="#A8A8A8",
        elinewidth=7,
        label=_ALONE,
    )
    axis.axvline(1.0, color="#333333", linewidth=1.0, linestyle=":", label=_FLOOR)
    squares, dots = [p.before for p in places], [p.after for p in places]
    if changed(story):
        axis.hlines(rows, dots, squares, color="#999999", linewidth=0.9)
        axis.plot(dots, rows, linestyle="", label="after", **FILLED)
    axis.plot(
        squares,
        rows,
        linestyle="",
        label="before" if changed(story) else "simulated (tuned)",
        **OPEN,
    )
    _decades(axis, [*squares, *(dots if changed(story) else []), 1.0])
    axis.set_yticks(rows, [f"{label(p.label, most=18)} ({p.samples})" for p in places])
    axis.set_ylim(rows[-1] + 0.7, -0.1)
    axis.set_xlabel("RMS of the residual, in units of the noise")


def in_order(axis: Axes) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend in the order in which a reader meets them."""
    found = dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    labels = [
        name for name in ("before", "simulated (tuned)", "after", _FLOOR, _ALONE) if name in found
    ]
    return [found[name] for name in labels], labels


def _decades(axis: Axes, values: Sequence[float]) -> None:
    """A log axis with plain numbers where the values span much."""
    there = np.array([v for v in values if np.isfinite(v) and v > 0])
    if not there.size or there.max() / there.min() < _SPAN_FOR_LOG:
        axis.set_xlim(left=0)
        return
    axis.set_xscale("log")
    low, high = there.min() / 1.4, there.max() * 1.4
    steps = (1, 2, 5) if high / low < 200 else (1, 3) if high / low < 1000 else (1,)
    ticks = [s * 10.0**e for e in range(-6, 10) for s in steps if low <= s * 10.0**e <= high]
    axis.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axis.set_xticks([], minor=True)
    axis.set_xlim(low, high)


def telling(profiles: Sequence[Profile]) -> list[Profile]:
    """The profiles in which the residual before stands out most, one for each variable before a
    second for any.
    """
    ranked = sorted((p for p in profiles if np.isfinite(_standing(p))), key=lambda p: -_standing(p))
    variables = [p.variable for p in ranked]
    again = [name in variables[:i] for i, name in enumerate(variables)]
    return [ranked[i] for i in np.argsort(again, kind="stable")[:MOST_PROFILES]]


def _standing(profile: Profile) -> float:
    there = np.isfinite(profile.before) & (profile.error > 0)
    return (
        float(np.mean((profile.before[there] / profile.error[there]) ** 2))
        if there.sum() > 1
        else float("nan")
    )


def profile_panel(axis: Axes, profile: Profile, unit: str, extended: bool) -> None:
    """The mean residual of a channel, with its unit, against a variable."""
    there = np.isfinite(profile.before)
    x, bars = profile.centres[there], 2 * profile.error[there]
    axis.axhline(0, color="#555555", linewidth=0.6)
    looks = [(profile.before, {**BEFORE, **OPEN, "markersize": 4.5, "linewidth": 1.0})]
    if extended:
        looks.append((profile.after, {**AFTER, **FILLED, "markersize": 3.5, "linewidth": 1.2}))
    for values, look in looks:
        axis.errorbar(x, values[there], yerr=bars, elinewidth=1.0, **look)
    axis.set_xlabel(label(profile.variable, profile.unit, 16))
    axis.set_ylabel(label(f"residual of {clean(profile.channel, 9)}", clean(unit, 9)))
    axis.locator_params(nbins=5)


def ranked(story: Story) -> list[Mapping[str, Any]]:
    """The candidates to show, the highest score first; what is found is among them."""
    ordered = sorted(story.verdict["candidates"], key=_size, reverse=True)
    others = [c for c in ordered if standing(story, c["effect"]) == "not needed"]
    beyond = others[max(0, MOST_CANDIDATES - len(ordered) + len(others)) :]
    return [c for c in ordered if c not in beyond]


def _size(candidate: Mapping[str, Any]) -> float:
    return float(candidate["score"] or 0.0)


def scores_panel(axis: Axes, story: Story, found: Sequence[Mapping[str, Any]]) -> None:
    """Bars of the candidates' scores, with their probabilities."""
    rows = np.arange(len(found))
    sizes = [max(_size(c), 0.0) for c in found]
    for row, size, c in zip(rows, sizes, found, strict=True):
        axis.barh(row, size, height=0.62, edgecolor="white", **_LOOKS[standing(story, c["effect"])])
        said = f"{number(c['score'])}  ({probability(c['p_value'])})"
        axis.annotate(
            said, (size, row), (4, 0), textcoords="offset points", va="center", fontsize=8
        )
    axis.set_yticks(rows, [label(name_of(c["effect"]), most=34) for c in found])
    axis.set_ylim(len(found) - 0.4, -0.6)
    axis.set_xlim(0, 1.35 * max(*sizes, 1e-9))
    axis.set_xlabel(
        "score: evidence that the simulation lacks it\n(twice the gain in log likelihood)"
    )


def gains_panel(axis: Axes, story: Story, found: Sequence[Mapping[str, Any]]) -> None:
    """The candidates' gains on held-out runs; none is drawn where none was measured."""
    rows = np.arange(len(found))
    gains = [np.nan if c["heldout_gain"] is None else c["heldout_gain"] for c in found]
    colours = [_LOOKS[standing(story, c["effect"])]["facecolor"] for c in found]
    axis.axvline(0, color="#555555", linewidth=0.6)
    axis.hlines(rows, 0, gains, color="#999999", linewidth=0.9)
    axis.scatter(gains, rows, c=colours, edgecolors="#333333", s=36, zorder=3)
    axis.set_xlabel(GAIN)
    axis.tick_params(left=False)


def standing(story: Story, effect: str) -> str:
    """Whether an effect is found, one of a set that cannot be told apart, or neither."""
    for cause in story.verdict["causes"]:
        if effect in (cause["effect"], *cause["alternatives"]):
            return "found, but cannot be told apart" if cause["alternatives"] else "found"
    return "not needed"


def standings(story: Story) -> tuple[list[Any], list[str]]:
    """Handles and labels of the candidates' legend."""
    from matplotlib.patches import Patch

    there = {standing(story, c["effect"]) for c in story.verdict["candidates"]}
    names = [name for name in _LOOKS if name in there] if there != {"not needed"} else []
    return [Patch(edgecolor="white", **_LOOKS[name]) for name in names], names
