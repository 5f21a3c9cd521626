"""Charts of a comparison, and its labels and styles, for its page and its printed figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_curves import select_checkpoints, select_distance_checkpoints
from bench.benchmark.statistics.training_amortisation import (
    AT_ONCE,
    NEVER,
    TARGETS_PER_TRAINING,
    build_break_even_table,
    build_time_per_target_table,
    find_cheapest_tuners,
    map_break_even_counts,
    split_by_training,
)
from bench.benchmark.storage.result_folder import StoredComparison
from bench.figures.style import MarkStyle, TunerStyles
from bench.pages.chart import (
    Axis,
    AxisSpan,
    Panel,
    ReferenceLine,
    Series,
    SeriesKind,
    make_method_series,
)
from bench.pages.text_format import format_number

PANEL_TITLES = {
    "in": "Targets in the training range",
    "wide": "Targets anywhere in the bounds",
    "real": "Recording",
    "obs_error": "Runs tuned on",
    "heldout_error": "Held-out runs, open loop",
}
"""Panel titles: ranges of targets, or kinds of runs of a recording."""


class AxisLabels(NamedTuple):
    """Axis labels of a comparison.

    Attributes:
        channel: Error channel with unit, e.g. ``q [rad]``.
        parameter: Name of the parameter, e.g. ``restitution``; empty for several parameters.
    """

    channel: str
    parameter: str


def make_axis_labels(experiment: Experiment) -> AxisLabels:
    """Make the axis labels of a comparison, with units.

    The label of a parameter is empty if there are several, because they share no unit. The problem
    is built to find the names and units of its parameters and channels, which takes time.
    """
    problem = TuningProblem(experiment)
    problem.close()
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    parameter = ""
    if len(parameters) == 1:
        unit = parameters[0].unit
        # The unit of a pure number is "1".
        parameter = parameters[0].name + (f" [{unit}]" if unit != "1" else "")
    return AxisLabels(f"{channel.name} [{channel.unit}]", parameter)


@dataclass(frozen=True)
class ComparisonView:
    """A comparison as charts and pages show it.

    Attributes:
        stored: Content of its folder.
        labels: Axis labels.
        statistics: Its statistics.
    """

    stored: StoredComparison
    labels: AxisLabels
    statistics: ComparisonStatistics

    @property
    def experiment(self) -> Experiment:
        """The experiment that was run."""
        return self.stored.experiment

    @property
    def is_recording(self) -> bool:
        """True if the target is a recording, whose true parameters are unknown."""
        return "real" in self.experiment.ranges

    @property
    def ranges(self) -> list[str]:
        """Ranges that have runs, in the experiment's order."""
        return [kind for kind in self.experiment.ranges if kind in self.statistics.target_counts]

    @cached_property
    def style(self) -> TunerStyles:
        """Styles of the tuners, and their order by the deciding error."""
        statistics = self.statistics
        return TunerStyles(self.experiment, statistics.order, notes=statistics.notes)

    def get_tuner_styles(self, tuners: Iterable[str]) -> dict[str, MarkStyle]:
        """Return the styles of the tuners of a column, best first."""
        present_tuners = set(tuners)
        names = [name for name in self.style.order if name in present_tuners]
        return {name: self.style.get_mark_style(name) for name in names}

    @property
    def levels(self) -> list[float]:
        """Error thresholds with costs, beginning with the one of printed figures."""
        first = self.statistics.reference_level
        return [first, *(level for level in self.statistics.tuning_costs if level != first)]

    @property
    def shown_metric(self) -> str:
        """The deciding error; for a single parameter in its own unit."""
        metric = self.statistics.metric
        return self.statistics.parameter_error_metric if metric == "param_error" else metric

    @property
    def unit_of_levels(self) -> str:
        """Unit of the error thresholds, with brackets; empty for that of the error."""
        in_widths = self.statistics.metric in ("param_error", "stiff_error")
        return " [training widths]" if in_widths else ""

    def format_metric_label(self, metric: str) -> str:
        """Return the axis label of an error, with its unit.

        Errors along stiff directions are those of parameter combinations that the data determine,
        sloppy ones those of the others. A training width is the width of the range of a parameter
        in which learned tuners train.

        Args:
            metric: Column of the run table, such as "param_error" or "obs_error".
        """
        channel, parameter = self.labels
        return {
            "param_abs_error": (
                f"absolute error of {parameter}"
                if parameter
                else "mean parameter error [training widths]"
            ),
            "param_error": "mean parameter error [training widths]",
            "stiff_error": "error along stiff directions [training widths]",
            "sloppy_error": "error along sloppy directions [training widths]",
            "obs_error": f"RMSE of {channel}" + (", runs tuned on" if self.is_recording else ""),
            "heldout_error": f"RMSE of {channel}, "
            + ("held-out runs" if self.is_recording else "unseen scenarios"),
        }[metric]


