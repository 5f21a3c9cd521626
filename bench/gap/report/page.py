"""HTML report of an explanation: one file that needs no network, also readable without scripts.

The most important information comes first: what is wrong, the gain, and what to do next. Every text
from a file or plugin is escaped by `safe`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path

from bench.gap.report.account import closes, effort, following, headline, heldout_unit, interval
from bench.gap.report.advice import advice
from bench.gap.report.agreement import agreement
from bench.gap.report.evidence import (
    CANDIDATES,
    FOLLOWS,
    PLACES,
    candidates_grid,
    candidates_table,
    follows_chart,
    follows_table,
    places_grid,
    places_table,
)
from bench.gap.report.fixable import fixable
from bench.gap.report.joints import by_joint, joint_of
from bench.gap.report.motion import TABLE as MOTION
from bench.gap.report.motion import motion, motion_chart
from bench.gap.report.pictures import Printed
from bench.gap.report.places import has_places, marks
from bench.gap.report.sections import (
    channels,
    numbers,
    parameters,
    reading,
    remains,
    sets,
    why,
    worst_first,
)
from bench.gap.report.story import Story
from bench.gap.report.words import clean, joined, name_of, number, percent, pretty, with_unit
from bench.pages.chart import Static
from bench.pages.elements import bar, code, figure, paragraph, safe, strong
from bench.pages.page import Page
from bench.pages.table import Table

_STYLE = Path(__file__).with_name("page.css")
_BADGES = {
    "adequate": "adequate: no gap found",
    "named": "named: the cause is found",
    "ambiguous": "ambiguous: one of several causes",
    "partial": "partial: a cause is found, and something remains",
    "unknown": "unknown: a gap, but no known cause",
    "unidentifiable": "unidentifiable: the data do not suffice",
}
"""Short text of every verdict."""
_CUT = {
    "partial": "partial: a cause is found; the search was ended early",
    "unknown": "unknown: the search was ended early",
}
"""Short text of a verdict if the search was stopped early."""
_FAULTY = "unknown: a unit or a sign of the recording is wrong"
"""Short text of the verdict if the recording is faulty."""
_OPEN = "partial: a cause is found, but its number lies at a bound or has no interval"
_BORDERING = "partial: a cause is found, but a parameter ends at a bound of its range"
"""Short text of the verdict if a base parameter is at a bound of its range."""
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
    "track": (
        "The ball's track in the film, as simgap track has written it beside the recording; what "
        "is explained are the heights that it gives."
    ),
    "candidates": (
        "The evidence for each candidate on the fitted runs; the line below gives p, the "
        "probability of such a score by chance. Causes are bold."
    ),
}
"""Captions of the figures."""
_SHARES = (
    " Left: the share of the gap on {runs} that each closes by itself, with its 95 % "
    "interval, where it was simulated there."
)
"""Addition to the caption of the candidates, if held-out runs were simulated with any of them."""
_TRACK = "The scene of the film with the ball's track over it, its height and radius over time."
"""Alternative text of the figure of a ball track."""
_JOINTS = (
    "A row for each joint; those that the verdict names are blue, behind a pointer. Left: "
    "measured and simulated. Right: what is measured less what is simulated, in units of the "
    "sensor's noise σ and on one scale for all; in the grey band 95 % of the noise would lie."
)
"""Caption of the figure of a robot's run."""
_PLACED = (
    " Each effect stands at the place where it explains most; ticks are the same effect elsewhere."
)
"""Addition to the caption of the candidates of a robot."""
_FEW = 5
"""Maximum number of places and candidates in an alternative text."""


