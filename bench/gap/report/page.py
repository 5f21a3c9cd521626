"""The page of an explanation: one file, readable without a network or scripts, in the light, in the
dark and in print.

Ten seconds come first: what is wrong, the gain, the run that shows it. Every text from a file or
plugin passes `safe`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path

from bench.gap.report.account import closes, effort, following, headline, heldout_unit, interval
from bench.gap.report.agreement import agreement
from bench.gap.report.fixable import fixable
from bench.gap.report.joints import by_joint
from bench.gap.report.places import has_places, marks
from bench.gap.report.sections import (
    candidates,
    changes,
    numbers,
    reading,
    remains,
    where,
    why,
    worst_first,
)
from bench.gap.report.story import Story
from bench.gap.report.words import clean, joined, name_of, number, percent, pretty, with_unit
from bench.pages.elements import bar, code, figure, paragraph, safe, strong

_STYLE = Path(__file__).with_name("page.css")
_BADGES = {
    "adequate": "adequate: no gap found",
    "named": "named: the cause is found",
    "ambiguous": "ambiguous: one of several causes",
    "partial": "partial: a cause is found, and something remains",
    "unknown": "unknown: a gap, but no known cause",
    "unidentifiable": "unidentifiable: the data do not suffice",
}
"""Every verdict in a few words."""
_CUT = {
    "partial": "partial: a cause is found; the search was ended early",
    "unknown": "unknown: the search was ended early",
}
"""The same where the search was ended early."""
_CAPTIONS = {
    "robot": (
        "The robot in the run below, where it is furthest from its beginning. Blue marks are "
        "places that the verdict names: whole where it is sure, dashed where it is one of several; "
        "circles are joints, squares actuators, diamonds bodies, triangles sensors."
    ),
    "overview": (
        "Above: measured and simulated; below: the residual, what is measured less what is "
        "simulated. In the grey band 95 % of the sensor's noise would lie."
    ),
    "where": (
        "Left: size of the residual by run, channel and phase; the dotted line at 1 is the noise "
        "floor, the grey bar what noise without memory gives by chance. Right: the variables that "
        "the residual follows most."
    ),
    "candidates": (
        "Left: evidence for each candidate, with the probability p of as much by chance. Right: "
        "what each gains on held-out runs."
    ),
}
"""Under the figures."""
_JOINTS = (
    "A row for each joint; those that the verdict names are blue, behind a pointer. Left: "
    "measured and simulated. Right: what is measured less what is simulated, in units of the "
    "sensor's noise σ and on one scale for all; in the grey band 95 % of the noise would lie."
)
"""Under the figure of a robot's run."""
_PLACED = (
    " Each effect stands at the place where it explains most; ticks are the same effect elsewhere."
)
"""Under the candidates of a robot."""
_FEW = 5
"""Places and candidates that are read aloud in place of a figure."""


def page(story: Story, drawn: Mapping[str, bytes], for_print: bool = True) -> str:
    """The page as HTML.

    Args:
        story: what is told.
        drawn: the figures as PNG, by name.
        for_print: name the PDF that lies beside the page under each figure.
    """
    pictures = {name: _picture(story, name, png, for_print) for name, png in drawn.items()}
    parts = [
        *_head(story),
        *_opening(story),
        pictures.get("robot", ""),
        pictures.get("overview", ""),
        *fixable(story),
        *why(story),
        *where(story, pictures.get("where", "")),
        *candidates(story, pictures.get("candidates", "")),
        *numbers(story),
        *agreement(story),
        *changes(story),
        *remains(story),
        *reading(),
        f"</main>\n{_footer(story)}\n</body>\n</html>\n",
    ]
    # A figure that was not drawn leaves no empty line.
    return "\n".join(part for part in parts if part)


def _head(story: Story) -> Iterator[str]:
    """All up to where the page's own words begin; the styles are within: it stays one file."""
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{safe(headline(story), 120)} {safe(story.title, 80)}</title>"
    styles = _STYLE.read_text(encoding="utf-8")
    yield f"<style>\n{styles}</style>\n</head>\n<body>\n<main>"


