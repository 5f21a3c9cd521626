"""Options of commands: those made from options dataclasses, those that several share, parsers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bench.benchmark.runner.worker_pools import Pool


def add_options(
    parser: argparse.ArgumentParser, options: type, **changed: Mapping[str, Any]
) -> None:
    """Add the options of a command that an options dataclass declares.

    The decorators of `bench.core.option_dataclasses` turn the same fields into arguments of
    Python functions, so that options and arguments are declared once. The annotation of a
    field decides how a value is parsed, and its entry in the class docstring is the help.

    Fields of a type that has no parser here exist in Python only.

    Args:
        parser: Parser of the command.
        options: Options dataclass.
        changed: By field, arguments of `add_argument` that differ from those of the declaration.
    """
    from bench.core.option_dataclasses import read_option_texts

    texts = read_option_texts(options)
    # Inherited options are listed last: their names are not attributes of the class itself.
    for option in sorted(fields(options), key=lambda each: each.name not in vars(options)):
        kind = str(option.type).removesuffix(" | None")  # annotations are texts
        metadata = {"in_command": True, **option.metadata}
        if kind not in _PARSERS_BY_ANNOTATION or not metadata["in_command"]:
            continue
        parse, metavar = _PARSERS_BY_ANNOTATION[kind]
        flags = metadata.get("flags") or [f"--{option.name.replace('_', '-')}"]
        # argparse formats the help, in which %% is a per cent sign.
        text = texts[option.name].rstrip(".").replace("`", "").replace("%", "%%")
        settings: dict[str, Any] = {"help": text[0].lower() + text[1:]}
        if kind == "bool":
            settings["action"] = "store_true"
        elif kind == "Files":
            settings |= {"action": "append", "default": [], "type": parse, "metavar": metavar}
        else:
            default = None if option.default == () else option.default
            if default not in (None, "") and "(default" not in text:
                default_text = f"{default:g}" if kind == "float" else default
                settings["help"] += f" (default: {default_text})"
            settings |= {"type": parse, "default": default}
            settings |= {"metavar": metadata.get("metavar") or metavar}
            if metadata.get("choices"):
                settings["choices"] = metadata["choices"]
        parser.add_argument(*flags, **{**settings, **changed.get(option.name, {})})


def collect_options(values: argparse.Namespace, options: type) -> dict[str, Any]:
    """Return the values of a dataclass's options on the command line, as keyword arguments.

    Args:
        values: Parsed command line.
        options: Dataclass whose fields declare the options.

    Returns:
        Values of the options that were given, by field name.
    """
    arguments = {}
    for option in fields(options):
        flags = option.metadata.get("flags") or [option.name]
        value = getattr(values, flags[0].strip("-").replace("-", "_"), None)
        if value not in (None, ""):
            arguments[option.name] = value
    return arguments


def add_recordings_argument(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the positional argument of one or more recordings.

    Args:
        parser: parser of the command.
        text: help text.
    """
    parser.add_argument(
        "recordings", metavar="RECORDING.csv", type=parse_path, nargs="+", help=text
    )


def add_out_option(
    parser: argparse.ArgumentParser, text: str, metavar: str = "DIR", required: bool = False
) -> None:
    """Add the option ``--out``.

    Args:
        parser: Parser of the command.
        text: Help of the option.
        metavar: Placeholder of the path.
        required: Whether the command needs it.
    """
    parser.add_argument("--out", metavar=metavar, type=parse_path, required=required, help=text)


def add_plugin_option(parser: argparse.ArgumentParser, parts: str) -> None:
    """Add the option ``--plugin FILE``; `parts` says what such a file adds.

    Args:
        parser: Parser of the command.
        parts: Parts that the file adds, e.g. "systems".
    """
    parser.add_argument(
        "--plugin",
        type=parse_file_name,
        action="append",
        default=[],
        metavar="FILE",
        help=f"Python file with further {parts}",
    )


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--force``."""
    parser.add_argument(
        "--force",
        action="store_true",
        help="start even if this machine has too little memory, disk or time, or if the data are "
        "implausible",
    )


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--pdf``, which `bench.cli.main` handles for every command that has it."""
    parser.add_argument(
        "--pdf", action="store_true", help="write every figure as PDF too (default: PNG only)"
    )


def parse_positive_int(text: str) -> int:
    """Parse a whole number of at least 1."""
    return _parse_whole_number(text, 1)