def page(story: Story, drawn: Mapping[str, Printed], folder: Path | None = None) -> str:
    """Render the report as HTML.

    Args:
        story: Report data.
        drawn: Figures by name; missing ones are left out.
        folder: Folder in which the report is written with the other files; None for a page alone.
    """
    style = _STYLE.read_text(encoding="utf-8")
    made = Page(f"{headline(story)} {clean(story.title, 80)}", _foot(story), style)
    frames = {
        CANDIDATES: candidates_table(story),
        PLACES: places_table(story),
        FOLLOWS: follows_table(story),
    }
    for name, frame in frames.items():
        if len(frame):
            made.table(name, frame)
    stills = {name: _still(story, name, figure) for name, figure in drawn.items()}
    made.add(*_opening(story))
    made.section("next", "What to do next", *advice(story, folder))
    made.section("run", "Run by run", *_runs(made, story, stills, drawn))
    made.section("fixable", "What this recording can fix", *fixable(story))
    made.section("why", "Why", *why(story))
    made.section("gap", "Where the gap is", *_where(made, story, stills, frames))
    made.section("causes", "What could be the cause", *_candidates(made, story, stills, frames))
    made.section("numbers", "What was found, in numbers", *numbers(story))
    made.section("parameters", "The simulator's own parameters", *parameters(story))
    made.section("trust", "Which number to trust", *agreement(story))
    faulty = bool(story.verdict.recording_faults)
    made.section("remains", "What remains", *(() if faulty else remains(story)))
    made.section("reading", "How to read this", *reading(story))
    return made.html()


def _opening(story: Story) -> Iterator[str]:
    """Yield the header: verdict, headline and the most important facts."""
    yield "<header>\n" + paragraph(safe(story.title), "recording")
    verdict = story.verdict
    badge = _BADGES[verdict.verdict] if verdict.cut is None else _CUT[verdict.verdict]
    if verdict.recording_faults:
        badge = _FAULTY
    elif verdict.cut is None and verdict.has_open_numbers:
        badge = _OPEN
    elif verdict.cut is None and verdict.bordering:
        badge = _BORDERING
    yield paragraph(f'<span class="badge">{badge}</span>')
    yield f"<h1>{safe(headline(story))}</h1>"
    for text in following(story):
        # These sentences list causes and their numbers, so they may be longer than other texts.
        yield paragraph(safe(text, 1000), "lead")
    yield "</header>"
    yield from _gain(story)


def _gain(story: Story) -> Iterator[str]:
    """Yield bars of the held-out error before and after, and of the noise floor."""
    held_out = story.verdict.heldout
    if held_out is None:
        return
    # Without a cause both errors are equal, so a second bar would be misleading.
    extended = bool(story.verdict.causes)
    rows = [("before", "tuned simulation", held_out.rmse_base)]
    if extended:
        rows = [
            ("before", "before: tuned simulation", held_out.rmse_base),
            ("after", "after: with what was found", held_out.rmse_extended),
        ]
    rows.append(("floor", "noise floor", held_out.noise_floor))
    runs = story.validation_runs
    yield f'<section class="gain" aria-label="error on {runs}">'
    if extended and closes(held_out):
        closed = strong(f"{percent(held_out.gap_closed)} of the gap closed")
        yield paragraph(closed + interval(held_out), "closed")
    note = f"Error on {runs} (RMSE): shorter is better, the noise floor is best."
    yield paragraph(note, "soft")
    # Bars are relative to the longest one; a failed simulation has no error and no bar.
    known = [value for _, _, value in rows if value is not None and isfinite(value)]
    longest = max(known, default=0.0)
    for kind, name, value in rows:
        share = 100.0 * value / longest if value is not None and longest > 0 else 0.0
        amount = safe(with_unit(number(value), heldout_unit(story)))
        cells = f'<span>{name}</span>{bar(kind, share)}<span class="value">{amount}</span>'
        yield f'<div class="row">{cells}</div>'
    yield "</section>"


def _still(story: Story, name: str, figure: Printed) -> Static:
    return Static(figure.svg or figure.png, figure.pdf, _alternative(story, name), name)


def _runs(
    made: Page, story: Story, stills: Mapping[str, Static], drawn: Mapping[str, Printed]
) -> Iterator[str]:
    """Yield the chart of measured and simulated motion, next to the robot or the film's track."""
    shown = motion(story)
    made.table(MOTION, shown.frame)
    printed = _JOINTS if by_joint(story) else _CAPTIONS["overview"]
    chart = made.chart(motion_chart(story, shown, stills.get("overview"), printed))
    beside = [*_robot(made, story, drawn), *_film(story)]
    if not beside:
        yield chart
        return
    aside = "\n".join(beside)
    yield f'<div class="beside"><aside>\n{aside}\n</aside>\n{chart}</div>'


