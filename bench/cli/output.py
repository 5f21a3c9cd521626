"""Print the results of commands as text or JSON, and build the JSON summaries of studies.

A command is a function of its options and of `print_line`, which prints one line of text at once.
It returns a `CommandResult`, which contains the same information as JSON. One of the two printers
here prints either the one or the other; so every command has ``--json``, and errors have one form.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from sims.core.json_documents import to_json_value

if TYPE_CHECKING:
    from bench.benchmark.runner.study_base import Study

JsonDocument = dict[str, Any]
"""Data that can be written as JSON after conversion by `to_json_value`."""
PrintLine = Callable[[str], None]
"""Prints a line of text."""
ErrorKind = Literal["usage", "input", "memory", "interrupted", "internal"]
EXIT_OK = 0
"""Exit code of a command that succeeded."""
EXIT_PROBLEMS_FOUND = 1
"""Exit code of a command that completed but found a problem."""
EXIT_ERROR = 2
"""Exit code of a command that could not begin or continue."""
EXIT_INTERRUPTED = 130
"""Exit code of a command that was interrupted, by the convention of shells."""
EXIT_CODES = {
    EXIT_OK: "done",
    EXIT_PROBLEMS_FOUND: "done, but a run or a check failed, or the condition of an option was met",
    EXIT_ERROR: "an error in the input, described in one line; no incomplete results are left",
    EXIT_INTERRUPTED: "interrupted; finished results are kept",
}
"""Meaning of every exit code."""
_FIGURES_FOLDER = "figures"
"""Name of the folder of figures."""


class CommandResult(NamedTuple):
    """Result of a command for a program.

    Attributes:
        document: JSON document by the schema of the command's name (`simgap schema NAME`).
        code: Exit code of the program, one of `EXIT_CODES`.
    """

    document: JsonDocument
    code: int = EXIT_OK


class OutputWriter:
    """Prints the results of a command: lines for a person, or one JSON document for a program.

    Args:
        as_json: Whether stdout gets the JSON document and nothing else.
    """

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json

    def print_line(self, line: str) -> None:
        """Print a line of text; the JSON document contains its information."""
        if not self._as_json:
            print(line)

    def capture_output(self) -> AbstractContextManager[None]:
        """Return the context in which the command runs; other output than JSON goes to stderr."""
        return _redirect_stdout_to_stderr() if self._as_json else nullcontext()

    def print_result(self, answer: CommandResult) -> None:
        """Print the JSON document of a command, whose lines have been printed before."""
        if self._as_json:
            print(format_json(answer.document))

    def print_error(self, kind: ErrorKind, message: str, code: int) -> None:
        """Print why the command failed: a line on stderr, and the JSON document.

        Args:
            kind: Kind of the error; an internal error has a traceback instead of the line.
            message: One line.
            code: Exit code of the program.
        """
        if kind != "internal":
            print(f"simgap: {message}", file=sys.stderr)
        if self._as_json:
            print(format_json({"error": {"kind": kind, "message": message, "code": code}}))


def format_json(document: JsonDocument) -> str:
    """Format a document as indented JSON."""
    return json.dumps(to_json_value(document), indent=1, allow_nan=False, ensure_ascii=False)


@contextmanager
def _redirect_stdout_to_stderr() -> Iterator[None]:
    """Redirect to stderr what Python, C libraries and worker processes print.

    With ``--json`` stdout must contain the JSON document only. C libraries write to the descriptor
    1 directly, so it is redirected too.
    """
    sys.stdout.flush()
    with redirect_stdout(sys.stderr):
        try:
            descriptor = sys.__stdout__.fileno() if sys.__stdout__ else None
        except (OSError, ValueError):
            descriptor = None
        if descriptor is None:
            yield
            return
        saved_descriptor = os.dup(descriptor)
        try:
            os.dup2(2, descriptor)
            yield
        finally:
            _flush_c()
            os.dup2(saved_descriptor, descriptor)
            os.close(saved_descriptor)


def _flush_c() -> None:
    """Flush the output buffers of C; at exit they would be written into the JSON output."""
    import ctypes

    try:
        ctypes.CDLL(None).fflush(None)
    except (AttributeError, OSError, TypeError):  # C's library is not accessible in the program.
        return


def summarise_study(study: Study) -> JsonDocument:
    """Summarise a study: name, folder, files, isolation, kind of salt, and results."""
    experiment = study.configuration.experiment
    return {
        "name": experiment.name,
        "folder": study.folder,
        "trusted": experiment.trusted,
        "salt": "secret" if experiment.salt_sha256 else "public",
        "files": list_result_files(study.folder),
        "results": summarise_results(study.folder / "table.csv"),
    }


def list_result_files(folder: Path) -> list[Path]:
    """List the files of a result folder and its figures, without the data of single runs."""
    paths = [*folder.glob("*"), *(folder / _FIGURES_FOLDER).glob("*")]
    return sorted(path for path in paths if path.is_file() and not path.name.startswith("."))


def summarise_results(table: Path) -> list[JsonDocument]:
    """Read the last row of each tuner, range and metric from a table.

    All rows are read for bounce shots and diagnosers, and none if there is no table.
    """
    if not table.is_file():
        return []
    import pandas as pd

    # Only empty cells are missing values, and names such as "None" are not.
    lines = pd.read_csv(table, keep_default_na=False, na_values=[""]).astype(object)
    if "simulations" in lines and "metric" in lines:
        # Rows are ordered by the number of simulations.
        lines = lines.groupby(["tuner", "range", "metric"], sort=False, dropna=False).tail(1)
    rows = lines.where(lines.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]
