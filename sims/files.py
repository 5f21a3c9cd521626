"""Files that are written whole or not at all, folders that are made so, and what a failed one says.

What is written stands beside its place under another name until it is complete and on the disk; a
reader, or whoever comes after a kill, never meets half of it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import datetime, timezone
from itertools import islice
from pathlib import Path

from sims.base import InputError
from sims.limits import cut

Content = str | bytes
"""Of a file; text is written as UTF-8."""


_MOST_LISTED = 10_000
"""Maximum number of a folder's entries among which similar names are looked for."""


def require_file(path: Path, wanted: str = "") -> None:
    """Refuse a path where there is no file.

    Args:
        path: of the file.
        wanted: what was expected, for the message; may be empty.

    Raises:
        InputError: the file does not exist; the message names similar files in its folder.
    """
    expected = f"; expected {wanted}" if wanted else ""
    try:
        if path.is_file():
            return
        exists = path.exists()
    except (OSError, ValueError) as error:  # too long, or with a null character
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{cut(str(path))}: not a path ({why})") from None
    if exists:
        raise InputError(f"{path}: not a file{expected}")
    raise InputError(f"{path}: no such file{expected}{_similar(path)}")


def _similar(path: Path) -> str:
    """The end of a message about a missing file: files of similar names beside it."""
    from difflib import get_close_matches

    try:
        entries = list(islice(path.parent.iterdir(), _MOST_LISTED))
    except OSError:
        return "" if path.parent.is_dir() else f"; there is no folder '{path.parent}'"
    stems = {entry.stem: entry.name for entry in entries if entry.suffix == path.suffix}
    near = [stems[stem] for stem in get_close_matches(path.stem, stems, n=3)]
    return f"; did you mean {' or '.join(near)}?" if near else ""


def write(path: Path, content: Content) -> None:
    """Write a whole file or none, in place of what is there."""
    with replacing(path) as partial:
        partial.write_bytes(_bytes(content))


def write_all(contents: Mapping[Path, Content]) -> None:
    """Write whole files, all or none, in place of what is there."""
    with ExitStack() as places:
        # None takes its place before all are complete.
        for path, content in contents.items():
            places.enter_context(replacing(path)).write_bytes(_bytes(content))


@contextmanager
def replacing(path: Path, *, keep_ending: bool = False) -> Iterator[Path]:
    """The place where a library may write what becomes `path` when the block ends well.

    Args:
        path: the file to be; what is there is replaced.
        keep_ending: for libraries that tell the format by the name. Elsewhere the other name has
            an ending of its own, so that nobody who lists files by theirs takes it for one.
    """
    partial = _beside(path, keep_ending)
    try:
        yield partial
        _to_disk(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_new(contents: Mapping[Path, Content]) -> None:
    """Write all files or none, and never over what is there.

    Raises:
        OSError: one cannot be written, or exists (`FileExistsError`); its filename says which.
    """
    with ExitStack() as cleaning, ExitStack() as undoing:
        partials = {path: _beside(path) for path in contents}
        for path, partial in partials.items():
            cleaning.callback(partial.unlink, missing_ok=True)
            with _naming(path):
                partial.write_bytes(_bytes(contents[path]))
                _to_disk(partial)
        for path, partial in partials.items():
            with _naming(path):
                _place(partial, path)
            undoing.callback(path.unlink)
        # All stand in their places: what would take them away again is forgotten.
        undoing.pop_all()


def _place(partial: Path, path: Path) -> None:
    try:
        # Unlike a rename, this fails if somebody made the file in the meantime.
        os.link(partial, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if path.exists():
            raise FileExistsError(str(path)) from None
        partial.rename(path)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """An error within is about `path`, whatever file beside it was touched."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


@contextmanager
def fresh_folder(folder: Path) -> Iterator[Path]:
    """A folder that takes the place of `folder`, new or empty, when the block ends well.

    Raises:
        OSError: it cannot be made, or something is in `folder`.
    """
    partial = _beside(folder)
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def refuse_full(folder: Path) -> None:
    """Refuse a folder that has something in it.

    Raises:
        InputError: it has.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder}: exists and is not empty; results are never overwritten: name another folder"
        )


def stamped(parent: Path, name: str) -> Path:
    """A folder that is not there yet, named for the time and numbered where it is taken."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    folder, number = parent / f"{name}-{stamp}", 1
    while folder.exists():
        number += 1
        folder = parent / f"{name}-{stamp}-{number}"
    return folder


def first_line(error: BaseException) -> str:
    """The first line of what an error says; its class where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _beside(path: Path, keep_ending: bool = False) -> Path:
    # The process is in the name: two that write one file at a time do not write into each other.
    if keep_ending:
        return path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _bytes(content: Content) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _to_disk(path: Path) -> None:
    """Wait until a file's content is on the disk: a rename may come there before it."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
