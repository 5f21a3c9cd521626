"""Explain many recordings separately, and write the table and the summary page of their causes.

1. Explain each log (`explain_batch`). The calls may run in any order, locally or on a cluster. A
   log that cannot be explained becomes a row with the reason and does not affect the others.
2. Write all causes with their numbers as logs.csv (`format_log_table`).
3. Write the page (`write_summary_page`): the verdicts and causes of all logs, each number of the
   causes over the logs, and the errors on held-out runs.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from math import isfinite
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np
import pandas as pd

from bench.benchmark.runner.worker_pools import Pool
from bench.diagnosis.explain import explain
from bench.diagnosis.report import cause_and_value_text
from bench.diagnosis.report.cause_and_value_text import (
    append_unit,
    format_label,
    format_number,
    joined,
)
from bench.figures import figure_output, style
from bench.figures.figure_layout import finish_chart
from bench.figures.figure_settings import is_pdf_wanted
from bench.figures.label_text import break_name
from bench.logs.recording_digest import compute_content_digest, compute_recording_digest
from bench.logs.recording_joining import make_log_names
from bench.pages.chart import Axis, Panel, ReferenceLine, Series, draw_chart
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_csv
from sims.core.files import check_folder_empty, get_first_line, write_atomically
from sims.core.json_documents import Document
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOGS_TABLE_FILE = "logs.csv"
"""File name of the table of causes, which has one row for each number of each cause of each log."""
LOG_COLUMNS = (
    "log", "verdict", "cause", "alternatives", "coefficient", "value", "low", "high", "unit",
    "gap_closed", "seconds", "error",
)  # fmt: skip
"""Columns of the table of causes."""
BATCH_STATE_FILE = "logs.json"
"""File name of the batch state, which is rewritten whenever a log is done."""
REPORT_FILE = "report.html"
"""File name of a log's report in its folder, and of the summary page of all logs."""
_TEMPLATE = Path(__file__).with_name("many_logs.html")
"""Template of the page."""
_TEXT_COLUMNS = ("log", "verdict", "causes", "error", "report")
_NUMERIC_COLUMNS = ("gap_closed", "low", "high", "before", "after", "seconds")
"""Text and numeric columns of the table of logs on the page, after the number of the log."""
MAX_NAMED = 6
"""Maximum number of causes, and of failed logs, that are listed before the tables."""
MAX_COEFFICIENT_NAME_CHARACTERS = 80
"""Maximum number of characters of a coefficient's name that are shown."""
MAX_PANELS = 4
"""Maximum number of numbers that the printed figure shows."""
_MAX_AXIS_CHARACTERS = 120
"""Maximum total number of characters of log names on an axis; with more, the logs are numbered."""
_MAX_TITLE_CHARACTERS = 34
"""Maximum line length of a panel's title, in characters."""
_LOG_HEIGHT_INCHES = 0.3
"""Height of a log in the printed figures, in inches."""
_BEFORE_STYLE = style.make_mark_style(style.VERMILION, (), "s")
_AFTER_STYLE = style.make_mark_style(style.BLUE, (), "o")
"""Marks of the errors before and after the causes are added; values of causes have the latter."""


@dataclass(frozen=True)
class LogResult(Document):
    """Result of one log.

    Attributes:
        log: Name of the log.
        digest: Digest of the log's files and settings, see `BatchLog`.
        verdict: Verdict in one word; empty if the log could not be explained.
        causes: Causes as in verdict.json.
        gap_closed: Share of the held-out gap that is closed; None without held-out runs.
        seconds: Duration of the diagnosis in seconds.
        error: Reason why the log could not be explained, in one line.
    """

    log: str
    digest: str
    verdict: str = ""
    causes: tuple[Mapping[str, Any], ...] = ()
    gap_closed: float | None = None
    seconds: float | None = None
    error: str = ""


@dataclass(frozen=True)
class BatchLog:
    """Recording of a batch, with its output folder.

    Attributes:
        name: Short name that is unique in the batch.
        path: Path of its table or description.
        folder: Folder for verdict, extended simulator, figures and report.
        digest: Digest of its files, including those in its description, and of the settings.
    """

    name: str
    path: Path
    folder: Path
    digest: str


def list_logs(paths: Sequence[Path], out: Path, settings: Mapping[str, Any]) -> list[BatchLog]:
    """List the logs with their names, folders and digests.

    The digest of a recording with all settings shows a later call whether the log must be explained
    again.

    Args:
        paths: Paths of the recordings.
        out: Output folder of the batch.
        settings: Arguments of `explain`, and its ``budget`` in seconds.

    Raises:
        InputError: A file does not exist.
    """
    settings_text = repr(sorted((key, str(value)) for key, value in settings.items()))
    # The content of the model file counts, too: it may change without its path.
    if settings.get("model") is not None:
        settings_text += compute_content_digest(Path(settings["model"])).hex()
    return [
        BatchLog(
            name,
            path.absolute(),
            out.absolute() / name.replace("/", "_"),
            compute_recording_digest(path, settings_text),
        )
        for name, path in zip(make_log_names(paths), paths, strict=True)
    ]


