"""HTML report of a comparison of diagnosers: its data, charts, conclusions and warnings."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.diagnosis_benchmark.result_tables import (
    P_VALUE_LEVELS,
    PRIMARY_METRIC,
    REFERENCE_DIAGNOSER,
    SET_SIZE_BINS,
    TARGET_FALSE_ALARM_RATE,
    build_failure_table,
    index_by_diagnoser,
    is_correct,
    select_graded_answers,
)
from bench.figures.figure_output import FigureFiles
from bench.figures.style import (
    GREY,
    TRUSTED_TUNERS_NOTE,
    MarkStyle,
    get_mark_style,
    make_mark_style,
)
from bench.pages.chart import Axis, Panel, ReferenceLine, Series, make_method_series
from bench.pages.html_page import HtmlPage


@dataclass(frozen=True)
class DiagnoserReportData:
    """Data of a comparison of diagnosers that its HTML report displays.

    Attributes:
        experiment: the experiment that was run.
        folder: result folder.
        order: names of the diagnosers, in the order of their colours.
        rows: one row per answer, only for cases that every diagnoser has answered.
        tables: tables by name, see `bench.diagnosis_benchmark.result_tables.build_all_tables`.
        training: training costs, one row per diagnoser and system.
        pictures: printed figures by name.
        skipped: diagnosers that could not be run, with the reason.
        planned: number of cases in the case set.
        left_out: rows of cases that a diagnoser does not support; they count in no table.
    """

    experiment: Experiment
    folder: str
    order: Sequence[str]
    rows: pd.DataFrame
    tables: Mapping[str, pd.DataFrame]
    training: Sequence[Mapping[str, str]]
    pictures: Mapping[str, FigureFiles]
    skipped: Mapping[str, str]
    planned: int
    left_out: pd.DataFrame

    @property
    def title(self) -> str:
        """Title of the experiment."""
        return self.experiment.title or self.experiment.name

    @property
    def counts(self) -> dict[str, int | str]:
        """Numbers of recordings behind the charts, for their captions.

        ``power_counts`` is a text, as "40 of 1 noises, 40 of 3 noises": number of recordings with a
        hidden effect of each size.
        """
        table, power, calibration = (
            self.tables[name] for name in ("table", "power", "calibration")
        )
        sizes = power[power["metric"] == "named"].drop_duplicates("size")
        return {
            "clean_count": int(table.loc[table["metric"] == "false alarms", "of"].max()),
            "single_count": int(table.loc[table["metric"] == PRIMARY_METRIC, "of"].max()),
            "power_counts": ", ".join(
                f"{int(count)} of {size:g} noises"
                for size, count in sizes[["size", "of"]].to_numpy()
            ),
            "calibration_count": int(calibration["of"].max()) if len(calibration) else 0,
        }

    @property
    def case_count(self) -> int:
        """Number of cases that every diagnoser has answered."""
        return int(self.rows["question"].nunique())

    @property
    def styles(self) -> dict[str, MarkStyle]:
        """Style (colour, dash and marker) of each diagnoser, in their order."""
        return {name: get_mark_style(place) for place, name in enumerate(self.order)}

    def make_interval_series(self, is_shifted: bool = False) -> tuple[Series, ...]:
        """Make a series of points with error bars for each diagnoser.

        Args:
            is_shifted: whether the points lie side by side on a category axis.
        """
        options: dict[str, Any] = {"low": "low", "high": "high", "draw": "points"}
        styles = self.styles
        return make_method_series(styles, "diagnoser", "share", is_shifted=is_shifted, **options)

    def make_line_series(self, frame: pd.DataFrame, **where: str) -> tuple[Series, ...]:
        """Make one line with error bars for each diagnoser that occurs in a table.

        Args:
            frame: the table.
            **where: values of further columns that select the rows of the line.
        """
        names = set(frame["diagnoser"])
        styles = {name: look for name, look in self.styles.items() if name in names}
        return make_method_series(styles, "diagnoser", "share", where=where, low="low", high="high")


_SHARE_METRICS = {
    "false alarms": "alarms",
    "named, alone": "alone",
    PRIMARY_METRIC: "set of 2",
    "something seen": "detected",
    "pairs: both named": "pairs",
    "foreign causes: unknown or partial": "outside",
    "95 % intervals that hold": "intervals",
}
"""Metrics of the chart of shares, each with its label on the axis."""
_SHARE_LIMITS = (-0.03, 1.03)
_SHARE_AXIS = Axis("share", scales=("linear",), ends=_SHARE_LIMITS)


def build_chart_tables(data: DiagnoserReportData) -> dict[str, pd.DataFrame]:
    """Build the tables of the charts that are not tables of the comparison.

    A chart of the page reads a table with one column per coordinate. Category axes need a column
    ``place`` with the number of the category.

    Args:
        data: graded answers and result tables of all diagnosers.

    Returns:
        Tables by name; those without data are empty.

        * ``board``: share of named single causes with the false alarms, both in per cent.
        * ``shares``: shares of all metrics, with the category of each metric.
        * ``calibration``: share of clean recordings by the level of the p-value; the rows of
          diagnoser "" are the ideal line, on which the share equals the level.
        * ``sets``: answers by the size of their largest set, with the category of each size.
        * ``cost``: share of named single causes with the costs of an answer.
    """
    table = data.tables["table"]
    alarms = table[table["metric"] == "false alarms"].set_index("diagnoser")["share"]
    named_rows = table[(table["metric"] == PRIMARY_METRIC) & (table["of"] > 0)]
    leaderboard = named_rows.assign(alarms=100 * named_rows["diagnoser"].map(alarms))
    leaderboard[["share", "low", "high"]] *= 100
    metric_position = {metric: position for position, metric in enumerate(_list_shares(data))}
    shares = table[table["metric"].isin(metric_position)]
    levels = pd.DataFrame({"diagnoser": "", "level": P_VALUE_LEVELS, "share": P_VALUE_LEVELS})
    calibration, sets = data.tables["calibration"], data.tables["sets"]
    sizes = {label: position for position, label in enumerate(SET_SIZE_BINS)}
    return {
        "board": leaderboard.dropna(subset="alarms"),
        "shares": shares.assign(place=shares["metric"].map(metric_position)),
        "calibration": pd.concat([calibration, levels], ignore_index=True)
        if len(calibration)
        else calibration,
        "sets": sets.assign(place=sets["largest_set"].map(sizes)),
        "cost": named_rows.merge(data.tables["costs"], on="diagnoser"),
    }


def _list_shares(data: DiagnoserReportData) -> list[str]:
    """List the metrics of the chart of shares that have answers."""
    table = data.tables["table"]
    return [name for name in _SHARE_METRICS if table.loc[table["metric"] == name, "of"].any()]


def make_charts(data: DiagnoserReportData) -> dict[str, list[Panel]]:
    """Make the panels of every chart by name; a chart without data has none.

    The chart ``board`` is the leaderboard: named causes against false alarms.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    tables = build_chart_tables(data)
    return {
        "board": _make_board(data) if len(tables["board"]) else [],
        "shares": _make_shares(data, tables["shares"]) if len(tables["shares"]) else [],
        "power": _make_power(data) if len(data.tables["power"]) else [],
        "calibration": _make_calibration(data) if len(tables["calibration"]) else [],
        "sets": _make_sets(data) if tables["sets"]["of"].any() else [],
        "cost": _make_cost(data) if len(tables["cost"]) else [],
    }


