"""Pack a result folder into one archive (`simgap bundle`); verify an archive or an explanation.

The folder is that of a comparison or an explanation; the archive is meant for the supplement of a
paper. `simgap verify` checks whether an archive made elsewhere is consistent.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from bench.core.plugin_registries import simulators
from bench.diagnosis.score_extended import score_model
from bench.diagnosis.verdict import Verdict
from bench.misspecification.calibration import MODEL_LABELS
from bench.schemas import find_violations
from bench.studies.study import list_study_folders
from bench.studies.verification import VerificationFailure, VerificationResult, verify_comparison
from sims.core.files import get_first_line
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, open_extended

PrintLine = Callable[[str], None]
VERDICT_FILE = "verdict.json"
"""File of the verdict in the folder of an explanation."""
EXTENDED_MODEL_FILE = "extended.toml"
"""File of the extended simulator in the folder of an explanation."""
_FORMAT_VERSION = 1
"""Version of the manifest's format."""
_RECORDINGS_FOLDER = "recordings"
"""Folder of recordings in the archive of an explanation."""
_PLUGIN_FOLDER = "plugins"
"""Folder of plugin files in the archive of a comparison."""
_ERROR_TOLERANCE = 1e-3
"""Relative tolerance of a held-out error.

Initial states are estimated again, possibly on another machine.
"""


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
                files[f"{_RECORDINGS_FOLDER}/{path.name}"] = path
    return files


def _format_explain_command(folder: Path) -> str:
    """Build the command that reproduces an explanation, as far as its folder states it."""
    environment = read_environment(folder)
    tables = [
        each["file"] for each in environment.get("recordings", []) if each["file"][-5:] != ".toml"
    ]
    words = format_explain_command(tables or ["RECORDING.csv"], environment.get("settings", {}))
    return shlex.join(words)


class ExplanationVerification(NamedTuple):
    """Result of verifying an explanation.

    Attributes:
        checked: descriptions of what was checked.
        unchecked: what could not be checked, with the reason.
        doubts: verification failures.
    """

    checked: list[str]
    unchecked: list[str]
    doubts: list[VerificationFailure]

    def to_document(self) -> dict[str, Any]:
        """Convert to a JSON document."""
        doubts = [doubt._asdict() for doubt in self.doubts]
        return {**self._asdict(), "follows": not self.doubts, "doubts": doubts}


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
            _format_result(doubts, archive, print_line)
            return ArchiveVerification(description, doubts, [], None)
        print_line(
            f"{MANIFEST_FILE}: every listed file exists with its SHA-256, and there are no others"
        )
        if description["kind"] == "explanation":
            explained = _verify_extended_model(unpacked.folder, print_line)
            _format_result(explained.doubts, archive, print_line)
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


def _format_result(
    doubts: Sequence[VerificationFailure], folder: Path, print_line: PrintLine
) -> None:
    """Print the doubts (numbers that do not follow from others), at most 20 of them."""
    for doubt in doubts[:20]:
        print_line(f"NOT REPRODUCED  {folder}/{doubt}")
    if len(doubts) > 20:
        print_line(f"and {len(doubts) - 20} more")


def verify_explanation(folder: Path, print_line: PrintLine) -> ExplanationVerification:
    """Verify that the files of an explanation are valid and consistent.

    If the folder contains the recording, the held-out error is computed again.

    Args:
        folder: folder of the explanation.
        print_line: prints a line.
    """
    verification = _verify_extended_model(folder, print_line)
    _format_result(verification.doubts, folder, print_line)
    return verification


def _verify_extended_model(folder: Path, print_line: PrintLine) -> ExplanationVerification:
    """Check that the verdict and the extended model of an explanation agree.

    The verdict must follow its schema, the extended model must load and have the same values, and
    its errors on the recording are computed again if the recording is there. A failed check is a
    doubt; a check that is not possible here, for example without the robot's model file, is listed
    as unchecked.

    Args:
        folder: folder of the explanation.
        print_line: prints one line of text.
    """
    verification = ExplanationVerification([], [], [])

    def note(line: str) -> None:
        verification.checked.append(line)
        print_line(line)

    verdict = _read_verdict(folder, verification)
    if verdict is None:
        return verification
    note(f"{VERDICT_FILE}: valid for the JSON schema verdict: {verdict.verdict}")
    try:
        extended, _, _ = open_extended(folder / EXTENDED_MODEL_FILE, simulators.get)
    except InputError as error:
        text = str(error).replace(f"{folder}/", "")
        # The hash of a robot's model file is known; its absence here is no verification failure.
        if "model" in text and "no such file" in text:
            verification.unchecked.append(f"{EXTENDED_MODEL_FILE}: {text}")
            print_line(f"not checked: {verification.unchecked[-1]}")
        else:
            verification.doubts.append(VerificationFailure(EXTENDED_MODEL_FILE, 0, text))
        return verification
    note(f"{EXTENDED_MODEL_FILE}: loads as a simulator of {extended.system or extended.name}")
    verification.doubts.extend(_find_differing_numbers(verdict, extended))
    if not verification.doubts:
        note(f"{VERDICT_FILE} and {EXTENDED_MODEL_FILE} have the same values")
    _score_extended_model(folder, verdict, verification, note)
    for line in verification.unchecked:
        print_line(f"not checked: {line}")
    if not verification.doubts:
        print_line(
            "all results are reproducible"
            if not verification.unchecked
            else "all results that could be checked are reproducible"
        )
    return verification


