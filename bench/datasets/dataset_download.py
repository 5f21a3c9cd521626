"""Download a data set, check size and SHA-256 of every file, convert it, and write its folder.

Either the whole folder is written or nothing.
"""

from __future__ import annotations

import hashlib
import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from bench import __version__
from bench.datasets.dataset_catalogue import DataSet, SourceFile
from bench.datasets.dataset_conversion import CONVERSIONS
from sims.core.files import Content, atomic_new_folder
from sims.core.simulator import InputError

_TIMEOUT = 30.0
"""Timeout for a server that sends no data, seconds."""
_READ_BLOCK_BYTES = 1 << 16
"""Number of bytes that are read at a time."""

Advance = Callable[[int], None]
"""Callback with the number of bytes received."""


def download(
    data_set: DataSet, folder: Path, source: str = "", advance: Advance = lambda _: None
) -> Path:
    """Write a data set into the folder NAME below `folder`.

    Args:
        data_set: the data set.
        folder: parent folder of the data sets of this kind; created if it does not exist.
        source: source of the files instead of their public repository: a folder that contains them,
            such as a clone at the data set's commit, or an address that serves the repository's
            files; empty for the public repository.
        advance: called when bytes are received.

    Returns:
        The data set's folder.

    Raises:
        InputError: a file cannot be downloaded or is not the published one, or the folder cannot be
            written. Nothing is written then.
    """
    target = folder / data_set.name
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(
            f"{target}: exists and does not contain {' and '.join(data_set.provides)}; "
            "delete it, or choose another folder with --out"
        )
    contents = {
        file.name: _check_content(file, *_fetch_file(data_set, file, source, advance))
        for file in data_set.files
    }
    written: dict[str, Content] = dict(contents)
    if data_set.conversion:
        licence = {"LICENSE": contents["LICENSE"]}
        written = {**CONVERSIONS[data_set.conversion](contents), **licence}
    written["SOURCE.txt"] = _format_provenance(data_set)
    _write_folder(target, written)
    return target


def _fetch_file(
    data_set: DataSet, file: SourceFile, source: str, advance: Advance
) -> tuple[str, bytes]:
    """Fetch a file from the folder or address that the user gave, or from the public repository.

    Args:
        data_set: Data set that has the file.
        file: File to read.
        source: Folder, or http or https address; empty for the public repository.
        advance: Called with the number of bytes received.

    Returns:
        Path or address of the file, for messages, and its content, which is not checked yet.

    Raises:
        InputError: The source is of another form, or the file cannot be read.
    """
    if source and "://" not in source:
        return _read_file(data_set, file, Path(source), advance)
    if source and not source.startswith(("http://", "https://")):
        raise InputError(f"--from {source}: expected a folder, or an http or https address")
    url = f"{(source or data_set.base_url).rstrip('/')}/{file.path}"
    return url, _download_content(url, data_set, file, advance)


def _read_file(
    data_set: DataSet, file: SourceFile, folder: Path, advance: Advance
) -> tuple[str, bytes]:
    """Read a file from a folder that contains a clone, or the files without subfolders.

    At most one byte more than expected is read: enough to see that the file is too long.

    Args:
        data_set: Data set that has the file.
        file: File to read.
        folder: Folder that the user gave.
        advance: Called with the number of bytes read.

    Returns:
        Path and content of the file.

    Raises:
        InputError: The file is not there, or cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"--from {folder}: no such folder")
    for path in (folder / file.path, folder / Path(file.path).name, folder / file.name):
        if path.is_file():
            try:
                with path.open("rb") as stream:
                    content = stream.read(file.bytes + 1)
            except OSError as error:
                raise InputError(f"{path}: cannot be read ({error.strerror})") from None
            advance(len(content))
            return str(path), content
    origin = f"commit {data_set.commit[:7]} of {data_set.repository}"
    raise InputError(
        f"{folder}: expected {file.path} of {origin}, or the file alone; found neither"
    )


def _download_content(url: str, data_set: DataSet, file: SourceFile, advance: Advance) -> bytes:
    """Download the content of an address, in blocks.

    At most one byte more than expected is received: enough to see that the file is too long.

    Args:
        url: Address of the file.
        data_set: Data set, for the advice in messages.
        file: Expected size of the content.
        advance: Called with the number of bytes received.

    Raises:
        InputError: The file cannot be downloaded.
    """
    remedy = (
        f"download it by other means and give its folder with `{data_set.command} --from FOLDER`"
    )
    request = urllib.request.Request(url, headers={"User-Agent": f"simgap/{__version__}"})
    content = b""
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT) as answer:
            while len(content) <= file.bytes:
                block = answer.read(min(_READ_BLOCK_BYTES, file.bytes + 1 - len(content)))
                if not block:
                    break
                content += block
                advance(len(block))
    except urllib.error.HTTPError as error:
        response_text = f"the server answers {error.code} {error.reason}"
        raise InputError(f"{url}: {response_text}; {remedy}") from None
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{url}: cannot be downloaded ({reason}); {remedy}") from None
    return content


def _check_content(file: SourceFile, location: str, content: bytes) -> bytes:
    """Return the content of a file if it is the published one.

    Args:
        file: File with its published size and SHA-256.
        location: Path or address from which it was fetched, for messages.
        content: Content of the file.

    Raises:
        InputError: Size or SHA-256 differ.
    """
    size = len(content)
    if size > file.bytes:
        raise InputError(f"{location}: expected {file.bytes} bytes, found more; nothing is written")
    if size < file.bytes:
        mismatch = f"expected {file.bytes} bytes, found {size}"
        raise InputError(
            f"{location}: {mismatch}: incomplete; download it again; nothing is written"
        )
    digest = hashlib.sha256(content).hexdigest()
    if digest != file.sha256:
        mismatch = f"expected SHA-256 {file.sha256}, found {digest}"
        raise InputError(f"{location}: {mismatch}: not the published file; nothing is written")
    return content


def _format_provenance(data_set: DataSet) -> str:
    """Format SOURCE.txt: source, citation, licence and hashes of the files."""
    lines = [
        data_set.title,
        f"Source: {data_set.repository}, commit {data_set.commit}",
        f"Cite: {data_set.cite}",
        f"Licence: {data_set.licence}, see LICENSE",
        *(f"File: {file.path}, SHA-256 {file.sha256}" for file in data_set.files),
    ]
    if data_set.conversion:
        lines.append(
            f"{', '.join(data_set.provides)}: converted from it by `{data_set.command}` of simgap "
            f"{__version__} (bench/datasets/dataset_conversion.py, {data_set.conversion})"
        )
    return "\n".join(lines) + "\n"


def _write_folder(target: Path, contents: dict[str, Content]) -> None:
    """Write the folder of a data set as a whole, or not at all.

    Args:
        target: Folder of the data set, which must be empty or missing.
        contents: Files by name; text is written as UTF-8.

    Raises:
        InputError: The folder cannot be written.
    """
    try:
        with atomic_new_folder(target) as partial:
            for name, content in contents.items():
                data = content.encode() if isinstance(content, str) else content
                (partial / name).write_bytes(data)
    except OSError as error:
        remedy = "choose another folder with --out"
        raise InputError(f"{target}: cannot be written ({error.strerror}); {remedy}") from None
