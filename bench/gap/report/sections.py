"""Sections of the page below what one sees first: why, where, candidates, numbers, what remains,
how to read it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite

import numpy as np

from bench.gap.report.account import absorbed, experiment, rms, shift
from bench.gap.report.places import has_places, of_set, values_of, without_place
from bench.gap.report.ranking import entries, standing
from bench.gap.report.story import Place, Side, Story, Tuned
from bench.gap.report.words import (
    FAMILY,
    estimate,
    joined,
    name_of,
    noun,
    number,
    parted,
    probability,
    sentence,
    with_unit,
)
from bench.gap.verdict import Candidate, Cause
from bench.pages.elements import code, folded, heading, listed, paragraph, safe, strong, table
from sims.base import Array

MOST_CANDIDATES = 25
"""Effects at places in the table of candidates; all of them stand in the fold below it."""
MOST_ELSEWHERE = 4
"""Other places of an effect that are named in its row."""
MOST_ROWS = 40
"""Rows of a table of places; of more, the worst are shown."""
_LEFT = {
    "partial": "Structure that no known cause explains",
    "unknown": "Structure that no known cause explains",
    "unidentifiable": "What the simulation lacks is open",
}
"""What the residual is called where the verdict leaves something open."""
_ALIKE = "change these runs so much alike that either explains them equally well."
_READING = {
    "RMSE, RMS": "root mean square: the typical size of the error.",
    "noise floor": (
        "the error that a perfect simulation would still have, from the sensor's noise (σ)."
    ),
    "gap": "what the tuned simulation's error exceeds the noise floor by.",
    "before, after": (
        "the simulation with its own parameters tuned; the same with what was found, tuned again."
    ),
    "held-out runs": "runs on which nothing was fitted but where they begin.",
    "interval": "95 %: where the true value lies 19 times in 20, as far as the model is right.",
    "score, p": (
        "evidence for a cause, and how probable as much is by chance where nothing is missing."
    ),
}
"""The words of the page, half a line each."""
_DRAWN = 180.0
"""Width of the drawn intervals, of 200 with a margin for the marks."""


def why(story: Story) -> Iterator[str]:
    """Why the verdict is what it is."""
    if story.why:
        yield heading("Why")
        yield listed(safe(sentence(text)) for text in story.why)


def where(story: Story, picture: str) -> Iterator[str]:
    """Where the gap is, in units of the noise and of each channel."""
    yield heading("Where the gap is")
    yield picture
    worst = worst_first(story.places)[:MOST_ROWS]
    # In their own order, runs first: the table is for looking one up.
    shown = [place for place in story.places if place in worst]
    if shown:
        count = len(story.places)
        some = f" The {len(shown)} worst of {count}." if len(shown) < count else ""
        note = f"RMS of the residual in units of the noise; 1 is the noise floor.{some}"
        yield paragraph(note, "soft")
        yield _places(shown, bool(story.verdict.causes))
    yield from _channels(story)


def _places(places: Sequence[Place], extended: bool) -> str:
    heads = ["part of the data", "-samples"]
    heads += ["-RMS before", "-RMS after"] if extended else ["-RMS"]
    rows = []
    for p in places:
        row = [safe(f"{p.kind} {p.label}", 80), str(p.samples), f"{p.before:.2f}"]
        if extended:
            row.append(f"{p.after:.2f}")
        rows.append(row)
    return table(heads, rows)


def worst_first(places: Sequence[Place]) -> list[Place]:
    """The places, the largest gap first."""
    return sorted((p for p in places if isfinite(p.before)), key=lambda p: -p.before)


def _channels(story: Story) -> Iterator[str]:
    """The channels with their noise and their errors in their own units."""
    extended = bool(story.verdict.causes)
    whens = (" before", " after") if extended else ("",)
    kinds = [("fitted", story.fitting), ("held-out", story.held_out)]
    there = [(name, side) for name, side in kinds if side is not None and len(side.names)]
    heads = ["channel", "-noise, 1σ", "known how"]
    heads += [f"-RMSE{when}, {name} runs" for name, _ in there for when in whens]
    rows = []
    for i, c in enumerate(story.channels):
        known = "stated" if c.stated else "estimated"
        known += f", steps of {number(c.step)}" if c.step else ""
        row = [safe(c.name, 60), safe(with_unit(number(c.sigma), c.unit)), known]
        for _, side in there:
            errors = errors_of(side)[i, : len(whens)]
            row += [safe(with_unit(number(float(error)), c.unit)) for error in errors]
        rows.append(row)
    yield table(heads, rows)


def errors_of(side: Side) -> Array:
    """(C, 2) RMSE of each channel before and after, in its unit; NaN where nothing was seen."""
    errors = np.full((side.observed.shape[2], 2), np.nan)
    for column, simulated in enumerate((side.before, side.after)):
        for c in range(len(errors)):
            left = (side.observed - simulated)[:, :, c]
            # The mean of nothing would warn.
            if np.isfinite(left).any():
                errors[c, column] = np.sqrt(np.nanmean(left**2))
    return errors


def candidates(story: Story, picture: str) -> Iterator[str]:
    """The candidates with their evidence, what cannot be told apart, and what to do next."""
    yield heading("What could be the cause")
    for cause in story.verdict.causes:
        if cause.alternatives:
            members = safe(_set(story, cause), 1000)
            yield paragraph(f"{strong('Not to be told apart:')} {members}")
    if proposed := experiment(story):
        yield paragraph(f"{strong('Next experiment:')} {safe(proposed, 1000)}")
    yield picture
    if not story.verdict.candidates:
        yield paragraph("No candidate was tried.")
    elif has_places(story):
        yield _by_effect(story)
        count = len(story.verdict.candidates)
        yield folded(f"All {count} candidates, place by place", _ranking(story))
    else:
        yield _ranking(story)


def _by_effect(story: Story) -> str:
    """A row for each effect where it explains most, and what it scores elsewhere."""
    heads = ["candidate", "name", "-score", "-p", "-gain on held-out runs", "standing", "elsewhere"]
    rows = []
    marks = []
    there = entries(story)
    for entry in there[:MOST_CANDIDATES]:
        row, mark = _candidate(story, entry.best)
        others = [
            f"{_elsewhere(c)} {number(c.score) if c.score >= 1 else '<1'}" for c in entry.elsewhere
        ]
        more = f" and {len(others) - MOST_ELSEWHERE} more" * (len(others) > MOST_ELSEWHERE)
        rows.append([*row, safe(", ".join(others[:MOST_ELSEWHERE]) + more)])
        marks.append(mark)
    return table(heads, rows, marks)


def _elsewhere(c: Candidate) -> str:
    """The place of a candidate, in a list of places."""
    _, place = parted(c.effect)
    return "all" if place == FAMILY else place


def _ranking(story: Story) -> str:
    heads = ["candidate", "name", "-score", "-p", "-gain on held-out runs", "standing"]
    rows = []
    marks = []
    for c in story.verdict.candidates:
        row, mark = _candidate(story, c)
        rows.append(row)
        marks.append(mark)
    return table(heads, rows, marks)


def _candidate(story: Story, c: Candidate) -> tuple[list[str], str]:
    """A candidate's row, and its mark."""
    rank = standing(story, c.effect)
    row = [safe(name_of(c.effect)), code(safe(c.effect, 80)), number(c.score)]
    # The column's head says p already.
    row.append(probability(c.p_value).removeprefix("p = ").removeprefix("p "))
    row.append(number(c.heldout_gain))
    # Where nothing is found, nothing made the others needless.
    row.append(rank if story.verdict.causes else "not convincing")
    return row, "" if rank == "not needed" else "found"


