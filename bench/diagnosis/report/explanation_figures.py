"""Figures of an explanation: the run with the largest gap, where the gap is, and candidates.

They are readable in print without colour: before is dashed with open squares, and after is solid
with filled circles. Each figure is rendered as PNG, and as PDF and SVG if vector graphics are
requested (`bench.figures.figure_settings`). Texts from files are never parsed as mathematics.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.report.cause_text import (
    get_candidate_status,
    has_placed_causes,
    list_place_marks,
    rank_candidates,
    select_shown_candidates,
    shorten_effect_name,
)
from bench.diagnosis.report.effect_and_unit_text import (
    format_number,
    format_p_value,
    format_percent,
    sanitise,
)
from bench.diagnosis.report.figure_panels import (
    LONGEST_NAME,
    RunView,
    draw_gap_location_panel,
    draw_profile_panel,
    format_profile_label,
    get_legend_entries,
    has_extended_model,
    place_names,
    select_gap_locations,
    select_informative_profiles,
    select_worst_run,
)
from bench.diagnosis.report.joint_figure import draw_run_figure
from bench.diagnosis.report.report_data import DataSplit, DiagnosisReportData
from bench.diagnosis.verdict import Candidate
from bench.figures import figure_output
from bench.figures.figure_output import FigureFiles
from bench.figures.figure_settings import is_pdf_wanted
from bench.figures.robot_figure import compute_joint_positions, draw_robot_figure
from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    NEUTRAL_MARK,
    NOISE_BAND_GREY,
    SKY_BLUE,
    ZERO_LINE_GREY,
    apply_settings,
    break_name,
    count_max_lines,
    make_panel_grid,
    measure_text_width,
)
from sims.core.plain_values import format_count
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FOUND, ALIKE, NOT_NEEDED = "found", "found, but not distinguishable", "not needed"
"""Status texts of candidates, as returned by `get_candidate_status`."""
LINE_LENGTH = 44
"""Maximum number of characters per line of a candidate's name."""
LONGEST_LINE = 50
"""Maximum number of characters per line of the name of a place."""
MAX_UNPRINTED_P_VALUE = 1e-3
"""Maximum p-value that is not printed next to its bar; a note gives the largest of them."""
SIGNIFICANCE_LEVEL = 0.05
"""Maximum p-value of a significant score. A candidate above it has a white bar without its p-value,
and a note explains that.
"""
MIN_SIMULATED_SHARE = 0.5
"""Minimum share of candidates simulated on held-out runs for which the left panel is drawn."""
LOWEST_SHARE = -0.5
"""Lower limit of a share in the figure; for a failed model the exact value has no meaning."""
POINTER = "▸ "
"""Marker before the name of a cause, visible in print without colour too."""

_BARS: Mapping[str, Mapping[str, Any]] = {
    FOUND: {"facecolor": BLUE},
    ALIKE: {"facecolor": SKY_BLUE, "hatch": "///"},
    NOT_NEEDED: {"facecolor": NOISE_BAND_GREY},
}
_DOTS: Mapping[str, Mapping[str, Any]] = {
    FOUND: {"marker": "o", "markersize": 7, "markerfacecolor": BLUE},
    ALIKE: {"marker": "D", "markersize": 6, "markerfacecolor": SKY_BLUE},
    NOT_NEEDED: {"marker": "o", "markersize": 5, "markerfacecolor": "white"},
}

# Sizes in inches.
_EDGE = 0.12
_SHARES_WIDTH = 2.5
_SHARE_TEXTS_WIDTH = 1.5
_SCORES_WIDTH = 2.6
_SCORE_TEXTS_WIDTH = 0.95
_TOP = 0.9
_TOP_WITHOUT_LEGEND = 0.65
_BOTTOM = 0.95
_ROW = 0.13
_LINE = 0.145
_BAR = 0.16
_NAME_SIZE = 9
_TEXT_SIZE = 8
"""Size of the texts next to marks and bars, in points."""


