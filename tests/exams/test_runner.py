"""Tests that exams are resumed, calls are limited, and tables and pages are written."""

import json
import subprocess
import sys
from itertools import count
from pathlib import Path
from pkgutil import resolve_name

import pandas as pd
import pytest

from tests.exams import exam, exam_report, explain_calls, runner
from tests.exams.__main__ import EXAMS, main
from tests.exams.exam import Exam, Target
from tests.exams.explain_calls import ExplainCall
from tests.exams.marking import Mark

ADEQUATE = {"verdict": "adequate", "causes": [], "parameters": {}, "heldout": None}
BURN = "import time\nwhile time.process_time() < {seconds}: sum(range(10000))\n"
WRITE = f"out.mkdir()\n(out / 'verdict.json').write_text({json.dumps(json.dumps(ADEQUATE))})\n"


def command(path, body):
    """Write an executable that replaces simgap; `out` is the folder of --out."""
    path.write_text(
        f"#!{sys.executable}\nimport json, pathlib, subprocess, sys\n"
        f"out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n{body}\n"
    )
    path.chmod(0o755)
    return path


def test_a_call_measures_the_time_of_all_processes(tmp_path):
    child = f"subprocess.run([sys.executable, '-c', {BURN.format(seconds=0.4)!r}])\n"
    simgap = command(tmp_path / "simgap", BURN.format(seconds=0.3) + child + WRITE)
    outcome = ExplainCall(simgap)(tmp_path / "log.csv", tmp_path / "answer")
    assert outcome.verdict == ADEQUATE
    assert outcome.code == 0
    assert 0.7 <= outcome.cpu < 2.0
    assert outcome.wall > 0.3
    # A child also counts the memory pages of its parent until it executes the command.
    assert outcome.memory > 5


