"""Kinds of damage to result folders: by name, the file that the message must mention, and a
function that damages the folder.
"""

import json
import shutil

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet


def rows(change, name="runs.parquet"):
    """Return a function that damages a Parquet file; `change` maps a frame to a frame."""

    def damage(folder):
        path = folder / name
        metadata = parquet.read_schema(path).metadata
        whole = pa.Table.from_pandas(change(pd.read_parquet(path)), preserve_index=False)
        parquet.write_table(whole.replace_schema_metadata(metadata), path)

    return damage


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

    return damage


def lines(name, change):
    def damage(folder):
        path = folder / name
        before = path.read_text(encoding="utf-8").splitlines()
        path.write_text("".join(f"{line}\n" for line in change(before)), encoding="utf-8")

    return damage


def raw(name, change):
    def damage(folder):
        path = folder / name
        path.write_bytes(change(path.read_bytes()))

    return damage


def key(name, value):
    """Return a function that damages environment.json; the value None removes the key."""

    def damage(folder):
        path = folder / "environment.json"
        held = json.loads(path.read_text(encoding="utf-8"))
        held[name] = value
        if value is None:
            del held[name]
        path.write_text(json.dumps(held), encoding="utf-8")

    return damage


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
    """Combine two kinds of damage that hide each other."""
    return lambda folder: (first(folder), second(folder))


