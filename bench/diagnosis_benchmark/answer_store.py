"""Store of the answers, one line of JSON per case, and their rows in the tables of results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.diagnosis_benchmark.case_generation.recording_conditions import BenchmarkCase
from bench.diagnosis_benchmark.grading import grade_answer
from sims.core.files import open_locked

ANSWERS_FILE = "answers.jsonl"
"""File of the answers. It contains the true causes too; no diagnoser can read it."""


class AnswerStore:
    """Store of the answers in a result folder, opened for appending.

    Attributes:
        answered: by case name, the case ({} if it could not be drawn) and one row per diagnoser.

    Raises:
        InputError: another process is working in the folder.
    """

    def __init__(self, folder: Path) -> None:
        """Open the file of the answers for appending, lock it, and read its answers.

        The lock prevents two processes from appending to the same file.

        Args:
            folder: result folder of the study.
        """
        self._path = folder / ANSWERS_FILE
        self._file = open_locked(self._path, folder)
        self._end_last_line()
        self.answered = read_answers(folder)

    def _end_last_line(self) -> None:
        """Terminate a line that was cut off when a process was killed; the reader skips it."""
        data = self._path.read_bytes()
        if data and not data.endswith(b"\n"):
            self._file.write("\n")
            self._file.flush()

    def append(self, document: Mapping[str, Any]) -> None:
        """Append the answers to a case; they survive a kill of the process after this call.

        Args:
            document: JSON document of `case_evaluation.evaluate_case`: name of the case, the case,
                and one
                row per diagnoser that was asked.
        """
        self._file.write(json.dumps(document) + "\n")
        self._file.flush()
        _add_line(self.answered, document)

    def close(self) -> None:
        """Close the file and release its lock."""
        self._file.close()


AnswersByCase = dict[str, dict[str, Any]]


def read_answers(folder: Path) -> AnswersByCase:
    """Read all answers of a result folder.

    Returns:
        By case name, ``item`` (the case) and ``rows`` by diagnoser.
    """
    answers: AnswersByCase = {}
    path = folder / ANSWERS_FILE
    if not path.exists():
        return answers
    with path.open(encoding="utf-8") as file:
        for line in file:
            try:
                document = json.loads(line)
            except ValueError:
                continue  # incomplete line of a killed process
            _add_line(answers, document)
    return answers


def _add_line(answers: AnswersByCase, document: Mapping[str, Any]) -> None:
    """Add one line of the file of the answers to `answers`.

    A case has several lines if diagnosers were asked in different sessions. The newest line
    replaces the case, and the rows of its own diagnosers only.

    Args:
        answers: answers by name of the case; changed in place.
        document: document of the line: name of the case (``question``), case (``item``), and list
            of ``rows``.
    """
    stored = answers.setdefault(document["question"], {"item": document["item"], "rows": {}})
    stored["item"] = document["item"]
    for row in document["rows"]:
        stored["rows"][row["diagnoser"]] = row


CASE_COLUMNS = ("noise", "stated", "rate", "seconds", "runs", "source", "driven", "size", "beyond")
"""Attributes of a case that are columns of a result row."""
SKIPPED_STATUS = "skipped"
"""Status and outcome of a case that the diagnoser does not support."""
RUN_SECONDS_COLUMN = "run_seconds"
"""Column of the length of a run; the column `seconds` is the time of an answer."""


def build_answer_rows(answered: AnswersByCase, diagnosers: Sequence[str]) -> pd.DataFrame:
    """Build the result rows, ordered by diagnoser and then by case.

    Args:
        answered: stored answers.
        diagnosers: names of the diagnosers.
    """
    rows = [row for name in diagnosers for row in _iterate_rows(name, answered)]
    return pd.DataFrame(rows)


def _iterate_rows(diagnoser: str, answers: AnswersByCase) -> Iterator[dict[str, Any]]:
    """Yield the result rows of one diagnoser, ordered by the name of the case.

    A case is left out if it was not drawn (its stored document has no hidden effects) or if this
    diagnoser has not answered it.
    """
    for question, answer in sorted(answers.items()):
        # The case could not be drawn, or its worker was lost before it was drawn.
        if "effects" not in answer["item"] or diagnoser not in answer["rows"]:
            continue
        yield build_answer_row(
            question, BenchmarkCase.from_document(answer["item"]), answer["rows"][diagnoser]
        )


def build_answer_row(
    question: str, case: BenchmarkCase, stored_answer: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the result row of one answer: its case, true causes, answer, grade and cost.

    The rows of all answers are the file items.csv, from which all tables and figures are computed.

    Args:
        question: name of the case.
        case: the case with its true causes.
        stored_answer: stored answer of one diagnoser, with its status, reason and cost.

    Returns:
        Values by column. ``found`` and ``found_class`` tell whether the cause was identified
        without and with equivalent effects counted as one. ``alarm`` tells whether the diagnoser
        says that something is missing; a missing answer counts as an alarm. ``intervals`` is the
        number of closed 95 % intervals, ``holding`` how many of them contain the true value.
    """
    answer = stored_answer["answer"]
    grade = grade_answer(case, answer)
    known_coverage = [covered for covered in grade.covered.values() if covered is not None]
    causes = answer["causes"] if answer else []
    case_columns = {name: getattr(case, name) for name in CASE_COLUMNS}
    case_columns[RUN_SECONDS_COLUMN] = case_columns.pop("seconds")
    return {
        "question": question,
        "diagnoser": stored_answer["diagnoser"],
        "kind": case.kind,
        "system": case.system,
        "hidden": " + ".join(case.effects),
        **case_columns,
        "channels": " ".join(case.channels),
        "status": stored_answer["status"],
        "reason": (stored_answer["reason"].strip().splitlines() or [""])[-1][:200],
        "verdict": answer["verdict"] if answer else "",
        "named": grade.named,
        "outcome": SKIPPED_STATUS if stored_answer["status"] == SKIPPED_STATUS else grade.outcome,
        "set_size": grade.set_size,
        "class_size": grade.class_size,
        "largest_set": max((1 + len(c["alternatives"]) for c in causes), default=0),
        "found": grade.is_correct,
        "found_class": grade.is_correct_up_to_equivalence,
        "alarm": answer is None or answer["verdict"] != "adequate",
        "p_value": answer["p_value"] if answer else None,
        "intervals": len(known_coverage),
        "holding": sum(known_coverage),
        "simulations": stored_answer["simulations"],
        "seconds": stored_answer["seconds"],
        "processor_seconds": stored_answer["processor_seconds"],
        "trusted": stored_answer["trusted"],
    }