def _make_board(data: DiagnoserReportData) -> list[Panel]:
    """Make the leaderboard chart: share of named single causes against share of false alarms.

    A line marks the largest acceptable share of false alarms.
    """
    x_axis = Axis(
        "false alarms if nothing is hidden [%]",
        "symlog",
        ("symlog", "linear"),
        (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0),
        ends=(-0.15, 110.0),
    )
    # A margin of 3 %, so that marks at 0 and 100 % are visible.
    y_axis = Axis("single causes named [%]", scales=("linear",), ends=(-3.0, 103.0))
    series, percent = data.make_interval_series(), 100 * TARGET_FALSE_ALARM_RATE
    rules = (ReferenceLine(percent, f"{percent:g} %", "x"),)
    return [Panel("", "board", "alarms", series, x_axis, y_axis, rules=rules)]


def _make_shares(data: DiagnoserReportData, table: pd.DataFrame) -> list[Panel]:
    """Make the chart of the fractions in table.csv that have answers, one category per metric.

    Args:
        data: graded answers and result tables of all diagnosers.
        table: rows of table.csv of these metrics.
    """
    counts = table.groupby("metric")["of"].max()
    names = tuple(f"{_SHARE_METRICS[name]}\nn={int(counts[name])}" for name in _list_shares(data))
    x_axis = Axis("what is counted; at most n answers or intervals", names=names)
    series = data.make_interval_series(is_shifted=True)
    return [Panel("", "shares", "place", series, x_axis, _SHARE_AXIS)]


