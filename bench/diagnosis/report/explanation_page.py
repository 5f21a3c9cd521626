"""Page of an explanation, report.html, with its tables of evidence.

Numbers in these tables are those of verdict.json and of the report data.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.diagnosis.report.cause_text import (
    format_effect_set,
    get_candidate_status,
    has_placed_causes,
    list_place_marks,
    list_values,
    rank_candidates,
    strip_place,
)
from bench.diagnosis.report.consistency_section import (
    MAX_TABLE_ROWS,
    build_agreement_rows,
    format_consistency,
)
from bench.diagnosis.report.effect_and_unit_text import (
    ALL_PLACES,
    append_unit,
    format_effect,
    format_effect_name,
    format_label,
    format_number,
    format_percent,
    format_sentence,
    format_unit,
    get_place_kind,
    joined,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.report.explanation_figures import RenderedFigure
from bench.diagnosis.report.figure_panels import (
    MAX_LABEL_LENGTH,
    has_extended_model,
    select_informative_profiles,
)
from bench.diagnosis.report.identifiability_section import build_identifiability_section
from bench.diagnosis.report.joint_figure import find_joint, is_robot
from bench.diagnosis.report.motion_chart import (
    BASE_MODEL_STYLE,
    EXTENDED_MODEL_STYLE,
    MOTION_TABLE_NAME,
    make_motion_chart,
)
from bench.diagnosis.report.report_data import (
    DataSplit,
    DiagnosisReportData,
    ParameterChange,
    ResidualProfile,
)
from bench.diagnosis.report.summary_text import (
    compute_normalised_rms,
    format_coefficients,
    format_gain_and_caveats,
    format_headline,
    format_interval,
    format_next_run,
    format_shift,
    format_simulation_count,
    format_tuned_value,
    get_held_out_unit,
    has_absorbed_gap,
    has_gap_closed,
)
from bench.diagnosis.verdict import Cause
from bench.figures.style import shorten_name
from bench.pages.chart import Axis, Panel, PrintedFigure, Series
from bench.pages.html_page import HtmlPage
from bench.pages.page_table import IntervalDrawing, Table, draw_intervals
from sims import effects
from sims.core.simulator import Array, InputError

CANDIDATE_TABLE, GAP_LOCATION_TABLE, RESIDUAL_PROFILE_TABLE = "candidates", "where", "follows"
"""Names of the tables."""
BEST, ELSEWHERE = "the best of each effect", "the same at other places"
"""Labels of the rows of a robot's candidates, for the filter."""


def build_candidate_table(report: DiagnosisReportData) -> Table:
    """Build a table with one row per candidate, the highest score first.

    `set` numbers the candidates that the data cannot distinguish; `shown` says which rows are
    visible at first: of an effect that acts at several places, only the best one.

    Args:
        report: Data of the report.
    """
    sets = _map_indistinguishable_sets(report)
    heads = {entry.best.effect for entry in rank_candidates(report)}
    has_causes = bool(report.verdict.causes)
    rows = []
    for candidate in sorted(report.verdict.candidates, key=lambda candidate: -candidate.score):
        _, place = split_effect_name(candidate.effect)
        rows.append(
            {
                # A place has its own column.
                "candidate": sanitise(
                    format_effect_name(split_effect_name(candidate.effect)[0]), 120
                ),
                "effect": sanitise(candidate.effect, 120),
                "score": candidate.score,
                "p_value": candidate.p_value,
                "heldout_gain": candidate.heldout_gain,
                # Without a diagnosed cause, "not needed" would be wrong.
                "standing": get_candidate_status(report, candidate.effect)
                if has_causes
                else "not convincing",
                "set": sets.get(candidate.effect, ""),
                "kind": get_place_kind(candidate.effect),
                "place": "all" if place == ALL_PLACES else sanitise(place, 80),
                "joint": find_joint(report, get_place_kind(candidate.effect), place),
                "shown": BEST if candidate.effect in heads else ELSEWHERE,
                "says": _get_effect_description(report, candidate.effect),
            }
        )
    return Table.from_rows(rows).without(_list_empty_columns(report))


