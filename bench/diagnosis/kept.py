"""What a comparison of diagnosers keeps while it is made: a line of JSON for each question,
appended when all of its answers are there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from sims.base import InputError

ANSWERS = "answers.jsonl"
"""The file; the truth of every question that has been asked stands in it, out of diagnosers'
reach.
"""


class Kept:
    """The answers in a folder, ready for more.

    Args:
        folder: of the study.

    Attributes:
        answered: by question: its item, {} where it could not be drawn, and rows by diagnoser.

    Raises:
        InputError: another process is at work there.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / ANSWERS
        self._file: IO[str] = self._path.open("a", encoding="utf-8")
        try:
            _lock(self._file)
        except OSError:
            self._file.close()
            raise InputError(
                f"{folder}: another simgap is at work there; wait for it, or end it"
            ) from None
        self._end_last_line()
        self.answered = read(folder)

    def _end_last_line(self) -> None:
        """Put an end to a line that a kill has cut off: it is no JSON, and is read as none."""
        data = self._path.read_bytes()
        if data and not data.endswith(b"\n"):
            self._file.write("\n")
            self._file.flush()

    def add(self, one: Mapping[str, Any]) -> None:
        """Keep the answers to a question; when this returns they survive a kill."""
        self._file.write(json.dumps(one) + "\n")
        self._file.flush()
        _enter(self.answered, one)

    def close(self) -> None:
        """Let others work there."""
        self._file.close()


Answered = dict[str, dict[str, Any]]


def read(folder: Path) -> Answered:
    """All that was answered, by question: ``item``, and ``rows`` by diagnoser."""
    answered: Answered = {}
    path = folder / ANSWERS
    if not path.exists():
        return answered
    with path.open(encoding="utf-8") as file:
        for line in file:
            try:
                one = json.loads(line)
            except ValueError:
                continue  # cut off by a kill: it was not finished
            _enter(answered, one)
    return answered


def _enter(answered: Answered, one: Mapping[str, Any]) -> None:
    held = answered.setdefault(one["question"], {"item": one["item"], "rows": {}})
    held["item"] = one["item"]
    for row in one["rows"]:
        held["rows"][row["diagnoser"]] = row


def _lock(file: IO[str]) -> None:
    """Held until this process ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
