"""Hash the files of a recording, to detect whether it has changed."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from sims.core.files import hash_file
from sims.core.simulator import InputError
from sims.recording.column_mapping import list_mapped_files
from sims.recording.log_formats.hdf5_and_parquet import split_group_path
from sims.recording.log_formats.lerobot_dataset import list_episode_files, split_episode_path
from sims.recording.log_formats.ros_bags import split_bag_path
from sims.recording.recording_description import get_description_path

_INCLUDE = re.compile(rb"<include\s+file\s*=\s*[\"']([^\"']+)[\"']")


def compute_recording_digest(path: Path, further_text: str = "") -> str:
    """Hash a recording: its table, its description, all logs that it refers to, and its model.

    Args:
        path: Path of its table or description.
        further_text: Further text that is part of the hash.

    Returns:
        SHA-256, hexadecimal.

    Raises:
        InputError: The table or the description cannot be read.
    """
    digest = hashlib.sha256(further_text.encode())
    description = get_description_path(path)
    # `path` may be the description itself, which is then hashed once.
    for file in dict.fromkeys([path, description]):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    for file in list_mapped_files(description):
        digest.update(compute_content_digest(file))
    return digest.hexdigest()


def compute_content_digest(path: Path) -> bytes:
    """Return a hash of the content of a log or model file.

    The path names one of these:

    * an episode of a LeRobot dataset, which consists of several files; the result is the hashes of
      all of them, one after another
    * a topic of a ROS bag, or a group of an HDF5 file; the whole bag or file is hashed
    * a model file (.xml), hashed with the files that it includes
    * any other file

    Missing files contribute nothing; reading them later reports the error.

    Args:
        path: path of the file, perhaps with an episode, a topic or a group behind it.

    Returns:
        SHA-256 in binary form; empty for an episode that cannot be listed.
    """
    episode = split_episode_path(path)
    if episode is not None:
        try:
            return b"".join(compute_content_digest(file) for file in list_episode_files(*episode))
        except InputError:
            return b""
    # A bag or HDF5 file, and the topic or group in it; None for any other file.
    container = split_bag_path(path) or split_group_path(path)
    root = path if container is None else container[0]
    if root.suffix.lower() == ".xml":
        files = _list_included_files(root)
    elif container is not None and root.is_dir():  # a bag of ROS 2
        files = sorted(root.rglob("*"))
    else:
        files = [root]
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            file_stat = file.stat()
            digest.update(hash_file(file, file_stat.st_mtime_ns, file_stat.st_size))
    return digest.digest()


def _list_included_files(model: Path) -> list[Path]:
    """Return a model file and the files that it includes, directly or through others.

    As in MJCF, all names are relative to the folder of the model file.

    Args:
        model: path of the model file.
    """
    files = [model]
    # Files that are appended here are visited later in this loop.
    for file in files:
        names = _INCLUDE.findall(file.read_bytes()) if file.is_file() else []
        included_files = [model.parent / name.decode(errors="replace") for name in names]
        files += [included for included in dict.fromkeys(included_files) if included not in files]
    return files
