"""Cache of machine code on disk.

The name of a file contains a hash of everything on which the code depends. One process compiles the
code while the others wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from sims.core.files import lock_file

_DIGEST_BYTES = hashlib.sha256().digest_size


def get_cache_folder() -> Path:
    """Return the cache folder: $SIMGAP_COMPILED, else simgap/ in the user's cache folder."""
    if stated_folder := os.environ.get("SIMGAP_COMPILED"):
        return Path(stated_folder)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def read_cached(path: Path) -> bytes | None:
    """Return the cached content; None if it does not exist or is damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[_DIGEST_BYTES:]
    return content if hashlib.sha256(content).digest() == data[:_DIGEST_BYTES] else None


def make_cached(path: Path, make: Callable[[], bytes], report_wait: Callable[[], None]) -> bytes:
    """Return the cached content of a file, made by one of all processes that request it.

    Args:
        path: path of the file.
        make: function that makes the content if it does not exist.
        report_wait: called once if another process is making the content.

    Returns:
        The content.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _hold_lock(path.with_suffix(".lock"), report_wait):
        # Another process may have made it meanwhile.
        content = read_cached(path)
        if content is None:
            content = make()
            _write_atomically(path, content)
    return content


def _write_atomically(path: Path, content: bytes) -> None:
    """Write a file atomically, with the hash of its content."""
    # The temporary name is fixed, so that the file of a killed process is overwritten by the next.
    partial = path.with_suffix(".part")
    try:
        partial.write_bytes(hashlib.sha256(content).digest() + content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _hold_lock(path: Path, report_wait: Callable[[], None]) -> Iterator[None]:
    """Hold an exclusive lock between processes, so that only one of them compiles.

    If another process has the lock, `report_wait` is called before waiting. Without fcntl
    (Windows) there is no lock, and several processes may compile.
    """
    with path.open("w") as lock:
        try:
            lock_file(lock)
        except BlockingIOError:
            report_wait()
            lock_file(lock, is_blocking=True)
        yield
