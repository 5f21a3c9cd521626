"""Charts of a comparison, with the same numbers as its tables and printed figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import pandas as pd

from bench.analysis.amortisation import AT_ONCE, NEVER, SHARED, placed_even, seconds_table
from bench.analysis.medians import bin_names, moments
from bench.analysis.table import checkpoints
from bench.figures import errors
from bench.figures.identifiability import directional
from bench.figures.runtimes import break_even_sides, spread_caption
from bench.figures.style import TITLES
from bench.pages.chart import Axis, Chart, Draw, Panel, Rule, Series, Span
from bench.pages.comparison.results import Results
from bench.pages.elements import safe
from bench.pages.page import Page
from bench.pages.text import number

_DIGITS = 7
"""Number of significant digits of values that are in no file next to the page."""
_THIN = 3
"""Step between the stored points of a smooth curve."""
_MEDIAN = (
    "A line is the median over targets of the recommendation's error (mean over seeds), the band "
    "its 95 % bootstrap interval. Lower and further left is better."
)
_BESIDE = "targets"


def error_chart(results: Results, page: Page) -> str:
    """Build the main chart: error against simulations.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart.
    """
    shown = errors.panels(results.experiment, results.statistics, *results.labels)
    keys = [(panel.metric, panel.kind) for panel in shown]
    # If the targets come from another simulator, the misfit has its own figure.
    if "real" not in results.ranges and "misfit" not in results.pictures:
        keys += [("obs_error", kind) for kind in results.ranges]
    panels = [_against_simulations(results, "errors", *key) for key in keys]
    page.table("errors", _medians(results, keys), _DIGITS)
    same = results.statistics.coinciding(keys)
    still = results.still("error", "The median error of each tuner against simulations.")
    beside = "error" if "real" in results.ranges else _BESIDE
    return _shown(
        results,
        page,
        Chart("error", "Error against simulations", _MEDIAN, _filled(panels), still, beside),
        same,
    )


def misfit_chart(results: Results, page: Page) -> str:
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
    page.table("misfit", _medians(results, keys), _DIGITS)
    panels = []
    for kind in results.ranges:
        least = errors.least_misfit(results.statistics.of(kind))
        rule = Rule(least, f"least that any tuner reached: {number(least, 2)} (median)")
        panels.append(_against_simulations(results, "misfit", "obs_error", kind, (rule,)))
    caption = (
        "The targets come from another simulator. The dashed line is the least that any tuner "
        "reached: the gap that no parameter closes."
    )
    still = results.still("misfit", "The median misfit of each tuner against simulations.")
    chart = Chart("misfit", "What tuning leaves", caption, _filled(panels), still, _BESIDE)
    return _shown(results, page, chart)


def directions_chart(results: Results, page: Page) -> str:
    """Build the chart of errors along stiff and sloppy directions, and of prediction.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    metrics = directional(results.experiment, results.stored.runs)
    if "directions" not in results.pictures:
        return ""
    keys = [(metric, kind) for metric in metrics for kind in results.ranges]
    page.table("directions", _medians(results, keys), _DIGITS)
    panels = [_against_simulations(results, "directions", *key) for key in keys]
    caption = (
        f"{_MEDIAN} A sloppy direction is one that the target's data do not fix: nobody could know "
        "it, and an error there costs nobody anything. Choose the error above."
    )
    still = results.still("directions", "Errors along stiff and sloppy directions, of prediction.")
    title = "Stiff and sloppy directions, and prediction"
    return _shown(
        results, page, Chart("directions", title, caption, _filled(panels), still, _BESIDE)
    )


