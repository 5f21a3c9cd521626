"""Pack a result folder into one archive (`simgap bundle`), and verify an archive.

The folder is that of a comparison or an explanation; the archive is meant for the supplement of a
paper. `simgap verify` checks whether an archive made elsewhere is consistent.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench import __version__
from bench.benchmark.storage.hashed_archive import (
    MANIFEST_FILE,
    UnpackedArchive,
    unpack_archive,
    write_archive,
)
from bench.benchmark.storage.provenance import (
    compute_sha256,
    format_explain_command,
    read_environment,
)
from bench.benchmark.storage.result_folder import CONFIGURATION_FILE, read_configuration
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.misspecification.calibration import MODEL_LABELS
from bench.studies.comparison_verification import (
    VerificationFailure,
    VerificationResult,
    verify_comparison,
)
from bench.studies.explanation_verification import (
    EXTENDED_MODEL_FILE,
    RECORDINGS_FOLDER,
    VERDICT_FILE,
    ExplanationVerification,
    PrintLine,
    format_result,
    verify_extended_model,
)
from bench.studies.study import list_study_folders
from sims.core.simulator import InputError

_FORMAT_VERSION = 1
"""Version of the manifest's format."""
_PLUGIN_FOLDER = "plugins"
"""Folder of plugin files in the archive of a comparison."""


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
        """Convert to a JSON document."""
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
        command = _format_explain_command(folder)
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
        read_configuration(part)
        if (part / SEGMENTS_FOLDER).exists():
            raise InputError(f"{part}: not finished; resume it first")
    return "comparison"


def _list_result_files(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """List the files of a folder by their relative paths, and those that are left out."""
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
    """List the plugin files of a comparison, so that they can be inspected before they run."""
    plugins = [
        Path(file)
        for part in list_study_folders(folder)
        for file in read_configuration(part).plugins
    ]
    existing_files = [file for file in dict.fromkeys(plugins) if file.is_file()]
    return {f"{_PLUGIN_FOLDER}/{file.name}": file for file in existing_files}


def _list_comparison_folders(folder: Path) -> Iterator[Path]:
    """Yield the folders of the comparisons in a folder; a study of two has both in its own."""
    for part in list_study_folders(folder):
        models = [part / label for label in MODEL_LABELS if (part / label).is_dir()]
        yield from models or [part]


def _format_compare_command(folder: Path, name: str) -> str:
    """Build the command that repeats a comparison, or a suite's comparisons of some methods."""
    configurations = [read_configuration(part) for part in list_study_folders(folder)]
    experiment = configurations[0].experiment
    if not experiment.suite or experiment.diagnosis:
        return f"simgap compare {name}/{CONFIGURATION_FILE}"
    plugins = [
        f"--plugin {name}/{_PLUGIN_FOLDER}/{Path(f).name}" for f in configurations[0].plugins
    ]
    tuners = ",".join(entry.label for entry in experiment.tuners)
    return " ".join(["simgap compare suite", *plugins, f"--tuners {tuners}"])


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


def _format_explain_command(folder: Path) -> str:
    """Build the command that reproduces an explanation, as far as its folder states it."""
    environment = read_environment(folder)
    tables = [
        each["file"] for each in environment.get("recordings", []) if each["file"][-5:] != ".toml"
    ]
    words = format_explain_command(tables or ["RECORDING.csv"], environment.get("settings", {}))
    return shlex.join(words)


class ArchiveVerification(NamedTuple):
    """Result of verifying an archive.

    Attributes:
        archive: metadata of the archive.
        doubts: files that differ from the manifest; if there are any, nothing else is verified.
        comparisons: result for each comparison in it.
        explanation: result for the explanation in it.
    """

    archive: dict[str, Any]
    doubts: list[VerificationFailure]
    comparisons: list[VerificationResult]
    explanation: ExplanationVerification | None

    @property
    def is_consistent(self) -> bool:
        """True if there is no verification failure."""
        has_no_doubts = not self.doubts and all(each.is_consistent for each in self.comparisons)
        return has_no_doubts and not (self.explanation and self.explanation.doubts)

    def to_document(self) -> dict[str, Any]:
        """Convert to a JSON document."""
        comparisons = [each.to_document() for each in self.comparisons]
        explanation = self.explanation.to_document() if self.explanation else None
        archive = {**self.archive, "doubts": [doubt._asdict() for doubt in self.doubts]}
        parts = {"archive": archive, "comparisons": comparisons, "explanation": explanation}
        return {"follows": self.is_consistent, **parts}


def verify_archive(
    archive: Path, print_line: PrintLine, plugins: Sequence[str] = (), every: bool = False
) -> ArchiveVerification:
    """Verify that an archive matches its manifest, and verify the results in it.

    Args:
        archive: archive written by `write_bundle`, possibly elsewhere.
        print_line: prints a line.
        plugins: plugin files to load; those that the archive names or contains are never run.
        every: whether to repeat every simulation instead of a sample.

    Raises:
        InputError: the file is not such an archive, or is unsafe to unpack.
    """
    with unpack_archive(archive) as unpacked:
        description = _describe_archive(archive, unpacked)
        count, size = description["files"], description["bytes"]
        print_line(
            f"{archive}: {description['kind']} of simgap {description['simgap']}, {count} files, "
            f"{size} bytes"
        )
        doubts = [
            VerificationFailure(mismatch.file, 0, mismatch.says) for mismatch in unpacked.mismatches
        ]
        if doubts:
            format_result(doubts, archive, print_line)
            return ArchiveVerification(description, doubts, [], None)
        print_line(
            f"{MANIFEST_FILE}: every listed file exists with its SHA-256, and there are no others"
        )
        if description["kind"] == "explanation":
            explained = verify_extended_model(unpacked.folder, print_line)
            format_result(explained.doubts, archive, print_line)
            return ArchiveVerification(description, [], [], explained)
        verifications = [
            verify_comparison(part, print_line, plugins, every, own_plugins=False)._replace(
                folder=archive / part.relative_to(unpacked.folder.parent)
            )
            for part in _list_comparison_folders(unpacked.folder)
        ]
        return ArchiveVerification(description, [], verifications, None)


def _describe_archive(archive: Path, unpacked: UnpackedArchive) -> dict[str, Any]:
    """Return what the manifest says about an archive, as the beginning of the JSON document."""
    manifest = unpacked.manifest
    return {
        "file": archive,
        "kind": manifest["kind"],
        "files": len(manifest["files"]),
        "bytes": sum(each["bytes"] for each in manifest["files"]),
        "simgap": manifest["simgap"],
        "command": manifest["command"],
    }