def _read_verdict(folder: Path, verification: ExplanationVerification) -> Verdict | None:
    """Read the verdict of an explanation; add a doubt and return None if it is not valid."""
    try:
        document = json.loads((folder / VERDICT_FILE).read_text(encoding="utf-8"))
        violations = find_violations(document, "verdict")
        if not violations:
            return Verdict.from_document(document)
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        violations = [get_first_line(error)]
    verification.doubts.extend(VerificationFailure(VERDICT_FILE, 0, line) for line in violations)
    return None


def _find_differing_numbers(
    verdict: Verdict, extended: ExtendedSimulator
) -> Iterator[VerificationFailure]:
    """Yield numbers of the verdict that are missing or different in the extended simulator."""
    for name, number in verdict.parameters.items():
        model_value = extended.parameters.get(name)
        if model_value is not None and not math.isclose(
            number.value, model_value.value, rel_tol=1e-9
        ):
            yield VerificationFailure(
                VERDICT_FILE,
                0,
                f"{name}: {number.value:.9g}, in {EXTENDED_MODEL_FILE} {model_value.value:.9g}",
            )
    for cause in verdict.causes:
        coefficients: Mapping[str, Any] = extended.effects.get(cause.effect, {})
        for name, number in cause.coefficients.items():
            value = coefficients[name].value if name in coefficients else math.nan
            if not math.isclose(number.value, value, rel_tol=1e-9):
                label = f"{cause.effect} {name}"
                yield VerificationFailure(
                    VERDICT_FILE,
                    0,
                    f"{label}: {number.value:.9g}, in {EXTENDED_MODEL_FILE} {value:.9g}",
                )


def _score_extended_model(
    folder: Path, verdict: Verdict, verification: ExplanationVerification, note: PrintLine
) -> None:
    """Repeat the held-out error of the extended simulator, if the folder has the recording."""
    environment = read_environment(folder)
    stated_error = verdict.heldout.rmse_extended if verdict.heldout else None
    tables = sorted((folder / _RECORDINGS_FOLDER).glob("*.csv"))
    if stated_error is None:
        verification.unchecked.append("held-out error: the verdict does not state one")
        return
    if len(tables) != 1:
        location = f"{len(tables)} recordings are" if tables else "the recording is not"
        verification.unchecked.append(
            f"held-out error: {location} in it (simgap bundle --with LOG.csv)"
        )
        return
    hashes = {each["file"]: each["sha256"] for each in environment.get("recordings", [])}
    for path in (tables[0], tables[0].with_suffix(".toml")):
        if path.name in hashes and path.is_file() and compute_sha256(path) != hashes[path.name]:
            expected = (
                f"expected the recording that was explained, SHA-256 {hashes[path.name][:12]}"
            )
            verification.doubts.append(
                VerificationFailure(
                    f"{_RECORDINGS_FOLDER}/{path.name}", 0, f"{expected}; found another"
                )
            )
            return
    try:
        result = score_model(folder / EXTENDED_MODEL_FILE, tables[0], held_out=True)
    except InputError as error:
        verification.unchecked.append(f"held-out error: {str(error).replace(f'{folder}/', '')}")
        return
    assert verdict.heldout is not None
    units = result["units"]
    errors_in_unit = [
        e for name, e in result["rmse"].items() if units[name] == verdict.heldout.unit
    ]
    repeated_error = (
        math.sqrt(sum(e * e for e in errors_in_unit) / len(errors_in_unit))
        if errors_in_unit
        else math.nan
    )
    if not math.isclose(stated_error, repeated_error, rel_tol=_ERROR_TOLERANCE):
        difference = (
            f"rmse_extended on held-out runs: {stated_error:.6g}, recomputed {repeated_error:.6g}"
        )
        verification.doubts.append(VerificationFailure(VERDICT_FILE, 0, difference))
        return
    note(f"{VERDICT_FILE}: rmse_extended on held-out runs is reproduced: {repeated_error:.6g}")