def _list_empty_columns(report: DiagnosisReportData) -> list[str]:
    """List the columns that would be empty."""
    columns = [] if _map_indistinguishable_sets(report) else ["set"]
    return columns + ([] if has_placed_causes(report) else ["kind", "place", "joint", "shown"])


def _map_indistinguishable_sets(report: DiagnosisReportData) -> dict[str, str]:
    """Return, by effect, the set of effects that it is indistinguishable from."""
    sets: dict[str, str] = {}
    for cause in report.verdict.causes:
        if cause.alternatives:
            members = [cause.effect, *cause.alternatives]
            sets |= dict.fromkeys(members, sanitise(format_effect_set(members), 160))
    return sets


def _get_effect_description(report: DiagnosisReportData, name: str) -> str:
    """Return the description of an effect; for a cause, the one in the verdict.

    Args:
        report: content of the report.
        name: name of the effect, with its place if it has one.
    """
    for cause in report.verdict.causes:
        if cause.effect == name:
            return format_sentence(strip_place(sanitise(cause.says, 400)))
    base, place = split_effect_name(name)
    try:
        effect = effects.get_effect(base)
        return format_sentence((effect.says_at_place if place else "") or effect.says)
    except InputError:
        # The effect belongs to a plugin that is not loaded, or is a time step or integrator.
        return ""


def build_gap_location_table(report: DiagnosisReportData) -> Table:
    """Build a table with one row per part of the data: its RMS residual in units of the noise.

    Args:
        report: Data of the report, whose gap locations are runs, channels and phases of the motion.
    """
    rows = []
    for location in report.gap_locations:
        row = {
            "kind": location.kind,
            "part": sanitise(location.label, 80),
            "samples": location.samples,
            "before": location.before,
        }
        if has_extended_model(report):
            row["after"] = location.after
        if is_robot(report):
            name = location.label if location.kind == "channel" else ""
            row["joint"] = find_joint(report, "channel", name)
        rows.append(row)
    return Table.from_rows(rows)


def build_residual_profile_table(report: DiagnosisReportData) -> Table:
    """Build the table of residual profiles, with one row per bin.

    A profile is the mean residual of a channel in bins of another variable; its interval is two
    standard errors to either side.

    Args:
        report: Data of the report.
    """
    rows = []
    for profile in report.profiles:
        profile_columns = {
            "channel": sanitise(profile.channel, 80),
            "variable": sanitise(profile.variable, 80),
        }
        means_by_model = {"before": profile.before} | (
            {"after": profile.after} if has_extended_model(report) else {}
        )
        for model, means in means_by_model.items():
            for centre, mean, error in zip(profile.centres, means, profile.error, strict=True):
                values = {"mean": mean, "low": mean - 2 * error, "high": mean + 2 * error}
                rows.append({**profile_columns, "when": model, "at": centre, **values})
    return Table.from_rows(rows)


def list_less_informative_profiles(report: DiagnosisReportData) -> tuple[str, ...]:
    """List the names of the profiles that are not shown at first."""
    shown_ids = {id(profile) for profile in select_informative_profiles(report.profiles)}
    return tuple(
        _format_profile_name(profile) for profile in report.profiles if id(profile) not in shown_ids
    )


