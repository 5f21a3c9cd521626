"""Store of the answers: one line of JSON per case and session, appended as cases are finished."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
                and one row per diagnoser that was asked.
        """
        self._file.write(json.dumps(document) + "\n")
        self._file.flush()
        _add_line(self.answered, document)

    def close(self) -> None:
        """Close the file and release its lock."""
        self._file.close()


AnswersByCase = dict[str, dict[str, Any]]


def read_answers(folder: Path) -> AnswersByCase:
    """Read all answers of a result folder; there are none without a file of answers.

    Returns:
        By case name: ``item``, the case as JSON with its true causes ({} if it could not be drawn),
        and ``rows``, the stored answer of each diagnoser by its name.
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
