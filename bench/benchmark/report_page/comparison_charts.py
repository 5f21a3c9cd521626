"""Charts of a comparison, with the same numbers as its tables and printed figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import pandas as pd

from bench.benchmark.figures import error_figures
from bench.benchmark.figures.identifiability_figures import list_directional_metrics
from bench.benchmark.figures.runtime_figures import break_even_sides, format_threshold_caption
from bench.benchmark.report_page.comparison_page_data import ComparisonReportData
from bench.benchmark.statistics.error_table import select_checkpoints
from bench.benchmark.statistics.median_curves import format_bin_labels, select_distance_checkpoints
from bench.benchmark.statistics.training_amortisation import (
    AT_ONCE,
    NEVER,
    TARGETS_PER_TRAINING,
    build_time_per_target_table,
    placed_even,
)
from bench.figures.style import PANEL_TITLES
from bench.pages.chart import Axis, AxisSpan, Chart, Panel, ReferenceLine, Series, SeriesKind
from bench.pages.html_elements import safe
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_number

_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""
_THIN = 3
"""Step between the stored points of a smooth curve."""
_MEDIAN = (
    "A line is the median over targets of the recommendation's error (mean over seeds), the band "
    "its 95 % bootstrap interval. Lower and further left is better."
)
_BESIDE = "targets"


def render_error_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the main chart: error against simulations.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart.
    """
    shown = error_figures.list_error_panels(results.experiment, results.statistics, *results.labels)
    keys = [(panel.metric, panel.kind) for panel in shown]
    # If the targets come from another simulator, the misfit has its own figure.
    if "real" not in results.ranges and "misfit" not in results.pictures:
        keys += [("obs_error", kind) for kind in results.ranges]
    panels = [_against_simulations(results, "errors", *key) for key in keys]
    page.add_table("errors", _medians(results, keys), _DIGITS)
    same = results.statistics.coinciding(keys)
    still = results.make_static_figure(
        "error", "The median error of each tuner against simulations."
    )
    beside = "error" if "real" in results.ranges else _BESIDE
    return _shown(
        results,
        page,
        Chart("error", "Error against simulations", _MEDIAN, _filled(panels), still, beside),
        same,
    )


def render_misfit_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of the misfit, if the targets come from another simulator.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    if "misfit" not in results.pictures:
        return ""
    keys = [("obs_error", kind) for kind in results.ranges]
    page.add_table("misfit", _medians(results, keys), _DIGITS)
    panels = []
    for kind in results.ranges:
        least = error_figures.compute_min_misfit(results.statistics.select_range(kind))
        rule = ReferenceLine(
            least, f"least that any tuner reached: {format_number(least, 2)} (median)"
        )
        panels.append(_against_simulations(results, "misfit", "obs_error", kind, (rule,)))
    caption = (
        "The targets come from another simulator. The dashed line is the least that any tuner "
        "reached: the gap that no parameter closes."
    )
    still = results.make_static_figure(
        "misfit", "The median misfit of each tuner against simulations."
    )
    chart = Chart("misfit", "What tuning leaves", caption, _filled(panels), still, _BESIDE)
    return _shown(results, page, chart)


def render_directions_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of errors along stiff and sloppy directions, and of prediction.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    metrics = list_directional_metrics(results.experiment, results.stored.runs)
    if "directions" not in results.pictures:
        return ""
    keys = [(metric, kind) for metric in metrics for kind in results.ranges]
    page.add_table("directions", _medians(results, keys), _DIGITS)
    panels = [_against_simulations(results, "directions", *key) for key in keys]
    caption = (
        f"{_MEDIAN} A sloppy direction is one that the target's data do not fix: nobody could know "
        "it, and an error there costs nobody anything. Choose the error above."
    )
    still = results.make_static_figure(
        "directions", "Errors along stiff and sloppy directions, of prediction."
    )
    title = "Stiff and sloppy directions, and prediction"
    return _shown(
        results, page, Chart("directions", title, caption, _filled(panels), still, _BESIDE)
    )


def render_distance_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of the error against the target's distance from the training range.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    if "distance" not in results.pictures:
        return ""
    table = results.statistics.medians_by_distance
    page.add_table("distance", table, _DIGITS)
    names = tuple(format_bin_labels(table))
    label = f"{results.format_metric_label(results.statistics.parameter_error_metric)}, median"
    panels = []
    for k in select_distance_checkpoints(results.experiment.budget):
        series = tuple(
            Series(
                name,
                "median",
                drawn,
                {"tuner": name, "simulations": str(k)},
                "low",
                "high",
                "points",
                results.style.get_category_offset(name),
            )
            for name, drawn in results.get_tuner_styles(table["tuner"])
        )
        across = Axis("distance from the training range [widths of it]", names=names)
        facets = {"after": f"{k} simulations"}
        panels.append(
            Panel(f"After {k} simulations", "distance", "bin", series, across, _log(label), facets)
        )
    caption = (
        "Marks are medians over targets, bars their 95 % bootstrap intervals; n targets a group. A "
        "tuner whose marks rise to the right does not extrapolate."
    )
    still = results.make_static_figure(
        "distance", "The median error of each tuner by distance of the target."
    )
    title = "Error against distance from the training range"
    return _shown(results, page, Chart("distance", title, caption, tuple(panels), still, "after"))


