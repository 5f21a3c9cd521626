"""Further sections of the page: reasons, channels, sets, numbers, lack of fit and reading guide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite

import numpy as np

from bench.diagnosis.report.cause_text import format_effect_set, list_values, strip_place
from bench.diagnosis.report.report_data import (
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ParameterChange,
)
from bench.diagnosis.report.summary_text import (
    compute_normalised_rms,
    format_shift,
    has_absorbed_gap,
    tuned,
)
from bench.diagnosis.report.wording import (
    append_unit,
    format_effect,
    format_number,
    format_p_value,
    format_sentence,
    joined,
)
from bench.diagnosis.verdict import Cause
from bench.pages.html_elements import make_list, make_paragraph, make_strong, make_table, safe
from sims.core.simulator import Array

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


def render_reasons(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the reasons for the verdict."""
    if story.why:
        yield make_list(safe(format_sentence(text)) for text in story.why)


def sort_by_gap(places: Sequence[GapLocation]) -> list[GapLocation]:
    """Sort the gap locations by the size of the gap, largest first."""
    return sorted((p for p in places if isfinite(p.before)), key=lambda p: -p.before)


def render_channels(story: DiagnosisReportData) -> Iterator[str]:
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
        known += f", steps of {format_number(c.step)}" if c.step else ""
        row = [safe(c.name, 60), safe(append_unit(format_number(c.sigma), c.unit)), known]
        for _, side in there:
            errors = compute_channel_errors(side)[i, : len(whens)]
            row += [safe(append_unit(format_number(float(error)), c.unit)) for error in errors]
        rows.append(row)
    yield make_table(heads, rows)


def compute_channel_errors(side: DataSplit) -> Array:
    """Compute each channel's RMSE (C, 2) before and after, in its unit; NaN without samples."""
    errors = np.full((side.observed.shape[2], 2), np.nan)
    for column, simulated in enumerate((side.before, side.after)):
        for c in range(len(errors)):
            left = (side.observed - simulated)[:, :, c]
            # The mean of an empty set would cause a warning.
            if np.isfinite(left).any():
                errors[c, column] = np.sqrt(np.nanmean(left**2))
    return errors


def render_alternative_sets(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the sets of indistinguishable causes."""
    for cause in story.verdict.causes:
        if cause.alternatives:
            members = safe(_set(story, cause), 1000)
            yield make_paragraph(f"{make_strong('Not to be told apart:')} {members}", "set")


def _set(story: DiagnosisReportData, cause: Cause) -> str:
    """Format the members of a set of indistinguishable causes, with scores and held-out gains."""
    by_effect = {c.effect: c for c in story.verdict.candidates}
    members = []
    if any("@" in name for name in (cause.effect, *cause.alternatives)):
        alike = _ALIKE.replace("either", "each")
        return f"{format_effect_set([cause.effect, *cause.alternatives], 'and')} {alike}"
    for name in (cause.effect, *cause.alternatives):
        evidence = ""
        if (c := by_effect.get(name)) is not None:
            gain = format_number(c.heldout_gain)
            evidence = f" (score {format_number(c.score)}, held-out gain {gain})"
        members.append(format_effect(name) + evidence)
    return f"{joined(members)} {_ALIKE}"


def render_found_numbers(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the table of the causes with their fitted numbers."""
    rows = []
    for cause in story.verdict.causes:
        what = [safe(format_effect(cause.effect)), safe(strip_place(cause.says))]
        chance = format_p_value(cause.p_value)
        for name, value in list_values(cause) or [("–", "–")]:
            rows.append([*what, safe(name, 60), safe(value), chance])
    if rows:
        heads = ["cause", "what it does", "coefficient", "value (95 % interval)", "by chance"]
        yield make_table(heads, rows)


def render_parameters(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the table of the changes of the base parameters."""
    if not story.parameters:
        return
    extended = bool(story.verdict.causes)
    # Without a cause, nothing could have been absorbed.
    bent = [p for p in story.parameters if p.is_sensitive and has_absorbed_gap(p)]
    if bent and extended:
        yield make_paragraph(
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
    yield make_table(heads, rows)


def _tuned(p: ParameterChange, when: int) -> str:
    """Format a parameter before (0) or after (1)."""
    # An insensitive parameter was not estimated from the data.
    if not p.is_sensitive:
        return (
            safe(append_unit(format_number(p.before[0]), p.unit))
            + ", nominal: not touched by the data"
        )
    return safe(tuned(p, when))


def _move(p: ParameterChange) -> str:
    if not p.is_sensitive:
        return "–"
    how = "had absorbed part of the gap" if has_absorbed_gap(p) else "not significant"
    return f"{format_shift(p)}, {how}"


def _intervals(p: ParameterChange) -> str:
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


def render_lack_of_fit(story: DiagnosisReportData) -> Iterator[str]:
    """Yield what remains unexplained."""
    if story.lack_of_fit:
        yield make_list(safe(format_sentence(text)) for text in story.lack_of_fit)
        return
    # Nothing was fitted to the residual of held-out runs, except initial states.
    side, name = story.fitting, "fitted"
    if story.held_out:
        side, name = story.held_out, story.validation_run
    left = format_number(compute_normalised_rms(story, side, "after"), 2)
    verdict = story.verdict.verdict if story.verdict.cut is None else "unidentifiable"
    what = _LEFT.get(verdict, "Nothing that stands out")
    yield make_paragraph(f"{what}: the residual of the {name} runs is {left} times the noise.")


def render_reading_guide(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the explanations of the terms on the page."""
    yield "<dl>"
    validations = {"held-out runs", "runs left out in turn"}
    for word, meaning in _READING.items():
        if word in validations - {story.validation_runs}:
            continue
        yield f"<dt>{word}</dt><dd>{meaning}</dd>"
    yield "</dl>"
