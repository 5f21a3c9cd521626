"""HTML report of an explanation: one file that needs no network, also readable without scripts.

The most important information comes first: what is wrong, the gain, and what to do next. Every text
from a file or plugin is escaped by `safe`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path

from bench.diagnosis.report.cause_text import has_placed_causes, list_place_marks
from bench.diagnosis.report.consistency_section import render_consistency_section
from bench.diagnosis.report.evidence_tables import (
    CANDIDATES,
    FOLLOWS,
    PLACES,
    build_candidate_table,
    build_gap_location_table,
    build_residual_profile_table,
    make_candidate_grid,
    make_gap_location_grid,
    make_residual_profile_chart,
)
from bench.diagnosis.report.explanation_figures import RenderedFigure
from bench.diagnosis.report.identifiability_section import render_identifiability_section
from bench.diagnosis.report.joint_figure import find_joint, is_robot
from bench.diagnosis.report.motion_chart import MOTION_TABLE_NAME as MOTION
from bench.diagnosis.report.motion_chart import build_motion_table, make_motion_chart
from bench.diagnosis.report.next_steps import render_next_steps
from bench.diagnosis.report.page_sections import (
    render_alternative_sets,
    render_channels,
    render_found_numbers,
    render_lack_of_fit,
    render_parameters,
    render_reading_guide,
    render_reasons,
    sort_by_gap,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.summary_text import (
    format_gain_and_caveats,
    format_headline,
    format_interval,
    format_simulation_count,
    get_held_out_unit,
    has_gap_closed,
)
from bench.diagnosis.report.wording import (
    append_unit,
    format_effect_name,
    format_number,
    format_percent,
    format_unit,
    joined,
    sanitise,
)
from bench.pages.chart import PrintedFigure
from bench.pages.html_elements import (
    make_bar,
    make_code,
    make_figure,
    make_paragraph,
    make_strong,
    safe,
)
from bench.pages.html_page import HtmlPage
from bench.pages.page_table import Table

_STYLE = Path(__file__).with_name("report.css")
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


def render_report(
    story: DiagnosisReportData, drawn: Mapping[str, RenderedFigure], folder: Path | None = None
) -> str:
    """Render the report as HTML.

    Args:
        story: Report data.
        drawn: Figures by name; missing ones are left out.
        folder: Folder in which the report is written with the other files; None for a page alone.
    """
    style = _STYLE.read_text(encoding="utf-8")
    made = HtmlPage(f"{format_headline(story)} {sanitise(story.title, 80)}", _foot(story), style)
    frames = {
        CANDIDATES: build_candidate_table(story),
        PLACES: build_gap_location_table(story),
        FOLLOWS: build_residual_profile_table(story),
    }
    for name, frame in frames.items():
        if len(frame):
            made.add_table(name, frame)
    stills = {name: _still(story, name, figure) for name, figure in drawn.items()}
    made.append(*_render_summary(story))
    made.add_section("next", "What to do next", *render_next_steps(story, folder))
    made.add_section("run", "Run by run", *_runs(made, story, stills, drawn))
    made.add_section(
        "fixable", "What this recording can fix", *render_identifiability_section(story)
    )
    made.add_section("why", "Why", *render_reasons(story))
    made.add_section("gap", "Where the gap is", *_render_gap_location(made, story, stills, frames))
    made.add_section("causes", "What could be the cause", *_candidates(made, story, stills, frames))
    made.add_section("numbers", "What was found, in numbers", *render_found_numbers(story))
    made.add_section("parameters", "The simulator's own parameters", *render_parameters(story))
    made.add_section("trust", "Which number to trust", *render_consistency_section(story))
    faulty = bool(story.verdict.recording_faults)
    made.add_section("remains", "What remains", *(() if faulty else render_lack_of_fit(story)))
    made.add_section("reading", "How to read this", *render_reading_guide(story))
    return made.to_html()


def _render_summary(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the header: verdict, headline and the most important facts."""
    yield "<header>\n" + make_paragraph(safe(story.title), "recording")
    verdict = story.verdict
    badge = _BADGES[verdict.verdict] if verdict.cut is None else _CUT[verdict.verdict]
    if verdict.recording_faults:
        badge = _FAULTY
    elif verdict.cut is None and verdict.has_open_numbers:
        badge = _OPEN
    elif verdict.cut is None and verdict.bordering:
        badge = _BORDERING
    yield make_paragraph(f'<span class="badge">{badge}</span>')
    yield f"<h1>{safe(format_headline(story))}</h1>"
    for text in format_gain_and_caveats(story):
        # These sentences list causes and their numbers, so they may be longer than other texts.
        yield make_paragraph(safe(text, 1000), "lead")
    yield "</header>"
    yield from _gain(story)


def _gain(story: DiagnosisReportData) -> Iterator[str]:
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
    if extended and has_gap_closed(held_out):
        closed = make_strong(f"{format_percent(held_out.gap_closed)} of the gap closed")
        yield make_paragraph(closed + format_interval(held_out), "closed")
    note = f"Error on {runs} (RMSE): shorter is better, the noise floor is best."
    yield make_paragraph(note, "soft")
    # Bars are relative to the longest one; a failed simulation has no error and no bar.
    known = [value for _, _, value in rows if value is not None and isfinite(value)]
    longest = max(known, default=0.0)
    for kind, name, value in rows:
        share = 100.0 * value / longest if value is not None and longest > 0 else 0.0
        amount = safe(append_unit(format_number(value), get_held_out_unit(story)))
        cells = f'<span>{name}</span>{make_bar(kind, share)}<span class="value">{amount}</span>'
        yield f'<div class="row">{cells}</div>'
    yield "</section>"