def render_runtime_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of runtime distributions over all thresholds.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart.
    """
    table = results.statistics.runtime_distribution
    page.add_table("runtime", table, _DIGITS)
    panels = []
    for kind in dict.fromkeys(table["range"]):
        lines = _lines(results, table[table["range"] == kind], "share", "steps", range=kind)
        up = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
        across = _simulations(results)
        panels.append(_panel(results, kind, "runtime", "simulations", lines, across, up))
    caption = (
        f"{safe(format_threshold_caption(results.statistics.spread))} Higher is better; "
        "where a line ends is what can be solved at all."
    )
    still = results.make_static_figure("runtime", "The share of thresholds reached by each tuner.")
    return _shown(
        results,
        page,
        Chart("runtime", "Runtime distributions", caption, tuple(panels), still, _BESIDE),
    )


def render_ert_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of the expected running time against the error to be reached.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart is added.

    Returns:
        HTML of the chart.
    """
    table = results.tables["ert"]
    panels = []
    for kind in results.ranges:
        lines = _lines(results, table, "ert", "line", "low", "high", range=kind)
        across = _log(f"error to be reached{_in_widths(results)}")
        up = _log("expected simulations (ERT)")
        panels.append(_panel(results, kind, "ert", "threshold", lines, across, up))
    caption = (
        "Simulations spent in all runs for each run that reached the error for good, with their "
        "95 % bootstrap interval over targets; a line ends where no run got further."
    )
    title = "Expected running time"
    return _shown(results, page, Chart("ert", title, caption, _filled(panels), None, _BESIDE))


def render_cost_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of seconds per target by the cost of a simulation, with the winners.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart.
    """
    parts, panels = [], []
    wins = results.tables["who_wins"]
    for level in _levels(results):
        table = build_time_per_target_table(results.statistics.tuning_costs[level])
        parts.append(_thinned(table.assign(threshold=level), _THIN))
        for kind in results.ranges:
            won = wins[(wins["range"] == kind) & (wins["threshold"] == level)]
            looks = dict(results.get_tuner_styles(won["tuner"]))
            spans = tuple(
                AxisSpan(
                    row["from_seconds"], row["to_seconds"], row["tuner"], looks[row["tuner"]], True
                )
                for row in won.to_dict("records")
            )
            where = {"range": kind, "threshold": str(level)}
            lines = _lines(results, table[table["range"] == kind], "seconds", "line", **where)
            across, up = _log("seconds that one simulation takes"), _log("seconds for one target")
            panel = _panel(results, kind, "seconds", "simulation_seconds", lines, across, up, spans)
            panels.append(_with(panel, results, level))
    page.add_table("seconds", pd.concat(parts), _DIGITS)
    caption = (
        "Expected simulations times the seconds of one, and the tuner's own seconds as measured; a "
        f"training is shared by {TARGETS_PER_TRAINING} targets. "
        "The strip at the foot names who needs the least. "
        "A tuner without a line never reached the error."
    )
    still = results.make_static_figure(
        "cost", "Seconds for one target against seconds of one simulation."
    )
    title = "Who wins at which cost of a simulation"
    return _shown(results, page, Chart("cost", title, caption, _filled(panels), still, _BESIDE))


def render_amortisation_chart(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the chart of the number of targets from which on a training pays.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    if "amortisation" not in results.pictures:
        return ""
    evens = placed_even(results.tables["break_even"])
    parts, panels = [], []
    for level in _levels(results):
        searching, learning = break_even_sides(
            results.statistics.tuning_costs[level], results.style
        )
        part = evens[(evens["threshold"] == level) & evens["learned"].isin(learning)]
        parts.append(part.assign(row=part["search"].map(searching.index)))
        across = Axis("tuner that searches", names=tuple(searching))
        up = _log("number of targets from which on training pays")
        rules = (
            ReferenceLine(AT_ONCE, "at once: the search never reaches the error"),
            ReferenceLine(NEVER, "never: not within 10 000 targets"),
        )
        for kind in results.ranges:
            series = tuple(
                Series(
                    name,
                    "targets",
                    drawn,
                    {"learned": name, "range": kind, "threshold": str(level)},
                    "low",
                    "high",
                    "points",
                    0.6 * ((place + 0.5) / len(learning) - 0.5),
                )
                for place, (name, drawn) in enumerate(results.get_tuner_styles(part["learned"]))
            )
            panel = _panel(results, kind, "even", "row", series, across, up)
            panels.append(_with(replace(panel, rules=rules), results, level))
    page.add_table("even", pd.concat(parts), _DIGITS)
    caption = (
        "From a mark on, training plus targets times expected simulations of a trained tuner are "
        "fewer than those of a tuner that searches, to reach the error for good. Bars are 95 % "
        "bootstrap intervals over targets; lower is better for the training."
    )
    still = results.make_static_figure(
        "amortisation", "Number of targets from which on each training pays."
    )
    title = "From how many targets on a training pays"
    return _shown(
        results, page, Chart("amortisation", title, caption, _filled(panels), still, _BESIDE)
    )


def _shown(
    results: ComparisonReportData,
    page: HtmlPage,
    chart: Chart,
    same: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Add a chart to the page; its legend notes failed runs and coinciding curves.

    Args:
        results: Results of the comparison.
        page: The page.
        chart: Chart without notes.
        same: Text about coinciding curves, by tuner.
    """
    failed = results.statistics.notes
    names = dict.fromkeys((*failed, *same))
    notes = {n: "; ".join(part[n] for part in (failed, same) if n in part) for n in names}
    return page.render_chart(replace(chart, notes=notes))