def _make_power(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of the shares named and detected against the size of the hidden effect.

    Args:
        data: Results of all diagnosers; sizes are in units of the noise.
    """
    table = data.tables["power"]
    sizes = tuple(sorted(float(size) for size in table["size"].unique()))
    x_axis = Axis("size of the hidden effect [noises]", "log", ticks=sizes)
    panels = []
    for metric, title in (("named", "Named, in a set of at most two"), ("seen", "Detected")):
        lines = data.make_line_series(table, metric=metric)
        panels.append(Panel(title, "power", "size", lines, x_axis, _SHARE_AXIS, {"what": title}))
    return panels


def _make_calibration(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of the fraction of clean recordings with a p-value of at most each level.

    For a calibrated p-value the fraction equals the level; a grey line shows this ideal.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    ideal_series = Series(
        "calibrated p-value", "share", make_mark_style(GREY, (4.0, 3.0)), {"diagnoser": ""}
    )
    lines = data.make_line_series(data.tables["calibration"])
    x_axis = Axis("level", "log", ticks=P_VALUE_LEVELS)
    y_axis = Axis(
        "share of clean recordings with p below the level", scales=("linear",), ends=_SHARE_LIMITS
    )
    return [Panel("", "calibration", "level", (*lines, ideal_series), x_axis, y_axis)]


def _make_sets(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of answers, and of correct ones, by the size of their largest set.

    A set contains the effects that an answer cannot distinguish.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    x_axis = Axis("effects in the largest set of an answer", names=tuple(SET_SIZE_BINS))
    correct = data.make_interval_series(is_shifted=True)
    counts = tuple(replace(series, y="of", low="", high="") for series in correct)
    share_axis = Axis("share of sets with the true cause", scales=("linear",), ends=_SHARE_LIMITS)
    count_axis = Axis("answers of this size", scales=("linear",), holds=(0.0,))
    return [
        Panel("Correct", "sets", "place", correct, x_axis, share_axis, {"what": "correct"}),
        Panel("Number", "sets", "place", counts, x_axis, count_axis, {"what": "number"}),
    ]


def _make_cost(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of diagnosed single causes against the cost of an answer."""
    y_axis = Axis("share of single causes named", scales=("linear",), ends=_SHARE_LIMITS)
    labels = {
        "simulations_median": "simulations for an answer, median",
        "processor_seconds_median": "processor time for an answer [s], median",
    }
    series = data.make_interval_series()
    return [
        Panel("", "cost", column, series, Axis(label, "log"), y_axis, {"cost": label})
        for column, label in labels.items()
    ]


_SIGNIFICANCE_LEVEL = 0.05
"""Maximum Holm-corrected p-value for a significant difference between two diagnosers."""


def count_own_failures(data: DiagnoserReportData) -> dict[str, tuple[int, int]]:
    """Count the incorrect graded answers of simgap itself, and all of them, by kind of case.

    The report states these numbers, so that the failures of simgap itself are visible.
    """
    rows = select_graded_answers(data.rows[data.rows["diagnoser"] == REFERENCE_DIAGNOSER])
    wrong = rows[~is_correct(rows)]["kind"].value_counts()
    counts = rows["kind"].value_counts()
    return {kind: (int(wrong.get(kind, 0)), int(counts[kind])) for kind in counts.index}


def find_leader(data: DiagnoserReportData) -> dict[str, Any] | None:
    """Find the best diagnoser among those with few false alarms.

    The best one has the highest primary metric. Diagnosers with more than `TARGET_FALSE_ALARM_RATE`
    false alarms cannot lead, because a diagnoser that always alarms finds every cause.

    Returns:
        * Without clean cases, in which false alarms could be counted: None.
        * If no diagnoser has few false alarms: a dictionary whose ``candidates`` are empty.
        * Otherwise ``name`` of the best one; ``candidates``, the diagnosers with few false alarms;
          ``alarms`` and ``named``, the rows of the best one in table.csv for false alarms and named
          causes. If the best one is simgap, ``similar`` are the candidates that do not differ
          significantly from it, and ``p_value`` is the largest p-value of these comparisons.
    """
    alarms = index_by_diagnoser(data.tables["table"], "false alarms")
    named = index_by_diagnoser(data.tables["table"], PRIMARY_METRIC)
    if not any(row["of"] for row in alarms.values()):
        return None
    candidates = [
        name
        for name in data.order
        if alarms[name]["share"] <= TARGET_FALSE_ALARM_RATE and named[name]["of"]
    ]
    if not candidates:
        return {"candidates": []}
    best = max(candidates, key=lambda name: float(named[name]["share"]))
    rows = {"alarms": alarms[best], "named": named[best]}
    leader = {"name": best, "candidates": candidates, **rows, "similar": [], "p_value": None}
    if best != REFERENCE_DIAGNOSER or len(candidates) == 1:
        return leader
    # McNemar's test, corrected by Holm's method for several comparisons.
    pairs = index_by_diagnoser(data.tables["pairs"], "named")
    p_values = {name: float(pairs[name]["p_holm"]) for name in candidates if name != best}
    similar = [name for name, p_value in p_values.items() if p_value >= _SIGNIFICANCE_LEVEL]
    return {**leader, "similar": similar, "p_value": max(p_values.values())}


def list_better_diagnosers(data: DiagnoserReportData) -> list[dict[Hashable, Any]]:
    """List the rows of pairs.csv in which another diagnoser is significantly better than simgap."""
    pairs = data.tables["pairs"]
    if pairs.empty:
        return []
    significant = pairs["p_holm"] < _SIGNIFICANCE_LEVEL
    return pairs[significant & (pairs["only_other"] > pairs["only_simgap"])].to_dict("records")


def summarise_unsupported(left_out: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Count the cases that diagnosers do not support, by diagnoser and reason.

    Args:
        left_out: rows of unsupported cases, with columns diagnoser and reason.

    Returns:
        List of (diagnoser, reason, number of cases).
    """
    groups = left_out.groupby(["diagnoser", "reason"], sort=False).size().reset_index(name="of")
    return [
        (str(diagnoser), str(reason), int(count))
        for diagnoser, reason, count in groups.itertuples(index=False)
    ]


_TEMPLATE = Path(__file__).with_name("diagnosers.html")
_DIGITS = 6
"""Number of significant digits of stored numbers."""


def render_page(data: DiagnoserReportData) -> str:
    """Render the HTML report of a comparison of diagnosers.

    The tables are embedded in the page for its charts; the numbers of the text are computed here.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    page = HtmlPage(data.pictures)
    failures = build_failure_table(data.rows, data.order)
    tables = {**data.tables, "failures": failures, "items": data.rows}
    tables |= build_chart_tables(data)
    page.add_tables(tables, _DIGITS)
    groups, confusion, costs = (data.tables[name] for name in ("groups", "confusion", "costs"))
    metrics = list(dict.fromkeys(groups["metric"]))
    confused = list(dict.fromkeys(confusion["diagnoser"]))
    better_diagnosers = list_better_diagnosers(data)
    trained = costs[costs["training_simulations"] > 0]
    return page.render(
        _TEMPLATE,
        shown=data,
        REFERENCE=REFERENCE_DIAGNOSER,
        PRIMARY_METRIC=PRIMARY_METRIC,
        own=count_own_failures(data),
        leader=find_leader(data),
        alarm_limit=TARGET_FALSE_ALARM_RATE,
        better=better_diagnosers,
        has_pairs=len(data.tables["pairs"]) > 0,
        trust_note=TRUSTED_TUNERS_NOTE if data.experiment.trusted else "",
        unanswered=data.rows[data.rows["status"] != "done"].groupby("diagnoser").size(),
        unsupported=summarise_unsupported(data.left_out),
        has_own_failures=bool((failures["diagnoser"] == REFERENCE_DIAGNOSER).any()),
        charts=make_charts(data),
        **data.counts,
        trained=list(
            trained[["diagnoser", "training_simulations"]].itertuples(index=False, name=None)
        ),
        first_metric="named" if "named" in metrics or not metrics else str(metrics[0]),
        first_confused=(
            REFERENCE_DIAGNOSER
            if REFERENCE_DIAGNOSER in confused or not confused
            else str(confused[0])
        ),
    )
