"""The folders in which tuners work: each is there for as long as the process that made it, and not
much longer, however that ends.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

_PREFIX = "simgap-tuner-"


class Folder(NamedTuple):
    """An empty folder, held by this process.

    Attributes:
        path: of it.
        lock: a file descriptor; who has it open uses the folder.
    """

    path: str
    lock: int

    def remove(self) -> None:
        """Delete it, and let go of it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)


def new() -> Folder:
    """A new folder."""
    sweep()
    while True:
        path = tempfile.mkdtemp(prefix=_PREFIX)
        lock = _locked(path, wait=True)
        # Between the two another process may have taken it for one that nobody uses.
        if lock is not None and os.path.isdir(path):
            return Folder(path, lock)


def sweep() -> None:
    """Delete folders whose processes were all killed before they could."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        lock = _locked(str(path), wait=False)
        if lock is not None:
            Folder(str(path), lock).remove()


def _locked(path: str, wait: bool) -> int | None:
    """A descriptor with the folder's lock; None where another process has it, or it is gone."""
    try:
        lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(lock)
        return None
    return lock
