"""Page of an explanation, report.html, with its tables of evidence.

Numbers in these tables are those of verdict.json and of the report data.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.diagnosis.report import cause_and_value_text, residual_analysis, summary_text
from bench.diagnosis.report.candidate_ranking import (
    BEST,
    build_candidate_table,
    has_placed_causes,
)
from bench.diagnosis.report.cause_and_value_text import format_label, sanitise
from bench.diagnosis.report.consistency_section import (
    MAX_TABLE_ROWS,
    build_agreement_rows,
    format_consistency,
    pluralise_group,
)
from bench.diagnosis.report.diagnosed_places import find_joint, list_place_marks
from bench.diagnosis.report.identifiability_section import build_identifiability_section
from bench.diagnosis.report.joint_figure import is_robot
from bench.diagnosis.report.motion_chart import (
    BASE_MODEL_STYLE,
    EXTENDED_MODEL_STYLE,
    MOTION_TABLE_NAME,
    make_motion_chart,
)
from bench.diagnosis.report.report_data import DiagnosisReportData, ResidualProfile
from bench.diagnosis.report.residual_analysis import build_gap_location_table
from bench.diagnosis.report.residual_figure import MAX_LABEL_LENGTH, select_informative_profiles
from bench.diagnosis.validation.confidence_intervals import Z95
from bench.figures.figure_output import FigureFiles
from bench.figures.label_text import shorten_name
from bench.pages.chart import Axis, Panel, Series
from bench.pages.html_page import HtmlPage
from bench.pages.interval_drawing import draw_intervals
from bench.pages.page_table import Table

CANDIDATE_TABLE, GAP_LOCATION_TABLE, RESIDUAL_PROFILE_TABLE = "candidates", "where", "follows"
"""Names of the tables of the page."""
_TEMPLATE = Path(__file__).with_name("explanation.html")
_STYLE = Path(__file__).with_name("report.css")
MAX_OPEN_CHANGES = 12
"""Maximum number of changes of a model file that are shown unfolded."""


def render_report(
    report: DiagnosisReportData,
    figures: Mapping[str, FigureFiles],
    folder: Path | None = None,
) -> str:
    """Render the report as HTML.

    The template (Jinja2) gets the report data, and the modules whose functions format them; tables
    and charts are drawn by the script of the page.

    Args:
        report: Report data.
        figures: Figures by name; missing ones are left out.
        folder: Folder in which the report is written with the other files; None for a page alone.
    """
    page = HtmlPage(figures, _STYLE.read_text(encoding="utf-8"))
    motion = make_motion_chart(report)
    page.add_tables(
        {
            CANDIDATE_TABLE: build_candidate_table(report),
            GAP_LOCATION_TABLE: build_gap_location_table(report),
            RESIDUAL_PROFILE_TABLE: build_residual_profile_table(report),
            MOTION_TABLE_NAME: motion.table.frame,
        }
    )
    return page.render(
        _TEMPLATE,
        story=report,
        folder=folder,
        is_robot=is_robot(report),
        has_places=has_placed_causes(report),
        headline=summary_text.format_headline(report),
        next_run=summary_text.format_next_run(report),
        consistency=format_consistency(report),
        marks=[
            (find_joint(report, mark.kind, mark.name), mark) for mark in list_place_marks(report)
        ],
        joint_positions=figures["robot"].joint_positions if "robot" in figures else (),
        motion=motion,
        identifiability=build_identifiability_section(report),
        profile_panels=make_residual_profile_panels(report),
        less_informative=list_less_informative_profiles(report),
        has_absorbed=any(
            p.is_sensitive and summary_text.has_absorbed_gap(p) for p in report.parameters
        ),
        splits=[
            (name, residual_analysis.compute_channel_errors(split).tolist())
            for name, split in (
                ("fitted", report.fitting),
                (report.validation_run, report.held_out),
            )
            if split is not None and len(split.names)
        ],
        agreement=build_agreement_rows(report),
        draw_intervals=draw_intervals,
        BEST=BEST,
        MAX_OPEN_CHANGES=MAX_OPEN_CHANGES,
        MAX_TABLE_ROWS=MAX_TABLE_ROWS,
        Z95=Z95,
        pluralise_group=pluralise_group,
        summary=summary_text,
        residuals=residual_analysis,
        wording=cause_and_value_text,
    )


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
        means_by_model = {"before": profile.before}
        if report.has_extended_model:
            means_by_model["after"] = profile.after
        for model, means in means_by_model.items():
            # The standard error follows from the noise, so it is that of both models.
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
    velocity. The panels read their curves from the table of `build_residual_profile_table`, by
    channel, variable and model.

    Args:
        report: content of the report, with the profiles.
    """
    units = {channel.name: channel.unit for channel in report.channels}
    styles = {
        "after": EXTENDED_MODEL_STYLE._replace(marker="o"),
        "before": BASE_MODEL_STYLE._replace(marker="s"),
    }
    models = ("after", "before") if report.has_extended_model else ("before",)
    # Informative profiles come first (False sorts before True). Profiles contain arrays, which
    # cannot be compared, so they are recognised by their identity.
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
