"""Store a folder as a zip archive with a manifest of file hashes.

The same folder gives the same bytes (with the same zlib): names are sorted, times are fixed. Before
an archive of unknown origin is unpacked, it is checked for attacks: paths outside the folder,
links, more bytes than stated or than any result has.
"""

from __future__ import annotations

import hashlib
import json
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, Any, NamedTuple

from bench.benchmark.storage.provenance import compute_sha256
from bench.schemas import find_violations
from sims.core.files import atomic_replacement
from sims.core.simulator import InputError

MANIFEST_FILE = "manifest.json"
MAX_UNPACKED_BYTES = 8 << 30
"""Maximum size of an unpacked archive in bytes."""
MAX_COMPRESSION_RATIO = 200
"""Maximum ratio of unpacked to packed size, if the unpacked size exceeds
`_MIN_BYTES_FOR_RATIO_CHECK`."""
_MIN_BYTES_FOR_RATIO_CHECK = 100 << 20
_MAX_FILES = 100_000
"""Maximum number of files in an archive."""
_MAX_MANIFEST_BYTES = 64 << 20
_BLOCK_BYTES = 1 << 20
"""Number of bytes that are read at a time."""
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a zip file can store, which is given to every file."""
_COMPRESSION_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that an archive may have."""
_ENCRYPTED_FLAG = 0x1
"""Flag of an encrypted file in a zip archive."""
_MAX_PATH_LENGTH = 1000
"""Maximum length of a path in characters."""


class ManifestMismatch(NamedTuple):
    """A difference between an archive and its manifest.

    Attributes:
        file: Path in the archive's folder.
        says: What was expected, and what was found.
    """

    file: str
    says: str


def write_archive(
    archive: Path, name: str, files: Mapping[str, Path], metadata: Mapping[str, Any]
) -> None:
    """Write an archive completely or not at all.

    Args:
        archive: Path of a new file.
        name: Name of the folder in the archive.
        files: Path of each file on disk, by its path in that folder.
        metadata: Entries of the manifest in addition to the files.

    Raises:
        InputError: The archive exists already, or a file cannot be read or written.
    """
    if archive.exists():
        raise InputError(f"{archive}: exists already; name another file with --out")
    file_entries = [
        {"path": path, "bytes": place.stat().st_size, "sha256": compute_sha256(place)}
        for path, place in sorted(files.items())
    ]
    manifest = json.dumps({**metadata, "files": file_entries}, indent=1, ensure_ascii=False) + "\n"
    try:
        archive.parent.mkdir(parents=True, exist_ok=True)
        with atomic_replacement(archive) as partial, zipfile.ZipFile(partial, "w") as packed:
            packed.writestr(
                _make_zip_header(f"{name}/{MANIFEST_FILE}"), manifest, zipfile.ZIP_DEFLATED, 9
            )
            for path, place in sorted(files.items()):
                with (
                    place.open("rb") as source,
                    packed.open(_make_zip_header(f"{name}/{path}"), "w") as target,
                ):
                    while block := source.read(_BLOCK_BYTES):
                        target.write(block)
    except OSError as error:
        raise InputError(f"{archive}: cannot be written ({error.strerror})") from None


def _make_zip_header(path: str) -> zipfile.ZipInfo:
    """Make the header of a file in the zip archive, with fixed time, permissions and system.

    The bytes of the archive then depend on the content of the files only.
    """
    entry = zipfile.ZipInfo(path, _ZIP_EPOCH)
    entry.create_system = 3  # Always Unix, so that the bytes do not depend on this machine.
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


class UnpackedArchive(NamedTuple):
    """An archive that has been unpacked.

    Attributes:
        folder: Temporary folder with its content.
        manifest: Its manifest.
        mismatches: Differences from the manifest.
    """

    folder: Path
    manifest: dict[str, Any]
    mismatches: list[ManifestMismatch]


@contextmanager
def unpack_archive(archive: Path) -> Iterator[UnpackedArchive]:
    """Context that unpacks an archive into a temporary folder.

    Raises:
        InputError: It is not an archive of simgap, or unpacking it could be harmful.
    """
    try:
        with zipfile.ZipFile(archive) as packed, TemporaryDirectory(prefix="simgap-") as folder:
            entries = _check_entries(archive, packed)
            top_folder = _find_top_folder(archive, entries)
            manifest = _read_manifest(archive, packed, top_folder)
            sizes_and_hashes = {}
            for entry in entries:
                path = Path(folder, *PurePosixPath(entry.filename).parts)
                path.parent.mkdir(parents=True, exist_ok=True)
                sizes_and_hashes[entry.filename.removeprefix(f"{top_folder}/")] = _unpack_file(
                    archive, packed, entry, path
                )
            del sizes_and_hashes[MANIFEST_FILE]
            yield UnpackedArchive(
                Path(folder, top_folder),
                manifest,
                list(_compare_with_manifest(manifest, sizes_and_hashes)),
            )
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError) as error:
        raise InputError(f"{archive}: expected an archive of simgap bundle; {error}") from None
    except OSError as error:
        raise InputError(f"{archive}: cannot be read ({error.strerror or error})") from None


