"""Tests that calls of the command are measured, limited and resumed."""

import json
import sys

import pytest

from tests.planted_causes import run_explain
from tests.planted_causes.__main__ import main, read_rows

ADEQUATE = {"verdict": "adequate", "causes": [], "parameters": {}, "heldout": None}
BURN = "import time\nwhile time.process_time() < {seconds}: sum(range(10000))\n"


def command(path, body):
    """Write an executable that replaces simgap; `out` is the folder of --out."""
    path.write_text(
        f"#!{sys.executable}\nimport json, pathlib, subprocess, sys\n"
        f"out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n{body}\n"
    )
    path.chmod(0o755)
    return path


WRITE = f"out.mkdir()\n(out / 'verdict.json').write_text({json.dumps(json.dumps(ADEQUATE))})\n"


def test_an_answer_and_the_time_of_all_processes(tmp_path):
    child = f"subprocess.run([sys.executable, '-c', {BURN.format(seconds=0.4)!r}])\n"
    simgap = command(tmp_path / "simgap", BURN.format(seconds=0.3) + child + WRITE)
    outcome = run_explain.explain(simgap, tmp_path / "log.csv", tmp_path / "answer")
    assert outcome.verdict == ADEQUATE
    assert outcome.code == 0
    assert 0.7 <= outcome.cpu < 2.0
    assert outcome.wall > 0.3
    # A child also counts the memory pages of its parent until it executes the command.
    assert outcome.memory > 5


def test_a_call_ends_at_the_limit_with_its_children(tmp_path):
    child = f"subprocess.run([sys.executable, '-c', {BURN.format(seconds=60)!r}])\n"
    simgap = command(tmp_path / "simgap", child + WRITE)
    outcome = run_explain.explain(simgap, tmp_path / "log.csv", tmp_path / "answer", 0.5)
    assert outcome.verdict is None
    assert outcome.code is None
    assert 0.5 <= outcome.cpu < 3.0


def test_an_error_is_no_answer(tmp_path):
    simgap = command(tmp_path / "simgap", "print('log.csv: no such file'); sys.exit(2)")
    outcome = run_explain.explain(simgap, tmp_path / "log.csv", tmp_path / "answer")
    assert (outcome.verdict, outcome.code) == (None, 2)
    assert outcome.message == "log.csv: no such file"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_interrupted_test_continues(tmp_path, capsys):
    calls = tmp_path / "calls"
    note = f"with open({str(calls)!r}, 'a') as file: file.write('x')\n"
    simgap = command(tmp_path / "simgap", note + WRITE)
    out = tmp_path / "out"
    given = ["--simgap", str(simgap), "--out", str(out), "--only", "reacher/damping"]
    assert main([*given, "--version", "one", "--count", "1"]) == 0
    with (out / "items.jsonl").open("a") as file:
        file.write('{"item": "cut o')  # An interruption leaves an incomplete line.
    assert main([*given, "--version", "one", "--count", "2"]) == 0
    assert calls.read_text() == "xx"
    assert main([*given, "--version", "two", "--count", "1"]) == 0
    rows = read_rows(out / "items.jsonl")
    assert [row["version"] for row in rows] == ["one", "one", "two"]
    assert {row["mark"]["outcome"] for row in rows} == {"missed"}
    assert rows[0]["digest"] == rows[2]["digest"]
    printed = capsys.readouterr().out
    assert "missed" in printed
    header, first = (out / "summary.csv").read_text().splitlines()[:2]
    assert header.startswith("version,group,items,strict,fair,no_answer,cpu_median_s")
    assert first.startswith("one,all,1,0,0,0,")


def test_an_unknown_robot_is_refused(tmp_path, capsys):
    simgap = command(tmp_path / "simgap", WRITE)
    arguments = ["--simgap", str(simgap), "--out", str(tmp_path), "--only", "no-robot"]
    assert main([*arguments, "--version", "one"]) == 2
    assert "robots are reacher" in capsys.readouterr().out
