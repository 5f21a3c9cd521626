"""HTML page of many logs that are explained separately: report.html next to logs.csv."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import pandas as pd

from bench.diagnosis.batch import summary_tables
from bench.diagnosis.batch.log_rows import LOGS_TABLE_FILE, LogResult, format_cause
from bench.diagnosis.batch.summary_figures import (
    MAX_NAMED_LOGS,
    MAX_PANELS,
    draw_held_out_figure,
    draw_numbers_figure,
)
from bench.diagnosis.report.next_steps import render_command
from bench.diagnosis.report.wording import (
    append_unit,
    format_effect_name,
    format_number,
    format_percent,
    format_sentence,
    joined,
)
from bench.figures import style
from bench.pages.chart import Axis, Chart, Panel, PrintedFigure, ReferenceLine, Series
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.html_elements import make_code, make_list, make_paragraph, make_strong, safe
from bench.pages.html_page import HtmlPage
from sims.core.atomic_files import write_atomically
from sims.core.simulator import InputError

_NAMED_LETTERS = 120
"""Maximum total number of characters of log names on an axis; with more, the logs are numbered."""
_SAID = 6
"""Maximum number of causes, and of failed logs, that are listed before the tables."""
_ORDER = ("named", "ambiguous", "partial", "adequate", "unknown", "unidentifiable")
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


def write_summary_page(rows: Sequence[LogResult], asked: BatchPageInput) -> Path:
    """Write the page next to the table.

    Args:
        rows: Result of each log.
        asked: Input of the page in addition to the rows.

    Returns:
        Path of the page.

    Raises:
        InputError: The page cannot be written.
    """
    path = asked.out / summary_tables.REPORT_FILE
    try:
        write_atomically(path, render_summary_page(rows, asked))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def render_summary_page(rows: Sequence[LogResult], asked: BatchPageInput) -> str:
    """Render the page as HTML: a summary of the causes over all logs, then the logs one by one.

    Args:
        rows: Result of each log, in the order given.
        asked: Input of the page in addition to the rows.
    """
    logs = summary_tables.build_log_table(rows, asked.folders)
    found = summary_tables.build_number_table(rows)
    made = (
        f"Made by simgap explain --each; the table is {make_code(LOGS_TABLE_FILE)} in "
        f"{make_code(safe(asked.out))}."
    )
    page = HtmlPage(f"{_counted(len(rows))}, each explained by itself", made)
    page.add_table("each", logs)
    page.add_table("logs", summary_tables.read_log_table(rows))
    page.append(f"<header>\n<h1>{_counted(len(rows))}, each explained by itself</h1>\n</header>")
    page.append(f'<div class="conclusion">{make_list(_conclusion(rows, logs, found, asked))}</div>')
    page.add_section("next", "What to do next", *_next(rows, asked))
    page.add_section("logs", "Log by log", page.render_grid(_render_log_table()))
    page.add_section(
        "numbers", "The numbers of the causes", *_render_numbers_section(page, logs, found)
    )
    page.add_section("gap", "What the causes explain", _held_out(page, logs))
    page.add_section("making", "How it was made", render_command(*asked.words))
    return page.to_html()


def _counted(count: int) -> str:
    return "One log" if count == 1 else f"{count} logs"


def _conclusion(
    rows: Sequence[LogResult], logs: pd.DataFrame, found: pd.DataFrame, asked: BatchPageInput
) -> Iterator[str]:
    """Yield sentences on verdicts, the commonest causes, the gap closed and the missing logs."""
    words = Counter(row.verdict for row in rows if row.verdict)
    said = [f"{words[word]} {safe(word)}" for word in _ORDER if words[word]]
    said += [f"{count} {safe(word)}" for word, count in words.items() if word not in _ORDER]
    failed = sum(1 for row in rows if row.error)
    if failed:
        said.append(f"{failed} could not be explained")
    yield f"Verdicts: {make_strong(joined(said) or 'none yet')}."
    causes = Counter(format_cause(cause) for row in rows for cause in row.causes)
    for name, count in causes.most_common(_SAID):
        words_of = joined([format_effect_name(part) for part in name.split(" or ")], "or")
        what = make_strong(safe(format_sentence(words_of)[:-1], 300))
        where = f"({make_code(safe(name, 200))}) in {count} of {len(rows)} logs"
        yield f"{what} {where}{safe(_spans(found[found['cause'] == name]))}."
    if len(causes) > _SAID:
        yield f"{len(causes) - _SAID} causes more, each in fewer logs or as many."
    closed = logs["gap_closed"][logs["causes"] != ""].dropna()
    if len(closed):
        ends = dict.fromkeys([format_percent(closed.min()), format_percent(closed.max())])
        middle = f"{format_percent(closed.median())} of the held-out gap (median)"
        yield f"What was found closes {middle}; {' to '.join(ends)} in {len(closed)} logs."
    if asked.left:
        yield f"{make_strong(f'{asked.left} logs are left')}: the same command goes on with them."


def _spans(found: pd.DataFrame) -> str:
    """Format the range of each coefficient of a cause, such as ``: 0.3 to 0.7 N``."""
    parts = []
    for name, mine in found.groupby("name", sort=False):
        ends = dict.fromkeys(
            format_number(end) for end in (mine["value"].min(), mine["value"].max())
        )
        label = "" if name == "coefficient" else f"{summary_tables.place_of(str(name))} "
        parts.append(label + append_unit(" to ".join(ends), str(mine["unit"].iloc[0])))
    return f": {joined(parts)}" if parts else ""


def _next(rows: Sequence[LogResult], asked: BatchPageInput) -> Iterator[str]:
    """Yield the next steps: logs to repair or continue, and logs to explain together."""
    failed = [row for row in rows if row.error]
    if failed:
        yield make_paragraph(make_strong("Not explained:"))
        more = len(failed) - _SAID
        told = [f"{make_code(safe(row.log, 100))}: {safe(row.error)}" for row in failed[:_SAID]]
        yield make_list([*told, *([f"and {more} more, in the table below"] if more > 0 else [])])
    if failed or asked.left:
        again = '<a href="#making">The same command</a>'
        yield make_paragraph(f"{again} explains what is mended or left, and nothing twice.")
    causes = Counter(format_cause(cause) for row in rows for cause in row.causes)
    commonest = causes.most_common(1)
    if commonest and commonest[0][1] > 1:
        name, _ = commonest[0]
        having = [row.log for row in rows if name in map(format_cause, row.causes)]
        yield make_paragraph(
            f"{make_strong('Do the numbers differ from log to log by more than chance?')} "
            f"Explained together, the {len(having)} logs with {make_code(safe(name, 200))} say so, "
            "and with what a number moves:"
        )
        yield render_command("simgap", "explain", *(asked.recordings[log] for log in having))
    if not causes and not failed:
        yield make_paragraph("Nothing: no log shows a cause.")


def _render_log_table() -> DataGrid:
    columns = (
        GridColumn("log", says="leads to its own report"),
        GridColumn("number", "#", 6),
        GridColumn("verdict"),
        GridColumn("causes"),
        GridColumn(
            "gap_closed", "gap closed", 3, "share of the held-out error above its noise floor"
        ),
        GridColumn("low", "95 % low", 3),
        GridColumn("high", "95 % high", 3),
        GridColumn("before", "before [floors]", 3, "error on held-out runs, in noise floors"),
        GridColumn("after", "after [floors]", 3, "the same with what was found"),
        GridColumn("seconds", "s", 3),
        GridColumn("error", "why not"),
    )  # fmt: skip
    return DataGrid("each", "Every log", "each", columns, ("verdict",), links="report")


def _across(logs: pd.DataFrame) -> Axis:
    """Make the axis of the logs."""
    if not _has_names(logs):
        ends = (0.5, len(logs) + 0.5)
        return Axis("log, by its number", scales=("linear",), ends=ends)
    return Axis("log", names=tuple(str(name) for name in logs["log"]))


def _has_names(logs: pd.DataFrame) -> bool:
    """Return whether the names of the logs fit on an axis."""
    names = [str(name) for name in logs["log"]]
    return len(names) * max(map(len, names), default=0) <= _NAMED_LETTERS


def _placed(frame: pd.DataFrame, logs: pd.DataFrame) -> pd.DataFrame:
    """Add the position on the axis; named logs have the positions 0, 1, 2, ..."""
    return frame.assign(place=frame["number"] - (1 if _has_names(logs) else 0))


def _render_numbers_section(
    page: HtmlPage, logs: pd.DataFrame, found: pd.DataFrame
) -> Iterator[str]:
    """Yield the chart of each number over the logs, and the table of all numbers."""
    columns = (
        GridColumn("log"),
        GridColumn("verdict"),
        GridColumn("cause"),
        GridColumn("alternatives"),
        GridColumn("coefficient", "number"),
        GridColumn("value", digits=4),
        GridColumn("low", "95 % low", 4),
        GridColumn("high", "95 % high", 4),
        GridColumn("unit"),
    )  # fmt: skip
    if found.empty:
        return
    page.add_table("found", _placed(found, logs))
    panels = []
    for what in dict.fromkeys(found["what"]):
        name, _, label = str(what).rpartition(": ")
        where = {"what": str(what)}
        series = (Series("each log", "value", _AFTER, where, "low", "high", "points"),)
        up = Axis(label, scales=("linear",))
        panels.append(Panel(name, "found", "place", series, _across(logs), up, {"number": what}))
    caption = (
        "A point is what a log gives by itself, the bar its 95 % interval. Bars that do not "
        "overlap are numbers that moved."
    )
    if len(panels) > MAX_PANELS:
        caption += f" In print the {MAX_PANELS} commonest numbers."
    # Too many panels next to each other cannot be compared.
    beside = "number" if len(panels) <= MAX_PANELS else ""
    still = _still(
        draw_numbers_figure(logs, found), "Each number of the causes over the logs.", "numbers"
    )
    title = "What each log gives"
    yield page.render_chart(Chart("found", title, caption, tuple(panels), still, beside))
    filters = ("log", "cause", "coefficient")
    yield page.render_grid(
        DataGrid("all-numbers", f"All numbers: {LOGS_TABLE_FILE}", "logs", columns, filters)
    )


def _held_out(page: HtmlPage, logs: pd.DataFrame) -> str:
    """Chart the errors on held-out runs before and after, in noise floors."""
    measured = logs[logs[["before", "after"]].map(lambda x: isfinite(x) and x > 0).all(axis=1)]
    if measured.empty:
        return ""
    page.add_table("held-out", _placed(logs[["number", "log", "before", "after"]], logs))
    series = (
        Series("before: tuned simulation", "before", _BEFORE, draw="points"),
        Series("after: with what was found", "after", _AFTER, draw="points"),
    )
    up = Axis("error on held-out runs [noise floors]", "log", holds=(1.0,))
    rules = (ReferenceLine(1.0, "noise floor"),)
    title = "Error on held-out runs"
    panel = Panel(
        _counted(len(measured)), "held-out", "place", series, _across(logs), up, rules=rules
    )
    caption = (
        "Squares: the tuned simulation as it is. Circles: with what was found. 1 is the noise "
        "floor, the best that any model can reach."
    )
    if len(logs) > MAX_NAMED_LOGS:
        caption += " Logs have the numbers of the table above."
    shows = "Error on held-out runs of each log before and after, in noise floors."
    return page.render_chart(
        Chart(
            "held-out",
            title,
            caption,
            (panel,),
            _still(draw_held_out_figure(measured), shows, "held-out"),
        )
    )


def _still(figure: Any, shows: str, name: str) -> PrintedFigure:
    picture = style.render_all_formats(figure)
    return PrintedFigure(picture.svg, picture.pdf, shows, name)
