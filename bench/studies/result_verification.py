"""Verify that results are consistent (`simgap verify`): a comparison, an explanation or an archive.

The targets of a finished comparison must follow from the salt that was committed before the first
run, its errors from its targets, its losses from its proposals, and its tables from its rows. The
files of an explanation must be valid and agree with each other. An archive must also match its
manifest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.targets import Target, draw_targets
from bench.benchmark.problem.tuning_problem import (
    ProposalEvaluator,
    TuningProblem,
    numeric_warnings_silenced,
)
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.statistics.comparison_statistics import build_tables
from bench.benchmark.storage.provenance import compute_sha256, read_environment
from bench.benchmark.storage.result_folder import (
    CONFIGURATION_FILE,
    StoredComparison,
    read_checked_comparison,
    read_configuration,
)
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.core.plugin_registries import simulators
from bench.diagnosis.score_extended import score_model
from bench.diagnosis.verdict import VERDICT_FILE, InvalidVerdictError, Verdict, read_verdict
from bench.studies.archive_bundle import (
    MANIFEST_FILE,
    RECORDINGS_FOLDER,
    UnpackedArchive,
    list_comparison_folders,
    unpack_archive,
)
from bench.studies.study_kinds import list_study_folders
from sims.core.simulator import Array, InputError
from sims.extended_simulator import EXTENDED_MODEL_FILE, ExtendedSimulator, open_extended

PrintLine = Callable[[str], None]
MAX_RESIMULATED_ROWS = 2000
"""Maximum number of simulations that are repeated, unless all are requested."""
_MAX_PRINTED_FAILURES = 20
"""Maximum number of verification failures that are printed."""
_ARITHMETIC_TOLERANCE = 1e-9
"""Relative tolerance of numbers that arithmetic alone determines."""
_SIMULATION_TOLERANCE = 1e-6
"""Relative tolerance of simulated numbers, possibly from another machine."""
_HELD_OUT_ERROR_TOLERANCE = 1e-3
"""Relative tolerance of a held-out error.

