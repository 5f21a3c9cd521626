"""Machine code in the user's cache: a file named for all that it depends on, made by one process
while the others wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

_DIGEST = hashlib.sha256().digest_size


def is_off() -> bool:
    """Whether the user wants no machine code."""
    return os.environ.get("SIMGAP_COMPILED") == "off"


def folder() -> Path:
    """$SIMGAP_COMPILED, else simgap/ in the user's cache folder."""
    if named := os.environ.get("SIMGAP_COMPILED"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def read(path: Path) -> bytes | None:
    """What was kept; None if there is nothing, or it is damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[_DIGEST:]
    return content if hashlib.sha256(content).digest() == data[:_DIGEST] else None


def made_once(path: Path, make: Callable[[], bytes], waits: Callable[[], None]) -> bytes:
    """What is kept at `path`, made by one of all processes that ask for it.

    Args:
        path: of the file.
        make: its content, if nobody has made it.
        waits: called once if another process is at it.

    Raises:
        OSError: there is no place for it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path.with_suffix(".lock"), waits):
        # Another process may have made it meanwhile.
        content = read(path)
        if content is None:
            content = make()
            _write(path, content)
    return content


def _write(path: Path, content: bytes) -> None:
    """All at once or not at all."""
    # The same name each time: what a killed process leaves of it is overwritten by the next.
    partial = path.with_suffix(".part")
    try:
        partial.write_bytes(hashlib.sha256(content).digest() + content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _alone(path: Path, waits: Callable[[], None]) -> Iterator[None]:
    """While no other process is in here with this path, where the system knows how to tell."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waits()
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