def parse_non_negative_int(text: str) -> int:
    """Parse a whole number of at least 0."""
    return _parse_whole_number(text, 0)


def _parse_whole_number(text: str, minimum: int) -> int:
    """Parse a whole number from `minimum` to MAX_INTEGER, for argparse.

    Raises:
        argparse.ArgumentTypeError: the text is not such a number.
    """
    from sims.core.number_limits import MAX_INTEGER
    from sims.core.user_messages import truncate_text

    try:
        value = int(text)
    except ValueError:
        value = minimum - 1
    if not minimum <= value <= MAX_INTEGER:
        expected = f"a whole number of at least {minimum}"
        if value > MAX_INTEGER:
            expected = f"{expected} and at most {MAX_INTEGER:.0e}"
        raise argparse.ArgumentTypeError(f"expected {expected}, found '{truncate_text(text)}'")
    return value


def parse_seconds(text: str) -> float:
    """Parse a number of seconds above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise argparse.ArgumentTypeError(f"expected a number of seconds above 0, found '{text}'")
    return value


def parse_path(text: str) -> Path:
    """Parse the path of a file or folder, which need not exist."""
    from sims.core.user_messages import truncate_text

    try:
        Path(text).lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    # The path is too long, contains circular links, or is not accessible.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise argparse.ArgumentTypeError(
            f"expected a path, found '{truncate_text(text)}' ({reason})"
        ) from None
    return Path(text)


def parse_file_name(text: str) -> str:
    """Check the path of a file, and return it as text."""
    parse_path(text)
    return text


def parse_name_list(text: str) -> list[str]:
    """Parse a list of names separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def parse_key_values(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Parse NAME=VALUE texts of an option, which is named in errors.

    Returns:
        Values by name.

    Raises:
        InputError: A text does not have this form, or a name is given twice.
    """
    from sims.core.simulator import InputError

    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise InputError(f"{option} {text}: expected NAME=VALUE")
        if name in values:
            raise InputError(f"{option}: {name} is given twice")
        values[name] = value
    return values


def parse_number(option: str, name: str, text: str) -> float:
    """Parse a finite number, the value of a name in an option; both are named in errors.

    Raises:
        InputError: The text is not a finite number.
    """
    from sims.core.simulator import InputError

    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise InputError(f"{option} {name}={text}: expected a number")
    return value


def parse_key_numbers(option: str, texts: Sequence[str]) -> dict[str, float]:
    """Parse NAME=NUMBER texts of an option into numbers by name."""
    return {
        name: parse_number(option, name, text)
        for name, text in parse_key_values(option, texts).items()
    }


def get_subparsers(parser: argparse.ArgumentParser) -> argparse._SubParsersAction[Any]:
    """Return the commands of the whole command line; argparse has no public way to list them."""
    (commands,) = [
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    ]
    return commands


_PARSERS_BY_ANNOTATION: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "Count": (parse_positive_int, "N"),
    "Natural": (parse_non_negative_int, "N"),
    "Seconds": (parse_seconds, "S"),
    "int": (int, "K"),
    "float": (float, "X"),
    "Name": (str, "NAME"),
    "str": (str, "TEXT"),
    "Names": (str, "A,B,..."),
    "Tuners": (str, "A,B,..."),
    "Files": (parse_file_name, "FILE"),
    "str | Path": (parse_path, "FILE"),
    "RecordingFile": (parse_path, "FILE"),
    "bool": (bool, ""),
}
"""Parser and placeholder of an option's value, by the annotation of its field."""


@contextmanager
def prefix_errors_with_option(option: str, value: object) -> Iterator[None]:
    """Prefix error messages that begin with an option's value with the option's name.

    Code below the command line knows values but not options.

    Args:
        option: Name of the option, e.g. ``--out``.
        value: Its value.

    Raises:
        InputError: The error of the context, with the prefix.
    """
    from sims.core.simulator import InputError

    try:
        yield
    except InputError as error:
        if value is None or not str(error).startswith(f"{value}:"):
            raise
        raise InputError(f"{option} {error}") from None


def make_cluster_pool(address: str | None) -> Pool | None:
    """Return the Dask cluster with this scheduler address; None without an address.

    Raises:
        InputError: The scheduler does not respond, or its workers have other code.
    """
    if not address:
        return None
    from bench.benchmark.runner.dask_cluster import ClusterPool

    with prefix_errors_with_option("--cluster", address):
        return ClusterPool(address)
