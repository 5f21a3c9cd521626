"""Explain many recordings separately: one folder for each, and one table of all.

The calls may run in any order, locally or on a cluster. A log that cannot be explained becomes a
row with the reason and does not affect the others.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.benchmark.runner.worker_pools import Pool
from bench.diagnosis.batch.log_tables import LOGS_TABLE_FILE, LogResult, format_log_table
from bench.diagnosis.explain import explain
from bench.figures.figure_files import is_pdf_wanted
from bench.logs.joined_recordings import make_log_names
from bench.logs.recording_digest import compute_recording_digest, read_content
from sims.core.files import check_folder_empty, get_first_line, write_atomically
from sims.core.simulator import InputError

BATCH_STATE_FILE = "logs.json"
"""File name of the batch state, which is rewritten whenever a log is done."""


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
    """List the logs with their names and folders.

    Args:
        paths: Paths of the recordings.
        out: Output folder of the batch.
        settings: Arguments of `explain`, and its ``budget`` in seconds.

    Raises:
        InputError: A file does not exist.
    """
    settings_text = repr(sorted((key, str(value)) for key, value in settings.items()))
    if settings.get("model") is not None:
        settings_text += read_content(Path(settings["model"])).hex()
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
    rows = _load_previous_results(out, logs)
    for row in rows.values():
        report_result(row)
    remaining = [log for log in logs if log.name not in rows]
    # A worker process does not know the figure settings of this process.
    calls = [(explain_log, (log, dict(settings), is_pdf_wanted())) for log in remaining]
    for index, result in pool.iterate_results(calls, np.inf):
        log = remaining[index]
        row = (
            result
            if isinstance(result, LogResult)
            else LogResult(log.name, log.digest, error=_format_error(result))
        )
        rows[log.name] = row
        ordered_results = [rows[batch_log.name] for batch_log in logs if batch_log.name in rows]
        _write_results(out, ordered_results)
        report_result(row)
        if stop():
            break
    ordered_results = [rows[log.name] for log in logs if log.name in rows]
    _write_results(out, ordered_results)
    return ordered_results


def explain_log(log: BatchLog, settings: Mapping[str, Any], pdf: bool = False) -> LogResult:
    """Explain a log and write its results, in any process.

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
    gap_closed = held_out["gap_closed"] if held_out else None
    causes = tuple(document["causes"])
    return LogResult(
        log.name, log.digest, document["verdict"], causes, gap_closed, document["seconds"]
    )


def _format_error(error: object) -> str:
    """Format the error that ended a call in one line."""
    message = get_first_line(error) if isinstance(error, BaseException) else "no result"
    return message if isinstance(error, InputError) else f"{type(error).__name__}: {message}"


def _load_previous_results(out: Path, logs: Sequence[BatchLog]) -> dict[str, LogResult]:
    """Load the results of an earlier call in the folder `out`, to explain only what has changed.

    A result is reused if its log and all settings are the same and it has no error.
    """
    path = out / BATCH_STATE_FILE
    if not path.exists():
        check_folder_empty(out)
        return {}
    try:
        stored_results = [LogResult(**row) for row in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError):
        raise InputError(f"{path}: was not written by simgap; name another folder") from None
    by_name = {row.log: row for row in stored_results}
    unchanged = {log.name: by_name[log.name] for log in logs if log.name in by_name}
    digests = {log.name: log.digest for log in logs}
    return {
        name: row
        for name, row in unchanged.items()
        if row.digest == digests[name] and not row.error
    }


def _write_results(out: Path, rows: Sequence[LogResult]) -> None:
    """Write the results so far: the state, with which a later call continues, and the table."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(
            out / BATCH_STATE_FILE, json.dumps([asdict(row) for row in rows], indent=1) + "\n"
        )
        write_atomically(out / LOGS_TABLE_FILE, format_log_table(rows))
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from None