def _set(story: Story, cause: Cause) -> str:
    """The members of a set with their scores and gains: they are too close for these data."""
    by_effect = {c.effect: c for c in story.verdict.candidates}
    members = []
    if any("@" in name for name in (cause.effect, *cause.alternatives)):
        alike = _ALIKE.replace("either", "each")
        return f"{of_set([cause.effect, *cause.alternatives], 'and')} {alike}"
    for name in (cause.effect, *cause.alternatives):
        evidence = ""
        if (c := by_effect.get(name)) is not None:
            gain = number(c.heldout_gain)
            evidence = f" (score {number(c.score)}, held-out gain {gain})"
        members.append(noun(name) + evidence)
    return f"{joined(members)} {_ALIKE}"


def numbers(story: Story) -> Iterator[str]:
    """What was found in numbers, and how the parameters move."""
    rows = []
    for cause in story.verdict.causes:
        what = [safe(noun(cause.effect)), safe(without_place(cause.says))]
        chance = probability(cause.p_value)
        for name, value in values_of(cause) or [("–", "–")]:
            rows.append([*what, safe(name, 60), safe(value), chance])
    if rows:
        heads = ["cause", "what it does", "coefficient", "value (95 % interval)", "by chance"]
        yield heading("What was found, in numbers")
        yield table(heads, rows)
    if story.parameters:
        yield heading("The simulator's own parameters")
        yield from _parameters(story)