def distance_chart(results: Results, page: Page) -> str:
    """Build the chart of the error against the target's distance from the training range.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart; empty without such a figure.
    """
    if "distance" not in results.pictures:
        return ""
    table = results.statistics.distances
    page.table("distance", table, _DIGITS)
    names = tuple(bin_names(table))
    label = f"{results.label(results.statistics.parameter_metric)}, median"
    panels = []
    for k in moments(results.experiment.budget):
        series = tuple(
            Series(
                name,
                "median",
                drawn,
                {"tuner": name, "simulations": str(k)},
                "low",
                "high",
                "points",
                results.style.offset(name),
            )
            for name, drawn in results.looks(table["tuner"])
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
    still = results.still("distance", "The median error of each tuner by distance of the target.")
    title = "Error against distance from the training range"
    return _shown(results, page, Chart("distance", title, caption, tuple(panels), still, "after"))


def runtime_chart(results: Results, page: Page) -> str:
    """Build the chart of runtime distributions over all thresholds.

    Args:
        results: Results of the comparison.
        page: Page, to which the chart and its tables are added.

    Returns:
        HTML of the chart.
    """
    table = results.statistics.shares
    page.table("runtime", table, _DIGITS)
    panels = []
    for kind in dict.fromkeys(table["range"]):
        lines = _lines(results, table[table["range"] == kind], "share", "steps", range=kind)
        up = Axis("share of (run, threshold) pairs reached", scales=("linear",), ends=(-0.02, 1.02))
        across = _simulations(results)
        panels.append(_panel(results, kind, "runtime", "simulations", lines, across, up))
    caption = (
        f"{safe(spread_caption(results.statistics.spread))} Higher is better; where a line ends "
        "is what can be solved at all."
    )
    still = results.still("runtime", "The share of thresholds reached by each tuner.")
    return _shown(
        results,
        page,
        Chart("runtime", "Runtime distributions", caption, tuple(panels), still, _BESIDE),
    )


def ert_chart(results: Results, page: Page) -> str:
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


def cost_chart(results: Results, page: Page) -> str:
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
        table = seconds_table(results.statistics.prices[level])
        parts.append(_thinned(table.assign(threshold=level), _THIN))
        for kind in results.ranges:
            won = wins[(wins["range"] == kind) & (wins["threshold"] == level)]
            looks = dict(results.looks(won["tuner"]))
            spans = tuple(
                Span(
                    row["from_seconds"], row["to_seconds"], row["tuner"], looks[row["tuner"]], True
                )
                for row in won.to_dict("records")
            )
            where = {"range": kind, "threshold": str(level)}
            lines = _lines(results, table[table["range"] == kind], "seconds", "line", **where)
            across, up = _log("seconds that one simulation takes"), _log("seconds for one target")
            panel = _panel(results, kind, "seconds", "simulation_seconds", lines, across, up, spans)
            panels.append(_with(panel, results, level))
    page.table("seconds", pd.concat(parts), _DIGITS)
    caption = (
        "Expected simulations times the seconds of one, and the tuner's own seconds as measured; a "
        f"training is shared by {SHARED} targets. The strip at the foot names who needs the least. "
        "A tuner without a line never reached the error."
    )
    still = results.still("cost", "Seconds for one target against seconds of one simulation.")
    title = "Who wins at which cost of a simulation"
    return _shown(results, page, Chart("cost", title, caption, _filled(panels), still, _BESIDE))


def amortisation_chart(results: Results, page: Page) -> str:
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
        searching, learning = break_even_sides(results.statistics.prices[level], results.style)
        part = evens[(evens["threshold"] == level) & evens["learned"].isin(learning)]
        parts.append(part.assign(row=part["search"].map(searching.index)))
        across = Axis("tuner that searches", names=tuple(searching))
        up = _log("number of targets from which on training pays")
        rules = (
            Rule(AT_ONCE, "at once: the search never reaches the error"),
            Rule(NEVER, "never: not within 10 000 targets"),
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
                for place, (name, drawn) in enumerate(results.looks(part["learned"]))
            )
            panel = _panel(results, kind, "even", "row", series, across, up)
            panels.append(_with(replace(panel, rules=rules), results, level))
    page.table("even", pd.concat(parts), _DIGITS)
    caption = (
        "From a mark on, training plus targets times expected simulations of a trained tuner are "
        "fewer than those of a tuner that searches, to reach the error for good. Bars are 95 % "
        "bootstrap intervals over targets; lower is better for the training."
    )
    still = results.still("amortisation", "Number of targets from which on each training pays.")
    title = "From how many targets on a training pays"
    return _shown(
        results, page, Chart("amortisation", title, caption, _filled(panels), still, _BESIDE)
    )


def _shown(
    results: Results, page: Page, chart: Chart, same: Mapping[str, str] = MappingProxyType({})
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
    return page.chart(replace(chart, notes=notes))


def _medians(results: Results, keys: Sequence[tuple[str, str]]) -> pd.DataFrame:
    frames = [
        results.statistics.medians(metric, kind).assign(range=kind, metric=metric)
        for metric, kind in keys
    ]
    return pd.concat(frames, ignore_index=True)


def _against_simulations(
    results: Results, table: str, metric: str, kind: str, rules: tuple[Rule, ...] = ()
) -> Panel:
    medians = results.statistics.medians(metric, kind)
    where = {"range": kind, "metric": metric}
    lines = _lines(results, medians, "median", "line", "low", "high", **where)
    label = results.label(metric)
    panel = _panel(
        results, kind, table, "simulations", lines, _simulations(results), _log(f"{label}, median")
    )
    facets = {**panel.facets, "error": label}
    # A recording has one range only; its panels differ in the runs.
    title = f"{label} ({results.count(kind)} starting points)" if kind == "real" else panel.title
    floor = results.statistics.floor_of(metric)
    if floor is not None:
        rules += (Rule(floor, f"below {number(floor, 2)}: count as equal"),)
    return replace(panel, facets=facets, rules=rules, title=title)


def _panel(
    results: Results,
    kind: str,
    table: str,
    x: str,
    lines: tuple[Series, ...],
    across: Axis,
    up: Axis,
    spans: tuple[Span, ...] = (),
) -> Panel:
    """Build a panel of one range of targets."""
    title = f"{TITLES[kind]} ({results.count(kind)} {'starts' if kind == 'real' else 'targets'})"
    return Panel(title, table, x, lines, across, up, {_BESIDE: TITLES[kind]}, spans=spans)


def _with(panel: Panel, results: Results, level: float) -> Panel:
    """Add the error threshold to a panel's facets."""
    reached = f"{number(level)}{_in_widths(results)}"
    return replace(panel, facets={**panel.facets, "error reached": reached})


def _lines(
    results: Results,
    table: pd.DataFrame,
    y: str,
    draw: Draw,
    low: str = "",
    high: str = "",
    **where: str,
) -> tuple[Series, ...]:
    """Make a series for each tuner of a table."""
    return tuple(
        Series(name, y, drawn, {"tuner": name, **where}, low, high, draw)
        for name, drawn in results.looks(table["tuner"])
    )


def _thinned(table: pd.DataFrame, step: int) -> pd.DataFrame:
    """Keep every `step`-th row of each range and tuner."""
    return table[table.groupby(["range", "tuner"]).cumcount() % step == 0]


def _levels(results: Results) -> list[float]:
    """List the error thresholds with costs, beginning with the one of printed figures."""
    first = results.statistics.level
    return [first, *(level for level in results.statistics.prices if level != first)]


def _in_widths(results: Results) -> str:
    inside = results.statistics.metric in ("param_error", "stiff_error")
    return " [training widths]" if inside else ""


def _simulations(results: Results) -> Axis:
    budget = results.experiment.budget
    ticks = tuple(float(k) for k in checkpoints(budget))
    label = "simulations used on the target"
    return Axis(label, "symlog", ("symlog", "linear"), ticks, ends=(-0.08, budget * 1.1))


def _log(label: str) -> Axis:
    return Axis(label, "log")


def _filled(panels: Sequence[Panel]) -> tuple[Panel, ...]:
    """Select the panels with data; at least one, since its axes show what is missing."""
    return tuple(panel for panel in panels if panel.series) or tuple(panels[:1])
