"""Files that users name: checks of paths, atomic writes, and locks between processes.

A file is first written completely to disk under another name in the same folder, and then renamed,
so that readers never see a partly written file, even after a crash.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import datetime, timezone
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import IO, Any

from sims.core.simulator import InputError
from sims.core.user_messages import truncate_text

_MAX_SEARCHED_ENTRIES = 10_000
"""Maximum number of a folder's entries among which similar names are searched."""


CHUNK_BYTES = 1 << 20
"""Number of bytes read at once; a bag file may be larger than the memory."""


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
    """Format the names of similar files in the folder as the end of a message.

    Args:
        path: Path that does not exist.

    Returns:
        Text such as "; did you mean swing.csv?"; empty if no name is similar.
    """
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


Content = str | bytes
"""Content of a file; text is written as UTF-8."""


def write_atomically(path: Path, content: Content) -> None:
    """Write a file atomically; an existing file is replaced.

    Args:
        path: Path of the file.
        content: Content of the file.
    """
    with atomic_replacement(path) as partial:
        partial.write_bytes(_encode_content(content))


def write_all_atomically(contents: Mapping[Path, Content]) -> None:
    """Write several files, all or none; existing files are replaced."""
    with ExitStack() as places:
        # No file is renamed before all are complete.
        for path, content in contents.items():
            places.enter_context(atomic_replacement(path)).write_bytes(_encode_content(content))


@contextmanager
def atomic_replacement(path: Path, *, keep_ending: bool = False) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` when the block ends without an error.

    Args:
        path: Path of the final file; an existing file is replaced.
        keep_ending: Whether the temporary name keeps the ending, for libraries that derive the
            format from it. By default it has another ending, so that the file is not listed as one
            of its kind.
    """
    partial = _make_temporary_path(path, keep_ending)
    try:
        yield partial
        _flush_to_disk(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_new_files(contents: Mapping[Path, Content]) -> None:
    """Write several new files, all or none; existing files are never overwritten.

    All contents are written to temporary files first, which then get their names. If one name is
    taken, the files that have theirs already are deleted again.

    Raises:
        OSError: A file cannot be written, or exists (`FileExistsError`); its filename says which.
    """
    with ExitStack() as cleaning, ExitStack() as undoing:
        partials = {path: _make_temporary_path(path) for path in contents}
        for path, partial in partials.items():
            cleaning.callback(partial.unlink, missing_ok=True)
            with _set_file_name_in_errors(path):
                partial.write_bytes(_encode_content(contents[path]))
                _flush_to_disk(partial)
        for path, partial in partials.items():
            with _set_file_name_in_errors(path):
                _rename_if_free(partial, path)
            undoing.callback(path.unlink)
        # All files are in place: keep them.
        undoing.pop_all()


def _rename_if_free(partial: Path, path: Path) -> None:
    """Give a complete file its final name, unless a file with this name exists.

    Args:
        partial: temporary path of the complete file.
        path: its final path.

    Raises:
        FileExistsError: another process has created the file in the meantime.
    """
    try:
        # Unlike a rename, this fails if the file was created in the meantime.
        os.link(partial, path)
    except FileExistsError:
        # It is an OSError too, but means that the name is taken.
        raise
    except OSError:  # a file system without hard links
        if path.exists():
            raise FileExistsError(str(path)) from None
        partial.rename(path)


@contextmanager
def _set_file_name_in_errors(path: Path) -> Iterator[None]:
    """Set the file name of an OSError to `path`, whichever temporary file caused it."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


@contextmanager
def atomic_new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `folder` when the block ends without an error.

    Raises:
        OSError: The folder cannot be made, or `folder` is not empty.
    """
    partial = _make_temporary_path(folder)
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.replace(folder)
    finally:
        # After a success there is no temporary folder to delete.
        shutil.rmtree(partial, ignore_errors=True)


def get_first_line(error: BaseException) -> str:
    """Return the first line of an error's message; its class if the message is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _make_temporary_path(path: Path, keep_ending: bool = False) -> Path:
    """Return the temporary name next to a file, under which it is written before it is renamed.

    Args:
        path: final path of the file.
        keep_ending: whether the temporary name has the same suffix, on which some writers depend.
    """
    # The name contains the process id, so that two processes do not write to the same file.
    if keep_ending:
        return path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _encode_content(content: Content) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _flush_to_disk(path: Path) -> None:
    """Flush a file's content to disk, so that it is there before the rename."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def write_files(contents: Mapping[Path, Content]) -> None:
    """Write all files or none; readers never see a partly written file.

    Raises:
        InputError: A file exists already, or cannot be written.
    """
    check_absent(contents)
    try:
        write_new_files(contents)
    except FileExistsError as error:
        raise make_exists_error(error.filename) from None
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be written ({error.strerror})") from None


def lock_file(file: IO[Any] | int, is_blocking: bool = False) -> None:
    """Lock an open file or folder until it is closed or this process ends.

    On an operating system without such locks (Windows) nothing is locked.

    Args:
        file: file, or descriptor of a file or folder.
        is_blocking: whether to wait for the lock.

    Raises:
        BlockingIOError: another process has the lock.
    """
    try:
        import fcntl
    except ImportError:
        return
    fcntl.flock(file, fcntl.LOCK_EX | (0 if is_blocking else fcntl.LOCK_NB))


def open_locked(path: Path, folder: Path) -> IO[str]:
    """Open a file for appending, and lock it until it is closed or this process ends.

    Two processes that write to the same results would damage them.

    Args:
        path: path of the file.
        folder: folder that the lock reserves, for the message.

    Raises:
        InputError: another process has the lock.
    """
    file = path.open("a", encoding="utf-8")
    try:
        lock_file(file)
    except OSError:
        file.close()
        raise InputError(
            f"{folder}: another simgap process uses this folder; wait for it, or end it"
        ) from None
    return file


@lru_cache(maxsize=256)
def hash_file(path: Path, _changed: int, _size: int) -> bytes:
    """Return the SHA-256 hash of a file; cached, as many logs may use the same file.

    Args:
        path: path of the file.
        _changed: time of the last change, ns; only part of the cache key, so that a changed file is
            hashed again.
        _size: size in bytes, likewise.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.digest()