def _check_entries(archive: Path, packed: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the entries of an archive if all of them can be unpacked safely.

    Raises:
        InputError: One cannot.
    """
    entries = packed.infolist()
    if len(entries) > _MAX_FILES:
        raise _make_refusal(archive, f"{len(entries)} files, at most {_MAX_FILES} expected")
    for entry in entries:
        if problem := _find_entry_error(entry):
            raise _make_refusal(archive, f"{entry.filename[:80]!r} {problem}")
    # Two names that a file system treats as equal would overwrite each other's file.
    repeated_names = [
        name for name, n in Counter(e.filename.casefold() for e in entries).items() if n > 1
    ]
    if repeated_names:
        raise _make_refusal(archive, f"{repeated_names[0]!r} is in it twice")
    total, size = sum(entry.file_size for entry in entries), archive.stat().st_size
    if total > MAX_UNPACKED_BYTES or (
        total > _MIN_BYTES_FOR_RATIO_CHECK and total > MAX_COMPRESSION_RATIO * size
    ):
        raise _make_refusal(archive, f"it would unpack from {size} bytes to {total}")
    if packed.comment or min((e.header_offset for e in entries), default=0) > 0:
        raise _make_refusal(archive, "it contains data that belong to no file")
    return entries


def _find_entry_error(entry: zipfile.ZipInfo) -> str:
    """Return why an entry of an archive must not be unpacked; empty if it may be.

    An archive of unknown origin could contain paths outside its folder, links or devices, which
    would overwrite files of the user.
    """
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = name.split("/")
    # If the two stored names of an entry differ, programs would unpack it to different paths.
    if name != entry.orig_filename or "\\" in name or ":" in name or not name.isprintable():
        return "is not a plain path"
    if len(name) > _MAX_PATH_LENGTH or any(part in ("", ".", "..") for part in parts):
        return "is not a path inside its folder"
    if kind not in (0, stat.S_IFREG) or entry.is_dir():
        return "is a link, a folder or a device; expected a file"
    if entry.flag_bits & _ENCRYPTED_FLAG:
        return "is encrypted"
    if entry.compress_type not in _COMPRESSION_METHODS:
        return "is compressed in a way that simgap does not use"
    return ""


def _make_refusal(archive: Path, reason: str) -> InputError:
    return InputError(f"{archive}: refused: {reason}; nothing was unpacked")


def _find_top_folder(archive: Path, entries: list[zipfile.ZipInfo]) -> str:
    """Return the single top-level folder of an archive, which contains the manifest.

    Raises:
        InputError: the archive has another form, so it was not made by `simgap bundle`.
    """
    tops = {entry.filename.partition("/")[0] for entry in entries}
    if len(tops) != 1 or f"{(top := tops.pop())}/{MANIFEST_FILE}" not in {
        e.filename for e in entries
    }:
        raise InputError(
            f"{archive}: expected an archive of simgap bundle: one folder with {MANIFEST_FILE} "
            "in it"
        )
    return top


def _read_manifest(archive: Path, packed: zipfile.ZipFile, top: str) -> dict[str, Any]:
    """Read and validate the manifest of an archive, the list of its files with their hashes.

    `packed` is the opened archive, and `top` its only folder. The size is checked first, because an
    archive of unknown origin could contain a manifest that fills the memory.

    Raises:
        InputError: the manifest is too large, or does not follow its schema.
    """
    entry = packed.getinfo(f"{top}/{MANIFEST_FILE}")
    if entry.file_size > _MAX_MANIFEST_BYTES:
        raise _make_refusal(archive, f"{MANIFEST_FILE} has {entry.file_size} bytes")
    try:
        manifest = json.loads(packed.read(entry))
    except (ValueError, RecursionError):
        manifest = None
    if violations := find_violations(manifest, "manifest"):
        raise InputError(f"{archive}: {MANIFEST_FILE}: {violations[0]}")
    checked: dict[str, Any] = manifest
    return checked


def _unpack_file(
    archive: Path, packed: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path
) -> tuple[int, str]:
    """Unpack one file to `path`; return its size in bytes and its SHA-256.

    The size is checked while it is written, because a compressed file may be far larger than the
    archive says and fill the disk.
    """
    digest, size = hashlib.sha256(), 0
    with packed.open(entry) as source, path.open("wb") as target:
        for block in _read_blocks(source):
            size += len(block)
            if size > entry.file_size:
                raise _make_refusal(
                    archive, f"{entry.filename!r} has more bytes than its entry states"
                )
            digest.update(block)
            target.write(block)
    return size, digest.hexdigest()


def _read_blocks(source: IO[bytes]) -> Iterator[bytes]:
    while block := source.read(_BLOCK_BYTES):
        yield block


def _compare_with_manifest(
    manifest: dict[str, Any], unpacked: Mapping[str, tuple[int, str]]
) -> Iterator[ManifestMismatch]:
    """Yield files that are missing, added, or different from the manifest."""
    listed_files = {each["path"]: (each["bytes"], each["sha256"]) for each in manifest["files"]}
    if len(listed_files) < len(manifest["files"]):
        yield ManifestMismatch(MANIFEST_FILE, "expected each file once, found one listed twice")
    for path in sorted({*listed_files, *unpacked}):
        if path not in unpacked:
            yield ManifestMismatch(path, "expected it, as the manifest lists it; found none")
        elif path not in listed_files:
            yield ManifestMismatch(
                path, "expected no file that the manifest does not list; found this one"
            )
        elif listed_files[path] != unpacked[path]:
            (size, digest), (found_size, found_digest) = listed_files[path], unpacked[path]
            expected = f"{size} bytes with SHA-256 {digest[:12]}"
            yield ManifestMismatch(
                path, f"expected {expected}, found {found_size} bytes with {found_digest[:12]}"
            )
