"""The command line of simgap; `simgap --help` lists its commands.

Heavy packages are imported by the commands that need them, so that `simgap --help` is quick. A
fault of the user's is one line on stderr and exit code 2; an internal error keeps its traceback.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from bench import __version__
from bench.commands.check import add_check
from bench.commands.compare import add_compare, add_plot, add_status, add_verify
from bench.commands.datasheet import add_datasheet
from bench.commands.design import add_design
from bench.commands.explain import add_explain, add_score
from bench.commands.film import add_film, add_track
from bench.commands.importing import add_import
from bench.commands.interrupts import INTERRUPTED
from bench.commands.listing import add_list
from bench.commands.recordings import add_inspect, add_simulate
from bench.commands.train import add_train

COMMANDS = (
    ("compare", add_compare, "run an experiment: tuners x targets x seeds; write table and figure"),
    ("train", add_train, "train a learned tuner ahead of the comparisons that use it"),
    ("status", add_status, "what a comparison's folder holds, and what is missing"),
    ("verify", add_verify, "see whether a finished comparison follows from its salt and its rows"),
    ("check", add_check, "run the conformance suite on a tuner, a simulator or an effect"),
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
    ("list", add_list, "list tuners, simulators, systems, effects or experiments"),
)
"""Name, what adds its options, and its line of help, in the order of `simgap --help`."""


class _Parser(argparse.ArgumentParser):
    """A parser whose faults are one line, as every other of the user's is."""

    def error(self, message: str) -> NoReturn:
        from sims.base import InputError  # its message can be printed, whatever was typed

        self.exit(2, f"simgap: {InputError(message)}; see {self.prog} --help\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parser().parse_args(arguments)
    from sims.base import InputError  # after the parser, which has ended the quick `--help`

    try:
        code: int = options.command(options)
    except InputError as error:
        print(f"simgap: {error}", file=sys.stderr)
        return 2
    except MemoryError as error:  # whoever insisted
        print(f"simgap: not enough memory: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `simgap list ... | head`
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        print("simgap: interrupted before there was a result", file=sys.stderr)
        return INTERRUPTED
    return code


def parser() -> argparse.ArgumentParser:
    """The parser of the command line, all commands in it."""
    whole = _Parser(
        prog="simgap",
        description="Compare methods that tune simulator parameters; find what tuning cannot fix.",
    )
    whole.add_argument("--version", action="version", version=f"simgap {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", title="commands")

    for name, add, says in COMMANDS:
        add(commands.add_parser(name, help=says))
    return whole


if __name__ == "__main__":
    sys.exit(main())
