"""Kinds of damage to result folders by name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from bench.benchmark.storage.run_journal import (
    JOURNAL_FILE,
    decode_rows,
    encode_record,
    read_records,
)


class Damage(NamedTuple):
    """A change of a file in a result folder.

    Attributes:
        file: name of the file that the message must mention.
        change: function that changes the file in a folder.
    """

    file: str
    change: Callable[[Path], object]

    def __call__(self, folder):
        self.change(folder)


def rows(change, name="runs.parquet"):
    """Return a function that damages a Parquet file; `change` maps a frame to a frame."""

    def damage(folder):
        path = folder / name
        metadata = parquet.read_schema(path).metadata
        whole = pa.Table.from_pandas(change(pd.read_parquet(path)), preserve_index=False)
        parquet.write_table(whole.replace_schema_metadata(metadata), path)

    return Damage(name, damage)


def cell(name, row, value):
    def change(frame):
        if not isinstance(value, str):
            frame[name] = frame[name].astype(type(value))
        frame.loc[row, name] = value
        return frame

    return rows(change)


def column(name, values):
    return rows(lambda frame: frame.assign(**{name: values}))


def text(name, old, new, count=1):
    """Return a function that damages a text file."""

    def damage(folder):
        path = folder / name
        before = path.read_text(encoding="utf-8")
        assert old in before, f"{old} is not in {before}"
        path.write_text(before.replace(old, new, count), encoding="utf-8")

    return Damage(name, damage)


def lines(name, change):
    def damage(folder):
        path = folder / name
        before = path.read_text(encoding="utf-8").splitlines()
        path.write_text("".join(f"{line}\n" for line in change(before)), encoding="utf-8")

    return Damage(name, damage)


def raw(name, change):
    def damage(folder):
        path = folder / name
        path.write_bytes(change(path.read_bytes()))

    return Damage(name, damage)


def key(name, value):
    """Return a function that damages environment.json; the value None removes the key."""

    def damage(folder):
        path = folder / "environment.json"
        held = json.loads(path.read_text(encoding="utf-8"))
        held[name] = value
        if value is None:
            del held[name]
        path.write_text(json.dumps(held), encoding="utf-8")

    return Damage("environment.json", damage)


def another(row):
    """Return the id of a run with another tuner."""
    return row.replace("random", "annealing")


def column_of(name, place, change):
    """Return a function that damages a cell of the second line of a CSV file."""

    def changed(before):
        cells = before[1].split(",")
        cells[place] = change(cells[place])
        return [before[0], ",".join(cells), *before[2:]]

    return lines(name, changed)


def both(first, second):
    """Combine two kinds of damage that hide each other; the message is about the second."""
    return Damage(second.file, lambda folder: (first(folder), second(folder)))


def gone(name):
    """Return the damage of a missing file."""
    return Damage(name, lambda folder: (folder / name).unlink())


PARQUET, STATUS_CSV, PLAN = "runs.parquet", "status.csv", "segments/plan.txt"
JOURNAL = f"segments/{JOURNAL_FILE}"
TRAINED = ["random,0,1,1.5,True"]
DONE = {
    "no column": rows(lambda f: f.drop(columns="loss")),
    "no run": rows(lambda f: f.drop(columns="run")),
    "no parameter": rows(lambda f: f.drop(columns="true_rate")),
    "no recommendations": rows(
        lambda f: f[[c for c in f if not c.startswith(("proposal", "recomm", "true_"))]]
    ),
    "no channel": rows(lambda f: f.drop(columns="obs_error_x")),
    "text for numbers": column("loss", "much"),
    "text for k": rows(lambda f: f.assign(k=f["k"].astype(str))),
    "numbers for text": column("tuner", 3),
    "fractional k": rows(lambda f: f.assign(k=f["k"] + 0.5)),
    "NaN k": rows(lambda f: f.assign(k=f["k"].astype(float).replace(2.0, np.nan))),
    "no k": rows(lambda f: f.assign(k=f["k"].astype("Int64").replace(2, pd.NA))),
    "negative k": cell("k", 1, -1),
    "huge k": cell("k", 1, 2**62),
    "k beyond a double": rows(lambda f: f.assign(k=np.uint64(2**64 - 1))),
    "k twice": cell("k", 2, 1),
    "k goes on from a double": both(cell("k", 2, 1), cell("k", 3, 2)),
    "k left out": rows(lambda f: f.drop(index=1)),
    "no start": rows(lambda f: f.drop(index=0)),
    "no end": rows(lambda f: f.drop(index=3))._replace(file=STATUS_CSV),
    "loss at the start": cell("loss", 0, 0.5),
    "no loss": cell("loss", 1, np.nan),
    "negative loss": cell("loss", 1, -1.0),
    "infinite error": cell("param_error", 1, np.inf),
    "infinite proposal": cell("proposal_rate", 1, -np.inf),
    "true parameter unknown": cell("true_rate", 1, np.nan),
    "true parameter changes": cell("true_rate", 1, 2.5),
    "true parameter of one run": rows(
        lambda f: f.assign(true_rate=f["true_rate"].where(f["run"] != f["run"][0], 2.5))
    ),
    "negative seconds": cell("tuner_seconds", 1, -1.0),
    "range changes": cell("range", 1, "wide"),
    "unknown range": column("range", "far"),
    "tuner changes": cell("tuner", 1, "nelder_mead"),
    "run twice": rows(lambda f: pd.concat([f, f[f["run"] == f["run"][0]]])),
    "run missing": rows(lambda f: f[f["run"] != f["run"][0]])._replace(file=STATUS_CSV),
    "another run": rows(lambda f: f.assign(run=f["run"] + "0")),
    "another experiment": column("experiment", "other"),
    "no rows": rows(lambda f: f.iloc[:0])._replace(file=STATUS_CSV),
    "truncated": raw(PARQUET, lambda data: data[: len(data) // 2]),
    "empty": raw(PARQUET, lambda _: b""),
    "no Parquet": raw(PARQUET, lambda _: b"run,k\n1,2\n"),
    "parquet gone": gone(PARQUET),
    "pages": raw(PARQUET, lambda data: data[:4] + b"\xff" * 900 + data[904:]),
    "unknown status": text(STATUS_CSV, ",done,", ",perfect,"),
    "done too early": both(
        rows(lambda f: f.drop(index=3)), column_of(STATUS_CSV, -3, lambda _: "2")
    ),
    "status shortened": lines(STATUS_CSV, lambda ls: ls[:-1]),
    "status header": lines(STATUS_CSV, lambda ls: ls[:1]),
    "status twice": lines(STATUS_CSV, lambda ls: [*ls, ls[-1]]),
    "status cut": raw(STATUS_CSV, lambda data: data[:-30]),
    "status empty": raw(STATUS_CSV, lambda _: b""),
    "status gone": gone(STATUS_CSV),
    "other bytes": raw(STATUS_CSV, lambda data: data + b"\xff\xfe"),
    "zeros": raw(STATUS_CSV, lambda data: data + bytes(9)),
    "wrong separators": raw(STATUS_CSV, lambda data: data.replace(b",", b";")),
    "a cell more": lines(STATUS_CSV, lambda ls: [ls[0], ls[1] + ",1", *ls[2:]]),
    "open quote": text(STATUS_CSV, ",done,", ',"'),
    "column gone": text(STATUS_CSV, "seconds", "minutes"),
    "column twice": text(STATUS_CSV, "reason", "status"),
    "negative time": column_of(STATUS_CSV, -2, lambda v: f"-{v}"),
    "infinite time": column_of(STATUS_CSV, -2, lambda _: "inf"),
    "no time": column_of(STATUS_CSV, -2, lambda _: ""),
    "time in words": column_of(STATUS_CSV, -2, lambda _: "1_0"),
    "half a simulation": column_of(STATUS_CSV, -3, lambda v: f"{v}.5"),
    "more simulations": column_of(STATUS_CSV, -3, lambda _: "4"),
    "endless simulations": column_of(STATUS_CSV, -3, lambda _: "9" * 40),
    "another tuner": column_of(STATUS_CSV, 1, another),
    "another target": column_of(STATUS_CSV, 3, lambda _: "in-001"),
    "another seed": column_of(STATUS_CSV, 4, lambda _: "7"),
    "another simulator": column_of(STATUS_CSV, 2, lambda _: "pendulum"),
    "escapes": column_of(STATUS_CSV, 1, lambda _: "\x1b[31m\u2028"),
    "training header": text("training.csv", "seconds", "s"),
    "training of nobody": lines("training.csv", lambda ls: [*ls, "me,0,1,1,True"]),
    "training twice": lines("training.csv", lambda ls: [ls[0], *TRAINED * 2]),
    "training cost": lines("training.csv", lambda ls: [*ls, "random,0,-1,1,True"]),
    "training gone": gone("training.csv"),
    "no direction": column_of("identifiability.csv", 3, lambda _: "0"),
    "directions": column_of("identifiability.csv", 3, lambda _: "2"),
    "neither": column_of("identifiability.csv", 6, lambda _: "perhaps"),
    "component": column_of("identifiability.csv", 7, lambda _: "1.5"),
}  # fmt: skip
BOTH = {
    "environment empty": raw("environment.json", lambda _: b""),
    "environment listed": raw("environment.json", lambda _: b"[]"),
    "environment nested": raw("environment.json", lambda _: b"[" * 99999),
    "environment bytes": raw("environment.json", lambda _: b"\xff\xfe"),
    "no experiment": key("experiment", None),
    "no packages": key("packages", None),
    "numbered experiment": key("experiment", 3),
    "numbered plugins": key("plugins", [1]),
    "plugins in words": key("plugins", "spring.py"),
    "hashes listed": key("fingerprint", ["x"]),
    "numbered hashes": key("fingerprint", {"code": 1}),
    "jobs in words": key("jobs", "two"),
    "true jobs": key("jobs", True),
    "budget in words": text("experiment.toml", "budget = 3", 'budget = "x"'),
    "configuration bytes": raw("experiment.toml", lambda data: data + b"\xff"),
}
HALF = {
    "plan of others": text(PLAN, "random/", "annealing/"),
    "plan of other targets": text(PLAN, "in-000", "in-999"),
    "plan without ids": raw(PLAN, lambda _: b"one\ntwo\n"),
    "plan twice": lines(PLAN, lambda ls: [*ls, ls[0]]),
    "plan shortened": lines(PLAN, lambda ls: ls[:-1]),
    "plan bytes": raw(PLAN, lambda data: data + b"\xff"),
    "journal with a damaged record": raw(JOURNAL, lambda d: d[:60] + b"\xff\xff" + d[62:]),
    "journal of another kind": raw(JOURNAL, lambda _: b"a text instead of records"),
    "journal twice": raw(JOURNAL, lambda d: d + d),
}


def records(change):
    """Return a function that changes the records of a journal, each [index, status, rows]."""

    def damage(folder):
        path = folder / JOURNAL
        held = [[*json.loads(r.head), decode_rows(r.rows)] for r in read_records(path)]
        path.write_bytes(b"".join(_encode(*record) for record in change(held)))

    return Damage(JOURNAL, damage)


def _encode(index, status, rows):
    """Encode a record whose status may be anything."""
    with patch("bench.benchmark.storage.run_journal.asdict", lambda _: status):
        return encode_record(index, status, rows)


def change_status(**changes):
    def change(held):
        (index, status, table), *others = held
        return [[index, {**status, **changes}, table], *others]

    return records(change)


HALF |= {
    "foreign status": change_status(status="perfect"),
    "foreign run": change_status(run="random/in-000/0/0000000000"),
    "foreign tuner": change_status(tuner="annealing"),
    "status of numbers": change_status(status=3),
    "seconds in words": change_status(seconds="long"),
    "negative time in a journal": change_status(seconds=-1.0),
    "infinite time in a journal": change_status(seconds=float("inf")),
    "too many simulations": change_status(simulations=99),
    "no place": records(lambda held: [["x", *held[0][1:]], *held[1:]]),
    "beyond the plan": records(lambda held: [[99, *held[0][1:]], *held[1:]]),
    "status no table": records(lambda held: [[0, ["a"], held[0][2]], *held[1:]]),
    "status without a column": records(lambda held: [[0, {"run": "x"}, held[0][2]]]),
}


def rows_of_journal(change):
    """Return a function that changes the rows of the first run in a journal."""

    def changed(held):
        index, status, table = held[0]
        return [[index, status, pa.Table.from_pandas(change(table.to_pandas()))], *held[1:]]

    return records(changed)


ROWS_OF_JOURNAL = {
    "journal without a column": records(
        lambda held: [[i, status, table.drop_columns("loss")] for i, status, table in held]
    ),
    "journal with other k": rows_of_journal(lambda f: f.assign(k=f["k"] * 2)),
    "journal without an end": rows_of_journal(lambda f: f.drop(index=3)),
    "journal with rows of another run": rows_of_journal(lambda f: f.assign(run="x")),
    "journal with text": rows_of_journal(lambda f: f.assign(loss="x")),
}