def make_residual_profile_panels(report: DiagnosisReportData) -> list[Panel]:
    """Make the panels of the residual profiles, the most informative ones first.

    A profile is the mean residual of a channel as a function of another variable, such as a
    velocity.
    """
    units = {channel.name: channel.unit for channel in report.channels}
    styles = {
        "after": EXTENDED_MODEL_STYLE._replace(marker="o"),
        "before": BASE_MODEL_STYLE._replace(marker="s"),
    }
    models = ("after", "before") if has_extended_model(report) else ("before",)
    shown_ids = {id(profile) for profile in select_informative_profiles(report.profiles)}
    panels = []
    for profile in sorted(report.profiles, key=lambda profile: id(profile) not in shown_ids):
        channel, variable = sanitise(profile.channel, 80), sanitise(profile.variable, 80)
        series = []
        for model in models:
            selection = {"channel": channel, "variable": variable, "when": model}
            series.append(
                Series(f"simulated {model}", "mean", styles[model], selection, "low", "high")
            )
        # The title contains the full names; axes have no space for long ones.
        label = f"residual of {channel}" if len(channel) <= MAX_LABEL_LENGTH else "residual"
        value_label = format_label(label, units.get(profile.channel, "1"), 60)
        panels.append(
            Panel(
                title=_format_profile_name(profile),
                table=RESIDUAL_PROFILE_TABLE,
                x="at",
                series=tuple(series),
                across=Axis(
                    format_label(shorten_name(sanitise(variable), MAX_LABEL_LENGTH), profile.unit),
                    scales=("linear",),
                ),
                # The axis always contains zero.
                up=Axis(value_label, scales=("linear",), holds=(0.0,)),
                facets={"residual of": _format_profile_name(profile)},
                height=230,
            )
        )
    return panels


def _format_profile_name(profile: ResidualProfile) -> str:
    return f"{sanitise(profile.channel, 80)} against {sanitise(profile.variable, 80)}"


_TEMPLATE = Path(__file__).with_name("explanation.html")
_STYLE = Path(__file__).with_name("report.css")
_BADGES = {
    "adequate": "adequate: no gap found",
    "named": "named: the cause is found",
    "ambiguous": "ambiguous: one of several causes",
    "partial": "partial: a cause is found, but the residual still has structure",
    "unknown": "unknown: a gap, but no known cause",
    "unidentifiable": "unidentifiable: the data do not identify the parameters",
}
"""Short text of every verdict."""
_EARLY_STOP_BADGES = {
    "partial": "partial: a cause is found; the search was stopped early",
    "unknown": "unknown: the search was stopped early",
}
"""Short text of a verdict if the search was stopped early."""
_RESIDUAL_DESCRIPTIONS = {
    "partial": "Structure that no known cause explains",
    "unknown": "Structure that no known cause explains",
    "unidentifiable": "It is not known what the simulation lacks",
}
"""Description of the residual for verdicts that leave something open."""
MAX_OPEN_CHANGES = 12
"""Maximum number of changes of a model file that are shown unfolded."""
_MAX_LISTED_NAMES = 5
"""Maximum number of places and candidates in an alternative text."""


