"""The command line of simgap; `simgap --help` lists its commands.

Heavy packages are imported by the commands that need them, so that `simgap --help` is quick. A
fault of the user's is one line on stderr and exit code 2; an internal error keeps its traceback.
With ``--json`` both are a document too (`bench.commands.answer`).
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from bench import __version__
from bench.commands.answer import (
    DONE,
    EXITS,
    FAULT,
    INTERRUPTED,
    WRONG,
    Answer,
    Json,
    Printer,
    Words,
)
from bench.commands.bundle import add_bundle
from bench.commands.check import add_check
from bench.commands.compare import add_compare
from bench.commands.completion import add_completion
from bench.commands.datasheet import add_datasheet
from bench.commands.design import add_design
from bench.commands.diff import add_diff
from bench.commands.download import add_download
from bench.commands.explain import add_explain, add_score
from bench.commands.film import add_film, add_track
from bench.commands.importing import add_import
from bench.commands.info import add_info
from bench.commands.listing import add_list, add_schema
from bench.commands.plot import add_plot
from bench.commands.recordings import add_inspect, add_simulate
from bench.commands.status import add_status
from bench.commands.train import add_train
from bench.commands.variadic import positionals_first
from bench.commands.verify import add_verify

COMMANDS = (
    ("compare", add_compare, "run an experiment: tuners x targets x seeds; write table and figure"),
    ("train", add_train, "train a learned tuner ahead of the comparisons that use it"),
    ("status", add_status, "what a comparison's folder holds, and what is missing"),
    (
        "verify",
        add_verify,
        "see whether a comparison, an explanation or an archive of one is what it says",
    ),
    ("diff", add_diff, "two comparisons or two explanations: what changed, and significantly?"),
    ("bundle", add_bundle, "pack a comparison or an explanation as one archive that verifies"),
    ("check", add_check, "run the conformance suite on a tuner, simulator, effect or diagnoser"),
    ("plot", add_plot, "write table and figures of a comparison again, or of several together"),
    ("simulate", add_simulate, "write a recording of a simulated system, its truth apart"),
    ("import", add_import, "describe a robot's logs as they lie, so that every command reads them"),
    ("inspect", add_inspect, "summarise and draw a recording"),
    ("explain", add_explain, "show what a simulation gets wrong on a recording, and why"),
    ("design", add_design, "design the next recording, by which what is open would be settled"),
    ("datasheet", add_datasheet, "make the data sheet of a joint or actuator from its logs"),
    ("score", add_score, "error of an extended simulator on another recording"),
    ("film", add_film, "render a recorded ball as a video"),
    ("track", add_track, "track a ball in a video; write a recording"),
    (
        "list",
        add_list,
        "list tuners, simulators, systems, effects, diagnosers, experiments, references or schemas",
    ),
    ("download", add_download, "get a public data set that an experiment needs, or list them"),
    ("schema", add_schema, "print the JSON schema of what a command prints with --json"),
    ("info", add_info, "versions, engines, platform and paths, for a report of a fault"),
    ("completion", add_completion, "print a script by which a shell completes simgap's commands"),
)
"""Name, what adds its options, and its line of help, in the order of `simgap --help`."""

GARBAGE_THRESHOLD = 50_000
"""Number of new objects after which garbage is collected; Python's default is 700 or 2,000."""


class _UsageError(Exception):
    """A command line that no command understands."""


class _Parser(argparse.ArgumentParser):
    """A parser whose faults are one line, as every other of the user's is."""

    def error(self, message: str) -> NoReturn:
        from sims.base import InputError  # its message can be printed, whatever was typed

        raise _UsageError(f"{InputError(message)}; see {self.prog} --help")

    # argparse declares this method with overloads, of which none takes None for both arguments.
    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse a command line in which a positional argument may follow an option of several
        values.
        """
        words = sys.argv[1:] if args is None else list(args)
        return super().parse_known_args(positionals_first(self, words), namespace)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    printer: Printer = Json() if "--json" in words else Words()
    try:
        options = parser().parse_args(words)
    except _UsageError as error:
        printer.fault("usage", str(error), FAULT)
        sys.exit(FAULT)
    # After the parser, which has ended the quick `--help`.
    from bench.figures.formats import mark_as_command, pdf_figures
    from sims.base import InputError

    if arguments is None:
        # Only in a process of its own: a caller's environment is not changed.
        _name_glfw_library()
        mark_as_command()
        # Most of what a command makes while it loads modules stays.
        gc.set_threshold(GARBAGE_THRESHOLD)
    try:
        with printer.working(), pdf_figures(getattr(options, "pdf", False)):
            answer: Answer = options.command(options, printer.say)
        printer.answer(answer)
    except InputError as error:
        printer.fault("input", str(error), FAULT)
        return FAULT
    except MemoryError as error:  # whoever insisted
        printer.fault("memory", f"not enough memory: {error}", FAULT)
        return FAULT
    except BrokenPipeError:  # `simgap list ... | head`
        sys.stderr.close()
        return DONE
    except KeyboardInterrupt:
        printer.fault("interrupted", "interrupted before there was a result", INTERRUPTED)
        return INTERRUPTED
    except Exception as error:
        printer.fault("internal", f"{type(error).__name__}: {error}", WRONG)
        raise
    return answer.code


def _name_glfw_library() -> None:
    """Tell glfw, which MuJoCo imports, where its library is: the one that it would choose itself.

    Else glfw starts an interpreter for each library that it finds, to ask for its version. That is
    a third of the time of ``import mujoco``, in each process of a command.
    """
    if not sys.platform.startswith("linux") or "PYGLFW_LIBRARY" in os.environ:
        return
    package = find_spec("glfw")
    if package is None or package.origin is None:
        return
    session = os.environ.get("PYGLFW_LIBRARY_VARIANT") or os.environ.get("XDG_SESSION_TYPE", "")
    variant = "wayland" if session.lower() == "wayland" else "x11"
    library = Path(package.origin).parent / variant / "libglfw.so"
    if library.is_file():
        os.environ["PYGLFW_LIBRARY"] = str(library)


def parser() -> argparse.ArgumentParser:
    """The parser of the command line, all commands in it."""
    codes = "\n".join(f"  {code:<4} {says}" for code, says in EXITS.items())
    whole = _Parser(
        prog="simgap",
        description="Compare methods that tune simulator parameters; find what tuning cannot fix.",
        epilog=f"exit codes:\n{codes}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action="version", version=f"simgap {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", title="commands")

    for name, add, says in COMMANDS:
        command = commands.add_parser(name, help=says)
        add(command)
        # Commands that speak of commands ask it.
        command.set_defaults(parser=whole)
        command.add_argument(
            "--json",
            action="store_true",
            help=f"print one JSON document, and nothing else (`simgap schema {name}`)",
        )
    return whole


if __name__ == "__main__":
    sys.exit(main())