def draw_candidates_figure(report: DiagnosisReportData) -> Figure:
    """Draw the candidates, the highest score first.

    The left panel shows the share of the held-out gap that each closes alone, with its 95 %
    interval, if at least half of the candidates were simulated on held-out runs. The right panel
    shows the score on the fitted runs; without a left panel, the shares are written next to it.
    """
    candidates = select_shown_candidates(report)
    names = [_format_candidate_name(report, candidate) for candidate in candidates]
    simulated_count = sum(candidate.heldout_gain is not None for candidate in candidates)
    has_shares = simulated_count >= MIN_SIMULATED_SHARE * len(candidates) > 0

    # Names of causes are bold, which is a little wider.
    left_margin = _EDGE + 0.12 + measure_text_width(names, _NAME_SIZE, "bold")
    shares_width = _SHARES_WIDTH + _SHARE_TEXTS_WIDTH if has_shares else 0.0
    texts = [_format_score(report, candidate, not has_shares) for candidate in candidates]
    texts_width = max(_SCORE_TEXTS_WIDTH, measure_text_width(texts, _TEXT_SIZE, "normal") + 0.1)
    # Width in inches; a title needs at least 7.
    width = max(left_margin + shares_width + _SCORES_WIDTH + texts_width + _EDGE, 7.0)
    # All rows have the height of the longest name, so that bars are evenly spaced.
    row_height = _ROW + _LINE * count_max_lines(names)
    handles, labels = _make_legend(report)
    top = _TOP if handles else _TOP_WITHOUT_LEGEND
    height = top + _BOTTOM + row_height * len(candidates)

    figure, axes = make_panel_grid(
        1, 2 if has_shares else 1, (width, height), layout=None, sharey=True
    )
    bottom, size = _BOTTOM / height, row_height * len(candidates) / height
    scores = axes[0, -1]
    scores.set_position(((left_margin + shares_width) / width, bottom, _SCORES_WIDTH / width, size))
    _draw_scores(scores, report, candidates, texts, _BAR / row_height)
    if has_shares:
        shares = axes[0, 0]
        shares.set_position((left_margin / width, bottom, _SHARES_WIDTH / width, size))
        _draw_shares(shares, report, candidates)
        scores.tick_params(axis="y", left=False, labelleft=False)
    _label_rows(axes[0, 0], report, candidates, names)

    total = len(rank_candidates(report))
    selection = f", the best {len(candidates)} of {total}" if len(candidates) < total else ""
    title = f"Candidate causes, each by itself{selection}"
    figure.text(_EDGE / width, 1 - 0.2 / height, title, fontsize=11, va="center")
    figure.legend(
        handles,
        labels,
        loc="center left",
        # The legend is 0.46 inches below the upper edge.
        bbox_to_anchor=(_EDGE / width, 1 - 0.46 / height),
        ncols=4,
        fontsize=8.5,
        borderaxespad=0.0,
        handletextpad=0.5,
        columnspacing=1.4,
    )
    note = "\n".join(_format_notes(report, candidates))
    figure.text(_EDGE / width, 0.1 / height, note, fontsize=8, color=CAPTION_GREY, va="bottom")
    return figure


def _format_candidate_name(report: DiagnosisReportData, candidate: Candidate) -> str:
    """Format a candidate's name in as many lines as needed; its place is never cut off.

    Args:
        report: content of the report, with the status of the candidate.
        candidate: effect of the library with its score, p-value and held-out gain.
    """
    text = sanitise(shorten_effect_name(candidate.effect), 160)
    if get_candidate_status(report, candidate.effect) != NOT_NEEDED:
        text = POINTER + text
    if len(text) <= LINE_LENGTH:
        return text
    effect, separator, place = text.rpartition(" at ")
    if not separator:
        return "\n".join(textwrap.wrap(text, LINE_LENGTH))
    lines = textwrap.wrap(effect, LINE_LENGTH)
    place = f"at {place}"
    # The place is not broken, and has its own line unless it follows a short last one.
    if len(lines) > 1 and len(lines[-1]) + 1 + len(place) <= LINE_LENGTH:
        lines[-1] += f" {place}"
        return "\n".join(lines)
    return "\n".join([*lines, break_name(place, LONGEST_LINE)])