def render_report(
    report: DiagnosisReportData,
    rendered_figures: Mapping[str, RenderedFigure],
    folder: Path | None = None,
) -> str:
    """Render the report as HTML.

    The template gets the report data, finished texts, tables, charts and printed figures; tables
    and charts are drawn by the script of the page.

    Args:
        report: Report data.
        rendered_figures: Figures by name; missing ones are left out.
        folder: Folder in which the report is written with the other files; None for a page alone.
    """
    page = HtmlPage(_STYLE.read_text(encoding="utf-8"))
    tables = {
        CANDIDATE_TABLE: build_candidate_table(report),
        GAP_LOCATION_TABLE: build_gap_location_table(report),
        RESIDUAL_PROFILE_TABLE: build_residual_profile_table(report),
    }
    for name, table in tables.items():
        if len(table):
            page.add_table(name, table)
    motion = make_motion_chart(report)
    page.add_table(MOTION_TABLE_NAME, motion.table.frame)
    verdict, held_out = report.verdict, report.verdict.heldout
    has_share = held_out is not None and bool(verdict.causes) and has_gap_closed(held_out)
    residual_split, residual_runs = report.fitting, "fitted"
    # Nothing was fitted to the residual of held-out runs, except initial states.
    if report.held_out:
        residual_split, residual_runs = report.held_out, report.validation_run
    open_verdict = verdict.verdict if verdict.cut is None else "unidentifiable"
    splits = _list_error_rows(report)
    return page.render(
        _TEMPLATE,
        # Report data.
        story=report,
        verdict=verdict,
        folder=folder,
        is_robot=is_robot(report),
        has_places=has_placed_causes(report),
        has_shares=any(c.heldout_gain is not None for c in verdict.candidates),
        # Texts.
        badge=_format_badge(report),
        headline=format_headline(report),
        gain_and_caveats=list(format_gain_and_caveats(report)),
        next_run=format_next_run(report),
        values_of_causes=[_format_cause(cause) for cause in verdict.causes],
        consistency=format_consistency(report),
        alternative_sets=[_format_set(report, c) for c in verdict.causes if c.alternatives],
        residual_description=_RESIDUAL_DESCRIPTIONS.get(open_verdict, "Nothing significant"),
        residual_runs=residual_runs,
        residual_rms=format_number(compute_normalised_rms(report, residual_split, "after"), 2),
        units=_format_units(report),
        simulation_count=format_simulation_count(report),
        # Tables, charts and figures.
        closed=format_percent(held_out.gap_closed) if held_out and has_share else "",
        closed_interval=format_interval(held_out) if held_out else "",
        bars=list(_make_bars(report)),
        motion=motion,
        stills={name: _make_printed_figure(report, rendered_figures, name) for name in _FIGURES},
        joint_positions=rendered_figures["robot"].joint_positions
        if "robot" in rendered_figures
        else (),
        marks=_list_marks(report),
        identifiability=build_identifiability_section(report),
        profile_panels=make_residual_profile_panels(report),
        less_informative=list_less_informative_profiles(report),
        channel_headings=[f"-RMSE{model_suffix}, {name} runs" for name, _, model_suffix in splits],
        channels=_list_channels(report),
        has_absorbed=any(p.is_sensitive and has_absorbed_gap(p) for p in report.parameters),
        parameters=[_make_parameter_row(p) for p in report.parameters],
        agreement=build_agreement_rows(report),
        # Constants and functions.
        BEST=BEST,
        MAX_OPEN_CHANGES=MAX_OPEN_CHANGES,
        MAX_TABLE_ROWS=MAX_TABLE_ROWS,
        effect=format_effect,
        effect_name=format_effect_name,
        list_values=list_values,
        sentence=format_sentence,
        strip_place=strip_place,
    )


def _format_badge(report: DiagnosisReportData) -> str:
    """Return the verdict in a few words, with the reason if it is not complete.

    The reasons are tested in order of importance: a fault of the recording, a search that was
    stopped early, and a fitted value or base parameter at a bound.
    """
    verdict = report.verdict
    if verdict.recording_faults:
        return "unknown: the recording has a wrong unit or sign"
    if verdict.cut is not None:
        return _EARLY_STOP_BADGES[verdict.verdict]
    if verdict.has_open_numbers:
        return "partial: a cause is found, but its value is at a bound or has no interval"
    if verdict.bordering:
        return "partial: a cause is found, but a parameter is at a bound of its range"
    return _BADGES[verdict.verdict]


def _format_cause(cause: Cause) -> str:
    name = format_sentence(format_effect(cause.effect))[:-1]
    return f"{sanitise(name, 200)}: {format_coefficients(cause)}"


def _format_set(report: DiagnosisReportData, cause: Cause) -> str:
    """Format the members of a set of indistinguishable causes, with scores and held-out gains.

    Scores are left out if effects act at places: such sets are large, and the table has their
    scores.

    Args:
        report: content of the report, with the scores.
        cause: the cause and its alternatives.
    """
    names = [cause.effect, *cause.alternatives]
    if any("@" in name for name in names):
        return f"{format_effect_set(names, 'and')}. Each of them explains these runs equally well."
    by_effect = {c.effect: c for c in report.verdict.candidates}
    members = []
    for name in names:
        text = format_effect(name)
        if (candidate := by_effect.get(name)) is not None:
            score, gain = format_number(candidate.score), format_number(candidate.heldout_gain)
            text += f" (score {score}, held-out gain {gain})"
        members.append(text)
    return f"{joined(members)}. Either of them explains these runs equally well."