def explain_batch(
    logs: Sequence[BatchLog],
    out: Path,
    settings: Mapping[str, Any],
    pool: Pool,
    report_result: Callable[[LogResult], None],
    stop: Callable[[], bool] = lambda: False,
) -> list[LogResult]:
    """Explain every log that is not explained yet, and write the table of all.

    Args:
        logs: Logs of the batch.
        out: Output folder of the batch; results of an earlier call in it are reused.
        settings: Settings as for `list_logs`.
        pool: Worker pool that makes the calls.
        report_result: Callback that receives the result of each log.
        stop: Function that is called after each log; if it returns True, the other logs remain for
            another call.

    Returns:
        Results in the order of the logs.
    """
    # Results of an earlier call that are still valid are reported first.
    results_by_log = _load_previous_results(out, logs)
    for row in results_by_log.values():
        report_result(row)

    def write_results() -> list[LogResult]:
        """Write the results so far, and return them in the order of the logs."""
        results = [results_by_log[log.name] for log in logs if log.name in results_by_log]
        _write_results(out, results)
        return results

    remaining = [log for log in logs if log.name not in results_by_log]
    # A worker process does not know the settings of this process, so the call states whether
    # figures are written as PDF, too.
    calls = [(explain_log, (log, dict(settings), is_pdf_wanted())) for log in remaining]
    for index, result in pool.iterate_results(calls, np.inf):
        log = remaining[index]
        # The pool returns the exception of a call that failed.
        if not isinstance(result, LogResult):
            result = LogResult(log.name, log.digest, error=_format_error(result))
        results_by_log[log.name] = result
        write_results()
        report_result(result)
        if stop():
            break
    return write_results()


def explain_log(log: BatchLog, settings: Mapping[str, Any], pdf: bool = False) -> LogResult:
    """Explain a log and write its results; worker processes call this.

    An error of the input becomes the result of its log, so that it does not end the batch.

    Args:
        log: Log to explain.
        settings: Settings as for `list_logs`.
        pdf: Also write each figure as PDF.
    """
    try:
        explanation = explain(log.path, **settings)
        explanation.write(log.folder, pdf=pdf)
    except InputError as error:
        return LogResult(log.name, log.digest, error=get_first_line(error))
    document = explanation.answer.to_document()
    held_out = document["heldout"]
    return LogResult(
        log=log.name,
        digest=log.digest,
        verdict=document["verdict"],
        causes=tuple(document["causes"]),
        gap_closed=held_out["gap_closed"] if held_out else None,
        seconds=document["seconds"],
    )


def _format_error(error: object) -> str:
    """Format the error that ended a call in one line."""
    message = get_first_line(error) if isinstance(error, BaseException) else "no result"
    return message if isinstance(error, InputError) else f"{type(error).__name__}: {message}"


def _load_previous_results(out: Path, logs: Sequence[BatchLog]) -> dict[str, LogResult]:
    """Load the results of an earlier call in an output folder, to explain only what has changed.

    A result is reused if its log and all settings, by their digest, are the same and it has no
    error.

    Args:
        out: output folder of the batch; a folder with other files is refused.
        logs: logs of the batch.

    Returns:
        Results by log.
    """
    path = out / BATCH_STATE_FILE
    if not path.exists():
        check_folder_empty(out)
        return {}
    try:
        stored_results = [LogResult.from_document(row) for row in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError):
        raise InputError(f"{path}: was not written by simgap; name another folder") from None
    stored_by_log = {result.log: result for result in stored_results}
    reused = {}
    for log in logs:
        result = stored_by_log.get(log.name)
        if result is not None and result.digest == log.digest and not result.error:
            reused[log.name] = result
    return reused


