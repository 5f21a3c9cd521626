"""Page of many logs that are explained separately: the values of the template `many_logs.html`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from bench.diagnosis import many_logs
from bench.diagnosis.many_logs import LOGS_TABLE_FILE, LogResult
from bench.diagnosis.report import effect_and_unit_text
from bench.figures import figure_output, style
from bench.figures.label_text import break_name
from bench.pages.chart import Axis, Panel, ReferenceLine, Series
from bench.pages.chart_figure import draw_chart, finish_chart
from bench.pages.html_page import HtmlPage
from sims.core.files import write_atomically
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_TEMPLATE = Path(__file__).with_name("many_logs.html")
_NAMED_LETTERS = 120
"""Maximum total number of characters of log names on an axis; with more, the logs are numbered."""
MAX_NAMED = 6
"""Maximum number of causes, and of failed logs, that are listed before the tables."""
MAX_PANELS = 4
"""Maximum number of numbers that the printed figure shows."""
_TITLE_LINE = 34
"""Maximum line length of a panel's title, in characters."""
_NAME_HEIGHT = 0.3
"""Height of a log in the printed figures, in inches."""
_BEFORE = style.make_mark_style(style.VERMILION, (), "s")
_AFTER = style.make_mark_style(style.BLUE, (), "o")


@dataclass(frozen=True)
class BatchPageInput:
    """Input of the page in addition to the result rows.

    Attributes:
        out: Output folder of the batch.
        folders: Folder of each log's explanation, by log.
        recordings: Path of each recording, by log.
        words: Words of the command that continues the batch.
        left: Number of logs that are not explained yet.
    """

    out: Path
    folders: Mapping[str, Path]
    recordings: Mapping[str, Path]
    words: Sequence[str]
    left: int = 0


def write_summary_page(rows: Sequence[LogResult], batch: BatchPageInput) -> Path:
    """Write the page next to the table.

    Args:
        rows: Result of each log.
        batch: Input of the page in addition to the rows.

    Returns:
        Path of the page.

    Raises:
        InputError: The page cannot be written.
    """
    path = batch.out / many_logs.REPORT_FILE
    try:
        write_atomically(path, render_summary_page(rows, batch))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def render_summary_page(rows: Sequence[LogResult], batch: BatchPageInput) -> str:
    """Render the HTML summary page of explanations of many logs.

    The page has the verdicts and causes of all logs, each number of the causes over the logs, and
    the held-out errors.

    Args:
        rows: Result of each log, in the order given.
        batch: Input of the page in addition to the rows.
    """
    logs = many_logs.build_log_table(rows, batch.folders)
    number_table = many_logs.build_number_table(rows)
    causes = many_logs.list_common_causes(rows)
    charts = make_summary_charts(logs, number_table)
    # Panels and captions of the printed figures.
    printed = {
        "numbers": (
            charts.numbers[:MAX_PANELS],
            "Point: the value from one log. Bar: its 95 % interval.",
        ),
        "held-out": (
            charts.held_out,
            "Dashed: the noise floor, the best that any model can reach.",
        ),
    }
    figures = {}
    for name, (panels, caption) in printed.items():
        if panels:
            figure = draw_summary_figure(panels, charts.tables, caption)
            figures[name] = figure_output.render_all_formats(figure)
    page = HtmlPage(figures)
    page.add_tables({"each": logs, "logs": many_logs.read_log_table(rows), **charts.tables})
    return page.render(
        _TEMPLATE,
        rows=rows,
        batch=batch,
        table_file=LOGS_TABLE_FILE,
        verdicts=Counter(row.verdict for row in rows if row.verdict),
        causes=causes,
        first_recordings=[batch.recordings[log] for cause in causes[:1] for log in cause.logs],
        closed=sorted(logs["gap_closed"][logs["causes"] != ""].dropna()),
        failed=[row for row in rows if row.error],
        is_numbered=not charts.has_names,
        number_panels=charts.numbers,
        held_out_panels=charts.held_out,
        wording=effect_and_unit_text,
        median=median,
        MAX_NAMED=MAX_NAMED,
        MAX_PANELS=MAX_PANELS,
    )


class SummaryCharts(NamedTuple):
    """Charts of the page.

    Attributes:
        numbers: Panels of each number of a cause over the logs, the most common first.
        held_out: Panel of the errors on held-out runs; empty without errors.
        tables: Tables of the panels.
        has_names: Whether the logs have their names on the axis.
    """

    numbers: list[Panel]
    held_out: list[Panel]
    tables: dict[str, pd.DataFrame]
    has_names: bool