def _opening(story: Story) -> Iterator[str]:
    """The ten seconds."""
    yield "<header>\n" + paragraph(safe(story.title), "recording")
    verdict = story.verdict
    badge = _BADGES[verdict.verdict] if verdict.cut is None else _CUT[verdict.verdict]
    yield paragraph(f'<span class="badge">{badge}</span>')
    yield f"<h1>{safe(headline(story))}</h1>"
    for text in following(story):
        # Longer than other texts may be: a sentence here lists causes and their numbers.
        yield paragraph(safe(text, 1000), "lead")
    yield "</header>"
    yield from _gain(story)


def _gain(story: Story) -> Iterator[str]:
    """Bars of the held-out error before, after and of the floor."""
    held_out = story.verdict.heldout
    if held_out is None:
        return
    # Without a cause both errors are the same: a second bar would be a false comparison.
    extended = bool(story.verdict.causes)
    rows = [("before", "tuned simulation", held_out.rmse_base)]
    if extended:
        rows = [
            ("before", "before: tuned simulation", held_out.rmse_base),
            ("after", "after: with what was found", held_out.rmse_extended),
        ]
    rows.append(("floor", "noise floor", held_out.noise_floor))
    yield '<section class="gain" aria-label="error on held-out runs">'
    if extended and closes(held_out):
        closed = strong(f"{percent(held_out.gap_closed)} of the gap closed")
        yield paragraph(closed + interval(held_out), "closed")
    note = "Error on held-out runs (RMSE): shorter is better, the noise floor is best."
    yield paragraph(note, "soft")
    # Bars are shares of the longest: a simulation that failed has no error, and no bar.
    known = [value for _, _, value in rows if value is not None and isfinite(value)]
    longest = max(known, default=0.0)
    for kind, name, value in rows:
        share = 100.0 * value / longest if value is not None and longest > 0 else 0.0
        amount = safe(with_unit(number(value), heldout_unit(story)))
        cells = f'<span>{name}</span>{bar(kind, share)}<span class="value">{amount}</span>'
        yield f'<div class="row">{cells}</div>'
    yield "</section>"


def _picture(story: Story, name: str, png: bytes, for_print: bool) -> str:
    caption = _JOINTS if name == "overview" and by_joint(story) else _CAPTIONS.get(name, "")
    if name == "candidates" and has_places(story):
        caption += _PLACED
    if for_print:
        caption += f" <span>For print: {safe(name)}.pdf</span>"
    return figure(png, safe(_alternative(story, name), 700), caption)


def _alternative(story: Story, name: str) -> str:
    """What a figure shows, for those who do not see it."""
    if name == "robot":
        named = [f"{m.kind} {clean(m.name, 30)} ({clean(m.says, 60)})" for m in marks(story)]
        return f"The robot; marked: {joined(named) or 'nothing'}."
    if name == "overview":
        names = joined([clean(c.name, 30) for c in story.channels])
        what = f"Measured and simulated {names} of the run that fits worst, with the residual."
        return f"{what} {headline(story)}"
    # Read aloud a few of the largest are enough: the tables below have all.
    if name == "where":
        worst = worst_first(story.places)[:_FEW]
        sizes = [f"{p.kind} {clean(p.label, 30)} {number(p.before, 2)}" for p in worst]
        what = "Size of the residual in units of the noise, the largest before"
        return f"{what}: {'; '.join(sizes)}."
    best = story.verdict.candidates[:_FEW]
    scores = [f"{name_of(c.effect)} {number(c.score)}" for c in best]
    return f"Scores of the candidates, the best: {'; '.join(scores)}."


def _footer(story: Story) -> str:
    all_units = [pretty(c.unit) or "1" for c in story.channels]
    # Of a robot's many channels each unit is said once.
    units = safe(joined(list(dict.fromkeys(all_units)) if by_joint(story) else all_units), 100)
    recording = f"Recording: {code(safe(story.path, 300))} (channels in {units})."
    made = f"{safe(effort(story))} Made by simgap explain."
    return f'<footer class="soft">\n{paragraph(f"{recording} {made}")}\n</footer>'
