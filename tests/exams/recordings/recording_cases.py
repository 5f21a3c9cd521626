"""All measured recordings and cases, with what is known of each (recordings.toml)."""

from __future__ import annotations

import math
import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from sims.core.toml_validation import tomllib
from tests.exams.exam import Case, Exam, Question, Target, UndrawableError, conditions_text
from tests.exams.explain_calls import Outcome
from tests.exams.marking import Mark


def find_answer_errors(expected, outcome):
    """Return the errors of an answer; empty for a right one, None if no answer is expected.

    Args:
        expected: table of a recording in recordings.toml.
        outcome: `tests.exams.explain_calls.Outcome`.
    """
    if "plain" in expected:
        return None
    found = []
    if "exit" in expected and outcome.code != expected["exit"]:
        found.append(f"exit code {outcome.code}, not {expected['exit']}")
    if "message" in expected:
        text = outcome.output + str(outcome.verdict or "")
        if not re.search(expected["message"], text, re.IGNORECASE):
            found.append("no such finding in the output")
    if not {"verdicts", "causes", "parameters"} & expected.keys():
        return found
    if outcome.verdict is None:
        return [*found, "no answer"]
    verdict = outcome.verdict
    if "verdicts" in expected and verdict["verdict"] not in expected["verdicts"]:
        found.append(f"verdict {verdict['verdict']}, not {' or '.join(expected['verdicts'])}")
    if verdict["verdict"] in ("unknown", "unidentifiable") and expected.get("causes"):
        found.append("causes are listed, not named")
    found += _find_cause_errors(expected, verdict["causes"])
    for name, number in expected.get("parameters", {}).items():
        stated = verdict["parameters"].get(name)
        if stated is None:
            found.append(f"no parameter {name}")
        elif not _is_near(stated["value"], number):
            found.append(f"{name} = {stated['value']:.4g}, not {number['value']:g}")
    return found


def _find_cause_errors(expected, causes):
    found, matched = [], []
    for wanted in expected.get("causes", []):
        cause = next(
            (c for c in causes if {c["effect"], *c["alternatives"]} & set(wanted["effect"])), None
        )
        if cause is None:
            found.append(f"without {' or '.join(wanted['effect'])}")
            continue
        matched.append(cause["effect"])
        allowed = {*wanted["effect"], *wanted.get("alternatives", [])}
        strange = {cause["effect"], *cause["alternatives"]} - allowed
        if strange and "*" not in allowed:
            found.append(f"alternatives {', '.join(sorted(strange))}")
        if "value" in wanted and cause["effect"] in wanted["effect"]:
            values = [c["value"] for c in cause["coefficients"].values()]
            if not all(_is_near(value, wanted) for value in values):
                found.append(f"{cause['effect']} = {values[0]:.4g}, not {wanted['value']:g}")
    others = [cause["effect"] for cause in causes if cause["effect"] not in matched]
    if others and not expected.get("others", False):
        found.append(f"in addition {', '.join(others)}")
    return found


def _is_near(value, wanted):
    absolute = wanted.get("absolute", 0.0)
    return math.isclose(
        value, wanted["value"], rel_tol=wanted.get("tolerance", 0.0), abs_tol=absolute
    )


RECORDINGS = Path(__file__).with_name("recordings.toml")
SHARED = Path(os.environ.get("SIMGAP_SHARED", Path(__file__).parents[4] / "shared"))
"""Folder with cases/, data/ and robots/."""


@dataclass(frozen=True)
class RecordingQuestion(Question):
    """A measured recording."""

    name: str
    kind = "measured"

    @property
    def expected(self):
        return tomllib.loads(RECORDINGS.read_text())[self.name]

    @property
    def system(self):
        return self.expected["folder"]

    @property
    def effect(self):
        return " + ".join("|".join(c["effect"]) for c in self.expected.get("causes", []))

    def draw(self, seed=0):
        folder = SHARED / self.system
        if not folder.is_dir():
            raise UndrawableError(f"no folder {folder} (SIMGAP_SHARED names its parent)")
        return RecordingCase(self.expected, folder)


@dataclass(frozen=True)
class RecordingCase(Case):
    """A measured recording, and the right answer as far as it is known."""

    expected: dict
    folder: Path

    def write(self, folder):
        """Write a description where the recording has none, and return what is to be explained."""
        if "description" in self.expected:
            text = self.expected["description"].replace("{folder}", str(self.folder))
            (folder / "log.toml").write_text(text)
            if "model" in self.expected:
                (folder / "model.xml").write_text(self.expected["model"])
            return folder / "log.toml"
        if "import" in self.expected:
            return folder / "log.toml"
        return self.folder / self.expected.get("recording", "log.csv")

    def answer(self, recording, out, call):
        if "import" in self.expected:
            options = [o.replace("{folder}", str(self.folder)) for o in self.expected["import"]]
            command = [call.simgap, "import", self.folder, *options, "--out", recording]
            done = subprocess.run(
                [str(word) for word in command], capture_output=True, text=True, check=False
            )
            if done.returncode:
                return Outcome(None, 2, output=done.stdout + done.stderr)
        return call(recording, out, self.expected.get("options", ()))

    def describe(self):
        conditions = conditions_text(asked_s=self.expected.get("cpu", ""))
        return {"hidden": "", "size": "", "noise": "", "conditions": conditions}

    def mark(self, outcome):
        found = find_answer_errors(self.expected, outcome)
        causes = " + ".join(map(_cause_text, (outcome.verdict or {}).get("causes", [])))
        if found is None:
            return Mark("unknown", causes, note=self.expected["plain"])
        is_good = not found
        levels = dict.fromkeys(("strict", "few", "equivalent", "fair", "any"), is_good)
        return Mark("right" if is_good else "wrong", causes, note="; ".join(found), **levels)


def _cause_text(cause):
    values = " ".join(f"{c['value']:.4g}" for c in cause["coefficients"].values())
    return f"{'|'.join([cause['effect'], *cause['alternatives']])} ({values})"


def questions(seed=0):
    """Return all recordings."""
    return [RecordingQuestion(name) for name in tomllib.loads(RECORDINGS.read_text())]


EXAM = Exam(
    "Answers to all measured recordings and cases",
    "`tests/exams/recordings/recordings.toml` says what is known of each.",
    questions, (Target("right answers", "measured", "strict"),), groups=(), needs_command=True,
)  # fmt: skip
