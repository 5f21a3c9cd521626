"""Tables of candidates and gap locations, and a chart of residual profiles.

Their numbers are those of verdict.json and of the report data.
"""

from __future__ import annotations

from bench.diagnosis.report.cause_text import (
    format_effect_set,
    get_candidate_status,
    has_placed_causes,
    rank_candidates,
    strip_place,
)
from bench.diagnosis.report.figure_panels import (
    MAX_LABEL_LENGTH,
    has_extended_model,
    select_informative_profiles,
)
from bench.diagnosis.report.joint_figure import find_joint, is_robot
from bench.diagnosis.report.motion_chart import BASE_MODEL_STYLE, EXTENDED_MODEL_STYLE
from bench.diagnosis.report.report_data import DiagnosisReportData, ResidualProfile
from bench.diagnosis.report.wording import (
    ALL_PLACES,
    format_effect_name,
    format_label,
    format_sentence,
    get_place_kind,
    sanitise,
    split_effect_name,
)
from bench.figures.text_layout import shorten_name
from bench.pages.chart import Axis, Panel, Series
from bench.pages.page_table import Table
from sims import effects
from sims.core.simulator import InputError

CANDIDATE_TABLE, GAP_LOCATION_TABLE, RESIDUAL_PROFILE_TABLE = "candidates", "where", "follows"
"""Names of the tables."""
BEST, ELSEWHERE = "the best of each effect", "the same at other places"
"""Labels of the rows of a robot's candidates, for the filter."""


def build_candidate_table(report: DiagnosisReportData) -> Table:
    """Build a table with one row per candidate, the highest score first."""
    sets = _map_indistinguishable_sets(report)
    heads = {entry.best.effect for entry in rank_candidates(report)}
    has_causes = bool(report.verdict.causes)
    rows = []
    for c in sorted(report.verdict.candidates, key=lambda candidate: -candidate.score):
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
                "standing": get_candidate_status(report, c.effect)
                if has_causes
                else "not convincing",
                "set": sets.get(c.effect, ""),
                "kind": get_place_kind(c.effect),
                "place": "all" if place == ALL_PLACES else sanitise(place, 80),
                "joint": find_joint(report, get_place_kind(c.effect), place),
                "shown": BEST if c.effect in heads else ELSEWHERE,
                "says": _get_effect_description(report, c.effect),
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
    """Return the description of an effect; for a cause, the one in the verdict."""
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
    """Build a table with one row per part of the data: its RMS residual in units of the noise."""
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
    """Build the table of residual profiles, with one row per bin."""
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
    """Make the panels of the residual profiles, the most informative ones first."""
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
                _format_profile_name(profile),
                RESIDUAL_PROFILE_TABLE,
                "at",
                tuple(series),
                Axis(
                    format_label(shorten_name(sanitise(variable), MAX_LABEL_LENGTH), profile.unit),
                    scales=("linear",),
                ),
                Axis(value_label, scales=("linear",), holds=(0.0,)),
                {"residual of": _format_profile_name(profile)},
                height=230,
            )
        )
    return panels


def _format_profile_name(profile: ResidualProfile) -> str:
    return f"{sanitise(profile.channel, 80)} against {sanitise(profile.variable, 80)}"
