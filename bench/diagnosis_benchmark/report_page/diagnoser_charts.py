"""Interactive charts of the report of a comparison of diagnosers, drawn from its tables."""

from __future__ import annotations

import pandas as pd

from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import P_VALUE_LEVELS, PRIMARY_METRIC, SET_SIZE_LABELS
from bench.figures.style import GREY, make_mark_style
from bench.pages.chart import Axis, Chart, Panel, ReferenceLine, Series
from bench.pages.html_elements import make_paragraph, safe
from bench.pages.html_page import HtmlPage

_SHARES = (
    ("false alarms", "alarms"),
    ("named, alone", "alone"),
    (PRIMARY_METRIC, "set of 2"),
    ("something seen", "seen"),
    ("pairs: both named", "pairs"),
    ("foreign causes: unknown or partial", "foreign"),
    ("95 % intervals that hold", "intervals"),
)
"""Metrics of the chart of fractions, each with its label on the axis."""
_SHARE = (-0.03, 1.03)
"""Limits of an axis of fractions."""
_WILSON = "Bars: 95 % (Wilson)."


def render_leaderboard_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the chart of diagnosed single causes against false alarms."""
    table = shown.tables["table"]
    parts = {
        metric: table[table["metric"] == metric].set_index("diagnoser")
        for metric in ("false alarms", PRIMARY_METRIC)
    }
    alarms, named = parts["false alarms"], parts[PRIMARY_METRIC]
    if not (alarms["of"].any() and named["of"].any()):
        return ""
    frame = named.assign(alarms=100 * alarms["share"]).reset_index()
    for name in ("share", "low", "high"):
        frame[name] = 100 * frame[name]
    page.add_table("board", frame)
    across = Axis(
        "false alarms where nothing is hidden [%]",
        "symlog",
        ("symlog", "linear"),
        (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0),
        ends=(-0.15, 110.0),
    )
    up = Axis("single causes named [%]", scales=("linear",), ends=(-3.0, 103.0))
    rule = ReferenceLine(1.0, "1 %", "x")
    series = shown.make_interval_series("share")
    panel = Panel("", "board", "alarms", series, across, up, rules=(rule,))
    clean, asked = int(alarms["of"].max()), int(named["of"].max())
    caption = (
        f"{clean} recordings with nothing hidden, {asked} with one effect of at least one noise. "
        "Named: alone or in a set of at most two, equivalent effects being one. The best stand "
        f"left and high. {_WILSON}"
    )
    still = shown.make_static_figure(
        "board", "False alarms of each diagnoser against what it names."
    )
    title = "False alarms against what is named"
    return page.render_chart(Chart("board", title, caption, (panel,), still))


def render_shares_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the chart of all fractions of table.csv, one category per metric."""
    table = shown.tables["table"]
    there = [(m, says) for m, says in _SHARES if table.loc[table["metric"] == m, "of"].any()]
    if not there:
        return ""
    place = {metric: i for i, (metric, _) in enumerate(there)}
    frame = table[table["metric"].isin(place)].assign(place=lambda t: t["metric"].map(place))
    page.add_table("shares", frame)
    most = frame.groupby("metric")["of"].max()
    names = tuple(f"{says}\nn={int(most[metric])}" for metric, says in there)
    across = Axis("what is counted; n answers or intervals at most", names=names)
    up = Axis("share", scales=("linear",), ends=_SHARE)
    panel = Panel(
        "", "shares", "place", shown.make_interval_series("share", beside=True), across, up
    )
    caption = (
        "False alarms where nothing is hidden; single causes named alone, in a set of at most two, "
        "and seen at all; pairs of which both are named; foreign causes told as unknown; 95 % "
        "intervals that hold. Of alarms less is better, of the others more. Bars: 95 %, of alarms "
        "Clopper-Pearson's, else Wilson's. Intervals that overlap widely say little."
    )
    chart = Chart("shares", "Alarms, names, pairs, foreign causes", caption, (panel,))
    return page.render_chart(chart)