def _parameters(story: Story) -> Iterator[str]:
    extended = bool(story.verdict.causes)
    # Where nothing was found nothing could have been absorbed.
    bent = [p for p in story.parameters if p.touched and absorbed(p)]
    if bent and extended:
        yield paragraph(
            "Before, some of them were bent to absorb part of the gap: the move shows by how much."
        )
    heads = ["parameter", "value (95 % interval)"]
    if extended:
        heads = ["parameter", "before (95 % interval)", "after (95 % interval)", "move"]
        heads.append("before above, after below")
    rows = []
    for p in story.parameters:
        row = [safe(p.name, 60), _tuned(p, p.before)]
        if extended:
            row += [_tuned(p, p.after), safe(_move(p)), _intervals(p)]
        rows.append(row)
    yield table(heads, rows)


def _tuned(p: Tuned, value: tuple[float, float, float]) -> str:
    # What the data do not touch was not estimated: it is no number of theirs.
    if not p.touched:
        return safe(with_unit(number(value[0]), p.unit)) + ", nominal: not touched by the data"
    return safe(with_unit(estimate(*value), p.unit))


def _move(p: Tuned) -> str:
    if not p.touched:
        return "–"
    how = "had absorbed part of the gap" if absorbed(p) else "within its interval"
    return f"{shift(p)}, {how}"


def _intervals(p: Tuned) -> str:
    """The two intervals, one above the other: before dashed and open, after solid and filled."""
    if not np.isfinite([*p.before, *p.after]).all():
        return ""
    # One scale for both, or they could not be compared.
    low = min(p.before[1], p.after[1])
    high = max(p.before[2], p.after[2])
    scale = _DRAWN / (high - low) if high > low else 0.0
    shapes = []
    for kind, y, values in (("before", 8, p.before), ("after", 22, p.after)):
        middle, left, right = (10.0 + (value - low) * scale for value in values)
        ends = f'x1="{left:.1f}" x2="{right:.1f}" y1="{y}" y2="{y}"'
        shapes.append(f'<line class="{kind}" {ends} stroke-width="2"/>')
        centre = f'cx="{middle:.1f}" cy="{y}" r="4"'
        shapes.append(f'<circle class="{kind}" {centre} stroke-width="2"/>')
    label = f"intervals of {safe(p.name, 60)} before and after"
    return f'<svg viewBox="0 0 200 30" role="img" aria-label="{label}">{"".join(shapes)}</svg>'


def changes(story: Story) -> Iterator[str]:
    """The lines of the robot's model file to change, before and after."""
    # What is to be known of a file in which nothing changes is of no use.
    if not story.changes and not (story.unwritten and story.verdict.causes):
        return
    yield heading("What to change in the model file")
    lines = []
    for change in story.changes:
        lines.append(f'<span class="soft">{safe(change.element, 120)}</span>')
        # One blank line between elements, and none within.
        lines += [f'<del class="line">− {safe(change.before, 2000)}</del>'] * bool(change.before)
        lines += [f'<ins class="line">+ {safe(change.after, 2000)}</ins>'] * bool(change.after)
        lines += [f'<span class="soft">  {safe(change.comment, 600)}</span>'] * bool(change.comment)
        lines.append("")
    if lines:
        yield f'<pre class="scroll">{chr(10).join(lines[:-1])}</pre>'
    if story.unwritten:
        yield paragraph(
            "What is to be known of it, and what it cannot say (extended.toml has all):"
        )
        yield listed(safe(sentence(text)) for text in story.unwritten)


def remains(story: Story) -> Iterator[str]:
    """What is left unexplained."""
    yield heading("What remains")
    if story.remains:
        yield listed(safe(sentence(text)) for text in story.remains)
        return
    # On held-out runs the residual owes nothing to the fit.
    side, name = (story.held_out, "held-out") if story.held_out else (story.fitting, "fitted")
    left = number(rms(story, side, "after"), 2)
    verdict = story.verdict.verdict if story.verdict.cut is None else "unidentifiable"
    what = _LEFT.get(verdict, "Nothing that stands out")
    yield paragraph(f"{what}: the residual of the {name} runs is {left} times the noise.")


def reading() -> Iterator[str]:
    """The words of the page."""
    yield f"{heading('How to read this')}\n<dl>"
    for word, meaning in _READING.items():
        yield f"<dt>{word}</dt><dd>{meaning}</dd>"
    yield "</dl>"
