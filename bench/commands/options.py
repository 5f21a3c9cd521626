"""Options that several commands have, and the types of their values."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.runs.pools import Pool


def add_plugin(parser: argparse.ArgumentParser, more: str) -> None:
    """The option ``--plugin FILE``; `more` says what such a file adds."""
    parser.add_argument(
        "--plugin",
        type=file,
        action="append",
        default=[],
        metavar="FILE",
        help=f"Python file with more {more}",
    )


def add_model(
    parser: argparse.ArgumentParser,
    text: str = "take it for this robot, whatever the .toml says: an MJCF or URDF",
) -> None:
    """The option ``--model FILE``; `text` says what it is for."""
    parser.add_argument(
        "--model",
        type=place,
        metavar="FILE",
        help=text,
    )


def add_force(parser: argparse.ArgumentParser) -> None:
    """The option ``--force``."""
    parser.add_argument(
        "--force",
        action="store_true",
        help="begin although it needs more than this machine has, or cannot be sound",
    )


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """The option ``--pdf``, which `bench.cli` obeys for every command that has it."""
    parser.add_argument(
        "--pdf",
        action="store_true",
        help="write every figure as PDF too (default: PNG only)",
    )


def add_trust(parser: argparse.ArgumentParser) -> None:
    """The option ``--trust``."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help="run the tuners inside the harness: quicker, nothing is out of their reach, and what "
        "comes out is marked so",
    )


def positive(text: str) -> int:
    """A whole number of at least 1."""
    return _whole(text, 1)


def natural(text: str) -> int:
    """A whole number of at least 0."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    from sims.limits import MOST, cut

    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= MOST:
        wanted = f"a whole number of at least {least}"
        if value > MOST:
            wanted = f"{wanted} and at most {MOST:.0e}"
        raise argparse.ArgumentTypeError(f"expected {wanted}, found '{cut(text)}'")
    return value


def seconds(text: str) -> float:
    """A number of seconds above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise argparse.ArgumentTypeError(f"expected a number of seconds above 0, found '{text}'")
    return value


def place(text: str) -> Path:
    """The path of what is there, or could be."""
    from sims.limits import cut

    try:
        Path(text).lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    # Too long, of links that lead in a circle, or not ours to look at.
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise argparse.ArgumentTypeError(f"expected a path, found '{cut(text)}' ({why})") from None
    return Path(text)


def file(text: str) -> str:
    """The same of a file that is named in words."""
    place(text)
    return text


def names(text: str) -> list[str]:
    """Names with commas between."""
    return [name.strip() for name in text.split(",") if name.strip()]


@contextmanager
def said_as(option: str, value: object) -> Iterator[None]:
    """A fault that begins with the value is said with the option that gave it.

    What has no command line around it knows values, and says nothing of options.
    """
    from sims.base import InputError

    try:
        yield
    except InputError as error:
        if value is None or not str(error).startswith(f"{value}:"):
            raise
        raise InputError(f"{option} {error}") from None


def cluster_pool(address: str | None) -> Pool | None:
    """The Dask cluster with this scheduler; None without one.

    Raises:
        InputError: nobody answers there, or its workers have other code.
    """
    if not address:
        return None
    from bench.runs.cluster import ClusterPool

    with said_as("--cluster", address):
        return ClusterPool(address)