def _format_units(report: DiagnosisReportData) -> str:
    """List the units of the channels; 1 for a channel without a unit."""
    units = [format_unit(channel.unit) or "1" for channel in report.channels]
    # A robot has many channels, so each unit is listed once.
    return sanitise(joined(list(dict.fromkeys(units)) if is_robot(report) else units), 100)


class Bar(NamedTuple):
    """Bar of an error: its class in the style sheet, name, width in percent and value."""

    kind: str
    name: str
    width: float
    value: str


def _make_bars(report: DiagnosisReportData) -> Iterator[Bar]:
    """Yield bars of the held-out error before and after, and of the noise floor.

    The noise floor is the error that a perfect model would have. Widths are in percent of the
    longest bar.

    Args:
        report: Data of the report; without held-out runs there are no bars.
    """
    held_out = report.verdict.heldout
    if held_out is None:
        return
    # Without a cause both errors are equal, so a second bar would be misleading.
    bars = [("before", "tuned simulation", held_out.rmse_base)]
    if report.verdict.causes:
        bars = [
            ("before", "before: tuned simulation", held_out.rmse_base),
            ("after", "after: with the causes found", held_out.rmse_extended),
        ]
    bars.append(("floor", "noise floor", held_out.noise_floor))
    # Bars are relative to the longest one; a failed simulation has no error and no bar.
    finite_values = [value for _, _, value in bars if value is not None and isfinite(value)]
    longest_value = max(finite_values, default=0.0)
    for kind, name, value in bars:
        width = 100.0 * value / longest_value if value is not None and longest_value > 0 else 0.0
        yield Bar(kind, name, width, append_unit(format_number(value), get_held_out_unit(report)))


_FIGURES = ("robot", "overview", "where", "candidates")


def _make_printed_figure(
    report: DiagnosisReportData, rendered_figures: Mapping[str, RenderedFigure], name: str
) -> PrintedFigure | None:
    """Return a figure of the page with its text alternative; None if it was not drawn.

    `rendered_figures` has the rendered figures by name.
    """
    figure = rendered_figures.get(name)
    if figure is None:
        return None
    return PrintedFigure(figure.svg or figure.png, figure.pdf, _describe_figure(report, name), name)


def _describe_figure(report: DiagnosisReportData, name: str) -> str:
    """Return the alternative text of a figure.

    Args:
        report: content of the report.
        name: name of the figure: ``robot``, ``overview``, ``where``, or that of the candidates.
    """
    if name == "robot":
        mark_texts = [
            f"{mark.kind} {sanitise(mark.name, 30)} ({sanitise(mark.says, 60)})"
            for mark in list_place_marks(report)
        ]
        return f"The robot; marked: {joined(mark_texts) or 'nothing'}."
    if name == "overview":
        names = joined([sanitise(channel.name, 30) for channel in report.channels])
        sentence = f"Measured and simulated {names} of the run that fits worst, with the residual."
        return f"{sentence} {format_headline(report)}"
    # A few of the largest values suffice, because the tables contain all of them.
    if name == "where":
        finite = [place for place in report.gap_locations if isfinite(place.before)]
        sizes = [
            f"{place.kind} {sanitise(place.label, 30)} {format_number(place.before, 2)}"
            for place in sorted(finite, key=lambda place: -place.before)[:_MAX_LISTED_NAMES]
        ]
        return f"RMS of the residual in units of the noise, the largest before: {'; '.join(sizes)}."
    best = report.verdict.candidates[:_MAX_LISTED_NAMES]
    scores = [f"{format_effect_name(c.effect)} {format_number(c.score)}" for c in best]
    return f"Scores of the best candidates: {'; '.join(scores)}."


class MarkedPlace(NamedTuple):
    """Place that the verdict names, and the joint that is highlighted with it."""

    joint: str
    text: str