def _write_results(out: Path, rows: Sequence[LogResult]) -> None:
    """Write the results so far: the state, with which a later call continues, and the table.

    Args:
        out: output folder of the batch.
        rows: results in the order of the logs.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(
            out / BATCH_STATE_FILE, json.dumps([row.to_document() for row in rows], indent=1) + "\n"
        )
        write_atomically(out / LOGS_TABLE_FILE, format_log_table(rows))
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from None


def format_log_table(rows: Sequence[LogResult]) -> str:
    """Format the table of all logs as CSV, with one row for each number of each cause.

    A log without causes has one row, in which the cells of the cause are empty.

    Args:
        rows: result of each log, with its causes as in verdict.json.
    """
    lines: list[tuple[object, ...]] = []
    for row in rows:
        cause_cells: list[tuple[object, ...]] = []
        for cause in row.causes:
            alternatives = " or ".join(cause["alternatives"])
            for coefficient, number in cause["coefficients"].items():
                estimate = [number[key] for key in ("value", "low", "high", "unit")]
                cause_cells.append((cause["effect"], alternatives, coefficient, *estimate))
        common_cells = row.gap_closed, row.seconds, row.error
        # Effect, alternatives, coefficient, value, low, high and unit.
        no_cause = ("",) * 7
        lines += [
            (row.log, row.verdict, *cells, *common_cells) for cells in cause_cells or [no_cause]
        ]
    return format_csv(LOG_COLUMNS, lines)


def read_log_table(rows: Sequence[LogResult]) -> pd.DataFrame:
    """Read the text of logs.csv as a table; names that look like numbers stay text."""
    frame = pd.read_csv(StringIO(format_log_table(rows)), dtype=str, keep_default_na=False)
    numeric = ["value", "low", "high", "gap_closed", "seconds"]
    frame[numeric] = frame[numeric].apply(pd.to_numeric).astype(float)
    return frame


class CommonCause(NamedTuple):
    """Cause over all logs: its effects, the names of its logs, and the ranges of its numbers."""

    name: str
    logs: list[str]
    ranges: str


def list_common_causes(rows: Sequence[LogResult]) -> list[CommonCause]:
    """List the causes over all logs, the most common first.

    Alternatives that the data of a log do not distinguish count as one cause.

    Args:
        rows: result of each log, with its causes as in verdict.json.
    """
    logs_by_cause: dict[str, list[str]] = {}
    numbers_by_cause: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for row in rows:
        for cause in row.causes:
            name = format_cause(cause)
            logs_by_cause.setdefault(name, []).append(row.log)
            for coefficient, number in cause["coefficients"].items():
                by_coefficient = numbers_by_cause.setdefault(name, {})
                by_coefficient.setdefault(coefficient, []).append(number)
    causes = [
        CommonCause(name, logs, _format_ranges(numbers_by_cause.get(name, {})))
        for name, logs in logs_by_cause.items()
    ]
    return sorted(causes, key=lambda cause: -len(cause.logs))


def _format_ranges(numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Format the range of each coefficient over the logs, such as ``0.3 to 0.7 N``.

    Args:
        numbers: Estimates of each coefficient by its name, one for each log, as in verdict.json.
    """
    parts = []
    for name, estimates in numbers.items():
        values = [estimate["value"] for estimate in estimates]
        # Ends that are printed alike are printed once.
        ends = dict.fromkeys(format_number(end, 4) for end in (min(values), max(values)))
        label = "" if name == "coefficient" else f"{_format_coefficient_place(name)} "
        parts.append(label + append_unit(" to ".join(ends), estimates[0]["unit"]))
    return joined(parts)


def summarise_causes(rows: Sequence[LogResult]) -> list[str]:
    """Summarise how often each cause was found, and the range of its numbers, as lines."""
    return [
        f"{cause.name}: in {len(cause.logs)} of {len(rows)} logs, {cause.ranges}"
        for cause in list_common_causes(rows)
    ]


def format_cause(cause: Mapping[str, Any]) -> str:
    """Format a cause with its alternatives: ``friction.coulomb or joint.backlash``."""
    return " or ".join([cause["effect"], *cause["alternatives"]])


def _format_coefficient_place(name: str) -> str:
    """Format the place of a coefficient: ``at elbow`` for ``coefficient@elbow``."""
    coefficient, separator, place = name.partition("@")
    return f"at {place}" if separator and coefficient == "coefficient" else name


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
    path = batch.out / REPORT_FILE
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
    logs = build_log_table(rows, batch.folders)
    number_table = build_number_table(rows)
    causes = list_common_causes(rows)
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
        # A chart without panels has no figure.
        if panels:
            figure = draw_summary_figure(panels, charts.tables, caption)
            figures[name] = figure_output.render_all_formats(figure)
    page = HtmlPage(figures)
    page.add_tables({"each": logs, "logs": read_log_table(rows), **charts.tables})
    return page.render(
        _TEMPLATE,
        rows=rows,
        batch=batch,
        table_file=LOGS_TABLE_FILE,
        verdicts=Counter(row.verdict for row in rows if row.verdict),
        causes=causes,
        # Recordings with the most common cause.
        first_recordings=[batch.recordings[log] for cause in causes[:1] for log in cause.logs],
        closed=sorted(logs["gap_closed"][logs["causes"] != ""].dropna()),
        failed=[row for row in rows if row.error],
        is_numbered=not charts.has_names,
        number_panels=charts.numbers,
        held_out_panels=charts.held_out,
        wording=cause_and_value_text,
        median=median,
        MAX_NAMED=MAX_NAMED,
        MAX_PANELS=MAX_PANELS,
    )


