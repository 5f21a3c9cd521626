"""Figure of the residual: where the gap is, and how the residual depends on other variables."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.report.cause_and_value_text import format_label, sanitise
from bench.diagnosis.report.report_data import (
    DiagnosisReportData,
    GapLocation,
    ResidualProfile,
)
from bench.figures.figure_layout import make_panel_grid
from bench.figures.label_text import break_name, count_max_lines, measure_text_width
from bench.figures.style import (
    BASE_MODEL_LINE,
    BASE_MODEL_MARKER,
    CONNECTOR_GREY,
    EXTENDED_MODEL_LINE,
    EXTENDED_MODEL_MARKER,
    NEUTRAL_MARK,
    NULL_LEVEL_GREY,
    ZERO_LINE_GREY,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MAX_RUNS = 8
"""Maximum number of runs shown: those with the largest gap."""
MAX_GAP_LOCATIONS = 10
"""Maximum number of channels, and of phases, shown: those with the largest gap."""
MAX_PROFILES = 4
MAX_LABEL_LENGTH = 26
"""Maximum number of characters of the name of a variable or of a channel."""
LONGEST_NAME = 64
"""Maximum number of characters of the name of a run or channel among the gap locations."""
_NAME_LINE = 32
"""Maximum number of characters per line of the name of a gap location or variable."""
SHORT_LABEL_LENGTH = 9
"""Maximum number of characters of a unit next to a panel."""
_SPAN_FOR_LOG = 8.0
"""Minimum ratio of the largest to the smallest value for a logarithmic axis."""
_FLOOR = "1: noise floor"
_WHITE_NOISE = "range for white noise"
_WIDEST = 0.9
"""Maximum half-length of the bar for the noise about 1, so that it ends above 0."""
_NEXT = 1.0
"""Distance between rows of gap locations."""
_NEXT_KIND = 2.1
"""Distance to the first row of another kind, with space for its heading."""
_FIRST = 1.0
"""Position of the first row."""
_HEADING_OFFSET = 0.22
"""Distance from the upper edge to the middle of a heading, in inches."""
_HEADING_SIZE = 11.0
"""Maximum font size of a heading, in points."""
_MIN_NAMES_WIDTH = 1.9
"""Minimum width for the names of places, in inches."""
_PROFILES_AFTER = 4.1
"""Distance from the end of the names of places to the profiles, in inches."""
FONT_SIZE = 9
"""Font size of the figures of an explanation, in points."""


def draw_residual_figure(report: DiagnosisReportData) -> Figure:
    """Draw the gap locations on the left, and the most informative profiles on the right.

    A gap location is a run, channel or phase of the motion with its RMS residual. A profile is the
    mean residual in bins of another variable, such as the speed. All sizes are in inches, because
    texts do not grow with the figure.

    Args:
        report: Data of the report.
    """
    locations = select_gap_locations(report.gap_locations)
    profiles = select_informative_profiles(report.profiles)
    # At most two rows of profiles, filled row by row.
    rows = min(2, len(profiles))
    columns = ceil(len(profiles) / 2)
    names = place_names(locations)
    left_margin = max(_MIN_NAMES_WIDTH, 0.25 + measure_text_width(names, FONT_SIZE))
    profiles_from = left_margin + _PROFILES_AFTER
    # In inches: names, panel of the gaps (3.3) and columns of profiles. A single column is wider
    # than one of several.
    width = left_margin + 3.3 + (4.4 if columns == 1 else 3.1 * columns)
    # Height of a row, and of each further line of a name.
    row_height = 0.27 + 0.13 * (count_max_lines(names) - 1)
    # Variables of robots have long names, which need several lines below the panels.
    profile_labels = [format_profile_label(profile) for profile in profiles]
    label_height = 0.15 * (count_max_lines(profile_labels) - 1)
    # Title, axis and rows of the gaps; or titles and panels of the profiles.
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
        row, column = divmod(i, columns)
        axis = figure.add_subplot(grid[row, column])
        unit = units.get(profile.channel, "1")
        draw_profile_panel(
            axis, profile, unit, report.has_extended_model, one_channel=len(channels) == 1
        )
    return figure


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


def select_gap_locations(places: Sequence[GapLocation]) -> list[GapLocation]:
    """Select the runs, channels and phases with the largest gaps, in their original order.

    A gap location is such a part of the data with its RMS residual. Those without samples, which
    have no RMS, are left out. The original order is kept, because readers look for run 3 after run
    2.

    Args:
        places: Gap locations with their RMS residual before the causes are added.
    """
    selected: list[GapLocation] = []
    measured_locations = [p for p in places if np.isfinite(p.before) and p.samples > 0]
    for kind, max_count in (
        ("run", MAX_RUNS),
        ("channel", MAX_GAP_LOCATIONS),
        ("phase", MAX_GAP_LOCATIONS),
    ):
        locations_of_kind = [p for p in measured_locations if p.kind == kind]
        worst_locations = sorted(locations_of_kind, key=lambda p: -p.before)[:max_count]
        selected += [p for p in locations_of_kind if p in worst_locations]
    return selected


def draw_gap_location_panel(
    axis: Axes, places: Sequence[GapLocation], report: DiagnosisReportData
) -> None:
    """Draw the RMS residual of each run, channel and phase of the motion in units of the noise.

    Each is a row with a mark before and after the causes are added, joined by a line. A dotted line
    at 1 is the noise floor, and a bar the range in which the RMS of white noise lies.

    Args:
        axis: Axes to draw on.
        places: Gap locations to draw.
        report: Report data.
    """
    row_positions = _place_rows(axis, places)
    # The RMS of n noise samples has a standard deviation of 1 / sqrt(2 n); two of them are drawn.
    noise_ranges = [min(2 / (2 * place.samples) ** 0.5, _WIDEST) for place in places]
    axis.errorbar(
        np.ones(len(places)),
        row_positions,
        xerr=noise_ranges,
        fmt="none",
        ecolor=NULL_LEVEL_GREY,
        elinewidth=7,
        label=_WHITE_NOISE,
    )
    axis.axvline(1.0, color=NEUTRAL_MARK, linewidth=1.0, linestyle=":", label=_FLOOR)
    before_values = [place.before for place in places]
    after_values = [place.after for place in places]
    shown_values = before_values
    base_label = "simulated (tuned)"
    if report.has_extended_model:
        axis.hlines(row_positions, after_values, before_values, color=CONNECTOR_GREY, linewidth=0.9)
        axis.plot(after_values, row_positions, linestyle="", label="after", **EXTENDED_MODEL_MARKER)
        shown_values = [*before_values, *after_values]
        base_label = "before"
    axis.plot(before_values, row_positions, linestyle="", label=base_label, **BASE_MODEL_MARKER)
    # The noise floor must be visible, whatever the sizes.
    _use_log_axis_if_needed(axis, [*shown_values, 1.0])
    axis.set_yticks(row_positions, place_names(places), linespacing=1.05)
    # Rows are one apart, the first at the top; leave space for the last mark.
    axis.set_ylim(row_positions[-1] + 0.7, -0.1)
    axis.set_xlabel("RMS of the residual, in units of the noise")


def place_names(places: Sequence[GapLocation]) -> list[str]:
    """Format each gap location with its number of samples, in as many lines as needed."""
    names = [f"{sanitise(place.label, LONGEST_NAME)} ({place.samples})" for place in places]
    return [break_name(name, _NAME_LINE) for name in names]


def _place_rows(axis: Axes, places: Sequence[GapLocation]) -> list[float]:
    """Return the vertical position of each row, and write a heading above each kind of place.

    Args:
        axis: axes to draw on.
        places: places of the gap, sorted by kind.
    """
    row_positions: list[float] = []
    previous_kind = ""
    for place in places:
        is_new_kind = place.kind != previous_kind
        previous_kind = place.kind
        position = _FIRST
        if row_positions:
            position = row_positions[-1] + (_NEXT_KIND if is_new_kind else _NEXT)
        row_positions.append(position)
        if is_new_kind:
            # Left of the axis, a little less than a row above the first place of the kind.
            axis.text(
                -0.035,
                position - 0.85,
                f"by {place.kind} (samples)",
                transform=axis.get_yaxis_transform(),
                ha="right",
                va="center",
                fontsize=8.5,
                weight="bold",
            )
    return row_positions


def get_legend_entries(axis: Axes) -> tuple[list[Any], list[str]]:
    """Return handles and labels of the legend: models first, then the noise floor and its range."""
    handles, labels = axis.get_legend_handles_labels()
    handle_by_label = dict(zip(labels, handles, strict=True))
    order = ("before", "simulated (tuned)", "after", _FLOOR, _WHITE_NOISE)
    drawn_labels = [label for label in order if label in handle_by_label]
    return [handle_by_label[label] for label in drawn_labels], drawn_labels


def _use_log_axis_if_needed(axis: Axes, values: Sequence[float]) -> None:
    """Use a logarithmic axis with plain numbers if the values differ by a large factor.

    Otherwise the axis is linear and begins at 0.

    Args:
        axis: Axes whose horizontal scale is set.
        values: Values to be shown; only positive ones can be on a logarithmic axis.
    """
    positive = np.array([value for value in values if np.isfinite(value) and value > 0])
    if not positive.size or positive.max() / positive.min() < _SPAN_FOR_LOG:
        axis.set_xlim(left=0)
        return
    axis.set_xscale("log")
    # The axis extends by a factor of 1.4 beyond the smallest and the largest value.
    low = positive.min() / 1.4
    high = positive.max() * 1.4
    ticks = _compute_log_ticks(low, high)
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    # Minor ticks of a short axis would be labelled too, in powers of ten.
    axis.set_xticks([], minor=True)
    axis.set_xlim(low, high)


def _compute_log_ticks(low: float, high: float) -> list[float]:
    """Return round ticks of a logarithmic axis: 1, 2 and 5 in each decade, or fewer.

    Args:
        low: lower end of the axis, positive.
        high: upper end of the axis.
    """
    # With more decades, each has fewer numbers, so that labels do not overlap.
    steps: tuple[int, ...] = (1,)
    if high / low < 200:
        steps = (1, 2, 5)
    elif high / low < 1000:
        steps = (1, 3)
    ticks = np.outer(10.0 ** np.arange(-6, 10), steps).ravel()
    return [float(tick) for tick in ticks if low <= tick <= high]


def select_informative_profiles(profiles: Sequence[ResidualProfile]) -> list[ResidualProfile]:
    """Select the profiles in which the base model has the most significant residuals.

    At most `MAX_PROFILES` are selected. The best profile of each variable precedes further profiles
    of the same variable.

    Args:
        profiles: mean residual of a channel in bins of a variable, such as the speed.
    """
    measured_profiles = [p for p in profiles if np.isfinite(_compute_profile_significance(p))]
    first_of_variable: list[ResidualProfile] = []
    further: list[ResidualProfile] = []
    known_variables: set[str] = set()
    # The most significant profile comes first.
    for profile in sorted(measured_profiles, key=_compute_profile_significance, reverse=True):
        if profile.variable in known_variables:
            further.append(profile)
        else:
            first_of_variable.append(profile)
            known_variables.add(profile.variable)
    return [*first_of_variable, *further][:MAX_PROFILES]


def _compute_profile_significance(profile: ResidualProfile) -> float:
    """Compute the mean squared residual in standard errors; 1 for noise, NaN for too few bins."""
    is_measured = np.isfinite(profile.before) & (profile.error > 0)
    if is_measured.sum() < 2:
        return float("nan")
    return float(np.mean((profile.before[is_measured] / profile.error[is_measured]) ** 2))


def format_profile_label(profile: ResidualProfile) -> str:
    """Format a variable with its unit, in as many lines as needed."""
    name = format_label(
        sanitise(profile.variable, LONGEST_NAME), sanitise(profile.unit, 12), LONGEST_NAME
    )
    return break_name(name, _NAME_LINE)


def draw_profile_panel(
    axis: Axes, profile: ResidualProfile, unit: str, extended: bool, *, one_channel: bool = False
) -> None:
    """Draw the mean residual of a channel against a variable, without and with the causes.

    A perfect model has means near zero; a trend shows on which variable the missing force depends.
    Bars are two standard errors of the mean to either side; they follow from the noise, and so are
    equal for both models.

    Args:
        axis: Axes to draw on.
        profile: Residual in bins.
        unit: Unit of the channel.
        extended: Whether there is an extended model (with the causes) to draw.
        one_channel: Whether all panels show the same channel, which their heading names.
    """
    # Bins without samples have no mean.
    is_measured = np.isfinite(profile.before)
    centres = profile.centres[is_measured]
    bars = 2 * profile.error[is_measured]
    axis.axhline(0, color=ZERO_LINE_GREY, linewidth=0.6)
    base_style = {**BASE_MODEL_LINE, **BASE_MODEL_MARKER, "markersize": 4.5, "linewidth": 1.0}
    curves = [(profile.before, base_style)]
    if extended:
        extended_style = {**EXTENDED_MODEL_LINE, **EXTENDED_MODEL_MARKER}
        curves.append((profile.after, {**extended_style, "markersize": 3.5, "linewidth": 1.2}))
    for means, curve_style in curves:
        axis.errorbar(centres, means[is_measured], yerr=bars, elinewidth=1.0, **curve_style)
    axis.set_xlabel(format_profile_label(profile))
    label = "residual"
    if not one_channel:
        label = f"residual of {sanitise(profile.channel, MAX_LABEL_LENGTH)}"
    label_with_unit = format_label(label, sanitise(unit, SHORT_LABEL_LENGTH))
    axis.set_ylabel(break_name(label_with_unit, MAX_LABEL_LENGTH))
    axis.locator_params(nbins=5)
