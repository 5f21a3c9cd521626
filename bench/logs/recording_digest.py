"""Hash of a recording and of all files that it uses."""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from pathlib import Path

from sims.core.simulator import InputError
from sims.recording.column_mapping import list_mapped_files
from sims.recording.log_formats.hdf5_and_parquet import group_of
from sims.recording.log_formats.lerobot_dataset import list_episode_files, split_episode_path
from sims.recording.log_formats.ros_bags import split_bag_path
from sims.recording.recording_description import get_description_path

CHUNK_BYTES = 1 << 20
"""Number of bytes read at once; a bag file may be larger than the memory."""
_INCLUDE = re.compile(rb"<include\s+file\s*=\s*[\"']([^\"']+)[\"']")


def compute_recording_digest(path: Path, further_text: str = "") -> str:
    """Hash a recording: its table, its description, the mapped logs and bags, and its model.

    Args:
        path: Path of its table or description.
        further_text: Further text that is part of the hash.

    Raises:
        InputError: The table or the description cannot be read.
    """
    digest = hashlib.sha256(further_text.encode())
    description = get_description_path(path)
    for file in dict.fromkeys([path, description]):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    for file in list_mapped_files(description):
        digest.update(read_content(file))
    return digest.hexdigest()


def read_content(path: Path) -> bytes:
    """Return the hash of a file and of the files that it includes, or of the bag or episode.

    Missing files contribute nothing; reading them later reports the error.
    """
    episode = split_episode_path(path)
    if episode is not None:
        try:
            return b"".join(read_content(file) for file in list_episode_files(*episode))
        except InputError:
            return b""
    bag = split_bag_path(path) or group_of(path)
    root = path if bag is None else bag[0]
    files = sorted(root.rglob("*")) if bag is not None and root.is_dir() else [root]
    content = hashlib.sha256()
    for file in files if root.suffix.lower() != ".xml" else _list_included_files(root):
        if file.is_file():
            file_stat = file.stat()
            content.update(_hash_file(file, file_stat.st_mtime_ns, file_stat.st_size))
    return content.digest()


def _list_included_files(model: Path) -> list[Path]:
    """Return a model file and the files that it includes, searched in the folder of the model."""
    files, visited_count = [model], 0
    while visited_count < len(files):
        visited_file = files[visited_count]
        names = _INCLUDE.findall(visited_file.read_bytes()) if visited_file.is_file() else []
        included_files = [model.parent / name.decode(errors="replace") for name in names]
        files += [file for file in dict.fromkeys(included_files) if file not in files]
        visited_count += 1
    return files


@lru_cache(maxsize=256)
def _hash_file(path: Path, _changed: int, _size: int) -> bytes:
    """Return the hash of a file; cached, as many logs may use the same file.

    The unused arguments are part of the cache key, so a changed file is hashed again.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.digest()