SIDE_BY_SIDE = "targets"
"""Facet of the ranges of targets, whose panels are side by side."""
DIRECTIONAL_METRICS = ("stiff_error", "sloppy_error", "heldout_error")
_THINNING_STEP = 3
"""Step between the stored points of a smooth curve."""


@dataclass(frozen=True)
class ComparisonChart:
    """Panels of a chart with the tables that they need.

    Attributes:
        panels: Panels of the chart; those without data are left out.
        tables: Tables by name.
        side_by_side: Facet whose panels are side by side.
        notes: Texts after names in the legend.
    """

    panels: Sequence[Panel]
    tables: Mapping[str, pd.DataFrame]
    side_by_side: str = SIDE_BY_SIDE
    notes: Mapping[str, str] = field(default_factory=dict)


def make_error_chart(view: ComparisonView) -> ComparisonChart:
    """Make the main chart: error against simulations.

    One panel per error measure and range of targets; the median over targets is drawn.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.

    Returns:
        The chart, with the tables that it draws.
    """
    runs = view.statistics.all_runs
    # The true parameters of a recording are unknown, so its error on held-out runs is shown.
    if view.is_recording:
        available_metrics = [m for m in ("heldout_error", "obs_error") if runs[m].notna().any()]
        return _make_median_chart(
            view, "errors", [(m, "real") for m in available_metrics], side_by_side="error"
        )
    metrics_and_ranges = [(view.statistics.parameter_error_metric, kind) for kind in view.ranges]
    # If the targets come from another simulator (`world`), the misfit has its own figure.
    if not view.experiment.world:
        metrics_and_ranges += [("obs_error", kind) for kind in view.ranges]
    return _make_median_chart(view, "errors", metrics_and_ranges)


def make_misfit_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of the misfit, for targets that come from another simulator.

    The misfit is the RMS error of the tuned simulator on the observations of a target. The smallest
    possible misfit is unknown; the smallest that any tuner reached is an upper bound, and is drawn
    as a line.

    Args:
        view: Comparison with its statistics and styles of tuners.
    """
    chart = _make_median_chart(view, "misfit", [("obs_error", kind) for kind in view.ranges])
    panels = []
    # There is one panel for each range, in this order.
    for panel, kind in zip(chart.panels, view.ranges, strict=False):
        runs = view.statistics.select_range(kind)
        # Smallest misfit of any tuner on each target, and its median over targets.
        smallest = float(runs.groupby("target")["obs_error"].min().median())
        text = f"smallest that any tuner reached: {format_number(smallest, 2)} (median)"
        panels.append(replace(panel, rules=(ReferenceLine(smallest, text), *panel.rules)))
    return replace(chart, panels=panels)


def make_directions_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of errors along stiff and sloppy directions, and of prediction."""
    keys = [(m, kind) for m in list_directional_metrics(view.stored) for kind in view.ranges]
    return _make_median_chart(view, "directions", keys)


def list_directional_metrics(stored: StoredComparison) -> list[str]:
    """List the errors of `make_directions_chart` that the runs have.

    A recording has none, since its held-out runs are drawn with its errors.
    """
    if "real" in stored.experiment.ranges:
        return []
    return [m for m in DIRECTIONAL_METRICS if m in stored.runs and stored.runs[m].notna().any()]