def _still(story: DiagnosisReportData, name: str, figure: RenderedFigure) -> PrintedFigure:
    return PrintedFigure(figure.svg or figure.png, figure.pdf, _alternative(story, name), name)


def _runs(
    made: HtmlPage,
    story: DiagnosisReportData,
    stills: Mapping[str, PrintedFigure],
    drawn: Mapping[str, RenderedFigure],
) -> Iterator[str]:
    """Yield the chart of measured and simulated motion, next to the robot or the film's track."""
    shown = build_motion_table(story)
    made.add_table(MOTION, shown.frame)
    printed = _JOINTS if is_robot(story) else _CAPTIONS["overview"]
    chart = made.render_chart(make_motion_chart(story, shown, stills.get("overview"), printed))
    beside = [*_robot(made, story, drawn), *_film(story)]
    if not beside:
        yield chart
        return
    aside = "\n".join(beside)
    yield f'<div class="beside"><aside>\n{aside}\n</aside>\n{chart}</div>'


def _robot(
    made: HtmlPage, story: DiagnosisReportData, drawn: Mapping[str, RenderedFigure]
) -> Iterator[str]:
    """Yield the figure of the robot, and a list of the diagnosed places."""
    if "robot" not in drawn:
        return
    robot = drawn["robot"]
    still = _still(story, "robot", robot)
    yield made.render_figure("robot", still, _CAPTIONS["robot"], spots=robot.joint_positions)
    items = []
    for mark in list_place_marks(story):
        lights = safe(find_joint(story, mark.kind, mark.name), 60)
        says = f"{mark.kind} {sanitise(mark.name, 40)}: {sanitise(mark.says, 80)}"
        items.append(f'<li data-lights="{lights}">{safe(says)}</li>')
    if items:
        yield make_paragraph("The places that the verdict names:", "soft")
        yield f"<ul>{''.join(items)}</ul>"


def _film(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the figure of the track, for a recording from a film."""
    if story.track:
        yield make_figure(story.track, _TRACK, _CAPTIONS["track"])


def _render_gap_location(
    made: HtmlPage,
    story: DiagnosisReportData,
    stills: Mapping[str, PrintedFigure],
    frames: Mapping[str, Table],
) -> Iterator[str]:
    """Yield the section on where the gap is, in units of the noise and of each channel."""
    if "where" in stills:
        tables = [PLACES] * bool(story.places) + [FOLLOWS] * bool(story.profiles)
        yield made.render_figure("where-picture", stills["where"], _CAPTIONS["where"], tables)
    if story.profiles:
        yield made.render_chart(make_residual_profile_chart(story))
    if story.places:
        note = "RMS of the residual in units of the noise; 1 is the noise floor."
        yield make_paragraph(note, "soft") + made.render_grid(
            make_gap_location_grid(frames[PLACES])
        )
    yield from render_channels(story)


def _candidates(
    made: HtmlPage,
    story: DiagnosisReportData,
    stills: Mapping[str, PrintedFigure],
    frames: Mapping[str, Table],
) -> Iterator[str]:
    """Yield the candidates with their evidence, and the sets of indistinguishable causes."""
    yield from render_alternative_sets(story)
    if "candidates" in stills:
        caption = _CAPTIONS["candidates"] + (_PLACED if has_placed_causes(story) else "")
        if any(c.heldout_gain is not None for c in story.verdict.candidates):
            caption += _SHARES.format(runs=story.validation_runs)
        yield made.render_figure("candidates-picture", stills["candidates"], caption, [CANDIDATES])
    if not story.verdict.candidates:
        yield make_paragraph("No candidate was tried.")
    else:
        yield made.render_grid(make_candidate_grid(frames[CANDIDATES]))


def _alternative(story: DiagnosisReportData, name: str) -> str:
    """Return the alternative text of a figure."""
    if name == "robot":
        named = [
            f"{m.kind} {sanitise(m.name, 30)} ({sanitise(m.says, 60)})"
            for m in list_place_marks(story)
        ]
        return f"The robot; marked: {joined(named) or 'nothing'}."
    if name == "overview":
        names = joined([sanitise(c.name, 30) for c in story.channels])
        what = f"Measured and simulated {names} of the run that fits worst, with the residual."
        return f"{what} {format_headline(story)}"
    # A few of the largest values suffice, because the tables contain all of them.
    if name == "where":
        worst = sort_by_gap(story.places)[:_FEW]
        sizes = [f"{p.kind} {sanitise(p.label, 30)} {format_number(p.before, 2)}" for p in worst]
        what = "Size of the residual in units of the noise, the largest before"
        return f"{what}: {'; '.join(sizes)}."
    best = story.verdict.candidates[:_FEW]
    scores = [f"{format_effect_name(c.effect)} {format_number(c.score)}" for c in best]
    return f"Scores of the candidates, the best: {'; '.join(scores)}."


def _foot(story: DiagnosisReportData) -> str:
    all_units = [format_unit(c.unit) or "1" for c in story.channels]
    # A robot has many channels, so each unit is listed once.
    units = safe(joined(list(dict.fromkeys(all_units)) if is_robot(story) else all_units), 100)
    recording = f"Recording: {make_code(safe(story.path, 300))} (channels in {units})."
    return f"{recording} {safe(format_simulation_count(story))} Made by simgap explain."