def build_log_table(rows: Sequence[LogResult], folders: Mapping[str, Path]) -> pd.DataFrame:
    """Build a table with one row per log: its causes, its report and the share of the gap closed.

    `before` and `after` are the errors on held-out runs of the base and the extended model, as
    multiples of the noise floor. `gap_closed` is the share of the gap between the first error and
    the noise floor that the causes close, with its interval from `low` to `high`. All of them are
    NaN if a log was not explained.

    Args:
        rows: Result of each log.
        folders: Folder of each log's explanation, by log.
    """
    lines = []
    for log_number, row in enumerate(rows, start=1):
        folder = folders[row.log]
        errors = _read_held_out_errors(folder) if not row.error else {}
        report = "" if row.error else quote(f"{folder.name}/{REPORT_FILE}")
        lines.append({
            "number": log_number, "log": row.log, "verdict": row.verdict or "not explained",
            "causes": "; ".join(format_cause(cause) for cause in row.causes),
            "gap_closed": row.gap_closed,
            "low": errors.get("low"), "high": errors.get("high"),
            "before": _convert_to_noise_floors(errors, "rmse_base"),
            "after": _convert_to_noise_floors(errors, "rmse_extended"),
            "seconds": row.seconds, "error": row.error, "report": report,
        })  # fmt: skip
    frame = pd.DataFrame(lines, columns=["number", *_TEXT_COLUMNS, *_NUMERIC_COLUMNS])
    return frame.astype(dict.fromkeys(_NUMERIC_COLUMNS, float))


def _read_held_out_errors(folder: Path) -> dict[str, float]:
    """Read the held-out errors from a log's verdict.json; empty if it cannot be read."""
    try:
        held_out = json.loads((folder / "verdict.json").read_text(encoding="utf-8"))["heldout"]
        return {key: value for key, value in held_out.items() if isinstance(value, (int, float))}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _convert_to_noise_floors(errors: Mapping[str, float], key: str) -> float | None:
    """Return a held-out error as a multiple of the noise floor; None if one of them is unknown.

    Args:
        errors: held-out errors in the unit of the channel, and ``noise_floor``, by name.
        key: name of the error.
    """
    value, floor = errors.get(key), errors.get("noise_floor")
    return value / floor if value is not None and floor else None


def build_number_table(rows: Sequence[LogResult]) -> pd.DataFrame:
    """Build a table with one row per number of each cause, those of the commonest cause first.

    A number is a fitted coefficient of a cause, with its 95 % interval `low` to `high`. The column
    `what` names cause, coefficient and unit; numbers with equal text are shown together.

    Args:
        rows: results of the diagnoses, one for each log.
    """
    lines = []
    for log_number, row in enumerate(rows, start=1):
        for cause in row.causes:
            for name, estimate in cause["coefficients"].items():
                label = format_label(
                    _format_coefficient_place(name),
                    estimate["unit"],
                    MAX_COEFFICIENT_NAME_CHARACTERS,
                )
                lines.append(
                    {
                        "number": log_number,
                        "log": row.log,
                        "cause": format_cause(cause),
                        "name": name,
                        "what": f"{format_cause(cause)}: {label}",
                        **estimate,
                    }
                )
    columns = ["number", "log", "cause", "name", "what", "value", "low", "high", "unit"]
    frame = pd.DataFrame(lines, columns=columns)
    frame = frame.astype(dict.fromkeys(["value", "low", "high"], float))
    # The number that most logs have comes first.
    frequency = frame["what"].map(frame["what"].value_counts())
    order = frequency.sort_values(ascending=False, kind="stable").index
    return frame.loc[order].reset_index(drop=True)


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
        logs: Table of `build_log_table`.
        numbers: Table of `build_number_table`.
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
    if len(names) * max(map(len, names), default=0) <= _MAX_AXIS_CHARACTERS:
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
                _AFTER_STYLE,
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
        Series("before: tuned simulation", "before", _BEFORE_STYLE, draw="points"),
        Series("after: with the causes found", "after", _AFTER_STYLE, draw="points"),
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
    height = 1.2 + _LOG_HEIGHT_INCHES * len(log_names) if log_names else 4.0
    figure, axes = draw_chart(panels, tables, size=(3.4, height), horizontal=True)
    for axis, panel in zip(axes, panels, strict=True):
        axis.set_title(
            break_name(panel.title, _MAX_TITLE_CHARACTERS), fontsize=8.5, parse_math=False
        )
    return finish_chart(figure, axes[0], caption=caption, legend="outside upper center")
