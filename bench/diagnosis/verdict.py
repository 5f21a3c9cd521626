"""Verdict: the result of explain, as an object and as verdict.json.

The fields of each class are the keys of its entry in verdict.json, in this order.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench.diagnosis.evaluation.search_control import EarlyStop
from bench.diagnosis.experiment_design.discriminating_run import DiscriminatingRun
from bench.diagnosis.search.verdict_rules import (
    BORDERING,
    EARLY_STOP_MEANINGS,
    FAULTY,
    OPEN,
    VERDICT_MEANINGS,
    VerdictName,
)
from bench.schemas import find_violations
from sims.core.files import get_first_line
from sims.core.json_documents import OPTIONAL, Document
from sims.core.simulator import InputError
from sims.extended_simulator import FittedValue

VERDICT_FILE = "verdict.json"
"""File of the verdict in the folder of an explanation."""


@dataclass(frozen=True, repr=False)
class Cause(Document):
    """Effect that the simulator lacks.

    Attributes:
        effect: Name of the effect.
        alternatives: Effects that explain the data as well, the most plausible first.
        says: Description of the effect in one sentence.
        coefficients: Fitted coefficients, by name.
        p_value: Probability of such a gain if the effect were absent.
        form: ``soft`` if dry friction has the solver parameters of the robot's model file, or
            MuJoCo's defaults; left out where it is stiff, and for other causes.
    """

    effect: str
    alternatives: tuple[str, ...]
    says: str
    coefficients: Mapping[str, FittedValue]
    p_value: float
    form: str | None = field(default=None, metadata=OPTIONAL)

    @property
    def open_numbers(self) -> dict[str, FittedValue]:
        """Coefficients that are not results: at a bound, or without an interval.

        Time step and integrator are chosen, so they have no interval and are not included.
        """
        if self.effect.startswith("numerics."):
            return {}
        return {name: n for name, n in self.coefficients.items() if not n.is_result}

    def __repr__(self) -> str:
        names = " or ".join([self.effect, *self.alternatives])
        numbers = [
            f"{name} = {_format_value(number)}" for name, number in self.coefficients.items()
        ]
        return f"Cause({names}: {', '.join(numbers)})"


@dataclass(frozen=True, repr=False)
class HeldOutResult(Document):
    """Errors on held-out runs, or on runs left out in turn (cross-validation).

    Cross-validation is used for recordings of two or three runs without marked ones. A value that
    the data do not give is None.

    Attributes:
        rmse_base: RMSE of the fitted base model, in `unit`.
        rmse_extended: RMSE of the extended model.
        noise_floor: RMSE of a perfect model.
        gap_closed: (base - extended) / (base - floor).
        low: Lower end of the 95 % interval of `gap_closed`.
        high: Upper end of the 95 % interval of `gap_closed`.
        unit: Unit of the errors; empty if unknown.
    """

    rmse_base: float | None
    rmse_extended: float | None
    noise_floor: float | None
    gap_closed: float | None
    low: float | None
    high: float | None
    unit: str = ""

    def __repr__(self) -> str:
        before, after = _format_number(self.rmse_base), _format_number(self.rmse_extended)
        change = f"{before} -> {after} {self.unit}".rstrip()
        floor = _format_number(self.noise_floor)
        gap_closed = _format_number(self.gap_closed)
        return f"Heldout({change}, floor {floor}, closed {gap_closed})"


@dataclass(frozen=True, repr=False)
class Candidate(Document):
    """Effect of the library with the evidence for it about the base model.

    Attributes:
        effect: Name of the effect.
        score: Twice the log-likelihood gain of this effect alone, less log n for each of its
            coefficients beyond the first, for n samples.
        p_value: Probability that the best score of the library is as high if nothing is missing.
        heldout_gain: Share of the gap on held-out runs that it closes alone; None if not measured.
    """

    effect: str
    score: float
    p_value: float
    heldout_gain: float | None

    def __repr__(self) -> str:
        return f"Candidate({self.effect}: score {self.score:.3g}, p {self.p_value:.2g})"


@dataclass(frozen=True)
class RecordingFault(Document):
    """Wrong unit or reversed sign of recorded signals that explains nearly all of the misfit.

    Attributes:
        signals: Channels and inputs that are concerned.
        factor: Factor by which the SI values of the first one have to be multiplied.
        unit: Actual unit of its values; None if only its sign or factor is wrong.
        says: What is wrong, and the change of the description that corrects it.
        lines: For each signal, its table in the description and the keys to set.
        error_before: RMS residual of the base model on the fitted runs, in units of the noise; None
            if not measured.
        error_after: RMS residual with the correction, in units of the noise.
        alternatives: Other corrections that explain the recording as well, one sentence each.
    """

    signals: tuple[str, ...]
    factor: float
    unit: str | None
    says: str
    lines: tuple[str, ...]
    error_before: float | None
    error_after: float | None
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class Verdict(Document):
    """Verdict of explain.

    Attributes:
        verdict: One of the six verdicts.
        system: System of the recording.
        engine: Engine of the simulator; ``its own`` if it has its own integrator.
        causes: Effects that the simulator lacks, strongest first.
        parameters: Base parameters, by name.
        heldout: Gain on held-out runs, or on runs left out in turn; None if there are neither, or
            the simulation failed.
        candidates: Effects of the library, best score first; empty if nothing was scored.
        next_experiment: Proposed next experiment; None if nothing is open.
        simulations: Number of simulations made.
        seconds: Duration of the diagnosis in seconds.
        cut: Early end of the search; None if it was complete.
        recording_faults: Wrong units or signs of the recording, because of which no cause was
            searched; left out where it is empty.
        recording_notes: Notes on samples of the recording, such as those with drives switched off;
            left out where it is empty.
    """

    verdict: VerdictName
    system: str
    engine: str
    causes: tuple[Cause, ...]
    parameters: Mapping[str, FittedValue]
    heldout: HeldOutResult | None
    candidates: tuple[Candidate, ...]
    next_experiment: DiscriminatingRun | None
    simulations: int
    seconds: float
    cut: EarlyStop | None = None
    recording_faults: tuple[RecordingFault, ...] = field(default=(), metadata=OPTIONAL)
    recording_notes: tuple[str, ...] = field(default=(), metadata=OPTIONAL)

    @property
    def meaning(self) -> str:
        """Meaning of the verdict in one sentence.

        More special cases come first: a wrong unit or sign of the recording, then a coefficient of
        a cause that is not a result, then a base parameter at a bound of its range. A search that
        ended early (`cut`) has sentences of its own, and the second and third case do not count.
        """
        if self.recording_faults:
            return FAULTY
        if self.cut is None and self.has_open_numbers:
            return OPEN
        if self.cut is None and self.bordering:
            return BORDERING
        return (
            VERDICT_MEANINGS[self.verdict]
            if self.cut is None
            else EARLY_STOP_MEANINGS[self.verdict]
        )

    @property
    def has_open_numbers(self) -> bool:
        """Return whether the verdict is `partial` and a number of a cause is not a result."""
        return self.verdict == "partial" and any(cause.open_numbers for cause in self.causes)

    @property
    def bordering(self) -> dict[str, FittedValue]:
        """Base parameters at a bound of their range, if they make the verdict `partial`.

        A value at a bound is not a result, except zero at a lower bound, such as the coefficient
        of a friction that does not exist.
        """
        if self.verdict != "partial" or not self.causes:
            return {}
        return {
            name: number
            for name, number in self.parameters.items()
            if number.at_bound is not None and not number.is_result
        }

    def __repr__(self) -> str:
        names = ", ".join(" or ".join([c.effect, *c.alternatives]) for c in self.causes)
        cause_text = f": {names}" if names else ""
        return f"Verdict({self.verdict}{cause_text}; {self.system}, {self.simulations} simulations)"


def to_finite_or_none(value: float) -> float | None:
    """Return a number for JSON; None for NaN and infinite values."""
    # NaN is not valid JSON: strict readers would refuse the whole file.
    return value if np.isfinite(value) else None


def _format_value(number: FittedValue) -> str:
    return f"{number.value:.3g} {number.unit}"


def _format_number(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"


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

    Args:
        folder: Folder to which the explanation was written.

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