def render_power_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the fractions diagnosed and detected against the size of the hidden effect."""
    frame = shown.tables["power"]
    if frame.empty:
        return ""
    page.add_table("power", frame)
    sizes = tuple(sorted(float(size) for size in frame["size"].unique()))
    across = Axis("size of the hidden effect [noises]", "log", ticks=sizes)
    panels = []
    for metric, says in (("named", "named, in a set of at most two"), ("seen", "something seen")):
        up = Axis(f"share {metric}", scales=("linear",), ends=_SHARE)
        lines = shown.make_line_series("share", frame, metric=metric)
        facets = {"what": says}
        panels.append(Panel(says.capitalize(), "power", "size", lines, across, up, facets))
    counts = frame[(frame["metric"] == "named") & (frame["diagnoser"] == frame["diagnoser"].iat[0])]
    said = ", ".join(f"{int(n)} of {s:g} noises" for s, n in counts[["size", "of"]].to_numpy())
    caption = f"Recordings with one hidden effect: {said}. {_WILSON} Who alarms always sees all."
    still = shown.make_static_figure(
        "power", "The share named and seen by each diagnoser against the size."
    )
    chart = Chart("power", "Power against size", caption, tuple(panels), still, "what")
    return page.render_chart(chart)


def render_calibration_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the fraction of clean recordings whose p-value is below a level, against the level."""
    frame = shown.tables["calibration"]
    if frame.empty:
        return ""
    fair = pd.DataFrame({"diagnoser": "", "level": P_VALUE_LEVELS, "share": P_VALUE_LEVELS})
    page.add_table("calibration", pd.concat([frame, fair], ignore_index=True))
    ideal = Series(
        "a p value that is one", "share", make_mark_style(GREY, (4.0, 3.0)), {"diagnoser": ""}
    )
    across = Axis("level", "log", ticks=P_VALUE_LEVELS)
    up = Axis("share of clean recordings with p below", scales=("linear",), ends=_SHARE)
    lines = (*shown.make_line_series("share", frame), ideal)
    panel = Panel("", "calibration", "level", lines, across, up)
    caption = (
        f"Up to {int(frame['of'].max())} recordings with nothing hidden, of diagnosers that give p "
        "values. Above the dashes it alarms too often, below it is too careful. Bars: 95 % "
        "(Clopper-Pearson)."
    )
    still = shown.make_static_figure(
        "calibration", "How often p is at most a level where nothing is hidden."
    )
    title = "Calibration of p"
    return page.render_chart(Chart("calibration", title, caption, (panel,), still))


def render_set_size_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the number and correctness of answers by the size of their largest set of causes."""
    frame = shown.tables["sets"]
    if not frame["of"].any():
        return ""
    place = {said: i for i, said in enumerate(SET_SIZE_LABELS)}
    page.add_table("sets", frame.assign(place=frame["largest_set"].map(place)))
    across = Axis("effects in the largest set of an answer", names=tuple(place))
    points = shown.make_interval_series("share", beside=True)
    counts = tuple(
        Series(one.name, "of", one.look, one.where, draw="points", shift=one.shift)
        for one in points
    )
    up = Axis("share that holds the truth", scales=("linear",), ends=_SHARE)
    many = Axis("answers of this size", scales=("linear",), holds=(0.0,))
    panels = (
        Panel("Held", "sets", "place", points, across, up, {"what": "held"}),
        Panel("How many", "sets", "place", counts, across, many, {"what": "how many"}),
    )
    caption = (
        "Answers about single effects of at least one noise that name something. A set is only as "
        f"good as it is small. {_WILSON}"
    )
    title = "Sets by their size"
    return page.render_chart(Chart("sets", title, caption, panels, None, "what"))


def render_cost_chart(shown: DiagnoserReportData, page: HtmlPage) -> str:
    """Render the chart of diagnosed single causes against the cost of an answer."""
    table, costs = shown.tables["table"], shown.tables["costs"]
    named = table[(table["metric"] == PRIMARY_METRIC) & (table["of"] > 0)]
    frame = named.merge(costs, on="diagnoser")
    if frame.empty:
        return ""
    page.add_table("cost", frame)
    up = Axis("share of single causes named", scales=("linear",), ends=_SHARE)
    panels = []
    for column, label in (
        ("simulations_median", "simulations for an answer, median"),
        ("processor_seconds_median", "processor time for an answer [s], median"),
    ):
        across = Axis(label, "log")
        facets = {"cost": label}
        panels.append(
            Panel("", "cost", column, shown.make_interval_series("share"), across, up, facets)
        )
    caption = f"Left and high is better. {_WILSON} {_learned(costs)}"
    still = shown.make_static_figure(
        "cost", "What an answer of each diagnoser costs against what it names."
    )
    return page.render_chart(
        Chart("cost", "Cost against truth", caption, tuple(panels), still, "cost")
    )


def _learned(costs: pd.DataFrame) -> str:
    """Say how many training simulations each trained diagnoser has used."""
    told = costs[costs["training_simulations"] > 0]
    return " ".join(
        f"{safe(name, 60)} has learned from {count:,} simulations before.".replace(",", " ")
        for name, count in told[["diagnoser", "training_simulations"]].itertuples(index=False)
    )


def render_static_figures(
    shown: DiagnoserReportData, page: HtmlPage, *names: tuple[str, str, str]
) -> str:
    """Render figures that have no interactive version.

    Args:
        shown: data of the report.
        page: page that receives the figures.
        *names: name, title and caption of each figure.
    """
    parts = []
    for name, title, caption in names:
        if still := shown.make_static_figure(name, caption):
            parts.append(f"<h3>{safe(title)}</h3>")
            parts.append(page.render_figure(f"{name}-figure", still, safe(caption)))
    return "\n".join(parts) or make_paragraph("There is nothing to draw.", "soft")