def _list_marks(report: DiagnosisReportData) -> list[MarkedPlace]:
    """List the places that are marked in the drawing of the robot, each with joint and text."""
    return [
        MarkedPlace(
            find_joint(report, mark.kind, mark.name),
            f"{mark.kind} {sanitise(mark.name, 40)}: {sanitise(mark.says, 80)}",
        )
        for mark in list_place_marks(report)
    ]


class ChannelRow(NamedTuple):
    """Channel with its noise, and its errors in its own unit."""

    name: str
    noise: str
    source: str
    errors: list[str]


def _list_error_rows(report: DiagnosisReportData) -> list[tuple[str, DataSplit, str]]:
    """List the sets of runs and models for which the table states the error of each channel.

    The fitted and the held-out runs have separate rows. If causes were found, each has two rows:
    for the model before and after they are added.

    Args:
        report: Data of the report.

    Returns:
        Name of the set of runs ("fitted", "held-out" or "left-out"), its runs, and the suffix of
        the row's label: " before", " after", or nothing if no causes were found.
    """
    model_suffixes = (" before", " after") if report.verdict.causes else ("",)
    run_sets = [("fitted", report.fitting), (report.validation_run, report.held_out)]
    return [
        (name, split, model_suffix)
        for name, split in run_sets
        if split is not None and len(split.names)
        for model_suffix in model_suffixes
    ]


def _list_channels(report: DiagnosisReportData) -> list[ChannelRow]:
    """List each channel with its noise, the source of the noise, and its RMS errors.

    There is one error for each combination of runs and model, in the order of `_list_error_rows`.
    """
    # Column 0 of the errors is before, column 1 after the causes were added.
    errors_by_combination = [
        compute_channel_errors(split)[:, int(model_suffix == " after")]
        for _, split, model_suffix in _list_error_rows(report)
    ]
    rows = []
    for i, channel in enumerate(report.channels):
        source = "stated" if channel.stated else "estimated"
        source += f", steps of {format_number(channel.step)}" if channel.step else ""
        noise = append_unit(format_number(channel.sigma), channel.unit)
        errors = [
            append_unit(format_number(float(column[i])), channel.unit)
            for column in errors_by_combination
        ]
        rows.append(ChannelRow(channel.name, noise, source, errors))
    return rows


def compute_channel_errors(split: DataSplit) -> Array:
    """Compute each channel's RMSE (C, 2) before and after, in its unit; NaN without samples.

    Args:
        split: Recorded runs with the simulation before and after the causes are added.
    """
    errors = np.full((split.observed.shape[2], 2), np.nan)
    for column, simulated in enumerate((split.before, split.after)):
        for channel_index in range(len(errors)):
            residual = (split.observed - simulated)[:, :, channel_index]
            # The mean of an empty set would cause a warning.
            if np.isfinite(residual).any():
                errors[channel_index, column] = np.sqrt(np.nanmean(residual**2))
    return errors


class ParameterRow(NamedTuple):
    """Parameter before and after, its change, and both intervals as a drawing."""

    name: str
    before: str
    after: str
    change: str
    drawing: IntervalDrawing | None


def _make_parameter_row(p: ParameterChange) -> ParameterRow:
    """Return a table row with a base parameter before and after the causes were added.

    The base model bends its parameters to imitate a missing effect: the row says whether the
    parameter had absorbed part of the gap in this way.

    Args:
        p: Parameter with its estimates and intervals in the base and the extended model.
    """
    # An insensitive parameter was not estimated from the data.
    if not p.is_sensitive:
        nominal = append_unit(format_number(p.before[0]), p.unit)
        text = f"{nominal}, nominal: these data do not depend on it"
        return ParameterRow(p.name, text, text, "–", None)
    reason = "had absorbed part of the gap" if has_absorbed_gap(p) else "not significant"
    drawing = draw_intervals([("before", *p.before), ("after", *p.after)])
    return ParameterRow(
        p.name,
        format_tuned_value(p, 0),  # before
        format_tuned_value(p, 1),  # after
        f"{format_shift(p)}, {reason}",
        drawing,
    )