Initial states are estimated again, possibly on another machine.
"""
_NUMBER_TOLERANCE = 1e-9
"""Relative difference up to which numbers of verdict and extended model are equal."""


class VerificationFailure(NamedTuple):
    """Verification failure: a file or row that does not follow from the others.

    Attributes:
        file: path in the folder.
        row: number of the row from 1; 0 for the whole file.
        says: what was expected and what was found.
    """

    file: str
    row: int
    says: str

    def __str__(self) -> str:
        return f"{self.file}{f', row {self.row}' if self.row else ''}: {self.says}"


class Verification(NamedTuple):
    """Result of verifying a folder of results, or an archive of one.

    Attributes:
        comparisons: result for each comparison in it.
        explanation: result for the explanation in it.
        archive: metadata of the archive; None for a folder.
        doubts: files of the archive that differ from its manifest; if there are any, nothing else
            is verified.
    """

    comparisons: list[ComparisonVerification]
    explanation: ExplanationVerification | None
    archive: dict[str, Any] | None = None
    doubts: Sequence[VerificationFailure] = ()

    @property
    def is_consistent(self) -> bool:
        """True if there is no verification failure."""
        has_no_doubts = not self.doubts and all(part.is_consistent for part in self.comparisons)
        return has_no_doubts and not (self.explanation and self.explanation.doubts)

    def to_document(self) -> dict[str, Any]:
        """Convert the result to a JSON document."""
        archive = self.archive
        if archive is not None:
            archive = {**archive, "doubts": [doubt._asdict() for doubt in self.doubts]}
        return {
            "follows": self.is_consistent,
            "archive": archive,
            "comparisons": [part.to_document() for part in self.comparisons],
            "explanation": self.explanation.to_document() if self.explanation else None,
        }


def verify_results(
    path: Path, print_line: PrintLine, plugins: Sequence[str] = (), every: bool = False
) -> Verification:
    """Verify the results in a folder or in an archive, which must match its manifest.

    Args:
        path: folder of a comparison, a sweep or an explanation, or archive of `write_bundle`.
        print_line: prints a line.
        plugins: plugin files to load; those that an archive names or contains are never run.
        every: whether to repeat every simulation instead of a sample.

    Raises:
        InputError: the path has no results, or an archive is unsafe to unpack.
    """
    if path.is_file():
        with unpack_archive(path) as unpacked:
            return _verify_archive(path, unpacked, print_line, plugins, every)
    if (path / VERDICT_FILE).is_file():
        return Verification([], _verify_explanation(path, path, print_line))
    folders = list_study_folders(path)
    return Verification([verify_comparison(f, print_line, plugins, every) for f in folders], None)


def _verify_archive(
    archive: Path,
    unpacked: UnpackedArchive,
    print_line: PrintLine,
    plugins: Sequence[str],
    every: bool,
) -> Verification:
    """Verify that an archive matches its manifest, and verify the results in it.

    Args:
        archive: archive, possibly written elsewhere.
        unpacked: its content.
        print_line: prints a line.
        plugins: plugin files to load.
        every: whether to repeat every simulation instead of a sample.

    Returns:
        The result; without results of its content if files differ from the manifest.
    """
    description = _describe_archive(archive, unpacked)
    count, size = description["files"], description["bytes"]
    print_line(
        f"{archive}: {description['kind']} of simgap {description['simgap']}, {count} files, "
        f"{size} bytes"
    )
    mismatches = list(_compare_with_manifest(unpacked.manifest, unpacked.files))
    if mismatches:
        print_failures(mismatches, archive, print_line)
        return Verification([], None, description, mismatches)
    print_line(
        f"{MANIFEST_FILE}: every listed file exists with its SHA-256, and there are no others"
    )
    if description["kind"] == "explanation":
        explanation = _verify_explanation(unpacked.folder, archive, print_line)
        return Verification([], explanation, description)
    # The plugins that the archive contains are not run. Results are named by their path in the
    # archive, and not in the temporary folder.
    comparisons = [
        verify_comparison(part, print_line, plugins, every, own_plugins=False)._replace(
            folder=archive / part.relative_to(unpacked.folder.parent)
        )
        for part in list_comparison_folders(unpacked.folder)
    ]
    return Verification(comparisons, None, description)


def _compare_with_manifest(
    manifest: dict[str, Any], unpacked: Mapping[str, tuple[int, str]]
) -> Iterator[VerificationFailure]:
    """Yield files that are missing, added, or different from the manifest.

    Args:
        manifest: content of the manifest.
        unpacked: size in bytes and SHA-256 of each unpacked file, by path.
    """
    listed_files = {
        listed_file["path"]: (listed_file["bytes"], listed_file["sha256"])
        for listed_file in manifest["files"]
    }
    if len(listed_files) < len(manifest["files"]):
        yield VerificationFailure(
            MANIFEST_FILE, 0, "expected each file once, found one listed twice"
        )
    for path in sorted({*listed_files, *unpacked}):
        if path not in unpacked:
            yield VerificationFailure(path, 0, "expected it, as the manifest lists it; found none")
        elif path not in listed_files:
            yield VerificationFailure(
                path, 0, "expected no file that the manifest does not list; found this one"
            )
        elif listed_files[path] != unpacked[path]:
            (size, digest), (found_size, found_digest) = listed_files[path], unpacked[path]
            expected = f"{size} bytes with SHA-256 {digest[:12]}"
            yield VerificationFailure(
                path, 0, f"expected {expected}, found {found_size} bytes with {found_digest[:12]}"
            )


def _describe_archive(archive: Path, unpacked: UnpackedArchive) -> dict[str, Any]:
    """Return what the manifest says about an archive, as the beginning of the JSON document.

    Args:
        archive: path of the archive.
        unpacked: its content.
    """
    manifest = unpacked.manifest
    return {
        "file": archive,
        "kind": manifest["kind"],
        "files": len(manifest["files"]),
        "bytes": sum(listed_file["bytes"] for listed_file in manifest["files"]),
        "simgap": manifest["simgap"],
        "command": manifest["command"],
    }


def _verify_explanation(folder: Path, name: Path, print_line: PrintLine) -> ExplanationVerification:
    """Verify an explanation, and print its failures; `name` is its folder or archive in them."""
    verification = verify_extended_model(folder, print_line)
    print_failures(verification.doubts, name, print_line)
    return verification


def print_failures(
    doubts: Sequence[VerificationFailure], folder: Path, print_line: PrintLine
) -> None:
    """Print verification failures, at most `_MAX_PRINTED_FAILURES` of them, and their number.

    Args:
        doubts: files and rows that do not follow from others.
        folder: folder of the results.
        print_line: prints one line of text.
    """
    for doubt in doubts[:_MAX_PRINTED_FAILURES]:
        print_line(f"NOT REPRODUCED  {folder}/{doubt}")
    if len(doubts) > _MAX_PRINTED_FAILURES:
        print_line(f"and {len(doubts) - _MAX_PRINTED_FAILURES} more")


class ComparisonVerification(NamedTuple):
    """Result of verifying a comparison.

    Attributes:
        folder: folder of the comparison.
        checked: descriptions of what was checked.
        doubts: verification failures.
    """

    folder: Path
    checked: tuple[str, ...]
    doubts: tuple[VerificationFailure, ...]

    @property
    def is_consistent(self) -> bool:
        """True if there is no verification failure."""
        return not self.doubts

    def to_document(self) -> dict[str, Any]:
        """Convert the result of verifying a comparison to a JSON document."""
        doubts = [doubt._asdict() for doubt in self.doubts]
        return {
            "folder": self.folder,
            "follows": self.is_consistent,
            "checked": self.checked,
            "doubts": doubts,
        }


@numeric_warnings_silenced()
def verify_comparison(
    folder: Path,
    print_line: PrintLine,
    plugins: Sequence[str] = (),
    every: bool = False,
    own_plugins: bool = True,
) -> ComparisonVerification:
    """Verify a finished comparison, and print the result.

    The salt, from which the targets were drawn, must be the one that was committed by its hash
    before the first run. Errors, a sample of the simulated losses, and the tables are computed
    again.

    Args:
        folder: folder of the comparison.
        print_line: prints a line.
        plugins: plugin files in addition to those that the comparison names.
        every: whether to repeat every simulation instead of a sample.
        own_plugins: whether to run the plugin files that the comparison names; False for a
            comparison from an untrusted source.

    Raises:
        InputError: the comparison is not finished, or it is damaged.
    """
    configuration = read_configuration(folder)
    experiment = configuration.experiment
    if (folder / SEGMENTS_FOLDER).exists():
        raise InputError(f"{folder}: not finished, so its salt is not revealed; resume it first")
    if experiment.shot:
        raise InputError(f"{folder}: expected a comparison, found a bounce shot")
    # A study with the table [calibration] contains two comparisons, in subfolders.
    if experiment.calibration:
        remedy = f"name one of the two in it: {folder / 'plain'} or {folder / 'extended'}"
        raise InputError(f"{folder}: expected a comparison, found a study of two; {remedy}")
    checks: list[str] = []

    def note(line: str) -> None:
        checks.append(line)
        print_line(line)

    # The salt in experiment.toml was already checked against its hash when the file was read.
    stored = read_checked_comparison(folder)
    note(_describe_salt(experiment))
    own_files = configuration.plugins if own_plugins else []
    files = [*own_files, *(str(Path(plugin).resolve()) for plugin in plugins)]
    load_plugins_for_experiment(list(dict.fromkeys(files)), experiment)
    problem = TuningProblem(experiment)
    try:
        doubts = _verify_runs_table(stored, problem, note, every)
    finally:
        problem.close()
    doubts += _verify_tables(folder, stored, note)
    print_failures(doubts, folder, print_line)
    if not doubts:
        print_line("all results are reproducible")
    return ComparisonVerification(folder, tuple(checks), tuple(doubts))


def _describe_salt(experiment: Experiment) -> str:
    """Describe the salt of a comparison that has been verified: public, or committed beforehand.

    Only a salt whose hash was published before the first run proves that nobody knew the targets.
    """
    if not experiment.salt_sha256:
        return f"{CONFIGURATION_FILE}: a public salt: anyone could draw the targets beforehand"
    return (
        f"{CONFIGURATION_FILE}: the salt has the SHA-256 that was committed, "
        f"{experiment.salt_sha256[:12]}"
    )


def _verify_runs_table(
    stored: StoredComparison, problem: TuningProblem, print_line: PrintLine, is_every_row: bool
) -> list[VerificationFailure]:
    """Verify runs.parquet, and return the failures.

    The targets are drawn again from the salt. Errors are computed from them in all rows; losses are
    simulated again.

    Args:
        stored: content of the result folder.
        problem: the problem, from which targets are drawn.
        print_line: prints one line of text.
        is_every_row: whether losses are simulated again in all rows, and not in a selection.
    """
    targets = {target.blinded.name: target for target in draw_targets(problem)}
    runs = stored.runs
    doubts = [
        VerificationFailure(
            "runs.parquet", int(runs.index[runs["target"] == name][0]) + 1, f"no target {name}"
        )
        for name in runs["target"].unique()
        if name not in targets
    ]
    if doubts:
        return doubts
    for name, rows in runs.groupby("target", sort=False):
        doubts += _verify_errors(problem, targets[str(name)], rows)
    print_line(
        f"runs.parquet: {len(targets)} targets drawn again, {len(runs)} rows compared with them"
    )
    checked_rows = _select_rows(runs, MAX_RESIMULATED_ROWS if not is_every_row else len(runs))
    for name, rows in checked_rows.groupby("target", sort=False):
        doubts += _verify_losses(problem, targets[str(name)], rows)
    print_line(f"runs.parquet: {len(checked_rows)} of {len(runs)} rows simulated again")
    # Rows must say whether the tuners ran without isolation; the first wrong one is reported.
    doubts += [
        VerificationFailure(
            "runs.parquet", int(row) + 1, f"trusted: expected {problem.experiment.trusted}"
        )
        for row in runs.index[runs["trusted"] != problem.experiment.trusted][:1]
    ]
    return doubts


def _verify_errors(
    problem: TuningProblem, target: Target, rows: pd.DataFrame
) -> Iterator[VerificationFailure]:
    """Yield rows of a target whose errors do not follow from its true parameters.

    Args:
        problem: problem with the simulator and its parameters.
        target: the target with its true parameters.
        rows: rows of all runs on the target.
    """
    if target.truth is None:
        return
    names = [parameter.name for parameter in problem.cube.parameters]
    recommended = rows[[f"recommendation_{name}" for name in names]].to_numpy()
    errors = np.abs(recommended - target.truth)
    expected = {f"true_{name}": np.full(len(rows), target.truth[i]) for i, name in enumerate(names)}
    expected["param_error"] = (errors / problem.cube.compute_training_widths()).mean(axis=1)
    expected["outside"] = np.full(
        len(rows), problem.cube.compute_distance_from_training(target.truth)
    )
    if len(names) == 1:
        expected["param_abs_error"] = errors[:, 0]
    for column, values in expected.items():
        # Rounding of parameters that are far larger than their error is not a failure.
        slack = 1e-12 * float(np.abs(target.truth).max())
        yield from _find_first_difference(rows, column, values, _ARITHMETIC_TOLERANCE, slack)


def _verify_losses(
    problem: TuningProblem, target: Target, rows: pd.DataFrame
) -> Iterator[VerificationFailure]:
    """Yield rows of a target whose losses and errors differ from repeated simulations.

    The proposals are simulated again for the losses, the recommendations for the errors on the
    fitted and on the held-out scenarios. The row k = 0 of a run has no proposal, only the first
    recommendation.

    Args:
        problem: problem with the simulator and its scenarios.
        target: the target with its observations.
        rows: rows of all runs on the target.
    """
    names = [parameter.name for parameter in problem.cube.parameters]
    channel = problem.error_channel
    proposal_rows = rows[rows["k"] > 0]
    fitting = ProposalEvaluator(problem, target.blinded.fitting)
    if len(proposal_rows):
        proposed = _convert_to_unit_cube(
            problem, proposal_rows[[f"proposal_{name}" for name in names]]
        )
        # One point at a time, because the observations of all would not fit in memory.
        losses = np.concatenate([loss for _, loss in (fitting(point[None]) for point in proposed)])
        yield from _find_first_difference(
            proposal_rows, "loss", losses, _SIMULATION_TOLERANCE, _SIMULATION_TOLERANCE
        )
    recommended = _convert_to_unit_cube(problem, rows[[f"recommendation_{name}" for name in names]])
    for column, observed_runs in (
        ("obs_error", target.blinded.fitting),
        ("heldout_error", target.blinded.held_out),
    ):
        # A run that ended before its first result has no error.
        has_value = rows[column].notna().to_numpy()
        if observed_runs.scenarios and has_value.any():
            # A new evaluator knows no point, and simulates all recommendations.
            rmse = ProposalEvaluator(problem, observed_runs).compute_rmse(
                recommended[:0], recommended[has_value]
            )
            tolerance = _SIMULATION_TOLERANCE * float(problem.scale[channel])
            yield from _find_first_difference(
                rows[has_value], column, rmse[:, channel], _SIMULATION_TOLERANCE, tolerance
            )


def _convert_to_unit_cube(problem: TuningProblem, frame: pd.DataFrame) -> Array:
    """Convert parameters to points of the unit cube, clipped because of rounding.

    Args:
        problem: the problem, with the bounds of its parameters.
        frame: one row for each point, one column for each parameter in physical units.

    Returns:
        (n, dim) points.
    """
    points: Array = np.clip(problem.cube.to_unit_cube(frame.to_numpy(dtype=float)), 0.0, 1.0)
    return points


def _find_first_difference(
    rows: pd.DataFrame,
    column: str,
    expected: Array,
    relative_tolerance: float,
    absolute_tolerance: float,
) -> Iterator[VerificationFailure]:
    """Yield the first row in which a column differs from the expected values.

    Args:
        rows: rows of all runs on one target.
        column: name of the column.
        expected: (n,) expected values.
        relative_tolerance: allowed difference as a share of the expected value.
        absolute_tolerance: allowed difference in the unit of the column.
    """
    if column not in rows:
        return
    values = rows[column].to_numpy(dtype=float)
    is_close = np.isclose(
        values, expected, rtol=relative_tolerance, atol=absolute_tolerance, equal_nan=True
    )
    if not is_close.all():
        first_row = int(np.argmin(is_close))
        count = int((~is_close).sum())
        message = f"{column}: expected {expected[first_row]:.9g}, found {values[first_row]:.9g}"
        suffix = f" ({count} rows of {rows['target'].iloc[0]})" if count > 1 else ""
        yield VerificationFailure("runs.parquet", int(rows.index[first_row]) + 1, message + suffix)


def _select_rows(runs: pd.DataFrame, max_count: int) -> pd.DataFrame:
    """Select at most `max_count` rows, evenly spaced, since simulating all again takes long.

    Args:
        runs: rows of runs.parquet.
        max_count: maximum number of rows.
    """
    row_indices = np.unique(
        np.linspace(0, len(runs) - 1, min(max_count, len(runs))).round().astype(int)
    )
    return runs.iloc[row_indices]


def _verify_tables(
    folder: Path, stored: StoredComparison, print_line: PrintLine
) -> list[VerificationFailure]:
    """Verify that table.csv follows from the rows, and return the failures.

    The table is computed again and compared column by column; numbers may differ by rounding. Of
    each column the first wrong row is reported. Without the file there is nothing to verify.

    Args:
        folder: folder of the comparison.
        stored: comparison read from its result folder: configuration, runs and statuses.
        print_line: prints one line of text.
    """
    path = folder / "table.csv"
    if not path.exists():
        print_line("table.csv: not found; write it with simgap plot")
        return []
    stored_table = pd.read_csv(path, keep_default_na=True)
    expected = build_tables(stored)["table"]
    if len(stored_table) != len(expected):
        return [
            VerificationFailure(
                path.name, 0, f"expected {len(expected)} rows, found {len(stored_table)}"
            )
        ]
    failures = []
    # The order of the rows is ignored: it depends on the version that wrote them.
    keys = ["experiment", "tuner", "range", "simulations", "metric"]
    if not set(keys) - set(stored_table):
        # The row of a skipped tuner has empty cells, which pandas reads as NaN.
        expected = expected.sort_values(keys, kind="stable")
        stored_table = stored_table.fillna({"range": "", "metric": ""}).sort_values(
            keys, kind="stable"
        )
    row_numbers = stored_table.index  # rows of the file, in the order of comparison
    for column in expected:
        if column not in stored_table:
            failures.append(
                VerificationFailure(path.name, 0, f"expected a column {column}, found none")
            )
            continue
        expected_values = expected[column].reset_index(drop=True)
        found_values = stored_table[column].reset_index(drop=True)
        is_equal = _compare_columns(expected_values, found_values)
        if not is_equal.all():
            first = int(np.argmin(is_equal))
            message = f"{column}: expected {expected_values[first]}, found {found_values[first]}"
            # Line of the file: lines count from 1, and the first one is the header.
            failures.append(VerificationFailure(path.name, int(row_numbers[first]) + 2, message))
    print_line(f"table.csv: {len(stored_table)} rows recomputed from runs.parquet")
    return failures


def _compare_columns(expected: pd.Series, found: pd.Series) -> NDArray[np.bool_]:
    """Return a mask (n,) of equal cells: numbers up to rounding, anything else as text."""
    if pd.api.types.is_numeric_dtype(expected) and expected.dtype != bool:
        return np.isclose(
            expected.astype(float), found.astype(float), rtol=_ARITHMETIC_TOLERANCE, equal_nan=True
        )
    is_equal: NDArray[np.bool_] = (expected.astype(str) == found.fillna("").astype(str)).to_numpy()
    return is_equal


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
        """Convert the result of verifying an explanation to a JSON document."""
        doubts = [doubt._asdict() for doubt in self.doubts]
        return {**self._asdict(), "follows": not self.doubts, "doubts": doubts}


def verify_extended_model(folder: Path, print_line: PrintLine) -> ExplanationVerification:
    """Check that the verdict and the extended model of an explanation agree.

    The verdict states the causes that were found, with their fitted numbers; the extended model is
    the simulator to which effects for these causes were added. The verdict must follow its schema,
    the extended model must load and have the same values, and its errors on the recording are
    computed again if the recording is there. A failed check is a doubt; a check that is not
    possible here, for example without the robot's model file, is listed as unchecked.

    Args:
        folder: folder of the explanation.
        print_line: prints one line of text.

    Returns:
        Checks that were made, those that were not possible, and failures.
    """
    verification = ExplanationVerification([], [], [])

    def note(line: str) -> None:
        verification.checked.append(line)
        print_line(line)

    try:
        verdict = read_verdict(folder)
    except InvalidVerdictError as error:
        verification.doubts.extend(
            VerificationFailure(VERDICT_FILE, 0, line) for line in error.violations
        )
        return verification
    note(f"{VERDICT_FILE}: valid for the JSON schema verdict: {verdict.verdict}")
    try:
        # The two simulator classes that are returned as well are not needed.
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


def _find_differing_numbers(
    verdict: Verdict, extended: ExtendedSimulator
) -> Iterator[VerificationFailure]:
    """Yield numbers of the verdict that are missing or different in the extended simulator.

    Args:
        verdict: Verdict read from `verdict.json`.
        extended: Extended simulator read from `extended.toml`, which must state the same numbers.
    """
    for name, fitted_value in verdict.parameters.items():
        model_value = extended.parameters.get(name)
        if model_value is not None and not math.isclose(
            fitted_value.value, model_value.value, rel_tol=_NUMBER_TOLERANCE
        ):
            yield VerificationFailure(
                VERDICT_FILE,
                0,
                f"{name}: {fitted_value.value:.9g}, "
                f"in {EXTENDED_MODEL_FILE} {model_value.value:.9g}",
            )
    for cause in verdict.causes:
        coefficients: Mapping[str, Any] = extended.effects.get(cause.effect, {})
        for name, fitted_value in cause.coefficients.items():
            # A missing number is NaN, which is close to no number.
            value = coefficients[name].value if name in coefficients else math.nan
            if not math.isclose(fitted_value.value, value, rel_tol=_NUMBER_TOLERANCE):
                label = f"{cause.effect} {name}"
                yield VerificationFailure(
                    VERDICT_FILE,
                    0,
                    f"{label}: {fitted_value.value:.9g}, in {EXTENDED_MODEL_FILE} {value:.9g}",
                )


def _score_extended_model(
    folder: Path, verdict: Verdict, verification: ExplanationVerification, note: PrintLine
) -> None:
    """Repeat the held-out error of the extended simulator, if the folder has the recording.

    Nothing can be repeated without a stated error or without the recording; the recording must have
    the hash that the explanation states. A difference beyond `_HELD_OUT_ERROR_TOLERANCE` is a
    failure.

    Args:
        folder: folder of the explanation.
        verdict: its verdict, with the stated error.
        verification: result, to which failures and skipped checks are added.
        note: prints one line of text.
    """
    environment = read_environment(folder)
    # RMS error of the extended simulator on the held-out runs.
    stated_error = verdict.heldout.rmse_extended if verdict.heldout else None
    tables = sorted((folder / RECORDINGS_FOLDER).glob("*.csv"))
    if stated_error is None:
        verification.unchecked.append("held-out error: the verdict does not state one")
        return
    if len(tables) != 1:
        location = f"{len(tables)} recordings are" if tables else "the recording is not"
        verification.unchecked.append(
            f"held-out error: {location} in it (simgap bundle --with LOG.csv)"
        )
        return
    failure = _find_other_recording(tables[0], environment)
    if failure is not None:
        verification.doubts.append(failure)
        return
    try:
        result = score_model(folder / EXTENDED_MODEL_FILE, tables[0], held_out=True)
    except InputError as error:
        verification.unchecked.append(f"held-out error: {str(error).replace(f'{folder}/', '')}")
        return
    assert verdict.heldout is not None  # because it states an error
    repeated_error = _combine_errors(result["rmse"], result["units"], verdict.heldout.unit)
    # NaN, which means that no channel has the unit, also counts as a difference.
    if not math.isclose(stated_error, repeated_error, rel_tol=_HELD_OUT_ERROR_TOLERANCE):
        difference = (
            f"rmse_extended on held-out runs: {stated_error:.6g}, recomputed {repeated_error:.6g}"
        )
        verification.doubts.append(VerificationFailure(VERDICT_FILE, 0, difference))
        return
    note(f"{VERDICT_FILE}: rmse_extended on held-out runs is reproduced: {repeated_error:.6g}")


def _find_other_recording(
    table: Path, environment: Mapping[str, Any]
) -> VerificationFailure | None:
    """Return a failure if a recording is not the one that was explained, and None otherwise.

    Args:
        table: table of the recording; its description is the TOML file of the same name.
        environment: content of the explanation's environment file, with the SHA-256 of each file
            that was explained. A file without a hash is not checked.
    """
    hashes = {
        recording["file"]: recording["sha256"] for recording in environment.get("recordings", [])
    }
    for path in (table, table.with_suffix(".toml")):
        if path.name in hashes and path.is_file() and compute_sha256(path) != hashes[path.name]:
            expected = (
                f"expected the recording that was explained, SHA-256 {hashes[path.name][:12]}"
            )
            return VerificationFailure(
                f"{RECORDINGS_FOLDER}/{path.name}", 0, f"{expected}; found another"
            )
    return None


def _combine_errors(
    rmse_by_channel: Mapping[str, float], units: Mapping[str, str], unit: str
) -> float:
    """Return the root mean square of the errors of those channels that have a given unit.

    Args:
        rmse_by_channel: root-mean-square error of each channel, in its unit.
        units: unit of each channel.
        unit: unit of the combined error.

    Returns:
        Combined error; NaN if no channel has the unit.
    """
    errors = [error for name, error in rmse_by_channel.items() if units[name] == unit]
    if not errors:
        return math.nan
    return math.sqrt(sum(error * error for error in errors) / len(errors))
