"""Tables of candidates and gap locations, and a chart of residual profiles.

Their numbers are those of verdict.json and of the report data.
"""

from __future__ import annotations

from bench.diagnosis.report.candidate_ranking import get_candidate_status, rank_candidates
from bench.diagnosis.report.cause_text import format_effect_set, has_placed_causes, strip_place
from bench.diagnosis.report.figure_panels import (
    MAX_LABEL_LENGTH,
    has_extended_model,
    select_informative_profiles,
)
from bench.diagnosis.report.joint_figure import find_joint, is_robot
from bench.diagnosis.report.motion_chart import BASE_MODEL_STYLE, EXTENDED_MODEL_STYLE
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.wording import (
    ALL_PLACES,
    format_effect_name,
    format_label,
    format_sentence,
    get_place_kind,
    sanitise,
    split_effect_name,
)
from bench.figures.text_layout import brief
from bench.pages.chart import Axis, Chart, Panel, Series
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.page_table import Table
from sims import effects
from sims.core.simulator import InputError

CANDIDATES, PLACES, FOLLOWS = "candidates", "where", "follows"
"""Names of the tables."""
BEST, ELSEWHERE = "the best of each effect", "the same at other places"
"""Labels of the rows of a robot's candidates, for the filter."""


def build_candidate_table(story: DiagnosisReportData) -> Table:
    """Build a table with one row per candidate, the highest score first."""
    sets = _sets(story)
    heads = {entry.best.effect for entry in rank_candidates(story)}
    found = bool(story.verdict.causes)
    rows = []
    for c in sorted(story.verdict.candidates, key=lambda one: -one.score):
        _, place = split_effect_name(c.effect)
        rows.append(
            {
                # A place has its own column.
                "candidate": sanitise(format_effect_name(split_effect_name(c.effect)[0]), 120),
                "effect": sanitise(c.effect, 120),
                "score": c.score,
                "p_value": c.p_value,
                "heldout_gain": c.heldout_gain,
                # Without a diagnosed cause, "not needed" would be wrong.
                "standing": get_candidate_status(story, c.effect) if found else "not convincing",
                "set": sets.get(c.effect, ""),
                "kind": get_place_kind(c.effect),
                "place": "all" if place == ALL_PLACES else sanitise(place, 80),
                "joint": find_joint(story, get_place_kind(c.effect), place),
                "shown": BEST if c.effect in heads else ELSEWHERE,
                "says": _says(story, c.effect),
            }
        )
    return Table.from_rows(rows).without(_needless(story))


def _needless(story: DiagnosisReportData) -> list[str]:
    """List the columns that would be empty."""
    columns = [] if _sets(story) else ["set"]
    return columns + ([] if has_placed_causes(story) else ["kind", "place", "joint", "shown"])


def _sets(story: DiagnosisReportData) -> dict[str, str]:
    """Return, by effect, the set of effects that it is indistinguishable from."""
    found: dict[str, str] = {}
    for cause in story.verdict.causes:
        if cause.alternatives:
            members = [cause.effect, *cause.alternatives]
            found |= dict.fromkeys(members, sanitise(format_effect_set(members), 160))
    return found


def _says(story: DiagnosisReportData, name: str) -> str:
    """Return the description of an effect; for a cause, the one in the verdict."""
    for cause in story.verdict.causes:
        if cause.effect == name:
            return format_sentence(strip_place(sanitise(cause.says, 400)))
    try:
        return format_sentence(effects.get_effect(split_effect_name(name)[0]).says)
    except InputError:
        # The effect belongs to a plugin that is not loaded, or is a time step or integrator.
        return ""


def make_candidate_grid(frame: Table) -> DataGrid:
    """Make the grid of candidates; for a robot it first shows the best place of each effect."""
    digits = {"score": 3, "p_value": 2, "heldout_gain": 3}
    heads = {
        "effect": "name",
        "p_value": "p",
        "heldout_gain": "held-out gain",
        "says": "what it does",
        "set": "not to be told apart",
    }
    says = {
        "score": "evidence that the simulation lacks it: twice the gain in log likelihood",
        "p_value": "how probable as much evidence is by chance",
        "heldout_gain": "share of the gap on runs that no fit has seen that it closes by itself",
    }
    columns = tuple(
        GridColumn(name, heads.get(name, name), digits.get(name, 0), says.get(name, ""))
        for name in frame.columns
        if name not in ("kind", "joint", "shown")
    )
    filters = tuple(name for name in ("standing", "kind", "joint", "shown") if name in frame)
    placed = "shown" in frame
    return DataGrid(
        "candidates-table",
        "Every candidate",
        CANDIDATES,
        columns,
        filters,
        only={"shown": BEST} if placed else {},
        sort="score,down",
        marked=("standing", "found"),
        lights="joint" if placed else "",
    )


