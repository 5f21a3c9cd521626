"""Pack a result folder into one archive with a manifest of file hashes, and unpack it safely.

The same folder gives the same bytes (with the same zlib): names are sorted, times are fixed. Before
an archive of unknown origin is unpacked, it is checked for attacks: paths outside the folder,
links, more bytes than stated or than any result has.

The folder is that of a comparison or an explanation; the archive is meant for the supplement of a
paper. `bench.studies.result_verification` checks whether the content of an archive is consistent.
"""

from __future__ import annotations

import json
import shutil
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from bench import __version__
from bench.benchmark.storage.provenance import (
    compute_sha256,
    read_environment,
    read_explain_command,
)
from bench.benchmark.storage.result_folder import CONFIGURATION_FILE, read_configuration
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.diagnosis.verdict import VERDICT_FILE
from bench.misspecification.calibration_recording import MODEL_LABELS
from bench.schemas import find_violations
from bench.studies.study_kinds import list_study_folders
from sims.core.files import atomic_replacement
from sims.core.simulator import InputError
from sims.extended_simulator import EXTENDED_MODEL_FILE

MANIFEST_FILE = "manifest.json"
_FORMAT_VERSION = 1
"""Version of the manifest's format."""
_PLUGIN_FOLDER = "plugins"
"""Folder of plugin files in the archive of a comparison."""
RECORDINGS_FOLDER = "recordings"
"""Folder of recordings in the archive of an explanation."""
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


class BundleResult(NamedTuple):
    """Result of writing an archive.

    Attributes:
        archive: path of the archive.
        kind: comparison or explanation.
        files: number of files in it.
        command: command that reproduces its content.
        left_out: files of the folder that are not in it, with the reason.
    """

    archive: Path
    kind: str
    files: int
    command: str
    left_out: tuple[str, ...]

    def to_document(self) -> dict[str, Any]:
        """Convert the result of writing an archive to a JSON document."""
        size = self.archive.stat().st_size
        return {**self._asdict(), "bytes": size, "sha256": compute_sha256(self.archive)}


def write_bundle(
    folder: Path, out: Path | None = None, recordings: Sequence[Path] = ()
) -> BundleResult:
    """Write a result folder as one archive.

    Args:
        folder: folder of a finished comparison, a sweep or an explanation.
        out: path of the new archive; None for NAME.zip in the current folder.
        recordings: CSV files of the recordings to add to an explanation, with their descriptions.

    Raises:
        InputError: the folder is not a result folder or not finished, or the archive exists
            already.
    """
    kind = _find_folder_kind(folder)
    name = folder.resolve().name
    files, left_out = _list_result_files(folder)
    if kind == "comparison":
        if recordings:
            raise InputError("--with: recordings go with an explanation; leave them out")
        files |= _list_plugin_files(folder)
        command = _format_compare_command(folder, name)
    else:
        files |= _list_recording_files(recordings)
        command = read_explain_command(folder)
    metadata = {
        "format": _FORMAT_VERSION,
        "kind": kind,
        "name": name,
        "simgap": str(read_environment(list_study_folders(folder)[0]).get("simgap") or __version__),
        "bundled_by": __version__,
        "command": command,
    }
    archive = out or Path(f"{name}.zip")
    write_archive(archive, name, files, metadata)
    return BundleResult(archive, kind, len(files), command, tuple(left_out))


def _find_folder_kind(folder: Path) -> str:
    """Return whether a folder has an "explanation" or a "comparison", which may be a sweep.

    Raises:
        InputError: it is not a result folder, or a comparison in it is not finished.
    """
    if (folder / VERDICT_FILE).is_file() and (folder / EXTENDED_MODEL_FILE).is_file():
        return "explanation"
    for part in list_study_folders(folder):
        read_configuration(part)  # raises an error for any other folder
        if (part / SEGMENTS_FOLDER).exists():
            raise InputError(f"{part}: not finished; resume it first")
    return "comparison"


