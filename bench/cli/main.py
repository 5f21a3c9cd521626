"""Entry point of the command line; `simgap --help` lists the commands.

Heavy packages are imported by the commands that need them, so that `simgap --help` is fast. A user
error is one line on stderr and exit code 2; an internal error keeps its traceback. With ``--json``
both are also a JSON document (`bench.cli.output`).
"""

from __future__ import annotations

import argparse
import atexit
import gc
import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import NamedTuple, NoReturn

from bench import __version__
from bench.cli.output import (
    EXIT_CODES,
    EXIT_ERROR,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_PROBLEMS_FOUND,
    CommandResult,
    OutputWriter,
)
from sims.core.mujoco_import import set_glfw_library


class Command(NamedTuple):
    """A command of the command line.

    Attributes:
        name: Name of the command.
        function_path: Module of `bench.cli.commands` and its function that adds the options, with a
            colon between them.
        summary: What the command does, as the beginning of a sentence without a full stop.
        example: A command line that works.
    """

    name: str
    function_path: str
    summary: str
    example: str


COMMANDS = (
    Command(
        "compare",
        "compare:add_compare_arguments",
        "run an experiment (tuners x targets x seeds); write tables, figures and a report",
        "simgap compare ball-drop --tuners cma_es,least_squares --targets 10",
    ),
    Command(
        "train",
        "train:add_train_arguments",
        "train a learned tuner before the comparisons that use it",
        "simgap train tunenet ball --seeds 1",
    ),
    Command(
        "status",
        "status:add_status_arguments",
        "show the runs in the folder of a comparison, and what is missing",
        "simgap status results/ball-drop-2026-11-27-120000 --runs",
    ),
    Command(
        "verify",
        "verify:add_verify_arguments",
        "check whether the results in a comparison, an explanation or an archive are reproducible",
        "simgap verify results/ball-drop-2026-11-27-120000",
    ),
    Command(
        "diff",
        "diff:add_diff_arguments",
        "show the significant differences between two comparisons or two explanations",
        "simgap diff results/before results/after --fail-on worse",
    ),
    Command(
        "bundle",
        "bundle:add_bundle_arguments",
        "pack a comparison or an explanation into one archive that can be verified",
        "simgap bundle results/explain-swing --with swing.csv --out swing.zip",
    ),
    Command(
        "check",
        "check:add_check_arguments",
        "run the conformance suite on a tuner, simulator, effect or diagnoser",
        "simgap check corners --plugin corners.py",
    ),
    Command(
        "plot",
        "plot:add_plot_arguments",
        "write tables and figures of one comparison again, or of several together",
        "simgap plot results/ball-drop-2026-11-27-120000 --behind ball-drop",
    ),
    Command(
        "simulate",
        "simulate:add_simulate_arguments",
        "write a recording of a simulated system, with its true parameters in a separate file",
        "simgap simulate pendulum --effect drag.linear=2e-4 --noise 0.002 --out swing.csv",
    ),
    Command(
        "import",
        "import_logs:add_import_arguments",
        "write a description of a robot's logs, so that every command can read them",
        "simgap import log.csv --model arm.xml --out arm.toml",
    ),
    Command(
        "inspect",
        "inspect_recording:add_inspect_arguments",
        "summarise and draw a recording",
        "simgap inspect swing.csv --check",
    ),
    Command(
        "explain",
        "explain:add_explain_arguments",
        "find where a simulation differs from a recording, and the cause",
        "simgap explain swing.csv --out results/swing",
    ),
    Command(
        "design",
        "design:add_design_arguments",
        "design the next recording, which distinguishes equivalent causes",
        "simgap design swing.csv --seconds 4 --out next.csv",
    ),
    Command(
        "datasheet",
        "datasheet:add_datasheet_arguments",
        "make the data sheet of a joint or actuator from its logs",
        "simgap datasheet swing.csv --out results/sheet",
    ),
    Command(
        "score",
        "score:add_score_arguments",
        "compute the error of an extended simulator on another recording",
        "simgap score results/swing/extended.toml other.csv --held-out",
    ),
    Command(
        "film",
        "film:add_film_arguments",
        "render a recorded ball as a video",
        "simgap film drop.csv --out drop.mp4",
    ),
    Command(
        "track",
        "film:add_track_arguments",
        "track a ball in a video, and write a recording",
        "simgap track drop.mp4 --ball-diameter 0.067 --out drop.csv",
    ),
    Command(
        "list",
        "list_catalogue:add_list_arguments",
        "list tuners, simulators, systems, effects, diagnosers, experiments, references or schemas",
        "simgap list experiments",
    ),
    Command(
        "download",
        "download:add_download",
        "download a public data set that an experiment needs, or list the data sets",
        "simgap download so101",
    ),
    Command(
        "schema",
        "list_catalogue:add_schema_arguments",
        "print the JSON schema of the output of a command with --json",
        "simgap schema explain",
    ),
    Command(
        "info",
        "info:add_info_arguments",
        "print versions, engines, platform and paths for a bug report",
        "simgap info",
    ),
    Command(
        "completion",
        "completion:add_completion_arguments",
        "print a shell script that completes simgap's commands",
        "simgap completion bash > ~/.local/share/bash-completion/completions/simgap",
    ),
)
"""All commands, in the order of the help."""

