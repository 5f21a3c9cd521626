"""Sections of the page below what one sees first: why, where, candidates, numbers, what remains,
how to read it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from math import isfinite
from typing import Any

import numpy as np

from bench.gap.report.account import absorbed, experiment, rms, shift
from bench.gap.report.panels import standing
from bench.gap.report.story import Place, Side, Story, Tuned
from bench.gap.report.words import (
    clean,
    estimate,
    joined,
    name_of,
    noun,
    number,
    probability,
    sentence,
    with_unit,
)
from sims.base import Array

MOST_ROWS = 40
"""Rows of a table of places; of more, the worst are shown."""


_LEFT = {
    "partial": "Structure that no known cause explains",
    "unknown": "Structure that no known cause explains",
    "unidentifiable": "What the simulation lacks is open",
}


def safe(value: object, most: int = 400) -> str:
    """A text from a file or plugin, fit to stand in the page."""
    return escape(clean(value, most)).replace(" %", "\u00a0%")


def why(story: Story) -> Iterator[str]:
    """Why the verdict is what it is."""
    if story.why:
        yield "<h2>Why</h2>"
        yield "<ul>" + "".join(f"<li>{safe(sentence(text))}</li>" for text in story.why) + "</ul>"


def where(story: Story, picture: str) -> Iterator[str]:
    """Where the gap is, in units of the noise and of each channel."""
    yield "<h2>Where the gap is</h2>"
    yield picture
    worst = worst_first(story.places)
    shown = [p for p in story.places if p in worst[:MOST_ROWS]]
    extended = bool(story.verdict["causes"])
    heads = [
        "part of the data",
        "-samples",
        *(["-RMS before", "-RMS after"] if extended else ["-RMS"]),
    ]
    rows = [
        [
            safe(f"{p.kind} {p.label}", 80),
            str(p.samples),
            f"{p.before:.2f}",
            *([f"{p.after:.2f}"] if extended else []),
        ]
        for p in shown
    ]
    if rows:
        some = (
            f" The {len(rows)} worst of {len(story.places)}."
            if len(rows) < len(story.places)
            else ""
        )
        yield f'<p class="soft">RMS of the residual in units of the noise; 1 is the noise floor.{some}</p>'
        yield table(heads, rows)
    yield from _channels(story)


def worst_first(places: Sequence[Place]) -> list[Place]:
    """The places, the largest gap first."""
    return sorted((p for p in places if isfinite(p.before)), key=lambda p: -p.before)


def _channels(story: Story) -> Iterator[str]:
    """The channels with their noise and their errors in their own units."""
    extended = bool(story.verdict["causes"])
    runs = [("fitted", story.fitting), ("held-out", story.held_out)]
    there = [(name, side) for name, side in runs if side is not None and len(side.names)]
    heads = ["channel", "-noise, 1σ", "known how"]
    for name, _ in there:
        heads += [
            f"-RMSE{when}, {name} runs" for when in ((" before", " after") if extended else ("",))
        ]
    rows = []
    for i, c in enumerate(story.channels):
        known = "stated" if c.stated else "estimated"
        known += f", steps of {number(c.step)}" if c.step else ""
        errors = [errors_of(side)[i, : 1 + extended] for _, side in there]
        numbers = [safe(with_unit(number(float(e)), c.unit)) for pair in errors for e in pair]
        rows.append([safe(c.name, 60), safe(with_unit(number(c.sigma), c.unit)), known, *numbers])
    yield table(heads, rows)


def errors_of(side: Side) -> Array:
    """(C, 2) RMSE of each channel before and after, in its unit; NaN where nothing was seen."""
    result = np.full((side.observed.shape[2], 2), np.nan)
    for column, simulated in enumerate((side.before, side.after)):
        for c in range(len(result)):
            left = (side.observed - simulated)[:, :, c]
            if np.isfinite(left).any():
                result[c, column] = np.sqrt(np.nanmean(left**2))
    return result


def candidates(story: Story, picture: str) -> Iterator[str]:
    """The candidates with their evidence, what cannot be told apart, and what to do next."""
    candidates = story.verdict["candidates"]
    yield "<h2>What could be the cause</h2>"
    for cause in story.verdict["causes"]:
        if cause["alternatives"]:
            yield f"<p><strong>Not to be told apart:</strong> {safe(_set(story, cause), 1000)}</p>"
    if proposed := experiment(story):
        yield f"<p><strong>Next experiment:</strong> {safe(proposed, 1000)}</p>"
    yield picture
    if candidates:
        heads = ["candidate", "name", "-score", "-p", "-gain on held-out runs", "standing"]
        rows = [
            [
                safe(name_of(c["effect"])),
                f"<code>{safe(c['effect'], 80)}</code>",
                number(c["score"]),
                probability(c["p_value"]).removeprefix("p = ").removeprefix("p "),
                number(c["heldout_gain"]),
                standing(story, c["effect"]) if story.verdict["causes"] else "not convincing",
            ]
            for c in candidates
        ]
        marks = [
            "found" if standing(story, c["effect"]) != "not needed" else "" for c in candidates
        ]
        yield table(heads, rows, marks)
    else:
        yield "<p>No candidate was tried.</p>"


def _set(story: Story, cause: Mapping[str, Any]) -> str:
    """The members of a set with their scores and gains: they are too close for these data."""
    scores = {c["effect"]: c for c in story.verdict["candidates"]}
    parts = []
    for name in (cause["effect"], *cause["alternatives"]):
        found = scores.get(name)
        evidence = (
            f" (score {number(found['score'])}, held-out gain {number(found['heldout_gain'])})"
            if found
            else ""
        )
        parts.append(noun(name) + evidence)
    return (
        f"{joined(parts)} change these runs so much alike that either explains them equally well."
    )


def numbers(story: Story) -> Iterator[str]:
    """What was found in numbers, and how the parameters move."""
    rows = [
        [
            safe(noun(cause["effect"])),
            safe(cause["says"]),
            safe(name, 60),
            _estimated(c),
            probability(cause["p_value"]),
        ]
        for cause in story.verdict["causes"]
        for name, c in cause["coefficients"].items()
    ]
    if rows:
        yield "<h2>What was found, in numbers</h2>"
        yield table(
            ["cause", "what it does", "coefficient", "value (95 % interval)", "by chance"], rows
        )
    if story.parameters:
        yield "<h2>The simulator's own parameters</h2>"
        yield from _parameters(story)


def _estimated(c: Mapping[str, Any]) -> str:
    return safe(with_unit(estimate(c["value"], c["low"], c["high"]), c["unit"]))


def _parameters(story: Story) -> Iterator[str]:
    extended = bool(story.verdict["causes"])
    if any(absorbed(p) for p in story.parameters if p.touched) and extended:
        yield "<p>Before, some of them were bent to absorb part of the gap: the move shows by how much.</p>"
    later = ["before (95 % interval)", "after (95 % interval)", "move", "before above, after below"]
    heads = ["parameter", *(later if extended else ["value (95 % interval)"])]
    rows = []
    for p in story.parameters:
        row = [safe(p.name, 60), _tuned(p, p.before)]
        if extended:
            row += [_tuned(p, p.after), safe(_move(p)), _intervals(p)]
        rows.append(row)
    yield table(heads, rows)


def _tuned(p: Tuned, value: tuple[float, float, float]) -> str:
    if not p.touched:
        return safe(with_unit(number(value[0]), p.unit)) + ", nominal: not touched by the data"
    return safe(with_unit(estimate(*value), p.unit))


def _move(p: Tuned) -> str:
    if not p.touched:
        return "–"
    return (
        f"{shift(p)}, had absorbed part of the gap"
        if absorbed(p)
        else f"{shift(p)}, within its interval"
    )


def _intervals(p: Tuned) -> str:
    """The two intervals drawn one above the other: before dashed and open, after solid and filled."""
    if not np.isfinite([*p.before, *p.after]).all():
        return ""
    low, high = min(p.before[1], p.after[1]), max(p.before[2], p.after[2])
    scale = 180.0 / (high - low) if high > low else 0.0
    parts = []
    for kind, y, values in (("before", 8, p.before), ("after", 22, p.after)):
        middle, left, right = (10.0 + (v - low) * scale for v in values)
        parts.append(
            f'<line class="{kind}" x1="{left:.1f}" x2="{right:.1f}" y1="{y}" y2="{y}" stroke-width="2"/>'
        )
        parts.append(f'<circle class="{kind}" cx="{middle:.1f}" cy="{y}" r="4" stroke-width="2"/>')
    name = safe(p.name, 60)
    return f'<svg viewBox="0 0 200 30" role="img" aria-label="intervals of {name} before and after">{"".join(parts)}</svg>'


def remains(story: Story) -> Iterator[str]:
    """What is left unexplained."""
    yield "<h2>What remains</h2>"
    if story.remains:
        yield (
            "<ul>" + "".join(f"<li>{safe(sentence(text))}</li>" for text in story.remains) + "</ul>"
        )
        return
    side, name = (story.held_out, "held-out") if story.held_out else (story.fitting, "fitted")
    left = number(rms(story, side, "after"), 2)
    what = _LEFT.get(story.verdict["verdict"], "Nothing that stands out")
    yield f"<p>{what}: the residual of the {name} runs is {left} times the noise.</p>"


def reading() -> Iterator[str]:
    """The words of the page, half a line each."""
    yield "<h2>How to read this</h2>\n<dl>"
    for word, meaning in (
        ("RMSE, RMS", "root mean square: the typical size of the error."),
        (
            "noise floor",
            "the error that a perfect simulation would still have, from the sensor's noise (σ).",
        ),
        ("gap", "what the tuned simulation's error exceeds the noise floor by."),
        (
            "before, after",
            "the simulation with its own parameters tuned; the same with what was found, tuned again.",
        ),
        ("held-out runs", "runs on which nothing was fitted but where they begin."),
        (
            "interval",
            "95 %: where the true value lies 19 times in 20, as far as the model is right.",
        ),
        (
            "score, p",
            "evidence for a cause, and how probable as much is by chance where nothing is missing.",
        ),
    ):
        yield f"<dt>{word}</dt><dd>{meaning}</dd>"
    yield "</dl>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()) -> str:
    """An HTML table of cells that are safe already; a head that begins with - heads numbers."""
    kinds = [' class="number"' if head.startswith("-") else "" for head in heads]
    top = "".join(
        f'<th scope="col"{k}>{h.removeprefix("-")}</th>' for h, k in zip(heads, kinds, strict=True)
    )
    lines = []
    for i, row in enumerate(rows):
        mark = f' class="{marks[i]}"' if marks and marks[i] else ""
        lines.append(
            f"<tr{mark}>"
            + "".join(f"<td{k}>{c}</td>" for c, k in zip(row, kinds, strict=True))
            + "</tr>"
        )
    body = "\n".join(lines)
    return f'<div class="scroll"><table>\n<thead><tr>{top}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'
