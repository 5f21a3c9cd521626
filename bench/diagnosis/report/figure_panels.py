"""Panels of the figures of an explanation, and the choice of the run that they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.report.effect_and_unit_text import format_label, sanitise
from bench.diagnosis.report.report_data import (
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ResidualProfile,
)
from bench.diagnosis.report.summary_text import list_data_splits
from bench.figures.style import (
    BLUE,
    CONNECTOR_GREY,
    NEUTRAL_MARK,
    NULL_LEVEL_GREY,
    VERMILION,
    ZERO_LINE_GREY,
    break_name,
)
from sims.core.simulator import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
BASE_MODEL_LINE: Mapping[str, Any] = {
    "color": VERMILION,
    "linestyle": (0, (5, 2)),
    "linewidth": 1.3,
}
"""Line style of the fitted base model: dashed, so that it is recognised without colour."""
EXTENDED_MODEL_LINE: Mapping[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.5}
"""Line style of the extended model."""
BASE_MODEL_MARKER: Mapping[str, Any] = {
    "marker": "s",
    "markersize": 6,
    "markerfacecolor": "white",
    "color": VERMILION,
}
"""Marker style of the fitted base model: open squares, recognised without colour."""
EXTENDED_MODEL_MARKER: Mapping[str, Any] = {"marker": "o", "markersize": 5.5, "color": BLUE}
"""Marker style of the extended model."""
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


def shorten_label(name: object, unit: str = "1", max_length: int = 30) -> str:
    """Format a text from a file, optionally with its unit, short enough for a label.

    Args:
        name: Text of the label.
        unit: Unit; ``1`` for none.
        max_length: Maximum number of characters of the text.
    """
    return format_label(sanitise(name, max_length), sanitise(unit, 12))


def has_extended_model(report: DiagnosisReportData) -> bool:
    """Return whether there is an extended model to show next to the base model."""
    return bool(report.verdict.causes)


def select_gap_locations(places: Sequence[GapLocation]) -> list[GapLocation]:
    """Select the runs, channels and phases with the largest gaps, in their original order.

    A gap location is such a part of the data with its RMS residual. Those without samples are left
    out.

    Args:
        places: Gap locations with their RMS residual before the causes are added.
    """
    selected: list[GapLocation] = []
    # A part without samples has no RMS.
    measured_locations = [p for p in places if np.isfinite(p.before) and p.samples > 0]
    for kind, max_count in (
        ("run", MAX_RUNS),
        ("channel", MAX_GAP_LOCATIONS),
        ("phase", MAX_GAP_LOCATIONS),
    ):
        locations_of_kind = [p for p in measured_locations if p.kind == kind]
        worst_locations = sorted(locations_of_kind, key=lambda p: -p.before)[:max_count]
        # The original order is kept, because readers look for run 3 after run 2.
        selected += [p for p in locations_of_kind if p in worst_locations]
    return selected


def draw_gap_location_panel(
    axis: Axes, places: Sequence[GapLocation], report: DiagnosisReportData
) -> None:
    """Draw the RMS by run, channel and phase, with the range for white noise.

    Args:
        axis: Axes to draw on.
        places: Gap locations to draw.
        report: Report data.
    """
    row_positions = _place_rows(axis, places)
    # The RMS of n noise samples has a standard deviation of 1 / sqrt(2 n); two of them are drawn.
    noise = [min(2 / (2 * p.samples) ** 0.5, _WIDEST) for p in places]
    floor = np.ones(len(row_positions))
    axis.errorbar(
        floor,
        row_positions,
        xerr=noise,
        fmt="none",
        ecolor=NULL_LEVEL_GREY,
        elinewidth=7,
        label=_WHITE_NOISE,
    )
    axis.axvline(1.0, color=NEUTRAL_MARK, linewidth=1.0, linestyle=":", label=_FLOOR)
    before_values = [p.before for p in places]
    after_values = [p.after for p in places]
    if has_extended_model(report):
        axis.hlines(row_positions, after_values, before_values, color=CONNECTOR_GREY, linewidth=0.9)
        axis.plot(after_values, row_positions, linestyle="", label="after", **EXTENDED_MODEL_MARKER)
    name = "before" if has_extended_model(report) else "simulated (tuned)"
    axis.plot(before_values, row_positions, linestyle="", label=name, **BASE_MODEL_MARKER)
    shown_values = [*before_values, *after_values] if has_extended_model(report) else before_values
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
    for i, place in enumerate(places):
        is_new_kind = i == 0 or places[i - 1].kind != place.kind
        if not row_positions:
            row_positions.append(_FIRST)
        else:
            row_positions.append(row_positions[-1] + (_NEXT_KIND if is_new_kind else _NEXT))
        if is_new_kind:
            axis.text(
                -0.035,
                row_positions[-1] - 0.85,
                f"by {place.kind} (samples)",
                transform=axis.get_yaxis_transform(),
                ha="right",
                va="center",
                fontsize=8.5,
                weight="bold",
            )
    return row_positions


def get_legend_entries(axis: Axes) -> tuple[list[Any], list[str]]:
    """Return handles and labels of a legend in reading order."""
    handles, labels = axis.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    order = ("before", "simulated (tuned)", "after", _FLOOR, _WHITE_NOISE)
    present = [name for name in order if name in by_label]
    return [by_label[name] for name in present], present


def _use_log_axis_if_needed(axis: Axes, values: Sequence[float]) -> None:
    """Use a logarithmic axis with plain numbers if the values differ by a large factor.

    Args:
        axis: Axes whose horizontal scale is set.
        values: Values to be shown; only positive ones can be on a logarithmic axis.
    """
    positive = np.array([v for v in values if np.isfinite(v) and v > 0])
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
    """Return round ticks of a logarithmic axis; per decade 1, 2, 5 or fewer.

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
    """Select the profiles with the most significant residuals before the extension.

    Each variable comes once before any comes a second time.
    """
    measured_profiles = [p for p in profiles if np.isfinite(_compute_profile_significance(p))]
    strongest_first = sorted(measured_profiles, key=lambda p: -_compute_profile_significance(p))
    variables = [p.variable for p in strongest_first]
    is_repeated = [name in variables[:i] for i, name in enumerate(variables)]
    # The sort is stable: first profiles of each variable come first, each group by significance.
    order = np.argsort(is_repeated, kind="stable")
    return [strongest_first[i] for i in order[:MAX_PROFILES]]


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
    Bars are two standard errors of the mean to either side.

    Args:
        axis: Axes to draw on.
        profile: Residual in bins.
        unit: Unit of the channel.
        extended: Whether there is an extended model to draw.
        one_channel: Whether all panels show the same channel, which their heading names.
    """
    # Bins without samples have no mean.
    is_measured = np.isfinite(profile.before)
    centres = profile.centres[is_measured]
    bars = 2 * profile.error[is_measured]
    axis.axhline(0, color=ZERO_LINE_GREY, linewidth=0.6)
    curves = [
        (
            profile.before,
            {**BASE_MODEL_LINE, **BASE_MODEL_MARKER, "markersize": 4.5, "linewidth": 1.0},
        )
    ]
    if extended:
        curves.append(
            (
                profile.after,
                {
                    **EXTENDED_MODEL_LINE,
                    **EXTENDED_MODEL_MARKER,
                    "markersize": 3.5,
                    "linewidth": 1.2,
                },
            )
        )
    for values, curve_style in curves:
        axis.errorbar(centres, values[is_measured], yerr=bars, elinewidth=1.0, **curve_style)
    axis.set_xlabel(format_profile_label(profile))
    label = (
        "residual" if one_channel else f"residual of {sanitise(profile.channel, MAX_LABEL_LENGTH)}"
    )
    axis.set_ylabel(
        break_name(format_label(label, sanitise(unit, SHORT_LABEL_LENGTH)), MAX_LABEL_LENGTH)
    )
    axis.locator_params(nbins=5)


MAX_SAMPLES = 3000
"""Maximum number of samples drawn of a run; of a longer run the extremes of each part are drawn."""
MAX_OUTLINED_DOTS = 1000
"""Maximum number of dots drawn as vector outlines; more dots are rasterised in vector files too."""


class RunView(NamedTuple):
    """Run that a figure or chart shows.

    Attributes:
        data_split: Data split of the run.
        row: Index of the run in it.
        held_out: Whether the run is held out.
        sigma: (C,) Standard deviation of the noise of each channel.
        gap: RMS residual of the base model over all channels, in units of the noise.
    """

    data_split: DataSplit
    row: int
    held_out: bool
    sigma: Array
    gap: float

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.data_split.names[self.row]

    @property
    def times(self) -> Array:
        """Sample times (T,) of the run, s."""
        return self.data_split.times[self.row]

    def count_samples(self) -> int:
        """Count the sample times; one counts once, however many channels were recorded."""
        return int(np.isfinite(self.data_split.observed[self.row]).any(axis=1).sum())

    def get_samples(self, signal: str, channel_index: int) -> Array:
        """Return the samples (T,) of a channel.

        Args:
            signal: ``observed``, ``before`` (base model) or ``after`` (extended model).
            channel_index: index of the channel.
        """
        samples: Array = getattr(self.data_split, signal)
        return samples[self.row, : len(self.times), channel_index]

    def compute_residual(self, model: str, channel_index: int) -> Array:
        """Compute the residual (T,) of a channel in units of its noise.

        Args:
            model: ``before`` (base model) or ``after`` (extended model).
            channel_index: index of the channel.
        """
        observed = self.get_samples("observed", channel_index)
        difference = observed - self.get_samples(model, channel_index)
        residual: Array = difference / self.sigma[channel_index]
        return residual


def rank_runs(report: DiagnosisReportData) -> list[RunView]:
    """List all runs by descending gap, but the worst held-out run first, if there is any."""
    sigma = np.array([c.sigma for c in report.channels])
    runs = []
    for split in list_data_splits(report):
        squares = np.square((split.observed - split.before) / sigma)
        for row, run_squares in enumerate(squares):
            finite = run_squares[np.isfinite(run_squares)]
            gap = float(np.sqrt(finite.mean())) if finite.size else 0.0
            runs.append(RunView(split, row, split is report.held_out, sigma, gap))
    last_split = runs[-1].data_split
    runs.sort(key=lambda run: -run.gap)
    worst = next(run for run in runs if run.data_split is last_split)
    return [worst, *(run for run in runs if run is not worst)]


def select_worst_run(report: DiagnosisReportData) -> RunView:
    """Select the run with the largest gap in units of the noise, a held-out one if there is any."""
    return rank_runs(report)[0]


def format_selected_run(report: DiagnosisReportData, view: RunView) -> str:
    """Format the phrase of a caption that names a run and says why it is shown.

    For example "Run swing3, the held-out run with the largest gap".

    Args:
        report: content of the report, whose verdict gives the reason.
        view: the run that `select_worst_run` selected.
    """
    # `validation_run` is an adjective: "held-out" or "left-out".
    kind = f"{report.validation_run} run" if view.held_out else "run"
    reason = "that fits worst" if report.verdict.verdict == "adequate" else "with the largest gap"
    return f"Run {shorten_label(view.name)}, the {kind} {reason}"