def _make_median_chart(
    view: ComparisonView,
    table: str,
    metrics_and_ranges: Sequence[tuple[str, str]],
    side_by_side: str = SIDE_BY_SIDE,
) -> ComparisonChart:
    """Make panels of median errors against the number of simulations.

    Args:
        view: comparison with its statistics, experiment and styles of tuners.
        table: name of the table of the panels.
        metrics_and_ranges: metric and range of targets of each panel.
        side_by_side: facet whose panels are side by side. A facet is a property by which a reader
            of the page chooses panels.
    """
    statistics, budget = view.statistics, view.experiment.budget
    x_axis = make_simulations_axis(budget)
    frames, panels = [], []
    for metric, kind in metrics_and_ranges:
        medians = statistics.compute_median_curves(metric, kind)
        frames.append(medians.assign(range=kind, metric=metric))
        conditions = {"range": kind, "metric": metric}
        lines = _make_tuner_series(view, medians, "median", "line", "low", "high", **conditions)
        label = view.format_metric_label(metric)
        panel = _make_panel(
            view, kind, table, "simulations", lines, x_axis, Axis(f"{label}, median", "log")
        )
        title = panel.title
        # A recording has one range only, so its panels are named after their errors.
        if kind == "real":
            title = f"{PANEL_TITLES[metric]} ({statistics.target_counts[kind]} starting points)"
        # Below this error tuners count as equal; None for a metric that decides nothing.
        floor = statistics.get_error_floor(metric)
        rules: tuple[ReferenceLine, ...] = ()
        if floor is not None:
            rules = (ReferenceLine(floor, f"below {floor:.2g}: count as equal"),)
        facets = {**panel.facets, "error": label}
        panels.append(replace(panel, facets=facets, rules=rules, title=title))
    return ComparisonChart(
        _select_panels_with_data(panels),
        {table: pd.concat(frames, ignore_index=True)},
        side_by_side,
        _make_notes(view, _find_coinciding_tuners(statistics, metrics_and_ranges)),
    )


def make_distance_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of the error against the target's distance from the training range.

    One panel per number of simulations; targets are binned by their distance from the range in
    which learned tuners were trained.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.

    Returns:
        The chart, with the table `distance`.
    """
    table = view.statistics.medians_by_distance
    label = f"{view.format_metric_label(view.statistics.parameter_error_metric)}, median"
    x_axis = Axis(
        "distance from the training range [range widths]", names=tuple(format_bin_labels(table))
    )
    panels = []
    for simulations in select_distance_checkpoints(view.experiment.budget):
        series = _make_tuner_series(
            view, table, "median", "points", "low", "high", simulations=str(simulations)
        )
        # A facet is a property by which a reader of the page chooses panels.
        facets = {"after": f"{simulations} simulations"}
        title = f"After {simulations} simulations"
        panels.append(Panel(title, "distance", "bin", series, x_axis, Axis(label, "log"), facets))
    return ComparisonChart(panels, {"distance": table}, "after", _make_notes(view))


def make_simulations_axis(budget: int) -> Axis:
    """Make the axis of the number of simulations, up to a budget.

    Args:
        budget: Largest number of simulations per run.

    Returns:
        Axis that is logarithmic above 1 and linear below (`symlog`), with a tick at each
        checkpoint.
    """
    ticks = tuple(float(k) for k in select_checkpoints(budget))
    return Axis(
        "simulations used on the target",
        "symlog",
        ("symlog", "linear"),
        ticks,
        # Marks at the ends must not be cut off.
        ends=(-0.08, budget * 1.1),
    )


def make_runtime_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of runtime distributions over all thresholds.

    A runtime distribution is the share of pairs (run, error threshold) that are reached within a
    number of simulations.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.

    Returns:
        The chart, with the table `runtime`.
    """
    table = view.statistics.runtime_distribution
    budget = int(table["simulations"].max())
    x_axis = make_simulations_axis(budget)
    # A margin of 0.02, so that lines at 0 and 1 are visible.
    y_axis = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
    panels = []
    for kind in dict.fromkeys(table["range"]):
        # Steps, not slopes: no threshold is reached between two simulations.
        lines = _make_tuner_series(
            view, table[table["range"] == kind], "share", "steps", range=kind
        )
        panel = _make_panel(view, kind, "runtime", "simulations", lines, x_axis, y_axis)
        # The title counts only the targets that have the deciding error.
        targets = view.statistics.curves.select(range=str(kind)).keys["target"].nunique()
        panels.append(replace(panel, title=f"{PANEL_TITLES[str(kind)]} ({targets} targets)"))
    return ComparisonChart(panels, {"runtime": table}, notes=_make_notes(view))


