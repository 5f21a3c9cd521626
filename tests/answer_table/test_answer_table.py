"""Tests of the table of measured recordings with right and wrong answers."""

import dataclasses
import os
from pathlib import Path

import pytest

from sims.core.toml_validation import tomllib
from tests.answer_table.__main__ import RECORDINGS, SHARED, main, read_rows
from tests.answer_table.answer_marking import faults
from tests.planted_causes.run_explain import Outcome
from tests.planted_causes.test_run_explain import WRITE, command

EXPECTED = {
    "verdicts": ["named", "ambiguous"],
    "causes": [
        {
            "effect": ["drag.linear@elbow"],
            "value": 3.0,
            "tolerance": 0.05,
            "alternatives": ["actuator.damping@m"],
        }
    ],
}


def outcome(*sets, name="named", value=3.01, parameters=None):
    causes = [
        {"effect": s[0], "alternatives": list(s[1:]), "coefficients": {"c": {"value": value}}}
        for s in sets
    ]
    verdict = {"verdict": name, "causes": causes, "parameters": parameters or {}}
    return Outcome(verdict, 0, 1.0, 1.0, 100.0, "")


@pytest.mark.parametrize(
    ("answer", "fault"),
    [
        (outcome(("drag.linear@elbow",)), None),
        (outcome(("drag.linear@elbow", "actuator.damping@m"), name="ambiguous"), None),
        (outcome(("actuator.damping@m", "drag.linear@elbow"), value=9.0), None),
        (outcome(("drag.linear@elbow",), value=3.2), "= 3.2, not 3"),
        (outcome(("drag.linear@wrist",)), "without drag.linear@elbow"),
        (outcome(("drag.linear@elbow", "input.rate@m")), "alternatives input.rate@m"),
        (outcome(("drag.linear@elbow",), ("backlash@m",)), "in addition backlash@m"),
        (outcome(("drag.linear@elbow",), name="partial"), "verdict partial"),
        (outcome(name="adequate"), "verdict adequate"),
        (Outcome(None, None, 120.0, 130.0, 100.0, ""), "no answer"),
    ],
)
def test_faults(answer, fault):
    found = faults(EXPECTED, answer)
    assert (found == []) if fault is None else any(fault in text for text in found)


def test_faults_of_parameters_and_findings():
    free = {"parameters": {"drag.linear@elbow": {"value": 60.0, "tolerance": 0.05}}}
    right = outcome(name="adequate", parameters={"drag.linear@elbow": {"value": 59.0}})
    assert faults(free, right) == []
    assert faults(free, outcome(name="adequate")) == ["no parameter drag.linear@elbow"]
    refused = Outcome(None, 2, 1.0, 1.0, 100.0, "joint elbow: its axis is reversed")
    flipped = {"exit": 2, "message": "axis.*reversed"}
    assert faults(flipped, refused) == []
    assert faults(flipped, dataclasses.replace(refused, code=0)) == ["exit code 0, not 2"]
    assert len(faults(flipped, outcome(("mass.scale@upper",)))) == 2
    assert faults({"plain": "nothing is published"}, refused) is None


def test_every_recording_has_a_row():
    shared = Path(os.environ.get("SIMGAP_SHARED", SHARED))
    if not (shared / "cases").is_dir():
        pytest.skip(f"no cases: {shared / 'cases'} is missing (set SIMGAP_SHARED)")
    recordings = tomllib.loads(RECORDINGS.read_text())
    listed = {(r["folder"], r.get("recording")) for r in recordings.values()}
    folders = {folder for folder, _ in listed}
    for case in (shared / "cases").iterdir():
        assert f"cases/{case.name}" in folders or case.name in ("tuners", "ANSWERS.md")
    for path in (shared / "data").glob("*/*.csv"):
        assert (f"data/{path.parent.name}", path.name) in listed
    for path in (shared / "robots").glob("*/"):
        assert f"robots/{path.name}" in folders


def test_rows_are_not_made_again(tmp_path, capsys):
    folder = tmp_path / "shared" / "data" / "ball_drops"
    folder.mkdir(parents=True)
    calls, out = tmp_path / "calls", tmp_path / "table.csv"
    note = f"with open({str(calls)!r}, 'a') as file: file.write('x')\n"
    simgap = command(tmp_path / "simgap", note + WRITE)
    given = ["--simgap", str(simgap), "--out", str(out), "--shared", str(tmp_path / "shared")]
    assert main([*given, "--version", "one", "--only", "bowling_ball"]) == 0
    assert main([*given, "--version", "one", "--only", "*_ball"]) == 0
    rows = {row["item"]: row for row in read_rows(out)}
    assert calls.read_text() == "x" * len(rows)
    assert rows["bowling_ball"]["right"] == "yes"
    assert rows["tennis_ball"]["right"] == "no"
    assert rows["golf_ball"]["right"] == ""
    assert "1 of 4 right, 5 recordings" in capsys.readouterr().out