def _medians(results: ComparisonReportData, keys: Sequence[tuple[str, str]]) -> pd.DataFrame:
    frames = [
        results.statistics.compute_median_curves(metric, kind).assign(range=kind, metric=metric)
        for metric, kind in keys
    ]
    return pd.concat(frames, ignore_index=True)


def _against_simulations(
    results: ComparisonReportData,
    table: str,
    metric: str,
    kind: str,
    rules: tuple[ReferenceLine, ...] = (),
) -> Panel:
    medians = results.statistics.compute_median_curves(metric, kind)
    where = {"range": kind, "metric": metric}
    lines = _lines(results, medians, "median", "line", "low", "high", **where)
    label = results.format_metric_label(metric)
    panel = _panel(
        results, kind, table, "simulations", lines, _simulations(results), _log(f"{label}, median")
    )
    facets = {**panel.facets, "error": label}
    # A recording has one range only; its panels differ in the runs.
    title = (
        f"{label} ({results.count_targets(kind)} starting points)"
        if kind == "real"
        else panel.title
    )
    floor = results.statistics.floor_of(metric)
    if floor is not None:
        rules += (ReferenceLine(floor, f"below {format_number(floor, 2)}: count as equal"),)
    return replace(panel, facets=facets, rules=rules, title=title)


def _panel(
    results: ComparisonReportData,
    kind: str,
    table: str,
    x: str,
    lines: tuple[Series, ...],
    across: Axis,
    up: Axis,
    spans: tuple[AxisSpan, ...] = (),
) -> Panel:
    """Build a panel of one range of targets."""
    counted = "starts" if kind == "real" else "targets"
    title = f"{PANEL_TITLES[kind]} ({results.count_targets(kind)} {counted})"
    return Panel(title, table, x, lines, across, up, {_BESIDE: PANEL_TITLES[kind]}, spans=spans)


def _with(panel: Panel, results: ComparisonReportData, level: float) -> Panel:
    """Add the error threshold to a panel's facets."""
    reached = f"{format_number(level)}{_in_widths(results)}"
    return replace(panel, facets={**panel.facets, "error reached": reached})


def _lines(
    results: ComparisonReportData,
    table: pd.DataFrame,
    y: str,
    draw: SeriesKind,
    low: str = "",
    high: str = "",
    **where: str,
) -> tuple[Series, ...]:
    """Make a series for each tuner of a table."""
    return tuple(
        Series(name, y, drawn, {"tuner": name, **where}, low, high, draw)
        for name, drawn in results.get_tuner_styles(table["tuner"])
    )


def _thinned(table: pd.DataFrame, step: int) -> pd.DataFrame:
    """Keep every `step`-th row of each range and tuner."""
    return table[table.groupby(["range", "tuner"]).cumcount() % step == 0]


def _levels(results: ComparisonReportData) -> list[float]:
    """List the error thresholds with costs, beginning with the one of printed figures."""
    first = results.statistics.reference_level
    return [first, *(level for level in results.statistics.tuning_costs if level != first)]


def _in_widths(results: ComparisonReportData) -> str:
    inside = results.statistics.metric in ("param_error", "stiff_error")
    return " [training widths]" if inside else ""


def _simulations(results: ComparisonReportData) -> Axis:
    budget = results.experiment.budget
    ticks = tuple(float(k) for k in select_checkpoints(budget))
    label = "simulations used on the target"
    return Axis(label, "symlog", ("symlog", "linear"), ticks, ends=(-0.08, budget * 1.1))


def _log(label: str) -> Axis:
    return Axis(label, "log")


def _filled(panels: Sequence[Panel]) -> tuple[Panel, ...]:
    """Select the panels with data; at least one, since its axes show what is missing."""
    return tuple(panel for panel in panels if panel.series) or tuple(panels[:1])
