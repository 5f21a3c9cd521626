"""Lock files between processes."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

from sims.core.simulator import InputError


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