def _robot(made: Page, story: Story, drawn: Mapping[str, Printed]) -> Iterator[str]:
    """Yield the figure of the robot, and a list of the diagnosed places."""
    if "robot" not in drawn:
        return
    robot = drawn["robot"]
    still = _still(story, "robot", robot)
    yield made.picture("robot", still, _CAPTIONS["robot"], spots=robot.spots)
    items = []
    for mark in marks(story):
        lights = safe(joint_of(story, mark.kind, mark.name), 60)
        says = f"{mark.kind} {clean(mark.name, 40)}: {clean(mark.says, 80)}"
        items.append(f'<li data-lights="{lights}">{safe(says)}</li>')
    if items:
        yield paragraph("The places that the verdict names:", "soft")
        yield f"<ul>{''.join(items)}</ul>"


def _film(story: Story) -> Iterator[str]:
    """Yield the figure of the track, for a recording from a film."""
    if story.track:
        yield figure(story.track, _TRACK, _CAPTIONS["track"])


def _where(
    made: Page, story: Story, stills: Mapping[str, Static], frames: Mapping[str, Table]
) -> Iterator[str]:
    """Yield the section on where the gap is, in units of the noise and of each channel."""
    if "where" in stills:
        tables = [PLACES] * bool(story.places) + [FOLLOWS] * bool(story.profiles)
        yield made.picture("where-picture", stills["where"], _CAPTIONS["where"], tables)
    if story.profiles:
        yield made.chart(follows_chart(story))
    if story.places:
        note = "RMS of the residual in units of the noise; 1 is the noise floor."
        yield paragraph(note, "soft") + made.grid(places_grid(frames[PLACES]))
    yield from channels(story)


def _candidates(
    made: Page, story: Story, stills: Mapping[str, Static], frames: Mapping[str, Table]
) -> Iterator[str]:
    """Yield the candidates with their evidence, and the sets of indistinguishable causes."""
    yield from sets(story)
    if "candidates" in stills:
        caption = _CAPTIONS["candidates"] + (_PLACED if has_places(story) else "")
        if any(c.heldout_gain is not None for c in story.verdict.candidates):
            caption += _SHARES.format(runs=story.validation_runs)
        yield made.picture("candidates-picture", stills["candidates"], caption, [CANDIDATES])
    if not story.verdict.candidates:
        yield paragraph("No candidate was tried.")
    else:
        yield made.grid(candidates_grid(frames[CANDIDATES]))


def _alternative(story: Story, name: str) -> str:
    """Return the alternative text of a figure."""
    if name == "robot":
        named = [f"{m.kind} {clean(m.name, 30)} ({clean(m.says, 60)})" for m in marks(story)]
        return f"The robot; marked: {joined(named) or 'nothing'}."
    if name == "overview":
        names = joined([clean(c.name, 30) for c in story.channels])
        what = f"Measured and simulated {names} of the run that fits worst, with the residual."
        return f"{what} {headline(story)}"
    # A few of the largest values suffice, because the tables contain all of them.
    if name == "where":
        worst = worst_first(story.places)[:_FEW]
        sizes = [f"{p.kind} {clean(p.label, 30)} {number(p.before, 2)}" for p in worst]
        what = "Size of the residual in units of the noise, the largest before"
        return f"{what}: {'; '.join(sizes)}."
    best = story.verdict.candidates[:_FEW]
    scores = [f"{name_of(c.effect)} {number(c.score)}" for c in best]
    return f"Scores of the candidates, the best: {'; '.join(scores)}."


def _foot(story: Story) -> str:
    all_units = [pretty(c.unit) or "1" for c in story.channels]
    # A robot has many channels, so each unit is listed once.
    units = safe(joined(list(dict.fromkeys(all_units)) if by_joint(story) else all_units), 100)
    recording = f"Recording: {code(safe(story.path, 300))} (channels in {units})."
    return f"{recording} {safe(effort(story))} Made by simgap explain."