PARQUET, STATUS_CSV, PLAN = "runs.parquet", "status.csv", "segments/plan.txt"
TRAINED = ["random,0,1,1.5,True"]
DONE = {
    "no column": (PARQUET, rows(lambda f: f.drop(columns="loss"))),
    "no run": (PARQUET, rows(lambda f: f.drop(columns="run"))),
    "no parameter": (PARQUET, rows(lambda f: f.drop(columns="true_rate"))),
    "no recommendations": (
        PARQUET,
        rows(lambda f: f[[c for c in f if not c.startswith(("proposal", "recomm", "true_"))]]),
    ),
    "no channel": (PARQUET, rows(lambda f: f.drop(columns="obs_error_x"))),
    "text for numbers": (PARQUET, column("loss", "much")),
    "text for k": (PARQUET, rows(lambda f: f.assign(k=f["k"].astype(str)))),
    "numbers for text": (PARQUET, column("tuner", 3)),
    "fractional k": (PARQUET, rows(lambda f: f.assign(k=f["k"] + 0.5))),
    "NaN k": (PARQUET, rows(lambda f: f.assign(k=f["k"].astype(float).replace(2.0, np.nan)))),
    "no k": (PARQUET, rows(lambda f: f.assign(k=f["k"].astype("Int64").replace(2, pd.NA)))),
    "negative k": (PARQUET, cell("k", 1, -1)),
    "huge k": (PARQUET, cell("k", 1, 2**62)),
    "k beyond a double": (PARQUET, rows(lambda f: f.assign(k=np.uint64(2**64 - 1)))),
    "k twice": (PARQUET, cell("k", 2, 1)),
    "k goes on from a double": (PARQUET, both(cell("k", 2, 1), cell("k", 3, 2))),
    "k left out": (PARQUET, rows(lambda f: f.drop(index=1))),
    "no start": (PARQUET, rows(lambda f: f.drop(index=0))),
    "no end": (STATUS_CSV, rows(lambda f: f.drop(index=3))),
    "loss at the start": (PARQUET, cell("loss", 0, 0.5)),
    "no loss": (PARQUET, cell("loss", 1, np.nan)),
    "negative loss": (PARQUET, cell("loss", 1, -1.0)),
    "infinite error": (PARQUET, cell("param_error", 1, np.inf)),
    "infinite proposal": (PARQUET, cell("proposal_rate", 1, -np.inf)),
    "true parameter unknown": (PARQUET, cell("true_rate", 1, np.nan)),
    "true parameter changes": (PARQUET, cell("true_rate", 1, 2.5)),
    "true parameter of one run": (
        PARQUET,
        rows(lambda f: f.assign(true_rate=f["true_rate"].where(f["run"] != f["run"][0], 2.5))),
    ),
    "negative seconds": (PARQUET, cell("tuner_seconds", 1, -1.0)),
    "range changes": (PARQUET, cell("range", 1, "wide")),
    "unknown range": (PARQUET, column("range", "far")),
    "tuner changes": (PARQUET, cell("tuner", 1, "nelder_mead")),
    "run twice": (PARQUET, rows(lambda f: pd.concat([f, f[f["run"] == f["run"][0]]]))),
    "run missing": (STATUS_CSV, rows(lambda f: f[f["run"] != f["run"][0]])),
    "another run": (PARQUET, rows(lambda f: f.assign(run=f["run"] + "0"))),
    "another experiment": (PARQUET, column("experiment", "other")),
    "no rows": (STATUS_CSV, rows(lambda f: f.iloc[:0])),
    "truncated": (PARQUET, raw(PARQUET, lambda data: data[: len(data) // 2])),
    "empty": (PARQUET, raw(PARQUET, lambda _: b"")),
    "no Parquet": (PARQUET, raw(PARQUET, lambda _: b"run,k\n1,2\n")),
    "parquet gone": (PARQUET, lambda folder: (folder / PARQUET).unlink()),
    "pages": (PARQUET, raw(PARQUET, lambda data: data[:4] + b"\xff" * 900 + data[904:])),
    "unknown status": (STATUS_CSV, text(STATUS_CSV, ",done,", ",perfect,")),
    "done too early": (
        STATUS_CSV,
        both(rows(lambda f: f.drop(index=3)), column_of(STATUS_CSV, -3, lambda _: "2")),
    ),
    "status shortened": (STATUS_CSV, lines(STATUS_CSV, lambda ls: ls[:-1])),
    "status header": (STATUS_CSV, lines(STATUS_CSV, lambda ls: ls[:1])),
    "status twice": (STATUS_CSV, lines(STATUS_CSV, lambda ls: [*ls, ls[-1]])),
    "status cut": (STATUS_CSV, raw(STATUS_CSV, lambda data: data[:-30])),
    "status empty": (STATUS_CSV, raw(STATUS_CSV, lambda _: b"")),
    "status gone": (STATUS_CSV, lambda folder: (folder / STATUS_CSV).unlink()),
    "other bytes": (STATUS_CSV, raw(STATUS_CSV, lambda data: data + b"\xff\xfe")),
    "zeros": (STATUS_CSV, raw(STATUS_CSV, lambda data: data + bytes(9))),
    "wrong separators": (STATUS_CSV, raw(STATUS_CSV, lambda data: data.replace(b",", b";"))),
    "a cell more": (STATUS_CSV, lines(STATUS_CSV, lambda ls: [ls[0], ls[1] + ",1", *ls[2:]])),
    "open quote": (STATUS_CSV, text(STATUS_CSV, ",done,", ',"')),
    "column gone": (STATUS_CSV, text(STATUS_CSV, "seconds", "minutes")),
    "column twice": (STATUS_CSV, text(STATUS_CSV, "reason", "status")),
    "negative time": (STATUS_CSV, column_of(STATUS_CSV, -2, lambda v: f"-{v}")),
    "infinite time": (STATUS_CSV, column_of(STATUS_CSV, -2, lambda _: "inf")),
    "no time": (STATUS_CSV, column_of(STATUS_CSV, -2, lambda _: "")),
    "time in words": (STATUS_CSV, column_of(STATUS_CSV, -2, lambda _: "1_0")),
    "half a simulation": (STATUS_CSV, column_of(STATUS_CSV, -3, lambda v: f"{v}.5")),
    "more simulations": (STATUS_CSV, column_of(STATUS_CSV, -3, lambda _: "4")),
    "endless simulations": (STATUS_CSV, column_of(STATUS_CSV, -3, lambda _: "9" * 40)),
    "another tuner": (STATUS_CSV, column_of(STATUS_CSV, 1, another)),
    "another target": (STATUS_CSV, column_of(STATUS_CSV, 3, lambda _: "in-001")),
    "another seed": (STATUS_CSV, column_of(STATUS_CSV, 4, lambda _: "7")),
    "another simulator": (STATUS_CSV, column_of(STATUS_CSV, 2, lambda _: "pendulum")),
    "escapes": (STATUS_CSV, column_of(STATUS_CSV, 1, lambda _: "\x1b[31m\u2028")),
    "training header": ("training.csv", text("training.csv", "seconds", "s")),
    "training of nobody": (
        "training.csv",
        lines("training.csv", lambda ls: [*ls, "me,0,1,1,True"]),
    ),
    "training twice": ("training.csv", lines("training.csv", lambda ls: [ls[0], *TRAINED * 2])),
    "training cost": (
        "training.csv",
        lines("training.csv", lambda ls: [*ls, "random,0,-1,1,True"]),
    ),
    "training gone": ("training.csv", lambda folder: (folder / "training.csv").unlink()),
    "no direction": ("identifiability.csv", column_of("identifiability.csv", 3, lambda _: "0")),
    "directions": ("identifiability.csv", column_of("identifiability.csv", 3, lambda _: "2")),
    "neither": ("identifiability.csv", column_of("identifiability.csv", 6, lambda _: "perhaps")),
    "component": ("identifiability.csv", column_of("identifiability.csv", 7, lambda _: "1.5")),
}  # fmt: skip
BOTH = {
    "environment empty": ("environment.json", raw("environment.json", lambda _: b"")),
    "environment listed": ("environment.json", raw("environment.json", lambda _: b"[]")),
    "environment nested": ("environment.json", raw("environment.json", lambda _: b"[" * 99999)),
    "environment bytes": ("environment.json", raw("environment.json", lambda _: b"\xff\xfe")),
    "no experiment": ("environment.json", key("experiment", None)),
    "no packages": ("environment.json", key("packages", None)),
    "numbered experiment": ("environment.json", key("experiment", 3)),
    "numbered plugins": ("environment.json", key("plugins", [1])),
    "plugins in words": ("environment.json", key("plugins", "spring.py")),
    "hashes listed": ("environment.json", key("fingerprint", ["x"])),
    "numbered hashes": ("environment.json", key("fingerprint", {"code": 1})),
    "jobs in words": ("environment.json", key("jobs", "two")),
    "true jobs": ("environment.json", key("jobs", True)),
    "budget in words": ("experiment.toml", text("experiment.toml", "budget = 3", 'budget = "x"')),
    "configuration bytes": ("experiment.toml", raw("experiment.toml", lambda data: data + b"\xff")),
}
HALF = {
    "plan of others": (PLAN, text(PLAN, "random/", "annealing/")),
    "plan of other targets": (PLAN, text(PLAN, "in-000", "in-999")),
    "plan without ids": (PLAN, raw(PLAN, lambda _: b"one\ntwo\n")),
    "plan twice": (PLAN, lines(PLAN, lambda ls: [*ls, ls[0]])),
    "plan shortened": (PLAN, lines(PLAN, lambda ls: ls[:-1])),
    "plan bytes": (PLAN, raw(PLAN, lambda data: data + b"\xff")),
    "part cut": ("segments/000001.parquet", raw("segments/000001.parquet", lambda d: d[:-7])),
    "part empty": ("segments/000001.parquet", raw("segments/000001.parquet", lambda _: b"")),
    "part named": (
        "segments/old.parquet",
        lambda f: shutil.copy(f / "segments/000001.parquet", f / "segments/old.parquet"),
    ),
    "part twice": (
        "segments/000009.parquet",
        lambda f: shutil.copy(f / "segments/000001.parquet", f / "segments/000009.parquet"),
    ),
}


def statuses(change):
    """Return the damaged segment file and a function that changes its statuses."""

    def damage(folder):
        path = folder / "segments" / "000001.parquet"
        table = parquet.read_table(path)
        held = json.loads(table.schema.metadata[b"statuses"])
        table = table.replace_schema_metadata({"statuses": json.dumps(change(held))})
        parquet.write_table(table, path)

    return "segments/000001.parquet", damage


def change_status(**changes):
    return statuses(lambda held: [[held[0][0], {**held[0][1], **changes}], *held[1:]])


HALF |= {
    "foreign status": change_status(status="perfect"),
    "foreign run": change_status(run="random/in-000/0/0000000000"),
    "foreign tuner": change_status(tuner="annealing"),
    "status of numbers": change_status(status=3),
    "seconds in words": change_status(seconds="long"),
    "negative time in a part": change_status(seconds=-1.0),
    "infinite time in a part": change_status(seconds=float("inf")),
    "too many simulations": change_status(simulations=99),
    "no place": statuses(lambda held: [["x", held[0][1]], *held[1:]]),
    "beyond the plan": statuses(lambda held: [[99, held[0][1]], *held[1:]]),
    "statuses no list": statuses(lambda _: {"a": 1}),
    "status without a column": statuses(lambda held: [[0, {"run": "x"}]]),
}
PART = "segments/000001.parquet"
ROWS_OF_PARTS = {
    "part without a column": (PART, rows(lambda f: f.drop(columns="loss"), PART)),
    "part without a run": (PART, rows(lambda f: f[f["run"] != f["run"][0]], PART)),
    "part with other k": (PART, rows(lambda f: f.assign(k=f["k"] * 2), PART)),
    "part without an end": (PART, rows(lambda f: f.drop(index=3), PART)),
    "part with text": (PART, rows(lambda f: f.assign(loss="x"), PART)),
}