def make_ert_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of the expected running time against the error to be reached.

    The expected running time (ERT) is the mean number of simulations until an error is reached,
    with failed runs restarted.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.
    """
    statistics = view.statistics
    table = statistics.sort_rows(statistics.running_times)
    x_axis = Axis(f"error to be reached{view.unit_of_levels}", "log")
    y_axis = Axis("expected simulations (ERT)", "log")
    panels = []
    for kind in view.ranges:
        lines = _make_tuner_series(view, table, "ert", "line", "low", "high", range=kind)
        panels.append(_make_panel(view, kind, "ert", "threshold", lines, x_axis, y_axis))
    return ComparisonChart(_select_panels_with_data(panels), {}, notes=_make_notes(view))


def make_cost_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of seconds per target by the cost of a simulation, with the winners.

    One panel for each range of targets and error threshold that has to be reached. The seconds per
    target contain the training cost of learned tuners, divided among `TARGETS_PER_TRAINING`
    targets. A bar at the foot of a panel names the cheapest tuner at each cost of a simulation.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.

    Returns:
        The chart, with a thinned table `seconds`.
    """
    x_axis = Axis("seconds per simulation", "log")
    y_axis = Axis("seconds per target", "log")
    tables, panels = [], []
    for level in view.levels:
        costs = view.statistics.tuning_costs[level]
        table = build_time_per_target_table(costs)
        # Position of each point on its tuner's curve; the curves are smooth, so a part of the
        # points is enough.
        point_index = table.groupby(["range", "tuner"]).cumcount()
        tables.append(table[point_index % _THINNING_STEP == 0].assign(threshold=level))
        for kind in view.ranges:
            winners = list(find_cheapest_tuners(costs.get(kind, {}), TARGETS_PER_TRAINING))
            mark_styles = view.get_tuner_styles(tuner for _, _, tuner in winners)
            # `foot`: a strip at the bottom of the panel, not its whole height.
            spans = tuple(
                AxisSpan(low, high, tuner, mark_styles[tuner], foot=True)
                for low, high, tuner in winners
            )
            conditions = {"range": kind, "threshold": str(level)}
            lines = _make_tuner_series(
                view, table[table["range"] == kind], "seconds", "line", **conditions
            )
            panel = _make_panel(view, kind, "seconds", "simulation_seconds", lines, x_axis, y_axis)
            panels.append(_add_error_threshold(replace(panel, spans=spans), view, level))
    return ComparisonChart(
        _select_panels_with_data(panels), {"seconds": pd.concat(tables)}, notes=_make_notes(view)
    )


def make_amortisation_chart(view: ComparisonView) -> ComparisonChart:
    """Make the chart of the number of targets from which on a training pays.

    For each untrained tuner ("tuner that searches") and each learned tuner, the chart shows how
    many targets have to be tuned until the training has saved as many simulations as it cost. One
    panel for each range of targets and error threshold.

    Args:
        view: Comparison with its statistics, experiment and styles of tuners.

    Returns:
        The chart, with the table `even`.
    """
    # From a tenth of a target, since a training may pay at once.
    y_axis = Axis("number of targets at which training breaks even", "log", ends=(0.1, 1e5))
    rules = (
        ReferenceLine(AT_ONCE, "at once: the untrained tuner never reaches the error"),
        ReferenceLine(NEVER, "never: not within 10 000 targets"),
    )
    tables, panels = [], []
    for level in view.levels:
        costs = view.statistics.tuning_costs[level]
        searching, trained = split_by_training(costs, view.style.order)
        x_axis = Axis("tuner that searches", names=tuple(searching))
        for kind in view.ranges:
            break_even_rows = map_break_even_counts(
                build_break_even_table(view.experiment.name, kind, level, costs[kind])
            )
            break_even_rows = break_even_rows[break_even_rows["learned"].isin(trained)]
            # `row` is the position of the untrained tuner on the axis of names.
            tables.append(
                break_even_rows.assign(row=break_even_rows["search"].map(searching.index))
            )
            series = make_method_series(
                {name: view.style.get_mark_style(name) for name in trained},
                "learned",
                "targets",
                is_shifted=True,
                where={"range": kind, "threshold": str(level)},
                low="low",
                high="high",
                draw="points",
            )
            panel = _make_panel(view, kind, "even", "row", series, x_axis, y_axis)
            panels.append(_add_error_threshold(replace(panel, rules=rules), view, level))
    return ComparisonChart(
        _select_panels_with_data(panels), {"even": pd.concat(tables)}, notes=_make_notes(view)
    )


