"""Run a command on malformed input and check the rules that hold for every input."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import traceback
from collections.abc import Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

from bench.cli.main import main
from bench.core.plugin_registries import REGISTRIES
from sims.core.user_messages import MAX_MESSAGE_LENGTH
from tests.malformed_input.shortened_work import HERE, CutError

LIMIT = 30
"""Time limit of a command in seconds."""
_NONSENSE = re.compile(r"(?<![\w.])(nan|inf|infinity)(?!\w)", re.IGNORECASE)
_REFUSED = (0, 1, 2, 130)


@dataclass(frozen=True)
class Case:
    """Input files and a command that reads them.

    Attributes:
        arguments: arguments of the command, which runs in the folder of the files.
        files: contents by name; None removes a file of the base.
        base: name of a prepared folder, which is copied as `run`.
        owns: prefixes of the paths that the command may change if it succeeds.
        numbers: whether the printed numbers must be finite.
    """

    arguments: tuple[str, ...]
    files: Mapping[str, bytes | None] = field(default_factory=dict)
    base: str = ""
    owns: tuple[str, ...] = ()
    numbers: bool = False


class RuleViolationError(AssertionError):
    """A command has violated a rule."""


class _LateError(BaseException):
    """A command has exceeded the time limit."""


@dataclass(frozen=True)
class CommandOutput:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def tried(case: Case, place: Path, bases: Mapping[str, Path]) -> CommandOutput:
    """Run the command of a case in a new folder `place` and check the result.

    Raises:
        RuleViolationError: the command has violated a rule.
    """
    here = place / HERE
    here.mkdir(parents=True)
    if case.base:
        shutil.copytree(bases[case.base], here / "run")
    for name, data in case.files.items():
        path = here / name
        path.unlink(missing_ok=True)
        if data is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    before = _held(place)
    output = _run_command(case.arguments, here)
    _check_case(case, output, before, _held(place))
    return output


def _held(place: Path) -> dict[str, bytes]:
    """Return the contents of all files and folders; the name of a folder ends in a slash."""
    return {
        f"{path.relative_to(place)}{'/' * path.is_dir()}": b"" if path.is_dir() else read(path)
        for path in place.rglob("*")
        if "__pycache__" not in path.parts
    }


def read(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _run_command(arguments: tuple[str, ...], here: Path) -> CommandOutput:
    out, err = io.StringIO(), io.StringIO()
    before, parts = Path.cwd(), [registry.snapshot() for registry in REGISTRIES]
    os.chdir(here)
    try:
        with _limited(), redirect_stdout(out), redirect_stderr(err):
            code = main(list(arguments))
    except CutError:
        code = 0
    except SystemExit as end:
        code = end.code
    except _LateError:
        raise RuleViolationError(f"took more than {LIMIT} s") from None
    except BaseException:
        raise RuleViolationError(traceback.format_exc()) from None
    finally:
        os.chdir(before)
        for registry, snapshot in zip(REGISTRIES, parts, strict=True):
            registry.restore(snapshot)
    return CommandOutput(code, out.getvalue(), err.getvalue())


@contextmanager
def _limited():
    def late(*_):
        raise _LateError

    usual = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, usual)


def _check_case(
    case: Case, output: CommandOutput, before: Mapping[str, bytes], after: Mapping[str, bytes]
):
    if output.code not in _REFUSED or type(output.code) is not int:
        raise RuleViolationError(f"exit code {output.code!r}")
    if "Traceback" in output.err:
        raise RuleViolationError(f"said a traceback: {output.err}")
    if output.code == 2:
        _check_refusal(output)
        if "--json" in case.arguments:
            _check_error_document(output)
        owned = ()
    else:
        owned = tuple(f"{HERE}/{name}" for name in case.owns)
    changed = [
        name
        for name in before
        if before[name] != after.get(name) and not name.startswith(owned or ("\0",))
    ]
    added = [name for name in after if name not in before]
    if changed:
        raise RuleViolationError(f"changed {changed[:3]}")
    if output.code == 2 and added:
        raise RuleViolationError(f"refused, and left {added[:3]}")
    if output.code == 0:
        _check_printed_numbers(case, output)


def _check_refusal(output: CommandOutput) -> None:
    lines = output.err.splitlines()
    if len(lines) != 1 or not output.err.endswith("\n"):
        raise RuleViolationError(f"expected one line, found {output.err!r:.2000}")
    if not lines[0].startswith("simgap: ") or not lines[0].isprintable():
        raise RuleViolationError(f"expected a printable line of simgap's, found {lines[0]!r:.2000}")
    if not 15 < len(lines[0]) < MAX_MESSAGE_LENGTH + 200:
        raise RuleViolationError(f"a line of {len(lines[0])} characters: {lines[0]:.2000}")


def _check_error_document(output: CommandOutput) -> None:
    """Check that the JSON document on stdout has the message and exit code of stderr."""
    error = json.loads(output.out, parse_constant=_refuse)["error"]
    if f"simgap: {error['message']}\n" != output.err or error["code"] != output.code:
        raise RuleViolationError(f"said {error} to a program, and {output.err!r:.2000} to a person")


def _check_printed_numbers(case: Case, output: CommandOutput) -> None:
    if case.numbers and (found := _NONSENSE.search(output.out)):
        raise RuleViolationError(f"said {found.group()}: {output.out:.1000}")
    if "--json" in case.arguments:
        json.loads(output.out, parse_constant=_refuse)


def _refuse(constant: str) -> None:
    raise RuleViolationError(f"said {constant} in JSON")
