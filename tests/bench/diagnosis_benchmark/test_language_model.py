"""The diagnoser that asks a language model, with a program in place of the model."""

import csv
import json
import sys

import pytest

from bench.diagnosis_benchmark.diagnosers.language_model import parse_answer
from sims.core.simulator import InputError
from tests.command_output import run_command

EXPERIMENT = """
budget = 20000
timeout = 60.0
salt = "public"
[diagnosis]
diagnosers = ["ljung-box"]
[[diagnosis.questions]]
kind = "clean"
systems = ["slider"]
[[diagnosis.questions]]
kind = "single"
systems = ["slider"]
effects = ["drag.linear"]
sizes = [20.0]
rates = [50]
runs = [3]
"""
# It reads the summary as a model would: large residuals mean that something is missing.
STUB = """
import json, pathlib, sys
text = sys.stdin.read()
case = json.loads(text[text.index('{"simulator"'):])
pathlib.Path(sys.argv[1]).write_text(text)
worst = max(max(run["residual_rms"].values()) for run in case["runs"])
assert "drag.linear" in case["effects"]
if worst > 1.5:
    answer = {"verdict": "named", "causes": [{"effect": "drag.linear"}]}
else:
    answer = {"verdict": "adequate", "causes": []}
print("I think the answer is:\\n```json\\n" + json.dumps(answer) + "\\n```")
"""


@pytest.fixture
def diagnoser_command(monkeypatch, fresh_registries):
    monkeypatch.setenv("SIMGAP_DIAGNOSER_COMMAND", "")  # restored afterwards
    monkeypatch.setattr("bench.diagnosis_benchmark.diagnoser_report.draw_figures", lambda *_: {})


def compare(folder, command, code=0):
    """Compare diagnosers, one of which is a command; return the rows of the answers."""
    path, out = folder / "board.toml", folder / "out"
    path.write_text(EXPERIMENT)
    run_command("compare", path, "--command", command, "--jobs", 0, "--out", out, code=code)
    with (out / "items.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_command_is_a_diagnoser(tmp_path, diagnoser_command):
    stub, prompt = tmp_path / "stub.py", tmp_path / "prompt.txt"
    stub.write_text(STUB)
    rows = compare(tmp_path, f"{sys.executable} {stub} {prompt}")
    assert {row["diagnoser"] for row in rows} == {"language-model"}
    assert [row["status"] for row in rows] == ["done", "done"]
    assert sorted(row["verdict"] for row in rows) == ["adequate", "named"]
    assert {row["trusted"] for row in rows} == {"True"}
    text = prompt.read_text()
    summary = json.loads(text[text.index('{"simulator"') :])
    assert len(summary["runs"]) >= 2
    assert all(len(run["t"]) <= 40 for run in summary["runs"])
    assert {"verdict", "causes"} <= set(text.replace('"', " ").split())


def test_a_failing_command_is_a_failed_answer(tmp_path, diagnoser_command):
    rows = compare(tmp_path, f"{sys.executable} -c 'import sys; sys.exit(3)'", code=1)
    assert {row["status"] for row in rows} == {"crashed"}
    assert "exit code 3" in rows[0]["reason"]


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ('{"verdict": "unknown"}', "unknown"),
        ('Thus {"a": 1} and {"verdict": "named", "causes": ["wind"]}.', "named"),
        ('{"verdict": "adequate"} no, rather {"verdict": "unknown"}', "unknown"),
    ],
)
def test_the_last_verdict_in_a_text_counts(text, verdict):
    assert parse_answer(text).verdict == verdict


@pytest.mark.parametrize("text", ["", "I do not know.", '{"verdict": "maybe"}', "{" * 50])
def test_an_answer_without_a_verdict_is_one_message(text):
    with pytest.raises(InputError, match="verdict"):
        parse_answer(text)
