"""Write files and folders atomically, and check that files exist.

A file is first written completely to disk under another name in the same folder, and then renamed,
so that readers never see a partly written file, even after a crash.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sims.core.path_checks import check_absent, make_exists_error
from sims.core.simulator import InputError

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

    Raises:
        FileExistsError: another process has created the file in the meantime.
    """
    try:
        # Unlike a rename, this fails if the file was created in the meantime.
        os.link(partial, path)
    except FileExistsError:
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
        shutil.rmtree(partial, ignore_errors=True)


def get_first_line(error: BaseException) -> str:
    """Return the first line of an error's message; its class if the message is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _make_temporary_path(path: Path, keep_ending: bool = False) -> Path:
    """Return the temporary name next to a file, under which it is written before it is renamed."""
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
