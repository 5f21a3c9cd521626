"""Many recordings, each explained by itself: a folder for each, and one table of all of them.

Whatever makes the calls makes them in any order, here or on a cluster; a log that cannot be
explained is a row with its reason, and costs no other one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.figures.formats import is_pdf_wanted
from bench.gap.each.rows import TABLE, Row, table
from bench.gap.explain import explain
from bench.gap.model.watch import Watch
from bench.recordings.digest import content_of, digest_of
from bench.recordings.joined import names_of
from bench.runs.pools import Pool
from sims.base import InputError
from sims.files import first_line, refuse_full, write

STATE = "logs.json"
"""What is known of the logs: it is written again whenever one is done."""


@dataclass(frozen=True)
class Log:
    """A recording, and where what is found about it goes.

    Attributes:
        name: short, and no other log's.
        path: of its table or description.
        folder: for verdict, extended simulator, figures and report.
        digest: of its files, those that its description maps among them, and of what it is asked
            with.
    """

    name: str
    path: Path
    folder: Path
    digest: str


def logs_of(paths: Sequence[Path], out: Path, settings: Mapping[str, Any]) -> list[Log]:
    """The logs with their names and folders.

    Args:
        paths: of the recordings.
        out: the folder of all.
        settings: arguments of `explain`, and its ``budget`` in seconds.

    Raises:
        InputError: a file is not there.
    """
    told = repr(sorted((key, str(value)) for key, value in settings.items()))
    if settings.get("model") is not None:
        told += content_of(Path(settings["model"])).hex()
    return [
        Log(name, path.absolute(), out.absolute() / name.replace("/", "_"), digest_of(path, told))
        for name, path in zip(names_of(paths), paths, strict=True)
    ]


def explain_each(
    logs: Sequence[Log],
    out: Path,
    settings: Mapping[str, Any],
    pool: Pool,
    done: Callable[[Row], None],
    stop: Callable[[], bool] = lambda: False,
) -> list[Row]:
    """Explain every log that is not explained yet, and write the table of all.

    Args:
        logs: which.
        out: the folder of all; what an earlier call has left there is not made again.
        settings: those of `logs_of`.
        pool: makes the calls.
        done: told of each log as it ends.
        stop: asked after each log; True leaves the others for another call.
    """
    rows = _known(out, logs)
    for row in rows.values():
        done(row)
    left = [log for log in logs if log.name not in rows]
    # A worker process does not know what this one was asked to draw.
    calls = [(explained, (log, dict(settings), is_pdf_wanted())) for log in left]
    for place, result in pool.results(calls, np.inf):
        log = left[place]
        row = result if isinstance(result, Row) else Row(log.name, log.digest, error=_said(result))
        rows[log.name] = row
        ordered = [rows[one.name] for one in logs if one.name in rows]
        _write(out, ordered)
        done(row)
        if stop():
            break
    ordered = [rows[log.name] for log in logs if log.name in rows]
    _write(out, ordered)
    return ordered


def explained(log: Log, settings: Mapping[str, Any], pdf: bool = False) -> Row:
    """Explain a log and write what was found, in whichever process makes the call."""
    try:
        given = {key: value for key, value in settings.items() if key != "budget"}
        explanation = explain(log.path, watch=Watch(settings.get("budget")), **given)
        explanation.write(log.folder, pdf=pdf)
    except InputError as error:
        return Row(log.name, log.digest, error=first_line(error))
    found = explanation.answer.document()
    held_out = found["heldout"]
    closed = held_out["gap_closed"] if held_out else None
    causes = tuple(found["causes"])
    return Row(log.name, log.digest, found["verdict"], causes, closed, found["seconds"])


def _said(error: object) -> str:
    """One line about what ended a call."""
    said = first_line(error) if isinstance(error, BaseException) else "no result"
    return said if isinstance(error, InputError) else f"{type(error).__name__}: {said}"


def _known(out: Path, logs: Sequence[Log]) -> dict[str, Row]:
    """What an earlier call has found about the same files with the same settings."""
    path = out / STATE
    if not path.exists():
        refuse_full(out)
        return {}
    try:
        stored = [Row(**row) for row in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError):
        raise InputError(f"{path}: is none of simgap's; name another folder") from None
    by_name = {row.log: row for row in stored}
    same = {log.name: by_name[log.name] for log in logs if log.name in by_name}
    digests = {log.name: log.digest for log in logs}
    return {
        name: row for name, row in same.items() if row.digest == digests[name] and not row.error
    }


def _write(out: Path, rows: Sequence[Row]) -> None:
    """The state, and the table."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        write(out / STATE, json.dumps([asdict(row) for row in rows], indent=1) + "\n")
        write(out / TABLE, table(rows))
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from None
