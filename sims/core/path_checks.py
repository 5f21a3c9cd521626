"""Checks of paths that a user names: existing files, absent files and empty folders."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from itertools import islice
from pathlib import Path

from sims.core.simulator import InputError
from sims.core.value_limits import truncate_text

_MAX_SEARCHED_ENTRIES = 10_000
"""Maximum number of a folder's entries among which similar names are searched."""


def require_file(path: Path, wanted: str = "") -> None:
    """Refuse a path that is not a file.

    Args:
        path: Path of the file.
        wanted: Description of the expected file for the message; may be empty.

    Raises:
        InputError: The file does not exist; the message names similar files in its folder.
    """
    expected = f"; expected {wanted}" if wanted else ""
    try:
        if path.is_file():
            return
        exists = path.exists()
    except (OSError, ValueError) as error:  # too long, or with a null character
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{truncate_text(str(path))}: not a path ({reason})") from None
    if exists:
        raise InputError(f"{path}: not a file{expected}")
    raise InputError(f"{path}: no such file{expected}{_format_similar_names(path)}")


def is_existing_file(path: Path) -> bool:
    """Return whether a path is a file; False for a path that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a null character
        return False


def _format_similar_names(path: Path) -> str:
    """Format the names of similar files in the folder as the end of a message."""
    from difflib import get_close_matches

    try:
        entries = list(islice(path.parent.iterdir(), _MAX_SEARCHED_ENTRIES))
    except OSError:
        return "" if path.parent.is_dir() else f"; there is no folder '{path.parent}'"
    stems = {entry.stem: entry.name for entry in entries if entry.suffix == path.suffix}
    similar_files = [stems[stem] for stem in get_close_matches(path.stem, stems, n=3)]
    return f"; did you mean {' or '.join(similar_files)}?" if similar_files else ""


def check_folder_empty(folder: Path) -> None:
    """Check that a folder is empty or does not exist.

    Raises:
        InputError: The folder is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder}: exists and is not empty; results are never overwritten: name another folder"
        )


def make_timestamped_path(parent: Path, name: str) -> Path:
    """Return the path of a new folder named with the time, numbered if it exists.

    Args:
        parent: Parent folder.
        name: Beginning of the folder's name.
    """
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    folder, number = parent / f"{name}-{stamp}", 1
    while folder.exists():
        number += 1
        folder = parent / f"{name}-{stamp}-{number}"
    return folder


def check_absent(paths: Iterable[Path]) -> None:
    """Check that none of the files exists.

    Raises:
        InputError: A file exists already.
    """
    for path in paths:
        if path.exists():
            raise make_exists_error(path)


def make_exists_error(path: Path | str) -> InputError:
    """Make the error for a recording that exists already and would be overwritten."""
    return InputError(
        f"{path}: exists already; recordings are never overwritten, name another file"
    )
