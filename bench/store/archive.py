"""A folder as one archive that can be checked: a zip file with a manifest of every file's hash.

The same folder gives the same bytes (with the same zlib): names are sorted, times are fixed. What
an archive of unknown origin could do to whoever unpacks it is looked for before anything is
written: paths that leave the folder, links, more bytes than it says or than any run has.
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

from bench.schemas import faults
from bench.store.made import sha256
from sims.base import InputError
from sims.files import replacing

MANIFEST = "manifest.json"
LARGEST = 8 << 30
"""Bytes that an archive may unpack to."""
DENSEST = 200
"""Times its own size that it may unpack to, where that is more than `_HARMLESS`."""
_HARMLESS = 100 << 20
_MOST = 100_000
"""Files in an archive."""
_MANIFEST_BYTES = 64 << 20
_BLOCK = 1 << 20
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The first time that a zip file can hold: the time of every file in one of ours."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
_LONGEST = 1000
"""Characters of a path."""


class Fault(NamedTuple):
    """What is not as the manifest says.

    Attributes:
        file: in the archive's folder.
        says: what was expected, and what was found.
    """

    file: str
    says: str


def pack(archive: Path, name: str, files: Mapping[str, Path], about: Mapping[str, Any]) -> None:
    """Write an archive, whole or not at all.

    Args:
        archive: a new file.
        name: of the folder in it.
        files: by path in that folder, where each is now.
        about: what the manifest says beside the files.

    Raises:
        InputError: it is there already, or a file cannot be read or written.
    """
    if archive.exists():
        raise InputError(f"{archive}: exists already; name another file with --out")
    listed = [
        {"path": path, "bytes": place.stat().st_size, "sha256": sha256(place)}
        for path, place in sorted(files.items())
    ]
    manifest = json.dumps({**about, "files": listed}, indent=1, ensure_ascii=False) + "\n"
    try:
        archive.parent.mkdir(parents=True, exist_ok=True)
        with replacing(archive) as partial, zipfile.ZipFile(partial, "w") as packed:
            packed.writestr(_entry(f"{name}/{MANIFEST}"), manifest, zipfile.ZIP_DEFLATED, 9)
            for path, place in sorted(files.items()):
                with place.open("rb") as source, packed.open(_entry(f"{name}/{path}"), "w") as to:
                    while block := source.read(_BLOCK):
                        to.write(block)
    except OSError as error:
        raise InputError(f"{archive}: cannot be written ({error.strerror})") from None


def _entry(path: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(path, _EPOCH)
    entry.create_system = 3  # Unix, whatever this machine is
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


class Unpacked(NamedTuple):
    """An archive that has been unpacked.

    Attributes:
        folder: what was in it, for as long as it is looked at.
        manifest: what it says of itself.
        faults: what is not as the manifest says.
    """

    folder: Path
    manifest: dict[str, Any]
    faults: list[Fault]


@contextmanager
def unpacked(archive: Path) -> Iterator[Unpacked]:
    """An archive in a folder of its own, which is gone when the block ends.

    Raises:
        InputError: it is no archive of simgap's, or nothing that anybody should unpack.
    """
    try:
        with zipfile.ZipFile(archive) as packed, TemporaryDirectory(prefix="simgap-") as place:
            entries = _sound(archive, packed)
            top = _top(archive, entries)
            manifest = _manifest(archive, packed, top)
            found = {}
            for entry in entries:
                path = Path(place, *PurePosixPath(entry.filename).parts)
                path.parent.mkdir(parents=True, exist_ok=True)
                found[entry.filename.removeprefix(f"{top}/")] = _written(
                    archive, packed, entry, path
                )
            del found[MANIFEST]
            yield Unpacked(Path(place, top), manifest, list(_unlike(manifest, found)))
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError) as error:
        raise InputError(f"{archive}: expected an archive of simgap bundle; {error}") from None
    except OSError as error:
        raise InputError(f"{archive}: cannot be read ({error.strerror or error})") from None


def _sound(archive: Path, packed: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """The entries of an archive that can be unpacked without harm.

    Raises:
        InputError: there is one that cannot.
    """
    entries = packed.infolist()
    if len(entries) > _MOST:
        raise _refused(archive, f"{len(entries)} files, at most {_MOST} expected")
    for entry in entries:
        if wrong := _wrong(entry):
            raise _refused(archive, f"{entry.filename[:80]!r} {wrong}")
    # Two names that a file system takes for one would hide what the first holds.
    twice = [name for name, n in Counter(e.filename.casefold() for e in entries).items() if n > 1]
    if twice:
        raise _refused(archive, f"{twice[0]!r} is in it twice")
    total, size = sum(entry.file_size for entry in entries), archive.stat().st_size
    if total > LARGEST or (total > _HARMLESS and total > DENSEST * size):
        raise _refused(archive, f"it would unpack from {size} bytes to {total}")
    if packed.comment or min((e.header_offset for e in entries), default=0) > 0:
        raise _refused(archive, "there is something in it beside its files")
    return entries


def _wrong(entry: zipfile.ZipInfo) -> str:
    """Why an entry must not be unpacked; empty where it may."""
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = name.split("/")
    # A zip file that names one path in two places shows one of them to each reader.
    if name != entry.orig_filename or "\\" in name or ":" in name or not name.isprintable():
        return "is no plain path"
    if len(name) > _LONGEST or any(part in ("", ".", "..") for part in parts):
        return "leads out of its folder, or is none"
    if kind not in (0, stat.S_IFREG) or entry.is_dir():
        return "is a link, a folder or a device; expected a file"
    if entry.flag_bits & _ENCRYPTED:
        return "is encrypted"
    if entry.compress_type not in _METHODS:
        return "is compressed in a way that simgap does not use"
    return ""


def _refused(archive: Path, why: str) -> InputError:
    return InputError(f"{archive}: refused: {why}; nothing was unpacked")


def _top(archive: Path, entries: list[zipfile.ZipInfo]) -> str:
    """The one folder that all of it is in."""
    tops = {entry.filename.partition("/")[0] for entry in entries}
    if len(tops) != 1 or f"{(top := tops.pop())}/{MANIFEST}" not in {e.filename for e in entries}:
        raise InputError(
            f"{archive}: expected an archive of simgap bundle: one folder with {MANIFEST} in it"
        )
    return top


def _manifest(archive: Path, packed: zipfile.ZipFile, top: str) -> dict[str, Any]:
    entry = packed.getinfo(f"{top}/{MANIFEST}")
    if entry.file_size > _MANIFEST_BYTES:
        raise _refused(archive, f"{MANIFEST} has {entry.file_size} bytes")
    try:
        manifest = json.loads(packed.read(entry))
    except (ValueError, RecursionError):
        manifest = None
    if wrong := faults(manifest, "manifest"):
        raise InputError(f"{archive}: {MANIFEST}: {wrong[0]}")
    found: dict[str, Any] = manifest
    return found


def _written(
    archive: Path, packed: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path
) -> tuple[int, str]:
    """Unpack one file; its size and hash."""
    digest, size = hashlib.sha256(), 0
    with packed.open(entry) as source, path.open("wb") as to:
        for block in _blocks(source):
            size += len(block)
            if size > entry.file_size:
                raise _refused(archive, f"{entry.filename!r} holds more than it says")
            digest.update(block)
            to.write(block)
    return size, digest.hexdigest()


def _blocks(source: IO[bytes]) -> Iterator[bytes]:
    while block := source.read(_BLOCK):
        yield block


def _unlike(manifest: dict[str, Any], found: Mapping[str, tuple[int, str]]) -> Iterator[Fault]:
    """What is missing, added or other than the manifest says."""
    listed = {each["path"]: (each["bytes"], each["sha256"]) for each in manifest["files"]}
    if len(listed) < len(manifest["files"]):
        yield Fault(MANIFEST, "expected each file once, found one listed twice")
    for path in sorted({*listed, *found}):
        if path not in found:
            yield Fault(path, "expected it, as the manifest lists it; found none")
        elif path not in listed:
            yield Fault(path, "expected no file that the manifest does not list; found this one")
        elif listed[path] != found[path]:
            (size, digest), (other, its) = listed[path], found[path]
            what = f"{size} bytes with SHA-256 {digest[:12]}"
            yield Fault(path, f"expected {what}, found {other} bytes with {its[:12]}")
