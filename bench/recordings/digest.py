"""Hash of a recording and of all files that it uses."""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from pathlib import Path

from sims.base import InputError
from sims.recording.bags import bag_of
from sims.recording.description import description_of
from sims.recording.hdf5 import group_of
from sims.recording.lerobot import episode_of, files_of
from sims.recording.mapping import mapped

PIECE = 1 << 20
"""Number of bytes read at once; a bag file may be larger than the memory."""
_INCLUDE = re.compile(rb"<include\s+file\s*=\s*[\"']([^\"']+)[\"']")


def digest_of(path: Path, told: str = "") -> str:
    """Hash a recording: its table, its description, the mapped logs and bags, and its model.

    Args:
        path: Path of its table or description.
        told: Further text that is part of the hash.

    Raises:
        InputError: The table or the description cannot be read.
    """
    digest = hashlib.sha256(told.encode())
    description = description_of(path)
    for file in dict.fromkeys([path, description]):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    for file in mapped(description):
        digest.update(content_of(file))
    return digest.hexdigest()


def content_of(path: Path) -> bytes:
    """Return the hash of a file and of the files that it includes, or of the bag or episode.

    Missing files contribute nothing; reading them later reports the error.
    """
    episode = episode_of(path)
    if episode is not None:
        try:
            return b"".join(content_of(file) for file in files_of(*episode))
        except InputError:
            return b""
    bag = bag_of(path) or group_of(path)
    whole = path if bag is None else bag[0]
    files = sorted(whole.rglob("*")) if bag is not None and whole.is_dir() else [whole]
    content = hashlib.sha256()
    for file in files if whole.suffix.lower() != ".xml" else _with_included(whole):
        if file.is_file():
            about = file.stat()
            content.update(_hashed(file, about.st_mtime_ns, about.st_size))
    return content.digest()


def _with_included(model: Path) -> list[Path]:
    """Return a model file and the files that it includes, searched in the folder of the model."""
    files, found = [model], 0
    while found < len(files):
        inner = files[found]
        names = _INCLUDE.findall(inner.read_bytes()) if inner.is_file() else []
        beside = [model.parent / name.decode(errors="replace") for name in names]
        files += [file for file in dict.fromkeys(beside) if file not in files]
        found += 1
    return files


@lru_cache(maxsize=256)
def _hashed(path: Path, _changed: int, _size: int) -> bytes:
    """Return the hash of a file; cached, as many logs may use the same file.

    The unused arguments are part of the cache key, so a changed file is hashed again.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            digest.update(piece)
    return digest.digest()