def build_gap_location_table(story: DiagnosisReportData) -> Table:
    """Build a table with one row per part of the data: its RMS residual in units of the noise."""
    rows = []
    for p in story.places:
        row = {
            "kind": p.kind,
            "part": sanitise(p.label, 80),
            "samples": p.samples,
            "before": p.before,
        }
        if has_extended_model(story):
            row["after"] = p.after
        if is_robot(story):
            name = p.label if p.kind == "channel" else ""
            row["joint"] = find_joint(story, "channel", name)
        rows.append(row)
    return Table.from_rows(rows)


def make_gap_location_grid(frame: Table) -> DataGrid:
    """Make the grid of the parts of the data, the largest gap first."""
    after = "after" in frame
    heads = {"before": "RMS before" if after else "RMS", "after": "RMS after"}
    digits = {"samples": 7, "before": 3, "after": 3}
    columns = tuple(
        GridColumn(name, heads.get(name, name), digits.get(name, 0))
        for name in frame.columns
        if name != "joint"
    )
    return DataGrid(
        "where-table",
        "Parts of the data",
        PLACES,
        columns,
        ("kind",),
        sort="before,down",
        lights="joint" if "joint" in frame else "",
    )


def build_residual_profile_table(story: DiagnosisReportData) -> Table:
    """Build the table of residual profiles, with one row per bin."""
    rows = []
    for p in story.profiles:
        about = {"channel": sanitise(p.channel, 80), "variable": sanitise(p.variable, 80)}
        whens = {"before": p.before} | ({"after": p.after} if has_extended_model(story) else {})
        for when, means in whens.items():
            for centre, mean, error in zip(p.centres, means, p.error, strict=True):
                bars = {"mean": mean, "low": mean - 2 * error, "high": mean + 2 * error}
                rows.append({**about, "when": when, "at": centre, **bars})
    return Table.from_rows(rows)


def make_residual_profile_chart(story: DiagnosisReportData) -> Chart:
    """Make the chart of residual profiles; the most informative ones are shown first."""
    units = {c.name: c.unit for c in story.channels}
    looks = {"before": BASE_MODEL_STYLE, "after": EXTENDED_MODEL_STYLE}
    first = {id(p) for p in select_informative_profiles(story.profiles)}
    panels = []
    names: list[str] = []
    # The most informative profiles come first.
    for p in sorted(story.profiles, key=lambda one: id(one) not in first):
        about = {"channel": sanitise(p.channel, 80), "variable": sanitise(p.variable, 80)}
        series = []
        for when in ("after", "before") if has_extended_model(story) else ("before",):
            where = {**about, "when": when}
            look = looks[when]._replace(marker={"before": "s", "after": "o"}[when])
            series.append(Series(f"simulated {when}", "mean", look, where, "low", "high"))
        # The title contains the full names; axes have no space for long ones.
        name = f"{sanitise(p.channel, 80)} against {sanitise(p.variable, 80)}"
        variable = brief(sanitise(p.variable), MAX_LABEL_LENGTH)
        channel = sanitise(p.channel)
        residual = f"residual of {channel}" if len(channel) <= MAX_LABEL_LENGTH else "residual"
        names += [name] * (id(p) not in first)
        panels.append(
            Panel(
                name,
                FOLLOWS,
                "at",
                tuple(series),
                Axis(format_label(variable, p.unit), scales=("linear",)),
                Axis(
                    format_label(residual, units.get(p.channel, "1"), 60),
                    scales=("linear",),
                    holds=(0.0,),
                ),
                {"residual of": name},
                height=230,
            )
        )
    return Chart(
        FOLLOWS,
        "What the residual follows",
        "Mean residual in bins of what it may follow; bands: ±2 standard errors.",
        tuple(panels),
        toggles=("residual of",),
        off={"residual of": tuple(names)},
    )