PEAKS = """
from tests.exams import explain_calls
explain_calls._reset_peak_memory()
first = explain_calls._read_peak_memory()
# Written, so that the system provides the memory.
block = b"1" * 200_000_000
peak = explain_calls._read_peak_memory()
del block
explain_calls._reset_peak_memory()
print(first, peak, explain_calls._read_peak_memory())
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux counts the peak")
def test_a_question_does_not_count_the_memory_of_the_one_before():
    # In a worker of a whole run, other tests allocate and free memory, too.
    printed = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True)
    first, peak, last = (float(word) for word in printed.stdout.split())
    assert peak > first + 150.0
    assert last < peak - 150.0


def test_a_call_ends_at_the_limit_with_its_children(tmp_path):
    child = f"subprocess.run([sys.executable, '-c', {BURN.format(seconds=60)!r}])\n"
    simgap = command(tmp_path / "simgap", child + WRITE)
    outcome = ExplainCall(simgap, 0.5)(tmp_path / "log.csv", tmp_path / "answer")
    assert outcome.verdict is None
    assert outcome.code is None
    assert 0.5 <= outcome.cpu < 3.0


def test_an_error_of_the_command_is_no_answer(tmp_path):
    simgap = command(tmp_path / "simgap", "print('log.csv: no such file'); sys.exit(2)")
    outcome = ExplainCall(simgap)(tmp_path / "log.csv", tmp_path / "answer")
    assert (outcome.verdict, outcome.code) == (None, 2)
    assert outcome.message == "log.csv: no such file"


def test_an_error_of_the_function_is_no_answer(tmp_path, monkeypatch):
    def crash(recording):
        raise RuntimeError("no answer")

    monkeypatch.setattr("bench.diagnosis.explain.explain", crash)
    outcome = ExplainCall()(tmp_path / "log.csv", tmp_path)
    assert (outcome.verdict, outcome.code) == (None, 1)
    assert "RuntimeError: no answer" in outcome.message


@pytest.mark.slow
def test_an_interrupted_exam_continues_and_versions_share_a_folder(tmp_path, capsys):
    calls, out = tmp_path / "calls", tmp_path / "out"
    note = f"with open({str(calls)!r}, 'a') as file: file.write('x')\n"
    simgap = command(tmp_path / "simgap", note + WRITE)
    given = ["systems", "--simgap", str(simgap), "--out", str(out), "--quick", "--jobs", "1"]
    clean = [*given, "--only", "marks/clean"]
    assert main([*clean, "--version", "one", "--count", "1"]) == 0
    with (out / "items.jsonl").open("a") as file:
        file.write('{"item": "cut o')  # An interruption leaves an incomplete line.
    assert main([*clean, "--version", "one", "--count", "2"]) == 0
    assert calls.read_text() == "xx"
    assert main([*clean, "--version", "two", "--count", "1"]) == 0
    rows = exam.read_rows(out / "items.jsonl")
    assert [row["version"] for row in rows] == ["one", "one", "two"]
    assert {row["mark"]["outcome"] for row in rows} == {"right"}
    assert rows[0]["digest"] == rows[2]["digest"]
    assert "0/1 = 0.0%" in capsys.readouterr().out
    command(tmp_path / "simgap", "sys.exit(1)")
    assert main([*clean, "--version", "one", "--count", "1", "--fresh"]) == 1
    failed = {path.name for path in out.iterdir()}
    assert failed == {"items.jsonl", "items.csv", "summary.csv", "README.md", "figures"}


class SavedCase(exam.Case):
    """A case that answers itself and can be saved."""

    def __init__(self, number):
        self.number = number

    def save(self):
        return {"number": self.number}

    def write(self, folder):
        (folder / "log.csv").write_text(str(self.number))

    def describe(self):
        return {"hidden": str(self.number), "size": "1", "noise": "white", "conditions": ""}

    def mark(self, outcome):
        return Mark("right")

    def answer(self, recording, out, call):
        return explain_calls.Outcome(ADEQUATE, 0)


class SavedQuestion(exam.Question):
    """A question whose case is another one whenever it is drawn."""

    name, kind, system, effect = "single/a", "single", "a", "drag.linear"
    numbers = count()

    def draw(self, seed):
        return SavedCase(next(self.numbers))

    def restore(self, saved):
        return SavedCase(**saved)


def test_a_case_is_drawn_once_for_all_versions(tmp_path):
    """The case depends on the seed, so that another seed is drawn."""
    question = SavedQuestion()
    first = runner.answer_question(question, 0, None, tmp_path)
    again = runner.answer_question(question, 0, None, tmp_path, saved=first["saved"])
    assert (first["case"], first["digest"]) == (again["case"], again["digest"])
    assert first["saved"] == again["saved"] == {"seed": 0, "case": {"number": 0}}
    assert runner.answer_question(question, 0, None, tmp_path)["case"]["hidden"] == "1"
    rows = [first | {"version": "one"}]
    assert runner.list_saved(rows, seed=0) == {"single/a": first["saved"]}
    assert runner.list_saved(rows, seed=1) == {}


def test_an_unknown_case_name_is_refused(tmp_path, capsys):
    assert main(["planted", "--only", "no-robot", "--out", str(tmp_path)]) == 2
    assert "no question of planted has such a name" in capsys.readouterr().out
    assert main(["planted", "--spread", "--out", str(tmp_path)]) == 2
    assert "planted: this exam has no such selection" in capsys.readouterr().out
    assert main(["planted", "--simgap", "no-such", "--out", str(tmp_path)]) == 2
    assert "expected bin/simgap" in capsys.readouterr().out


@pytest.mark.parametrize("name", EXAMS)
def test_case_names_are_unique_and_any_part_of_the_order_is_balanced(name):
    pytest.importorskip("pinocchio", reason="pin has no wheel here")
    chosen = resolve_name(EXAMS[name])
    questions = runner.select_questions(chosen)
    assert len({q.name for q in questions}) == len(questions) >= 40
    kinds = {q.kind for q in questions}
    assert {q.kind for q in questions[:40]} >= kinds - {"numerics", "family", "double"}
    few = runner.select_questions(chosen, only=questions[0].name, count=3)
    assert few == questions[:1]


EXAM = Exam(
    "Title", "About.", list, (Target("named", "single", "strict", 0.5),), groups=("effect", "size")
)


def row(number, outcome="right", kind="single", version="one", **more):
    is_good = outcome == "right"
    mark = Mark(outcome, "drag.linear@elbow", 1, **dict.fromkeys(exam.LEVELS, is_good))
    case = {
        "hidden": "drag.linear@elbow=1",
        "size": 3.0,
        "noise": "white",
        "conditions": "part=marks",
    }
    return {
        "item": f"{kind}/{number}", "kind": kind, "system": "ur5", "effect": "drag.linear",
        "version": version, "case": case, "digest": "a", "mark": mark.to_json(), "verdict": None,
        "message": "", "cpu": 2.0 * number, "wall": 2.0, "memory": 200.0, **more,
    }  # fmt: skip


def test_tables_count_good_answers_and_undrawn_questions(tmp_path):
    rows = [row(1), row(2), row(3, "failed"), row(4, "alarm", "clean"), row(5, case=None)]
    rows[0]["mark"]["covered"] = {"a": True, "b": False, "c": None}
    table = exam.write_table(tmp_path / "items.csv", rows)
    assert list(table.columns[: len(exam.COLUMNS)]) == list(exam.COLUMNS)
    summary = exam_report.summarise(EXAM, table).set_index(["group", "value"])
    assert summary.loc[("kind", "single"), ["items", "strict", "no_answer"]].tolist() == [3, 2, 1]
    assert summary.loc[("all", ""), ["intervals_held", "intervals"]].tolist() == [1, 2]
    assert summary.loc[("all", ""), "cpu_max_s"] == 8.0
    (named, alarms, intervals) = exam_report.target_rows(EXAM, table)
    assert named[2][:2] == (2, 3)
    assert (named[3], alarms[3], intervals[3]) == (True, False, False)
    assert not exam_report.passes(EXAM, table)
    assert exam_report.passes(EXAM, table[table.outcome == "right"])


def test_the_page_keeps_text_outside_its_marks(tmp_path):
    (tmp_path / "README.md").write_text(
        f"# Mine\n\n{exam_report.BEGIN}\nold\n{exam_report.END}\nEnd.\n"
    )
    rows = [row(1), row(2, "wrong"), row(3, case=None)]
    table = exam.write_table(tmp_path / "items.csv", rows)
    exam_report.write_report(tmp_path, EXAM, table)
    page = (tmp_path / "README.md").read_text()
    assert page.startswith("# Mine\n\n<!-- results -->\n| criterion |")
    assert (
        "1 question is not graded, because no sampled recording shows the cause: `single/3`."
        in page
    )
    assert page.endswith("<!-- /results -->\nEnd.\n")
    assert "| named | at least 50% | 1/2 = 50.0%" in page
    assert "old" not in page
    assert (tmp_path / "figures" / "confusion.png").stat().st_size > 0
    assert pd.read_csv(tmp_path / "summary.csv").strict.iloc[0] == 1


def test_the_page_omits_criteria_without_cases(tmp_path):
    table = exam.write_table(tmp_path / "items.csv", [row(1, "right", "clean")])
    page = exam_report.format_page(EXAM, table)
    assert "| named |" not in page
    assert "| clean recordings: false alarms | at most 1% | 0/1 = 0.0%" in page


def test_answers_without_a_verdict_have_no_cause_in_the_confusion(tmp_path):
    rows = [row(1, "failed"), row(2, "right", "clean"), row(3, "unnamed")]
    for answer in rows:
        answer["mark"]["causes"] = ""
    table = exam.write_table(tmp_path / "items.csv", rows)
    counts = exam_report.count_confusion(table)
    assert counts.loc["(clean)", "(no cause)"] == 1
    assert counts.loc["drag.linear", ["(failed)", "(no cause)"]].tolist() == [1, 1]


def test_versions_with_different_recordings_are_reported():
    rows = [row(1), row(1, version="two"), row(2), row(2, version="two", digest="b")]
    (line,) = exam_report.differing_recordings(rows)
    assert line.endswith("(use --fresh): single/2")


def test_shares_have_wilson_or_exact_intervals():
    assert exam_report.share([True] * 97 + [False] * 3)[3] == pytest.approx(0.9155, abs=1e-3)
    exact = exam_report.share([False] * 300, exact=True)
    assert exact[4] == pytest.approx(1 - 0.025 ** (1 / 300))


def test_the_version_is_the_commit_of_the_source():
    assert explain_calls.version_of().rstrip("+").isalnum()