CHARTS: Mapping[str, Callable[[ComparisonView], ComparisonChart]] = {
    "error": make_error_chart,
    "misfit": make_misfit_chart,
    "distance": make_distance_chart,
    "runtime": make_runtime_chart,
    "cost": make_cost_chart,
    "amortisation": make_amortisation_chart,
    "directions": make_directions_chart,
    "ert": make_ert_chart,
}
"""Charts by name; all but ``ert`` are also printed figures."""


def _make_notes(
    view: ComparisonView, coinciding: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Make the notes of the legend, by tuner: failed runs and coinciding curves.

    Args:
        view: comparison with its statistics, experiment and styles of tuners.
        coinciding: notes on tuners whose curves lie on those of others; None for none.
    """
    parts = (view.statistics.notes, coinciding or {})
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: "; ".join(part[name] for part in parts if name in part) for name in names}


def _make_panel(
    view: ComparisonView,
    kind: str,
    table: str,
    x: str,
    series: tuple[Series, ...],
    x_axis: Axis,
    y_axis: Axis,
) -> Panel:
    """Make a panel of one range of targets, whose title has the number of targets.

    Args:
        view: comparison with its names, styles and metric.
        kind: range of the targets, such as ``wide``.
        table: name of the panel's table.
        x: column of the table for the horizontal axis.
        series: curves of the panel, one for each tuner.
        x_axis: horizontal axis.
        y_axis: vertical axis.
    """
    counted = "starting points" if kind == "real" else "targets"
    title = f"{PANEL_TITLES[kind]} ({view.statistics.target_counts[kind]} {counted})"
    return Panel(title, table, x, series, x_axis, y_axis, {SIDE_BY_SIDE: PANEL_TITLES[kind]})


def _add_error_threshold(panel: Panel, view: ComparisonView, level: float) -> Panel:
    """Add the error threshold to a panel's facets, among which a reader chooses panels.

    Args:
        panel: the panel.
        view: the comparison, with the unit of the thresholds.
        level: the threshold.
    """
    reached = f"{format_number(level)}{view.unit_of_levels}"
    return replace(panel, facets={**panel.facets, "error reached": reached})


def _make_tuner_series(
    view: ComparisonView,
    table: pd.DataFrame,
    y: str,
    draw: SeriesKind,
    low: str = "",
    high: str = "",
    **where: str,
) -> tuple[Series, ...]:
    """Make a series for each tuner of a table.

    Args:
        view: comparison with the style of each tuner.
        table: table with a column ``tuner``.
        y: column that is drawn.
        draw: how it is drawn, such as a line or points.
        low: column of the lower end of the interval; empty for none.
        high: column of the upper end.
        where: values of further columns, by which the rows are selected.

    Returns:
        Series in the order of the legend, the best tuner first.
    """
    styles = view.get_tuner_styles(table["tuner"])
    # Points of several tuners in one category are shifted, so that they lie side by side.
    options: dict[str, Any] = {"low": low, "high": high, "draw": draw, "where": where}
    return make_method_series(styles, "tuner", y, is_shifted=draw == "points", **options)


def _select_panels_with_data(panels: Sequence[Panel]) -> list[Panel]:
    """Select the panels with data; at least one, since its axes show what is missing."""
    return [panel for panel in panels if panel.series] or list(panels[:1])


_MAX_INVISIBLE_DIFFERENCE = 0.02
"""Relative difference of errors that is not visible on a logarithmic axis."""


def _find_coinciding_tuners(
    statistics: ComparisonStatistics, panels: Sequence[tuple[str, str]]
) -> dict[str, str]:
    """Find tuners whose curves are hidden below another curve in all panels of a chart.

    Args:
        statistics: statistics of the comparison, with its median curves.
        panels: metric and range of targets of each panel.

    Returns:
        Note by tuner, such as ``same as hybrid up to 2``.
    """
    curves_by_tuner: dict[str, list[pd.Series[float]]] = {}
    for metric, kind in panels:
        medians = statistics.compute_median_curves(metric, kind)
        for tuner, curve in medians.groupby("tuner", sort=False):
            curves_by_tuner.setdefault(str(tuner), []).append(
                curve.set_index("simulations")["median"]
            )
    return find_coinciding_curves(curves_by_tuner)


def find_coinciding_curves(
    curves_by_tuner: Mapping[str, Sequence[pd.Series[float]]],
) -> dict[str, str]:
    """Find curves that cannot be seen because another one is drawn above them.

    A reader would miss a tuner in the figure, so a note names the tuner that covers it. A curve
    coincides with a later one up to k simulations if the two differ by less than
    `_MAX_INVISIBLE_DIFFERENCE` in every panel up to k, and if the error has halved by then. Before
    that most tuners are equal.

    Args:
        curves_by_tuner: curves of each tuner in drawing order, one per panel: medians by number of
            simulations.

    Returns:
        Note by tuner whose curve is covered: ``same as hybrid up to 2``, or ``same as hybrid``.
    """
    notes = {}
    names = list(curves_by_tuner)
    for name_index, name in enumerate(names):
        curves = curves_by_tuner[name]
        longest_coincidence = 0
        for upper_name in names[name_index + 1 :]:
            upper_curves = curves_by_tuner[upper_name]
            # A tuner that misses a panel covers nothing there.
            if len(upper_curves) != len(curves):
                continue
            # Number of simulations up to which the two look the same in every panel.
            last_equal = min(map(_count_equal_simulations, curves, upper_curves))
            has_progress = any(
                (curve.loc[:last_equal] < 0.5 * curve.iloc[0]).any() for curve in curves
            )
            if last_equal > longest_coincidence and has_progress:
                longest_coincidence = last_equal
                is_whole_curve = all(last_equal == curve.index[-1] for curve in curves)
                suffix = "" if is_whole_curve else f" up to {last_equal}"
                notes[name] = f"same as {upper_name}{suffix}"
    return notes


def _count_equal_simulations(first: pd.Series[float], second: pd.Series[float]) -> int:
    """Return the largest number of simulations up to which two curves look the same; 0 for none.

    Args:
        first: errors, by number of simulations.
        second: errors of another tuner, by number of simulations.
    """
    # Numbers of simulations that both curves have.
    points = first.index.intersection(second.index)
    first_errors, second_errors = first[points].to_numpy(), second[points].to_numpy()
    # True up to the first visible difference.
    is_equal = np.logical_and.accumulate(
        np.abs(first_errors - second_errors)
        <= _MAX_INVISIBLE_DIFFERENCE * np.maximum(first_errors, second_errors)
    )
    return int(points[is_equal][-1]) if is_equal.any() else 0


def format_bin_labels(table: pd.DataFrame) -> list[str]:
    """Return labels of the groups of `compute_medians_by_distance`, with numbers of targets.

    Args:
        table: Result of `compute_medians_by_distance`, with the limits of each bin.
    """
    first = {int(row["bin"]): row for row in table.drop_duplicates("bin").to_dict("records")}
    names = []
    for bin_index in range(max(first, default=0) + 1):
        row = first.get(bin_index)
        # Only group 0, inside the training range, can be without targets.
        if row is None:
            names.append("inside\nn=0")
            continue
        # Equal limits are written once.
        limits = [f"{row[end]:.2f}" for end in ("beyond", "to")]
        name = "–".join(dict.fromkeys(limits)) if bin_index else "inside"
        names.append(f"{name}\nn={row['targets']}")
    return names
