"""Further sections of the page: reasons, channels, sets, numbers, lack of fit and reading guide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite

import numpy as np

from bench.gap.report.account import absorbed, rms, shift, tuned
from bench.gap.report.places import of_set, values_of, without_place
from bench.gap.report.story import Place, Side, Story, Tuned
from bench.gap.report.words import (
    joined,
    noun,
    number,
    probability,
    sentence,
    with_unit,
)
from bench.gap.verdict import Cause
from bench.pages.elements import listed, paragraph, safe, strong, table
from sims.base import Array

_LEFT = {
    "partial": "Structure that no known cause explains",
    "unknown": "Structure that no known cause explains",
    "unidentifiable": "What the simulation lacks is open",
}
"""Description of the residual for verdicts that leave something open."""
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
    "runs left out in turn": (
        "each run, predicted by a fit to the others (cross-validation); what is reported is fitted"
        " to all runs."
    ),
    "interval": "95 %: where the true value lies 19 times in 20, as far as the model is right.",
    "score, p": (
        "evidence for a cause, and how probable as much is by chance where nothing is missing."
    ),
}
"""Terms of the page with short explanations."""
_DRAWN = 180.0
"""Width of the drawn intervals; the drawing is 200 wide, with margins for the marks."""


def why(story: Story) -> Iterator[str]:
    """Yield the reasons for the verdict."""
    if story.why:
        yield listed(safe(sentence(text)) for text in story.why)


def worst_first(places: Sequence[Place]) -> list[Place]:
    """Sort the gap locations by the size of the gap, largest first."""
    return sorted((p for p in places if isfinite(p.before)), key=lambda p: -p.before)


def channels(story: Story) -> Iterator[str]:
    """Yield the table of channels with their noise and their errors in their own units."""
    extended = bool(story.verdict.causes)
    whens = (" before", " after") if extended else ("",)
    kinds = [("fitted", story.fitting), (story.validation_run, story.held_out)]
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
    """Compute each channel's RMSE (C, 2) before and after, in its unit; NaN without samples."""
    errors = np.full((side.observed.shape[2], 2), np.nan)
    for column, simulated in enumerate((side.before, side.after)):
        for c in range(len(errors)):
            left = (side.observed - simulated)[:, :, c]
            # The mean of an empty set would cause a warning.
            if np.isfinite(left).any():
                errors[c, column] = np.sqrt(np.nanmean(left**2))
    return errors


def sets(story: Story) -> Iterator[str]:
    """Yield the sets of indistinguishable causes."""
    for cause in story.verdict.causes:
        if cause.alternatives:
            members = safe(_set(story, cause), 1000)
            yield paragraph(f"{strong('Not to be told apart:')} {members}", "set")


def _set(story: Story, cause: Cause) -> str:
    """Format the members of a set of indistinguishable causes, with scores and held-out gains."""
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
    """Yield the table of the causes with their fitted numbers."""
    rows = []
    for cause in story.verdict.causes:
        what = [safe(noun(cause.effect)), safe(without_place(cause.says))]
        chance = probability(cause.p_value)
        for name, value in values_of(cause) or [("–", "–")]:
            rows.append([*what, safe(name, 60), safe(value), chance])
    if rows:
        heads = ["cause", "what it does", "coefficient", "value (95 % interval)", "by chance"]
        yield table(heads, rows)


def parameters(story: Story) -> Iterator[str]:
    """Yield the table of the changes of the base parameters."""
    if not story.parameters:
        return
    extended = bool(story.verdict.causes)
    # Without a cause, nothing could have been absorbed.
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
        # Without a cause, the last fit is also of the base model, and is the best one.
        row = [safe(p.name, 60), _tuned(p, 0 if extended else 1)]
        if extended:
            row += [_tuned(p, 1), safe(_move(p)), _intervals(p)]
        rows.append(row)
    yield table(heads, rows)


def _tuned(p: Tuned, when: int) -> str:
    """Format a parameter before (0) or after (1)."""
    # An insensitive parameter was not estimated from the data.
    if not p.touched:
        return safe(with_unit(number(p.before[0]), p.unit)) + ", nominal: not touched by the data"
    return safe(tuned(p, when))


def _move(p: Tuned) -> str:
    if not p.touched:
        return "–"
    how = "had absorbed part of the gap" if absorbed(p) else "not significant"
    return f"{shift(p)}, {how}"


def _intervals(p: Tuned) -> str:
    """Draw the two intervals: before above, dashed and open; after below, solid and filled."""
    if not np.isfinite([*p.before, *p.after]).all():
        return ""
    # A common scale makes them comparable.
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


def remains(story: Story) -> Iterator[str]:
    """Yield what remains unexplained."""
    if story.remains:
        yield listed(safe(sentence(text)) for text in story.remains)
        return
    # Nothing was fitted to the residual of held-out runs, except initial states.
    side, name = story.fitting, "fitted"
    if story.held_out:
        side, name = story.held_out, story.validation_run
    left = number(rms(story, side, "after"), 2)
    verdict = story.verdict.verdict if story.verdict.cut is None else "unidentifiable"
    what = _LEFT.get(verdict, "Nothing that stands out")
    yield paragraph(f"{what}: the residual of the {name} runs is {left} times the noise.")


def reading(story: Story) -> Iterator[str]:
    """Yield the explanations of the terms on the page."""
    yield "<dl>"
    validations = {"held-out runs", "runs left out in turn"}
    for word, meaning in _READING.items():
        if word in validations - {story.validation_runs}:
            continue
        yield f"<dt>{word}</dt><dd>{meaning}</dd>"
    yield "</dl>"
