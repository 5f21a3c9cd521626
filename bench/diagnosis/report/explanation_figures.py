"""Figures of an explanation: the run with the largest gap, where the gap is, and candidates.

They are readable in print without colour: before is dashed with open squares, and after is solid
with filled circles. Each figure is rendered as PNG, and as PDF and SVG if vector graphics are
requested (`bench.figures.figure_settings`). Texts from files are never parsed as mathematics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.diagnosis.report.candidate_ranking import select_shown_candidates
from bench.diagnosis.report.candidates_figure import draw_candidates_figure
from bench.diagnosis.report.diagnosed_places import list_place_marks
from bench.diagnosis.report.joint_figure import draw_run_figure
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.residual_figure import (
    FONT_SIZE,
    draw_residual_figure,
    select_gap_locations,
)
from bench.diagnosis.report.run_selection import RunView, select_worst_run
from bench.figures import figure_output
from bench.figures.figure_layout import apply_settings
from bench.figures.figure_output import FigureFiles
from bench.figures.figure_settings import is_pdf_wanted
from bench.figures.robot_figure import compute_joint_positions, draw_robot_figure
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DPI = 150
"""Resolution of the PNG files in dots per inch; the page shows them at about two thirds of their
size.
"""
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": FONT_SIZE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.usetex": False,
    # Names come from files, where a dollar sign must not start mathematics.
    "text.parse_math": False,
    # Unhinted letters are as wide as their outlines, by which margins are measured; hinting would
    # take a fifth of the time of drawing.
    "text.hinting": "none",
}


def list_figure_names(report: DiagnosisReportData) -> tuple[str, ...]:
    """List the names of the figures for which there are data.

    Args:
        report: Report data. Only a robot has a drawing, and the figures ``where`` and
            ``candidates`` need a gap location and a candidate to show.
    """
    is_available = {
        "robot": report.robot is not None,
        "overview": True,
        "where": bool(select_gap_locations(report.gap_locations)),
        "candidates": bool(select_shown_candidates(report)),
    }
    return tuple(name for name, available in is_available.items() if available)


def draw_figure(report: DiagnosisReportData, name: str) -> Figure:
    """Draw one figure.

    Args:
        report: Report data.
        name: One of `list_figure_names`.

    Raises:
        InputError: There is no figure of that name.
    """
    figure_names = list_figure_names(report)
    if name not in figure_names:
        raise make_unknown_name_error("figure", name, figure_names)
    with apply_settings(_STYLE):
        figure = _FIGURE_FUNCTIONS[name](report)
        # Ticks take their style from the settings that are active when they are first drawn.
        figure.draw_without_rendering()
    return figure


def render_figures(report: DiagnosisReportData) -> dict[str, FigureFiles]:
    """Draw all figures and render their files, by name.

    Args:
        report: Data of the report.

    Returns:
        PNG, and PDF and SVG if requested, of each figure by name.
    """
    # The style must stay active until the end, because text is laid out again when a figure is
    # written.
    with apply_settings(_STYLE):
        figures = {name: _FIGURE_FUNCTIONS[name](report) for name in list_figure_names(report)}
        rendered = {}
        for name, figure in figures.items():
            png, pdf = figure_output.render_png_and_pdf(figure, DPI)
            svg = figure_output.render_svg(figure) if is_pdf_wanted() else None
            rendered[name] = FigureFiles(png, svg, pdf)
        # The page highlights joints on the drawing of the robot, so it needs their positions.
        if report.robot is not None and "robot" in rendered:
            pose = get_extreme_pose(report, select_worst_run(report))
            positions = tuple(compute_joint_positions(figures["robot"], report.robot, pose))
            rendered["robot"] = rendered["robot"]._replace(joint_positions=positions)
        return rendered


def get_extreme_pose(report: DiagnosisReportData, view: RunView) -> dict[str, float]:
    """Return recorded joint positions at the sample of a run that is farthest from its start.

    In this pose the drawing of the robot shows more than at rest. The distance is the sum of the
    squared changes of all joint positions. Only joints with recorded positions are returned; the
    result is empty without positions.

    Args:
        report: Report data.
        view: Run to use.
    """
    positions = {}
    for channel_index, channel in enumerate(report.channels):
        quantity, _, joint = channel.name.partition(".")
        values = view.get_samples("observed", channel_index)
        recorded_values = values[np.isfinite(values)]
        # Channels named q.JOINT are joint positions.
        if quantity == "q" and recorded_values.size:
            # A missing sample counts as no motion.
            positions[joint] = np.nan_to_num(values, nan=float(recorded_values[0]))
    if not positions:
        return {}
    motion = np.stack(list(positions.values()))  # (joints, T)
    distances = np.square(motion - motion[:, :1]).sum(axis=0)
    extreme_pose = motion[:, int(np.argmax(distances))]
    return dict(zip(positions, extreme_pose.tolist(), strict=True))


def _draw_robot(report: DiagnosisReportData) -> Figure:
    """Draw the robot in the extreme pose of the run that is shown."""
    if report.robot is None:
        raise InputError(f"{report.path}: no robot was recorded")
    return draw_robot_figure(
        report.robot, get_extreme_pose(report, select_worst_run(report)), list_place_marks(report)
    )


_FIGURE_FUNCTIONS: Mapping[str, Callable[[DiagnosisReportData], Figure]] = {
    "robot": _draw_robot,
    "overview": draw_run_figure,
    "where": draw_residual_figure,
    "candidates": draw_candidates_figure,
}