def _label_rows(
    axis: Axes, report: DiagnosisReportData, candidates: Sequence[Candidate], names: Sequence[str]
) -> None:
    """Write the names of the candidates next to their rows, the first at the top.

    A name is bold unless the status of the candidate is "not needed".

    Args:
        axis: axes to draw on.
        report: report data.
        candidates: candidate effects in the order of the report.
        names: names of the candidates, the first at the top.
    """
    axis.set_yticks(np.arange(len(candidates)), names, fontsize=_NAME_SIZE, linespacing=1.15)
    axis.set_ylim(len(candidates) - 0.5, -0.5)
    axis.tick_params(axis="y", length=0)
    for label, candidate in zip(axis.get_yticklabels(), candidates, strict=True):
        if get_candidate_status(report, candidate.effect) != NOT_NEEDED:
            label.set_fontweight("bold")


def _draw_shares(axis: Axes, report: DiagnosisReportData, candidates: Sequence[Candidate]) -> None:
    """Draw which share of the held-out gap each candidate closes, with its 95 % interval.

    Each candidate is a row, in the given order. One that was not simulated has no mark.

    Args:
        axis: axes to draw on.
        report: report data.
        candidates: candidate effects in the order of the report.
    """
    lowest = 0.0
    for row, candidate in enumerate(candidates):
        axis.axhline(row, color=NOISE_BAND_GREY, linewidth=0.5, zorder=0)
        share = candidate.heldout_gain
        if share is None:
            continue
        # Very negative shares are drawn at the edge; the text has the value.
        position = max(share, LOWEST_SHARE)
        interval = report.share_intervals.get(candidate.effect)
        if interval is not None:
            low, high = (max(end, LOWEST_SHARE) for end in interval)
            axis.plot([low, high], [row, row], color=NEUTRAL_MARK, linewidth=1.4, zorder=2)
            lowest = min(lowest, low)
        lowest = min(lowest, position)
        marker_style = _DOTS[get_candidate_status(report, candidate.effect)]
        axis.plot(
            position, row, markeredgecolor=NEUTRAL_MARK, linestyle="", zorder=3, **marker_style
        )
        axis.annotate(
            format_percent(share) + _format_interval(report, candidate),
            (1.0, row),
            (8, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            fontsize=_TEXT_SIZE,
        )
    axis.axvline(0.0, color=ZERO_LINE_GREY, linewidth=0.6)
    axis.axvline(1.0, color=ZERO_LINE_GREY, linewidth=0.6, linestyle=":")
    # Shares from the lowest one to 1, with a margin for marks.
    axis.set_xlim(lowest - 0.03, 1.05)
    ticks = [tick for tick in (-0.5, 0.0, 0.25, 0.5, 0.75, 1.0) if tick >= lowest - 0.03]
    axis.set_xticks(ticks, [f"{100 * tick:.0f}".replace("-", "−") for tick in ticks])
    axis.set_xlabel("share of the held-out gap closed [%]")
    axis.set_title("Share of the gap closed, 95 % interval", fontsize=9.5, loc="left")


def _format_interval(report: DiagnosisReportData, candidate: Candidate, prefix: str = "") -> str:
    """Format the interval of a candidate's share of the gap; empty without one.

    Args:
        report: content of the report, with the intervals.
        candidate: effect of the library.
        prefix: text before the interval, in the brackets.
    """
    interval = report.share_intervals.get(candidate.effect)
    if interval is None:
        return ""
    return f" ({prefix}{' to '.join(format_percent(end)[:-2] for end in interval)})"


def _format_score(report: DiagnosisReportData, candidate: Candidate, with_share: bool) -> str:
    """Format the score of a candidate, with a p-value that is neither tiny nor insignificant.

    Args:
        report: content of the report.
        candidate: effect of the library.
        with_share: whether to add the share of the gap that it closes, if it was simulated.
    """
    text = format_number(candidate.score)
    if MAX_UNPRINTED_P_VALUE < candidate.p_value <= SIGNIFICANCE_LEVEL:
        text += f"  ({_format_p_value(candidate.p_value)})"
    if with_share and candidate.heldout_gain is not None:
        text += f", closes {format_percent(candidate.heldout_gain)} of the gap"
        text += _format_interval(report, candidate, "95 %: ")
    return text


def _draw_scores(
    axis: Axes,
    report: DiagnosisReportData,
    candidates: Sequence[Candidate],
    texts: Sequence[str],
    thickness: float,
) -> None:
    """Draw the score of each candidate as a bar, which is twice the gain in log-likelihood.

    Small vertical lines are the scores of the same effect at other places.

    Args:
        axis: axes to draw on.
        report: content of the report.
        candidates: candidates that the figure shows, the first at the top.
        texts: text next to the bar of each candidate.
        thickness: height of a bar in rows.
    """
    other_places = {entry.best.effect: entry.elsewhere for entry in rank_candidates(report)}
    longest_bar = 1e-9
    for row, (candidate, text) in enumerate(zip(candidates, texts, strict=True)):
        size = max(candidate.score, 0.0)
        bar_style = dict(_BARS[get_candidate_status(report, candidate.effect)])
        if _is_insignificant(report, candidate):
            bar_style["facecolor"] = "white"
        axis.barh(row, size, height=thickness, edgecolor=NEUTRAL_MARK, linewidth=0.6, **bar_style)
        other_scores = [max(member.score, 0.0) for member in other_places.get(candidate.effect, ())]
        axis.plot(
            other_scores,
            [row] * len(other_scores),
            "|",
            color=NEUTRAL_MARK,
            markersize=8,
            markeredgewidth=1.0,
        )
        longest_bar = max(longest_bar, size, *other_scores)
        axis.annotate(
            text,
            (max([size, *other_scores]), row),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=_TEXT_SIZE,
            annotation_clip=False,
        )
    axis.set_xlim(0.0, longest_bar)
    axis.locator_params(axis="x", nbins=5)
    axis.set_xlabel("score: twice the gain in log likelihood")
    axis.set_title("Evidence on the fitted runs", fontsize=9.5, loc="left")


def _is_insignificant(report: DiagnosisReportData, candidate: Candidate) -> bool:
    """Return whether the score of a candidate that is not a cause is insignificant.

    Args:
        report: content of the report, with the status of the candidate.
        candidate: effect of the library with its score, p-value and held-out gain.
    """
    return (
        candidate.p_value > SIGNIFICANCE_LEVEL
        and get_candidate_status(report, candidate.effect) == NOT_NEEDED
    )


def _format_p_value(p_value: float) -> str:
    """Format a p-value, such as ``p < 10⁻¹²``."""
    return format_p_value(p_value).replace(" 1×10", " 10")


def _format_notes(report: DiagnosisReportData, candidates: Sequence[Candidate]) -> list[str]:
    """Format the notes below the figure: numbers of runs and samples, meaning of p-values.

    P-values are printed next to bars only if they are neither tiny nor insignificant; the notes
    give the bound for the others.

    Args:
        report: content of the report.
        candidates: candidates that the figure shows.
    """
    counts = f"Fitted: {_format_split_size(report.fitting)}"
    if report.held_out is not None and report.cross_validated:
        counts += "; each run left out in turn"
    elif report.held_out is not None:
        counts += f"; held out: {_format_split_size(report.held_out)}"
    notes = [f"{counts}."]
    p_value_note = "p: p-value of the score"
    tiny_p_values = [c.p_value for c in candidates if c.p_value <= MAX_UNPRINTED_P_VALUE]
    insignificant_p_values = [c.p_value for c in candidates if _is_insignificant(report, c)]
    if tiny_p_values:
        bars = (
            "for all shown"
            if len(tiny_p_values) == len(candidates)
            else "for grey or coloured bars"
        )
        p_value_note += f"; {_format_p_value(max(tiny_p_values)).replace('=', '≤')} {bars}"
    if insignificant_p_values:
        bars = (
            "for all shown" if len(insignificant_p_values) == len(candidates) else "for white bars"
        )
        p_value_note += f"; {_format_p_value(min(insignificant_p_values)).replace('=', '≥')} {bars}"
    notes.append(f"{p_value_note}.")
    unsimulated_count = sum(candidate.heldout_gain is None for candidate in candidates)
    if 0 < unsimulated_count < len(candidates):
        notes[1] += f" Without a share of the gap: not simulated on {report.validation_runs}."
    return notes


def _format_split_size(split: DataSplit) -> str:
    """Format the size of a data split, such as ``3 runs, 1200 samples of 2 channels``."""
    runs, channels = len(split.times), split.observed.shape[2]
    samples = int(np.isfinite(split.observed).any(axis=2).sum())
    channel_text = f" of {channels} channels" if channels > 1 else ""
    return f"{format_count(runs, 'run')}, {samples} samples{channel_text}"


def _make_legend(report: DiagnosisReportData) -> tuple[list[Any], list[str]]:
    """Return handles and labels of the legend, for the styles that are drawn.

    It explains the styles of bars: a candidate may be a cause, explained by it, or not needed.

    Args:
        report: Data of the report.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    statuses = {
        get_candidate_status(report, candidate.effect) for candidate in report.verdict.candidates
    }
    # If all bars have the same style, no legend is needed.
    names = [name for name in _BARS if name in statuses] if statuses != {NOT_NEEDED} else []
    handles: list[Any] = [
        Patch(edgecolor=NEUTRAL_MARK, linewidth=0.6, **_BARS[name]) for name in names
    ]
    if any(entry.elsewhere for entry in rank_candidates(report)) and has_placed_causes(report):
        handles.append(Line2D([], [], color=NEUTRAL_MARK, marker="|", linestyle="", markersize=8))
        names = [*names, "the same effect at other places"]
    return handles, names


DPI = 150
"""Resolution of the PNG files in dots per inch; the page shows them at about two thirds of their
size.
"""
_HEADING_OFFSET = 0.22
"""Distance from the upper edge to the middle of a heading, in inches."""
_HEADING_SIZE = 11.0
"""Maximum font size of a heading, in points."""
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
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
    """List the names of the figures for which there are data."""
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
    with apply_settings(_STYLE):
        # The settings must stay active, because text is laid out again when a figure is written.
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

    In this pose the drawing of the robot shows more than at rest. Only joints with recorded
    positions are returned; the result is empty without positions.

    Args:
        report: Report data.
        view: Run to use.
    """
    joints, columns = [], []
    for c, channel in enumerate(report.channels):
        kind, _, joint = channel.name.partition(".")
        values = view.get_samples("observed", c)
        if kind == "q" and np.isfinite(values).any():
            joints.append(joint)
            columns.append(np.nan_to_num(values, nan=float(values[np.isfinite(values)][0])))
    if not joints:
        return {}
    motion = np.stack(columns)
    distances = np.square(motion - motion[:, :1]).sum(axis=0)
    return dict(zip(joints, motion[:, int(np.argmax(distances))].tolist(), strict=True))


def _draw_robot(report: DiagnosisReportData) -> Figure:
    """Draw the robot in the extreme pose of the run that is shown."""
    if report.robot is None:
        raise InputError(f"{report.path}: no robot was recorded")
    return draw_robot_figure(
        report.robot, get_extreme_pose(report, select_worst_run(report)), list_place_marks(report)
    )


class _FigureLayout(NamedTuple):
    """Figure layout in inches, so that margins do not change with the figure size.

    Attributes:
        figure: Figure that is laid out.
        width: Width in inches.
        height: Height in inches.
    """

    figure: Figure
    width: float
    height: float

    def across(self, inches: float) -> float:
        """Convert a distance from the left edge in inches to a share of the width."""
        return inches / self.width

    def up(self, inches: float) -> float:
        """Convert a distance from the lower edge in inches to a share of the height."""
        return inches / self.height

    def heading(self, inches: float, text: str) -> None:
        """Write a heading at a distance from the left edge, in a font size that fits.

        Args:
            inches: Distance from the left edge.
            text: Text of the heading.
        """
        # Hinting makes letters wider on the page than their outlines.
        available_width = self.width - inches - 0.3
        size = _HEADING_SIZE * min(1.0, available_width / measure_text_width([text], _HEADING_SIZE))
        y = 1 - self.up(_HEADING_OFFSET)
        self.figure.text(self.across(inches), y, text, fontsize=size, va="center")


_MIN_NAMES_WIDTH = 1.9
"""Minimum width for the names of places, in inches."""
_PROFILES_AFTER = 4.1
"""Distance from the end of the names of places to the profiles, in inches."""


def _draw_residual_locations(report: DiagnosisReportData) -> Figure:
    """Draw the gap locations on the left, and the most informative profiles on the right.

    A gap location is a run, channel or phase of the motion with its RMS residual. A profile is the
    mean residual in bins of another variable, such as the speed. All sizes are in inches, because
    texts do not grow with the figure.

    Args:
        report: Data of the report.
    """
    locations = select_gap_locations(report.gap_locations)
    profiles = select_informative_profiles(report.profiles)
    rows = min(2, len(profiles))
    columns = -(-len(profiles) // 2)
    names = place_names(locations)
    left_margin = max(_MIN_NAMES_WIDTH, 0.25 + measure_text_width(names, _STYLE["font.size"]))
    profiles_from = left_margin + _PROFILES_AFTER
    # A single column of profiles is wider than one of several columns.
    # Widths in inches: panel of the gaps, and each column of profiles.
    width = left_margin + 3.3 + (3.1 * columns if columns != 1 else 4.4)
    # Height of a row in inches, and of each further line of a name.
    row_height = 0.27 + 0.13 * (count_max_lines(names) - 1)
    # Variables of robots have long names, which need several lines below the panels.
    label_height = 0.15 * (
        count_max_lines([format_profile_label(profile) for profile in profiles]) - 1
    )
    # Height in inches of title, axis and rows; or of titles and panels of the profiles.
    height = max(2.6 + row_height * len(locations), 1.5 + (1.9 + label_height) * rows)
    figure, axes = make_panel_grid(1, 1, (width, height), layout=None)
    layout, axis = _FigureLayout(figure, width, height), axes[0, 0]
    # Left, bottom, width and height, given in inches, as shares of the figure.
    axis.set_position((left_margin / width, 1.0 / height, 3.1 / width, 1 - 1.4 / height))
    draw_gap_location_panel(axis, locations, report)
    layout.heading(0.15, "Where the gap is")
    figure.legend(
        *get_legend_entries(axis), loc="lower left", ncols=2, fontsize=8.5, columnspacing=1.0
    )
    if not profiles:
        return figure

    channels = {profile.channel for profile in profiles}
    channel_text = (
        f" of {sanitise(profiles[0].channel, LONGEST_NAME)}" if len(channels) == 1 else ""
    )
    layout.heading(profiles_from, f"Residual{channel_text} against other variables")
    note = "means in bins, bars: ±2 standard errors; residual: measured − simulated"
    figure.text(layout.across(profiles_from), layout.up(0.2), note, fontsize=8.5, va="center")
    grid = figure.add_gridspec(
        rows,
        columns,
        left=layout.across(profiles_from),
        right=1 - layout.across(0.12),
        # The labels below the panels need 0.85 inches and their further lines.
        bottom=layout.up(0.85 + label_height),
        top=1 - layout.up(0.5),
        hspace=0.45 + 0.6 * label_height,
        wspace=0.42,
    )
    units = {c.name: c.unit for c in report.channels}
    for i, profile in enumerate(profiles):
        axis = figure.add_subplot(grid[i // columns, i % columns])
        unit = units.get(profile.channel, "1")
        draw_profile_panel(
            axis, profile, unit, has_extended_model(report), one_channel=len(channels) == 1
        )
    return figure


_FIGURE_FUNCTIONS: Mapping[str, Callable[[DiagnosisReportData], Figure]] = {
    "robot": _draw_robot,
    "overview": draw_run_figure,
    "where": _draw_residual_locations,
    "candidates": draw_candidates_figure,
}
