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

from bench.gap.explain import explain
from bench.gap.explanation import csv_text
from bench.gap.model.watch import Watch
from bench.recordings.digest import content_of, digest_of
from bench.recordings.joined import names_of
from bench.runs.pools import Pool
from sims.base import InputError
from sims.files import first_line, refuse_full, write

STATE = "logs.json"
"""What is known of the logs: it is written again whenever one is done."""
TABLE = "logs.csv"
"""The table: a row for each number of each cause of each log."""
HEAD = (
    "log", "verdict", "cause", "alternatives", "coefficient", "value", "low", "high", "unit",
    "gap_closed", "seconds", "error",
)  # fmt: skip


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


@dataclass(frozen=True)
class Row:
    """What came of a log.

    Attributes:
        log: its name.
        digest: that of `Log`.
        verdict: the word; empty where it could not be explained.
        causes: as verdict.json has them.
        gap_closed: share of the held-out gap that is closed; None where nothing is held out.
        seconds: that it took.
        error: why it could not be explained, in one line.
    """

    log: str
    digest: str
    verdict: str = ""
    causes: tuple[Mapping[str, Any], ...] = ()
    gap_closed: float | None = None
    seconds: float | None = None
    error: str = ""


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
    calls = [(explained, (log, dict(settings))) for log in left]
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


def explained(log: Log, settings: Mapping[str, Any]) -> Row:
    """Explain a log and write what was found; whoever makes the call."""
    try:
        given = {key: value for key, value in settings.items() if key != "budget"}
        explanation = explain(log.path, watch=Watch(settings.get("budget")), **given)
        explanation.write(log.folder)
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


def table(rows: Sequence[Row]) -> str:
    """The table of all logs as CSV, a row for each number of each cause."""
    lines: list[tuple[object, ...]] = []
    for row in rows:
        cells: list[tuple[object, ...]] = []
        for cause in row.causes:
            for name, number in cause["coefficients"].items():
                what = cause["effect"], " or ".join(cause["alternatives"]), name
                cells.append((*what, *(number[key] for key in ("value", "low", "high", "unit"))))
        last = row.gap_closed, row.seconds, row.error
        lines += [(row.log, row.verdict, *cell, *last) for cell in cells or [("",) * 7]]
    return csv_text(HEAD, lines)


def told(rows: Sequence[Row]) -> list[str]:
    """How often each cause was named, and its numbers' range over the logs; most frequent first."""
    places: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        for cause in row.causes:
            places.setdefault(" or ".join([cause["effect"], *cause["alternatives"]]), []).append(
                cause["coefficients"]
            )
    lines = []
    for effects, found in sorted(places.items(), key=lambda entry: (-len(entry[1]), entry[0])):
        numbers = []
        for name, first in found[0].items():
            values = [c[name]["value"] for c in found if name in c]
            label = "" if name == "coefficient" else f"{name} "
            unit = "" if first["unit"] == "1" else f" {first['unit']}"
            low, high = min(values), max(values)
            span = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
            numbers.append(f"{label}{span}{unit}")
        lines.append(f"{effects}: in {len(found)} of {len(rows)} logs, {', '.join(numbers)}")
    return lines