def _list_result_files(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """List the files of a folder by their relative paths, and those that are left out.

    Links and hidden files are left out, because an archive must not contain files from elsewhere.

    Args:
        folder: Folder of results.

    Returns:
        Files by relative path, and a line for each path that is left out.
    """
    files, left_out = {}, []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            left_out.append(f"{name}: a link")
        elif path.is_file() and any(part.startswith(".") for part in Path(name).parts):
            left_out.append(f"{name}: hidden")
        elif path.is_file() and name != MANIFEST_FILE:
            files[name] = path
    return files, left_out


def _list_plugin_files(folder: Path) -> dict[str, Path]:
    """List the plugin files of a comparison, so that they can be inspected before they run.

    Args:
        folder: Folder of a comparison.

    Returns:
        Existing plugin files by their path in the archive.
    """
    plugins = [
        Path(file)
        for part in list_study_folders(folder)
        for file in read_configuration(part).plugins
    ]
    files: dict[str, Path] = {}
    for file in dict.fromkeys(plugins):
        if not file.is_file():
            continue
        name, number = file.name, 1
        # Plugins of different folders may have the same name.
        while f"{_PLUGIN_FOLDER}/{name}" in files:
            number += 1
            name = f"{file.stem}-{number}{file.suffix}"
        files[f"{_PLUGIN_FOLDER}/{name}"] = file
    return files


def _list_recording_files(tables: Sequence[Path]) -> dict[str, Path]:
    """List recordings for the archive: each CSV table, and its TOML description if it exists.

    Returns:
        Files on this machine, by their path in the archive.
    """
    files = {}
    for table in tables:
        if not table.is_file():
            raise InputError(f"{table}: no such file")
        for path in (table, table.with_suffix(".toml")):
            if path.is_file():
                files[f"{RECORDINGS_FOLDER}/{path.name}"] = path
    return files


def _format_compare_command(folder: Path, name: str) -> str:
    """Build the command that repeats a comparison, or a suite's comparisons of some methods.

    A suite is a versioned set of problems, which has a command of its own. Its tuners may be those
    of plugin files, which are named by their paths in the archive.

    Args:
        folder: folder of the comparison, or of a suite's comparisons.
        name: name of the folder in the archive.
    """
    configurations = [read_configuration(part) for part in list_study_folders(folder)]
    # A suite gives all its comparisons the same plugins and tuners, so the first one is used.
    experiment = configurations[0].experiment
    if not experiment.suite or experiment.diagnosis:
        return f"simgap compare {name}/{CONFIGURATION_FILE}"
    archived_paths = {file: path for path, file in _list_plugin_files(folder).items()}
    plugins = [
        f"--plugin {name}/{archived_paths[Path(file)]}"
        for file in configurations[0].plugins
        if Path(file) in archived_paths
    ]
    tuners = ",".join(entry.label for entry in experiment.tuners)
    return " ".join(["simgap compare suite", *plugins, f"--tuners {tuners}"])


def write_archive(
    archive: Path, name: str, files: Mapping[str, Path], metadata: Mapping[str, Any]
) -> None:
    """Write a zip archive of files and their manifest, completely or not at all.

    The manifest lists each file with its size and SHA-256, so that a changed file is detected.

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
        {"path": path, "bytes": file.stat().st_size, "sha256": compute_sha256(file)}
        for path, file in sorted(files.items())
    ]
    manifest = json.dumps({**metadata, "files": file_entries}, indent=1, ensure_ascii=False) + "\n"
    try:
        archive.parent.mkdir(parents=True, exist_ok=True)
        with atomic_replacement(archive) as partial, zipfile.ZipFile(partial, "w") as packed:
            packed.writestr(
                _make_zip_header(f"{name}/{MANIFEST_FILE}"),
                manifest,
                compress_type=zipfile.ZIP_DEFLATED,
                compresslevel=9,
            )
            for path, file in sorted(files.items()):
                with (
                    file.open("rb") as source,
                    packed.open(_make_zip_header(f"{name}/{path}"), "w") as target,
                ):
                    shutil.copyfileobj(source, target, _BLOCK_BYTES)
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
        files: Size in bytes and SHA-256 of each file by path, without the manifest.
    """

    folder: Path
    manifest: dict[str, Any]
    files: dict[str, tuple[int, str]]


@contextmanager
def unpack_archive(archive: Path) -> Iterator[UnpackedArchive]:
    """Context that unpacks an archive into a temporary folder.

    Args:
        archive: path of the archive, which may be of unknown origin.

    Yields:
        The folder, which is deleted afterwards, the manifest, and the files with their hashes.

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
                # No more bytes are read than the entry states, however many it contains.
                with packed.open(entry) as source, path.open("wb") as target:
                    shutil.copyfileobj(source, target, _BLOCK_BYTES)
                name = entry.filename.removeprefix(f"{top_folder}/")
                sizes_and_hashes[name] = path.stat().st_size, compute_sha256(path)
            # The manifest does not list itself.
            del sizes_and_hashes[MANIFEST_FILE]
            yield UnpackedArchive(Path(folder, top_folder), manifest, sizes_and_hashes)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError) as error:
        raise InputError(f"{archive}: expected an archive of simgap bundle; {error}") from None
    except OSError as error:
        raise InputError(f"{archive}: cannot be read ({error.strerror or error})") from None


def _check_entries(archive: Path, packed: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the entries of an archive if all of them can be unpacked safely.

    Args:
        archive: path of the archive, for messages.
        packed: archive, open for reading.

    Raises:
        InputError: One cannot.
    """
    entries = packed.infolist()
    if len(entries) > _MAX_FILES:
        raise _make_refusal(archive, f"{len(entries)} files, at most {_MAX_FILES} expected")
    for member in entries:
        if problem := _find_entry_error(member):
            raise _make_refusal(archive, f"{member.filename[:80]!r} {problem}")
    # Two names that a file system treats as equal would overwrite each other's file.
    repeated_names = [
        name for name, n in Counter(e.filename.casefold() for e in entries).items() if n > 1
    ]
    if repeated_names:
        raise _make_refusal(archive, f"{repeated_names[0]!r} is in it twice")
    # A small archive that unpacks to very much would fill the disk (a "zip bomb").
    total, size = sum(member.file_size for member in entries), archive.stat().st_size
    if total > MAX_UNPACKED_BYTES or (
        total > _MIN_BYTES_FOR_RATIO_CHECK and total > MAX_COMPRESSION_RATIO * size
    ):
        raise _make_refusal(archive, f"it would unpack from {size} bytes to {total}")
    # Such data are a comment at the end, or bytes before the first file.
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

    Args:
        archive: path of the archive, for messages.
        entries: its entries.

    Raises:
        InputError: the archive has another form, so it was not made by `simgap bundle`.
    """
    paths = {entry.filename for entry in entries}
    top_folders = {path.partition("/")[0] for path in paths}
    if len(top_folders) == 1:
        (top_folder,) = top_folders
        if f"{top_folder}/{MANIFEST_FILE}" in paths:
            return top_folder
    raise InputError(
        f"{archive}: expected an archive of simgap bundle: one folder with {MANIFEST_FILE} in it"
    )


def _read_manifest(archive: Path, packed: zipfile.ZipFile, top: str) -> dict[str, Any]:
    """Read and validate the manifest of an archive, the list of its files with their hashes.

    The size is checked first, because an archive of unknown origin could contain a manifest that
    fills the memory.

    Args:
        archive: path of the archive, for messages.
        packed: archive, open for reading.
        top: name of its only top-level folder.

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


def list_comparison_folders(folder: Path) -> Iterator[Path]:
    """Yield the folders of the comparisons in a folder.

    A misspecification study consists of two comparisons, in subfolders of its own folder.
    """
    for part in list_study_folders(folder):
        models = [part / label for label in MODEL_LABELS if (part / label).is_dir()]
        yield from models or [part]