def make_summary_charts(logs: pd.DataFrame, numbers: pd.DataFrame) -> SummaryCharts:
    """Make the charts of the summary page: numbers of the causes, and errors on held-out runs.

    Both have the logs on the horizontal axis, by name if all names fit, else by number from 1.

    Args:
        logs: Table of `many_logs.build_log_table`.
        numbers: Table of `many_logs.build_number_table`.
    """
    log_axis = _make_log_axis(logs)
    # Column "number" counts from 1. An axis of names counts from 0, an axis of numbers from 1.
    offset = 1 if log_axis.names else 0
    errors = logs[["number", "log", "before", "after"]]
    tables = {
        "found": numbers.assign(place=numbers["number"] - offset),
        "held-out": errors.assign(place=errors["number"] - offset),
    }
    number_panels = _make_number_panels(numbers, log_axis)
    held_out_panels = _make_held_out_panels(logs, log_axis)
    return SummaryCharts(number_panels, held_out_panels, tables, bool(log_axis.names))


def _make_log_axis(logs: pd.DataFrame) -> Axis:
    """Make the axis of the logs: with their names if they fit, otherwise with their numbers."""
    names = [str(name) for name in logs["log"]]
    if len(names) * max(map(len, names), default=0) <= _NAMED_LETTERS:
        return Axis("log", names=tuple(names))
    return Axis("log, by its number", scales=("linear",), ends=(0.5, len(logs) + 0.5))


def _make_number_panels(numbers: pd.DataFrame, across: Axis) -> list[Panel]:
    """Make a panel for each number of a cause, the most common first.

    A panel has a point with its interval for each log.

    Args:
        numbers: one row for each coefficient of a cause of a log.
        across: horizontal axis with the logs.
    """
    panels = []
    for label_with_cause in dict.fromkeys(numbers["what"].astype(str)):
        name, _, label = label_with_cause.rpartition(": ")
        # Names of columns are those of the table "found" in `SummaryCharts`.
        series = (
            Series(
                "each log",
                "value",
                _AFTER,
                where={"what": label_with_cause},
                low="low",
                high="high",
                draw="points",
            ),
        )
        panels.append(
            Panel(
                title=name,
                table="found",
                x="place",
                series=series,
                across=across,
                up=Axis(label, scales=("linear",)),
                facets={"number": label_with_cause},
            )
        )
    return panels


def _make_held_out_panels(logs: pd.DataFrame, across: Axis) -> list[Panel]:
    """Make the panel that shows the errors on held-out runs, in units of the noise floor.

    Return an empty list if no log has both errors.

    Args:
        logs: one row for each log, with the columns ``before`` and ``after``.
        across: horizontal axis with the logs.
    """
    errors = logs[["before", "after"]]
    log_count = int(errors.map(lambda error: isfinite(error) and error > 0).all(axis=1).sum())
    if not log_count:
        return []
    series = (
        Series("before: tuned simulation", "before", _BEFORE, draw="points"),
        Series("after: with the causes found", "after", _AFTER, draw="points"),
    )
    # `holds` keeps the noise floor, 1, within the range of the axis.
    error_axis = Axis("error on held-out runs [noise floors]", "log", holds=(1.0,))
    title = "One log" if log_count == 1 else f"{log_count} logs"
    rules = (ReferenceLine(1.0, "noise floor"),)
    # "held-out" is the key of the table in `SummaryCharts`, "place" its column for the x-axis.
    return [Panel(title, "held-out", "place", series, across, error_axis, rules=rules)]


def draw_summary_figure(
    panels: Sequence[Panel], tables: Mapping[str, pd.DataFrame], caption: str
) -> Figure:
    """Draw the printed version of a chart, with the logs from top to bottom.

    Args:
        panels: Panels of the chart.
        tables: Tables of the panels.
        caption: Caption below the figure.
    """
    # Height in inches: title and axis, and a line for each log that is named.
    log_names = panels[0].across.names
    height = 1.2 + _NAME_HEIGHT * len(log_names) if log_names else 4.0
    figure, axes = draw_chart(panels, tables, size=(3.4, height), horizontal=True)
    for axis, panel in zip(axes, panels, strict=True):
        axis.set_title(break_name(panel.title, _TITLE_LINE), fontsize=8.5, parse_math=False)
    return finish_chart(figure, axes[0], caption=caption, legend="outside upper center")