GARBAGE_THRESHOLD = 50_000
"""Number of new objects after which garbage is collected; Python's default is 700 or 2,000."""


class _UsageError(Exception):
    """The command line is not valid."""


class _Parser(argparse.ArgumentParser):
    """Parser that reports errors in one line, like all other user errors."""

    def error(self, message: str) -> NoReturn:
        """Raise a usage error with a one-line message; argparse would print its usage and exit."""
        # InputError makes the message printable, whatever the user typed.
        from sims.core.simulator import InputError

        raise _UsageError(f"{InputError(message)}; see {self.prog} --help")

    def refuse_unknown(self, kind: str, name: str, known_names: Iterable[str]) -> NoReturn:
        """Report an unknown command or option with the most similar known ones."""
        from difflib import get_close_matches

        from sims.core.user_messages import truncate_text

        similar_names = get_close_matches(
            name[:_MAX_COMPARED_CHARACTERS], list(known_names), cutoff=0.5
        )
        hint = f"; did you mean {', '.join(similar_names)}?" if similar_names else ""
        self.error(f"unknown {kind} '{truncate_text(name)}'{hint}")


_MAX_COMPARED_CHARACTERS = 100
"""Number of characters of an unknown name that are compared with the known ones."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return the exit code.

    Results and errors are printed as text, or as JSON with `--json`.

    Args:
        arguments: Words after `simgap`; None for those of the process. Settings of the whole
            process are only changed in the latter case.

    Returns:
        Exit code of the command: 0, 2 for wrong input, others as in the table of exit codes.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    printer = OutputWriter("--json" in words)
    try:
        options = _parse_command_line(words)
    except _UsageError as error:
        printer.print_error("usage", str(error), EXIT_ERROR)
        sys.exit(EXIT_ERROR)
    # These imports come after the parser, so that `--help` is fast.
    from bench.figures.figure_settings import mark_as_command, pdf_figures
    from sims.core.freed_memory import keep_freed_memory
    from sims.core.simulator import InputError

    if arguments is None:
        # Only in simgap's own process: the environment of a calling program is not changed.
        set_glfw_library()
        mark_as_command()
        # Most objects that a command creates while it loads modules live until its end, so that a
        # frequent search for garbage would find nothing.
        gc.set_threshold(GARBAGE_THRESHOLD)
        # The operating system frees the memory at once; Python would search all objects for cycles.
        atexit.register(gc.freeze)
        keep_freed_memory()
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
        printer.print_error("interrupted", "interrupted before the first result", EXIT_INTERRUPTED)
        return EXIT_INTERRUPTED
    except Exception as error:
        printer.print_error("internal", f"{type(error).__name__}: {error}", EXIT_PROBLEMS_FOUND)
        raise
    return answer.code


def _parse_command_line(words: Sequence[str]) -> argparse.Namespace:
    """Parse the command line.

    Raises:
        _UsageError: The command or an option is unknown, or a value is wrong.
    """
    names = [command.name for command in COMMANDS]
    command_name = words[0] if words and not words[0].startswith("-") else None
    parser = build_parser(command_name)
    if command_name is not None and command_name not in names:
        parser.refuse_unknown("command", command_name, names)
    options, unknown_words = parser.parse_known_args(words)
    # The first unknown word is reported.
    for word in unknown_words:
        command = options.command_parser
        if word.startswith("-"):
            name = word.partition("=")[0]
            command.refuse_unknown("option", name, command._option_string_actions)
        command.error(f"unexpected argument '{word}'")
    return options


def build_parser(only: str | None = "") -> _Parser:
    """Build the parser of the command line.

    Each command is a module of `bench.cli.commands`, which is imported only if its options are
    needed.

    Args:
        only: Name of the only command that gets its options, so that the modules of the others are
            not imported; empty for all commands, None for no command.
    """
    codes = "\n".join(f"  {code:<4} {meaning}" for code, meaning in EXIT_CODES.items())
    parser = _Parser(
        prog="simgap",
        description="Compare methods that tune simulator parameters; diagnose model errors.",
        epilog=f"exit codes:\n{codes}\n\nexample: simgap explain swing.csv",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"simgap {__version__}")
    # If an option precedes the command, the program's parser reports it.
    parser.set_defaults(command_parser=parser)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for name, function_path, summary, example in COMMANDS:
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=f"example: {example}",
            formatter_class=_HelpFormatter,
        )
        if only not in ("", name):  # it is listed in the help, without its options
            continue
        module, _, add_arguments = function_path.partition(":")
        getattr(import_module(f"bench.cli.commands.{module}"), add_arguments)(command)
        command.set_defaults(command_parser=command)
        command.add_argument(
            "--json",
            action="store_true",
            help=f"print one JSON document, and nothing else (`simgap schema {name}`)",
        )
    return parser


class _HelpFormatter(argparse.HelpFormatter):
    """Help whose example at the end is not wrapped, so that it can be copied."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith("example: "):
            return indent + text
        return super()._fill_text(text, width, indent)


if __name__ == "__main__":
    sys.exit(main())
