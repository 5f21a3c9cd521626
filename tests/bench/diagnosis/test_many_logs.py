"""Tests of the separate explanation of many logs: a folder per log, one table, no repeated work."""

import csv
import hashlib
import json

import numpy as np
import pytest

from bench.diagnosis.many_logs import (
    LOG_COLUMNS,
    LogResult,
    format_log_table,
    summarise_causes,
)
from tests.bench.diagnosis.explained_samples import write_slider_log
from tests.command_output import run_command
from tests.local_cluster import cluster


def log(folder, name, friction, seed):
    """Write runs of a driven slider with dry friction and encoder noise; return the path."""
    path, times = folder / f"{name}.csv", np.arange(150) / 50.0
    forces = [3 * np.sin(3 * times + number) for number in range(3)]
    return write_slider_log(path, "friction.coulomb", [1.4, friction], forces, seed)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return [log(folder, f"day{k}", 0.3 + 0.1 * k, k) for k in range(3)]


@pytest.fixture(scope="module")
def explained_logs(logs, tmp_path_factory):
    """Explain all logs with two processes; return the folder and the printed text."""
    out = tmp_path_factory.mktemp("explained") / "out"
    return out, explain(logs, out, "--jobs", "2").out


def rows_of(out):
    with (out / "logs.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def explain(logs, out, *more, code=0):
    """Explain each log alone; return what the command prints."""
    return run_command("explain", *logs, "--each", "--out", out, *more, code=code)


@pytest.mark.slow
def test_every_log_has_its_folder_and_its_row(logs, explained_logs):
    out, said = explained_logs
    rows = rows_of(out)
    assert tuple(rows[0]) == LOG_COLUMNS
    assert [(r["log"], r["verdict"], r["cause"]) for r in rows] == [
        (f"day{k}", "named", "friction.coulomb") for k in range(3)
    ]
    for k, row in enumerate(rows):
        assert float(row["low"]) < 0.3 + 0.1 * k < float(row["high"])
        verdict = json.loads((out / row["log"] / "verdict.json").read_text())
        number = verdict["causes"][0]["coefficients"]["coefficient"]
        assert float(row["value"]) == number["value"]
        assert (out / row["log"] / "report.html").exists()
    assert "friction.coulomb: in 3 of 3 logs, 0.3" in said
    assert f"report  {out / 'report.html'}" in said
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "3 logs, each explained separately" in page
    assert page.count('<a href="day') == 3
    environment = json.loads((out / "environment.json").read_text())
    assert environment["settings"]["each"] is True
    named = [(one["file"], one["sha256"]) for one in environment["recordings"]]
    assert [name for name, _ in named] == [
        file for k in range(3) for file in (f"day{k}.csv", f"day{k}.toml")
    ]
    assert named[2][1] == hashlib.sha256(logs[1].read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_log_that_cannot_be_explained_costs_no_other_and_what_is_there_stays(logs, tmp_path):
    out, bad = tmp_path / "out", tmp_path / "bad.csv"
    bad.write_text("nothing\n")
    bad.with_suffix(".toml").write_text('system = "slider"\n')
    explain([logs[0], bad], out, "--jobs", "1", code=1)
    first = rows_of(out)
    assert [row["verdict"] for row in first] == ["named", ""]
    assert "1 could not be explained" in (out / "report.html").read_text(encoding="utf-8")
    assert "bad.toml" in first[1]["error"]
    stamp = (out / "day0" / "verdict.json").stat().st_mtime_ns
    # After the repair, only the bad log and the added log are explained.
    log(tmp_path, "bad2", 0.5, 9)
    bad.write_bytes((tmp_path / "bad2.csv").read_bytes())
    bad.with_suffix(".toml").write_bytes((tmp_path / "bad2.toml").read_bytes())
    explain([*logs[:2], bad], out, "--jobs", "1")
    assert [row["log"] for row in rows_of(out)] == ["day0", "day1", "bad"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<strong>3 named</strong>" in page
    assert (out / "day0" / "verdict.json").stat().st_mtime_ns == stamp
    # A changed option (here the seed) invalidates all stored results.
    explain(logs[:1], out, "--jobs", "1", "--seed", "3")
    assert (out / "day0" / "verdict.json").stat().st_mtime_ns != stamp


def test_foreign_files_are_not_changed(logs, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "logs.json").write_text('{"mine": 1}')
    assert "name another folder" in explain(logs[:1], out, code=2).err
    assert (out / "logs.json").read_text() == '{"mine": 1}'
    (out / "logs.json").rename(out / "mine.json")
    assert "not empty" in explain(logs[:1], out, code=2).err
    assert [path.name for path in out.iterdir()] == ["mine.json"]


def test_a_cluster_needs_many_logs(logs, tmp_path):
    assert "--each" in run_command("explain", logs[0], "--cluster", "tcp://127.0.0.1:1", code=2).err


def test_names_that_look_like_formulas_are_text_and_numbers_have_their_range():
    def cause(value):
        number = {"value": value, "low": None, "high": None, "unit": "N"}
        return {"effect": "force.bias@a", "alternatives": ["x"], "coefficients": {"k": number}}

    rows = [
        LogResult("=cmd()", "d", "named", (cause(1.0),)),
        LogResult("b", "d", "named", (cause(3.5),)),
    ]
    assert "\n'=cmd()," in format_log_table(rows)
    assert summarise_causes(rows) == ["force.bias@a or x: in 2 of 2 logs, k 1 to 3.5 N"]


@pytest.mark.long
def test_a_cluster_finds_what_this_machine_finds(logs, explained_logs, tmp_path):
    there = tmp_path / "there"
    with cluster(tmp_path) as running:
        explain(logs[:2], there, "--cluster", running.address)
    untimed = [
        [{k: v for k, v in row.items() if k != "seconds"} for row in rows_of(out)]
        for out in (explained_logs[0], there)
    ]
    assert untimed[0][:2] == untimed[1]
    assert (there / "day1" / "report.html").exists()
