"""Verify that the files of an explanation are valid and consistent (`simgap verify`)."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.benchmark.storage.provenance import compute_sha256, read_environment
from bench.core.plugin_registries import simulators
from bench.diagnosis.score_extended import score_model
from bench.diagnosis.verdict import Verdict
from bench.schemas import find_violations
from bench.studies.comparison_verification import VerificationFailure
from sims.core.files import get_first_line
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, open_extended

PrintLine = Callable[[str], None]

VERDICT_FILE = "verdict.json"
"""File of the verdict in the folder of an explanation."""

EXTENDED_MODEL_FILE = "extended.toml"
"""File of the extended simulator in the folder of an explanation."""


_ERROR_TOLERANCE = 1e-3
"""Relative tolerance of a held-out error.

Initial states are estimated again, possibly on another machine.
"""
RELATIVE_TOLERANCE = 1e-9
"""Relative difference up to which two numbers of the files are equal."""


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

    try:
        verdict = read_verdict(folder)
    except InvalidVerdictError as error:
        verification.doubts.extend(
            VerificationFailure(VERDICT_FILE, 0, line) for line in error.violations
        )
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


class InvalidVerdictError(InputError):
    """Error of a verdict that cannot be read.

    Attributes:
        violations: what is wrong with it, one line each.
    """

    def __init__(self, message: str, violations: Sequence[str]) -> None:
        super().__init__(message)
        self.violations = violations


def read_verdict(folder: Path) -> Verdict:
    """Read the verdict of an explanation.

    Raises:
        InvalidVerdictError: it is missing, or violates its JSON schema.
    """
    path = folder / VERDICT_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        violations = find_violations(document, "verdict")
        if not violations:
            return Verdict.from_document(document)
    except OSError as error:
        remedy = "name a folder that simgap explain has written"
        raise InvalidVerdictError(
            f"{path}: cannot be read ({error.strerror}); {remedy}", [get_first_line(error)]
        ) from None
    except (ValueError, RecursionError, KeyError, TypeError) as error:
        violations = [get_first_line(error)]
    raise InvalidVerdictError(
        f"{path}: expected a verdict of simgap explain; {violations[0]}", violations
    )


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
            fitted_value.value, model_value.value, rel_tol=RELATIVE_TOLERANCE
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
            if not math.isclose(fitted_value.value, value, rel_tol=RELATIVE_TOLERANCE):
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
    the hash that the explanation states. A difference beyond `_ERROR_TOLERANCE` is a failure.

    Args:
        folder: folder of the explanation.
        verdict: its verdict, with the stated error.
        verification: result, to which failures and skipped checks are added.
        note: prints one line of text.
    """
    environment = read_environment(folder)
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
    if not math.isclose(stated_error, repeated_error, rel_tol=_ERROR_TOLERANCE):
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


RECORDINGS_FOLDER = "recordings"
"""Folder of recordings in the archive of an explanation."""
