"""Options that several commands share, and parsers of their values."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.benchmark.runner.worker_pools import Pool


def add_plugin_option(parser: argparse.ArgumentParser, more: str) -> None:
    """Add the option ``--plugin FILE``; `more` says what such a file adds.

    Args:
        parser: Parser of the command.
        more: Parts that the file adds, e.g. "systems".
    """
    parser.add_argument(
        "--plugin",
        type=parse_file_name,
        action="append",
        default=[],
        metavar="FILE",
        help=f"Python file with more {more}",
    )


def add_model_option(
    parser: argparse.ArgumentParser,
    text: str = "take it for this robot, whatever the .toml says: an MJCF or URDF",
) -> None:
    """Add the option ``--model FILE``; `text` is its help.

    Args:
        parser: Parser of the command.
        text: Help of the option.
    """
    parser.add_argument(
        "--model",
        type=parse_path,
        metavar="FILE",
        help=text,
    )


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--force``."""
    parser.add_argument(
        "--force",
        action="store_true",
        help="begin although it needs more than this machine has, or cannot be sound",
    )


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--pdf``, which `bench.cli.main` handles for every command that has it."""
    parser.add_argument(
        "--pdf",
        action="store_true",
        help="write every figure as PDF too (default: PNG only)",
    )


def add_trust_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--trust``."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help="run the tuners inside the harness: quicker, nothing is out of their reach, and what "
        "comes out is marked so",
    )


def parse_positive_int(text: str) -> int:
    """Parse a whole number of at least 1."""
    return _whole(text, 1)


def parse_non_negative_int(text: str) -> int:
    """Parse a whole number of at least 0."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    from sims.core.value_limits import MAX_INTEGER, truncate_text

    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= MAX_INTEGER:
        wanted = f"a whole number of at least {least}"
        if value > MAX_INTEGER:
            wanted = f"{wanted} and at most {MAX_INTEGER:.0e}"
        raise argparse.ArgumentTypeError(f"expected {wanted}, found '{truncate_text(text)}'")
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
    from sims.core.value_limits import truncate_text

    try:
        Path(text).lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    # The path is too long, contains circular links, or is not accessible.
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise argparse.ArgumentTypeError(
            f"expected a path, found '{truncate_text(text)}' ({why})"
        ) from None
    return Path(text)


def parse_file_name(text: str) -> str:
    """Check the path of a file, and return it as text."""
    parse_path(text)
    return text


def parse_name_list(text: str) -> list[str]:
    """Parse a list of names separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


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
