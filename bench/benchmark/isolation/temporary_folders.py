"""Temporary folders that are locked while they are in use, so that unused ones can be deleted.

Folders of killed processes are deleted by the next process that makes one.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

from sims.core.files import lock_file

_FOLDER_PREFIX = "simgap-tuner-"


class LockedFolder(NamedTuple):
    """Temporary folder that is locked by this process.

    Attributes:
        path: path of the folder.
        lock: file descriptor with the lock; the folder is in use while it is open.
    """

    path: str
    lock: int

    def remove(self) -> None:
        """Delete the folder and release its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)


def create_locked_folder() -> LockedFolder:
    """Create a new locked folder.

    The lock shows other processes that the folder is in use; folders of ended processes are removed
    first.

    Returns:
        The folder and its open lock, which is held until the process ends.
    """
    remove_stale_folders()
    while True:
        path = tempfile.mkdtemp(prefix=_FOLDER_PREFIX)
        lock = _lock_folder(path, is_blocking=True)
        # Between creation and lock another process may have removed the folder as unused.
        if lock is not None and os.path.isdir(path):
            return LockedFolder(path, lock)


def remove_stale_folders() -> None:
    """Delete the folders of processes that were killed."""
    for path in Path(tempfile.gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        lock = _lock_folder(str(path), is_blocking=False)
        if lock is not None:
            LockedFolder(str(path), lock).remove()


def _lock_folder(path: str, is_blocking: bool) -> int | None:
    """Lock a folder, so that no other process uses or deletes it, and return the descriptor.

    Args:
        path: path of the folder.
        is_blocking: True to wait for the lock.

    Returns:
        File descriptor; None if another process has the lock, or the folder does not exist.
    """
    try:
        lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        lock_file(lock, is_blocking)
    except OSError:
        os.close(lock)
        return None
    return lock
