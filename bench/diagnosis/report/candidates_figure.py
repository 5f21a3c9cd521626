"""Figure of the candidate causes: their scores, and the shares of the gap that they close."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.diagnosis.report.candidate_ranking import (
    get_candidate_status,
    has_placed_causes,
    rank_candidates,
    select_shown_candidates,
)
from bench.diagnosis.report.cause_and_value_text import (
    format_number,
    format_p_value,
    format_percent,
    sanitise,
    shorten_effect_name,
)
from bench.diagnosis.report.report_data import DataSplit, DiagnosisReportData
from bench.diagnosis.verdict import Candidate
from bench.figures.figure_layout import make_panel_grid
from bench.figures.label_text import break_name, count_max_lines, measure_text_width
from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    NEUTRAL_MARK,
    NOISE_BAND_GREY,
    SKY_BLUE,
    ZERO_LINE_GREY,
)
from sims.core.user_messages import format_count

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

    Args:
        report: content of the report, with the candidates of the verdict.
    """
    candidates = select_shown_candidates(report)
    names = [_format_candidate_name(report, candidate) for candidate in candidates]
    # The left panel needs at least one candidate, and the shares of enough of them.
    simulated_count = sum(candidate.heldout_gain is not None for candidate in candidates)
    has_shares = simulated_count >= MIN_SIMULATED_SHARE * len(candidates) > 0

    # Layout in inches. Names of causes are bold, which is a little wider.
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
    # Positions of panels are left, bottom, width and height as shares of the figure.
    bottom, panel_height = _BOTTOM / height, row_height * len(candidates) / height
    left_panel, scores = axes[0, 0], axes[0, -1]
    scores_left = (left_margin + shares_width) / width
    scores.set_position((scores_left, bottom, _SCORES_WIDTH / width, panel_height))
    _draw_scores(scores, report, candidates, texts, _BAR / row_height)
    if has_shares:
        left_panel.set_position((left_margin / width, bottom, _SHARES_WIDTH / width, panel_height))
        _draw_shares(left_panel, report, candidates)
        scores.tick_params(axis="y", left=False, labelleft=False)
    _label_rows(left_panel, report, candidates, names)

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
    # The place follows the last of several lines if it fits there, and else has its own line.
    if len(lines) > 1 and len(lines[-1]) + 1 + len(place) <= LINE_LENGTH:
        lines[-1] += f" {place}"
    else:
        lines.append(break_name(place, LONGEST_LINE))
    return "\n".join(lines)


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
    # Rows are one apart; the vertical axis points downwards.
    axis.set_yticks(np.arange(len(candidates)), names, fontsize=_NAME_SIZE, linespacing=1.15)
    axis.set_ylim(len(candidates) - 0.5, -0.5)
    axis.tick_params(axis="y", length=0)
    for label, candidate in zip(axis.get_yticklabels(), candidates, strict=True):
        if get_candidate_status(report, candidate.effect) != NOT_NEEDED:
            label.set_fontweight("bold")


def _draw_shares(axis: Axes, report: DiagnosisReportData, candidates: Sequence[Candidate]) -> None:
    """Draw which share of the held-out gap each candidate closes, with its 95 % interval.

    Each candidate is a row, in the given order. One that was not simulated has no mark. A share of
    1 closes the gap fully; a negative one means that the candidate makes the prediction worse.

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
        # Shares below `LOWEST_SHARE` are drawn there, at the edge; the text has the value.
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
    # Both ends without " %".
    ends = [format_percent(end).removesuffix(" %") for end in interval]
    return f" ({prefix}{' to '.join(ends)})"


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
    longest_bar = 1e-9  # Positive, so that the axis has a length.
    for row, (candidate, text) in enumerate(zip(candidates, texts, strict=True)):
        size = max(candidate.score, 0.0)
        bar_style = dict(_BARS[get_candidate_status(report, candidate.effect)])
        # A white bar means an insignificant score.
        if _is_insignificant(report, candidate):
            bar_style["facecolor"] = "white"
        axis.barh(row, size, height=thickness, edgecolor=NEUTRAL_MARK, linewidth=0.6, **bar_style)
        # Scores of the effect at the places that this candidate represents.
        other_scores = [max(other.score, 0.0) for other in other_places.get(candidate.effect, ())]
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
    """Format the two notes below the figure: numbers of runs and samples, and p-values.

    P-values are printed next to bars only if they are neither tiny nor insignificant; the second
    note gives the bound for the others, and says which candidates were not simulated.

    Args:
        report: content of the report.
        candidates: candidates that the figure shows.
    """
    counts = f"Fitted: {_format_split_size(report.fitting)}"
    if report.held_out is not None and report.cross_validated:
        counts += "; each run left out in turn"
    elif report.held_out is not None:
        counts += f"; held out: {_format_split_size(report.held_out)}"
    p_value_note = "p: p-value of the score"
    tiny_p_values = [c.p_value for c in candidates if c.p_value <= MAX_UNPRINTED_P_VALUE]
    if tiny_p_values:
        is_all = len(tiny_p_values) == len(candidates)
        bars = "for all shown" if is_all else "for grey or coloured bars"
        p_value_note += f"; {_format_p_value(max(tiny_p_values)).replace('=', '≤')} {bars}"
    insignificant_p_values = [c.p_value for c in candidates if _is_insignificant(report, c)]
    if insignificant_p_values:
        is_all = len(insignificant_p_values) == len(candidates)
        bars = "for all shown" if is_all else "for white bars"
        p_value_note += f"; {_format_p_value(min(insignificant_p_values)).replace('=', '≥')} {bars}"
    p_value_note += "."
    unsimulated_count = sum(candidate.heldout_gain is None for candidate in candidates)
    if 0 < unsimulated_count < len(candidates):
        p_value_note += f" Without a share of the gap: not simulated on {report.validation_runs}."
    return [f"{counts}.", p_value_note]


def _format_split_size(split: DataSplit) -> str:
    """Format the size of a data split, such as ``3 runs, 1200 samples of 2 channels``."""
    runs, channels = len(split.times), split.observed.shape[2]
    samples = int(np.isfinite(split.observed).any(axis=2).sum())
    channel_text = f" of {channels} channels" if channels > 1 else ""
    return f"{format_count(runs, 'run')}, {samples} samples{channel_text}"


def _make_legend(report: DiagnosisReportData) -> tuple[list[Any], list[str]]:
    """Return handles and labels of the legend, for the styles that are drawn.

    It explains the styles of bars: a candidate may be a cause, one of several indistinguishable
    causes, or not needed. The marks of other places are explained too.

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
