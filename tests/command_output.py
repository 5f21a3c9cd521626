"""Run commands of simgap in the process of a test."""

import io
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

from bench.cli.main import main


class CommandOutput(NamedTuple):
    """Standard output and standard error of a command."""

    out: str
    err: str


def run_command(*arguments, code=0):
    """Run a command, assert its exit code and return its output.

    Args:
        arguments: words of the command after ``simgap``, such as texts, paths and numbers.
        code: expected exit code.
    """
    streams = [io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2)]
    with redirect_stdout(streams[0]), redirect_stderr(streams[1]):
        try:
            ended = main([str(argument) for argument in arguments])
        except SystemExit as end:  # an error in an option
            ended = end.code
    output = CommandOutput(*(stream.buffer.getvalue().decode() for stream in streams))
    assert ended == code, output
    return output
