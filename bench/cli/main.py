"""Entry point of the command line; `simgap --help` lists the commands.

Heavy packages are imported by the commands that need them, so that `simgap --help` is fast. A user
error is one line on stderr and exit code 2; an internal error keeps its traceback. With ``--json``
both are also a JSON document (`bench.cli.output`).
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
from bench.cli.commands.bundle import add_bundle_arguments
from bench.cli.commands.check import add_check_arguments
from bench.cli.commands.compare import add_compare_arguments
from bench.cli.commands.completion import add_completion_arguments
from bench.cli.commands.datasheet import add_datasheet_arguments
from bench.cli.commands.design import add_design_arguments
from bench.cli.commands.diff import add_diff_arguments
from bench.cli.commands.download import add_download
from bench.cli.commands.explain import add_explain_arguments, add_score_arguments
from bench.cli.commands.film import add_film_arguments, add_track_arguments
from bench.cli.commands.import_logs import add_import_arguments
from bench.cli.commands.info import add_info_arguments
from bench.cli.commands.list_catalogue import add_list_arguments, add_schema_arguments
from bench.cli.commands.plot import add_plot_arguments
from bench.cli.commands.recordings import add_inspect_arguments, add_simulate_arguments
from bench.cli.commands.status import add_status_arguments
from bench.cli.commands.train import add_train_arguments
from bench.cli.commands.verify import add_verify_arguments
from bench.cli.output import (
    EXIT_CODES,
    EXIT_ERROR,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_PROBLEMS_FOUND,
    CommandResult,
    JsonWriter,
    OutputWriter,
    TextWriter,
)
from bench.cli.variadic_options import positionals_first

COMMANDS = (
    (
        "compare",
        add_compare_arguments,
        "run an experiment: tuners x targets x seeds; write table and figure",
    ),
    ("train", add_train_arguments, "train a learned tuner ahead of the comparisons that use it"),
    ("status", add_status_arguments, "what a comparison's folder holds, and what is missing"),
    (
        "verify",
        add_verify_arguments,
        "see whether a comparison, an explanation or an archive of one is what it says",
    ),
    (
        "diff",
        add_diff_arguments,
        "two comparisons or two explanations: what changed, and significantly?",
    ),
    (
        "bundle",
        add_bundle_arguments,
        "pack a comparison or an explanation as one archive that verifies",
    ),
    (
        "check",
        add_check_arguments,
        "run the conformance suite on a tuner, simulator, effect or diagnoser",
    ),
    (
        "plot",
        add_plot_arguments,
        "write table and figures of a comparison again, or of several together",
    ),
    (
        "simulate",
        add_simulate_arguments,
        "write a recording of a simulated system, its truth apart",
    ),
    (
        "import",
        add_import_arguments,
        "describe a robot's logs as they lie, so that every command reads them",
    ),
    ("inspect", add_inspect_arguments, "summarise and draw a recording"),
    ("explain", add_explain_arguments, "show what a simulation gets wrong on a recording, and why"),
    (
        "design",
        add_design_arguments,
        "design the next recording, by which what is open would be settled",
    ),
    (
        "datasheet",
        add_datasheet_arguments,
        "make the data sheet of a joint or actuator from its logs",
    ),
    ("score", add_score_arguments, "error of an extended simulator on another recording"),
    ("film", add_film_arguments, "render a recorded ball as a video"),
    ("track", add_track_arguments, "track a ball in a video; write a recording"),
    (
        "list",
        add_list_arguments,
        "list tuners, simulators, systems, effects, diagnosers, experiments, references or schemas",
    ),
    ("download", add_download, "get a public data set that an experiment needs, or list them"),
    ("schema", add_schema_arguments, "print the JSON schema of what a command prints with --json"),
    ("info", add_info_arguments, "versions, engines, platform and paths, for a report of a fault"),
    (
        "completion",
        add_completion_arguments,
        "print a script by which a shell completes simgap's commands",
    ),
)
"""Name, function that adds the options, and help line of each command, in help order."""

GARBAGE_THRESHOLD = 50_000
"""Number of new objects after which garbage is collected; Python's default is 700 or 2,000."""


class _UsageError(Exception):
    """The command line is not valid."""


class _Parser(argparse.ArgumentParser):
    """Parser that reports errors in one line, like all other user errors."""

    def error(self, message: str) -> NoReturn:
        from sims.core.simulator import (
            InputError,  # its message is printable, whatever the user typed
        )

        raise _UsageError(f"{InputError(message)}; see {self.prog} --help")

    # argparse declares this method with overloads; none of them takes None for both arguments.
    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse a command line where positional arguments may follow an option with several values.

        Args:
            args: words of the command line; None for those of the process.
            namespace: object that gets the values.
        """
        words = sys.argv[1:] if args is None else list(args)
        return super().parse_known_args(positionals_first(self, words), namespace)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    printer: OutputWriter = JsonWriter() if "--json" in words else TextWriter()
    try:
        options = build_parser().parse_args(words)
    except _UsageError as error:
        printer.print_error("usage", str(error), EXIT_ERROR)
        sys.exit(EXIT_ERROR)
    # These imports come after the parser, so that `--help` is fast.
    from bench.figures.figure_files import mark_as_command, pdf_figures
    from sims.core.simulator import InputError

    if arguments is None:
        # Only in simgap's own process: the environment of a calling program is not changed.
        _name_glfw_library()
        mark_as_command()
        # Most objects that a command creates while it loads modules live until its end.
        gc.set_threshold(GARBAGE_THRESHOLD)
    try:
        with printer.capture_output(), pdf_figures(getattr(options, "pdf", False)):
            answer: CommandResult = options.command(options, printer.print_line)
        printer.print_result(answer)
    except InputError as error:
        printer.print_error("input", str(error), EXIT_ERROR)
        return EXIT_ERROR
    except MemoryError as error:  # possible when the user has skipped the check of resources
        printer.print_error("memory", f"not enough memory: {error}", EXIT_ERROR)
        return EXIT_ERROR
    except BrokenPipeError:  # `simgap list ... | head`
        sys.stderr.close()
        return EXIT_OK
    except KeyboardInterrupt:
        printer.print_error(
            "interrupted", "interrupted before there was a result", EXIT_INTERRUPTED
        )
        return EXIT_INTERRUPTED
    except Exception as error:
        printer.print_error("internal", f"{type(error).__name__}: {error}", EXIT_PROBLEMS_FOUND)
        raise
    return answer.code


def _name_glfw_library() -> None:
    """Set the path of the library of glfw, which MuJoCo imports, to the one glfw would choose.

    Otherwise glfw starts an interpreter for each library that it finds, to get its version. That is
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


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the command line with all commands."""
    codes = "\n".join(f"  {code:<4} {says}" for code, says in EXIT_CODES.items())
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
        # Commands that describe commands use the parser.
        command.set_defaults(parser=whole)
        command.add_argument(
            "--json",
            action="store_true",
            help=f"print one JSON document, and nothing else (`simgap schema {name}`)",
        )
    return whole


if __name__ == "__main__":
    sys.exit(main())
