"""The command `simgap completion`: a completion script for a shell.

The script completes commands, options, files and names without starting Python.
"""

from __future__ import annotations

import argparse
from typing import Any

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import get_subparsers, parse_file_name, parse_path

SHELLS = ("bash", "zsh", "fish", "tcsh")
_BASH_FUNCTIONS = """
_simgap_experiments() {{ compgen -W "{experiments}" -- "$1"; compgen -f -- "$1"; }}
_simgap_parts() {{ compgen -W "{parts}" -- "$1"; }}
_simgap_schemas() {{ compgen -W "{schemas}" -- "$1"; }}
"""
"""Functions of bash that complete names; the other shells complete files instead."""


def add_completion_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap completion`."""
    parser.add_argument("shell", choices=SHELLS, help="shell that the script is for")
    parser.set_defaults(command=_run_completion)


def _run_completion(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap completion`: print the completion script of the named shell."""
    from bench.cli.main import build_parser

    script = build_completion_script(build_parser(), options.shell)
    print_line(script.rstrip("\n"))
    return CommandResult({"shell": options.shell, "script": script})


def build_completion_script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Build the completion script for a shell, in which all names are written out.

    Args:
        parser: Parser of the command line.
        shell: One of `SHELLS`.
    """
    import shtab

    from bench.benchmark.problem import experiment_config
    from bench.core.plugin_registries import REGISTRIES
    from bench.schemas import list_schema_names

    for name, command in get_subparsers(parser).choices.items():
        for action in command._actions:
            _set_completion(name, action, shtab)
    names = {
        "experiments": experiment_config.list_experiment_names(),
        "parts": [name for registry in REGISTRIES for name in registry.names()],
        "schemas": list_schema_names(),
    }
    names_by_key = {key: " ".join(values) for key, values in names.items()}
    functions = _BASH_FUNCTIONS.format(**names_by_key) if shell == "bash" else ""
    script: str = shtab.complete(parser, shell=shell, preamble=functions)
    return script


_BASH_COMPLETERS = {
    ("compare", "experiment"): "_simgap_experiments",
    ("train", "experiment"): "_simgap_experiments",
    ("check", "name"): "_simgap_parts",
    ("schema", "name"): "_simgap_schemas",
}
"""Functions of bash that complete an argument, by command and argument."""


def _set_completion(command: str, action: argparse.Action, shtab: Any) -> None:
    """Set how the shell completes an argument: known names (in bash only), or a file.

    Args:
        command: name of the command.
        action: its argument, changed in place.
        shtab: library that builds the completion script.
    """
    bash_function = _BASH_COMPLETERS.get((command, action.dest))
    if bash_function:
        complete = {**shtab.FILE, "bash": bash_function}
    elif action.type in (parse_path, parse_file_name):
        complete = shtab.FILE
    else:
        return
    # The library shtab reads an attribute of this name.
    action.complete = complete  # type: ignore[attr-defined]
