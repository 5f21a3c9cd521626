"""Verdict: the result of explain, as an object and as verdict.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
from sims.extended_simulator import FittedValue

JsonDocument = dict[str, Any]


@dataclass(frozen=True, repr=False)
class Cause:
    """Effect that the simulator lacks.

    Attributes:
        effect: Name of the effect.
        alternatives: Effects that explain the data as well, the most plausible first.
        says: Description of the effect in one sentence.
        coefficients: Fitted coefficients with their 95 % intervals, by name.
        p_value: Probability of such a gain if the effect were absent.
        form: ``soft`` if dry friction has the solver parameters of the robot's model file, or
            MuJoCo's defaults; left out where it is stiff, and for all other causes.
    """

    effect: str
    alternatives: tuple[str, ...]
    says: str
    coefficients: Mapping[str, FittedValue]
    p_value: float
    form: str | None = None

    @property
    def open_numbers(self) -> dict[str, FittedValue]:
        """Coefficients that are not results: at a bound, or without an interval.

        Time step and integrator are chosen, so they have no interval and are not included.
        """
        if self.effect.startswith("numerics."):
            return {}
        return {name: n for name, n in self.coefficients.items() if not n.is_result}

    def to_document(self) -> JsonDocument:
        """Return the cause as in verdict.json."""
        return {
            "effect": self.effect,
            "alternatives": list(self.alternatives),
            "says": self.says,
            "coefficients": _convert_estimates(self.coefficients),
            "p_value": self.p_value,
            **({"form": self.form} if self.form is not None else {}),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Cause:
        """Build a cause from its entry in verdict.json."""
        return cls(
            document["effect"],
            tuple(document["alternatives"]),
            document["says"],
            _read_estimates(document["coefficients"]),
            document["p_value"],
            document.get("form"),
        )

    def __repr__(self) -> str:
        names = " or ".join([self.effect, *self.alternatives])
        numbers = [
            f"{name} = {_format_value(number)}" for name, number in self.coefficients.items()
        ]
        return f"Cause({names}: {', '.join(numbers)})"


@dataclass(frozen=True, repr=False)
class HeldOutResult:
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

    def to_document(self) -> JsonDocument:
        """Return the errors as in verdict.json, with null where there is no number."""
        numbers = {
            "rmse_base": self.rmse_base,
            "rmse_extended": self.rmse_extended,
            "noise_floor": self.noise_floor,
            "gap_closed": self.gap_closed,
            "low": self.low,
            "high": self.high,
        }
        return {**numbers, "unit": self.unit}

    def __repr__(self) -> str:
        before, after = _format_number(self.rmse_base), _format_number(self.rmse_extended)
        change = f"{before} -> {after} {self.unit}".rstrip()
        floor = _format_number(self.noise_floor)
        gap_closed = _format_number(self.gap_closed)
        return f"Heldout({change}, floor {floor}, closed {gap_closed})"


@dataclass(frozen=True, repr=False)
class Candidate:
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

    def to_document(self) -> JsonDocument:
        """Return the candidate as in verdict.json."""
        return {
            "effect": self.effect,
            "score": self.score,
            "p_value": self.p_value,
            "heldout_gain": self.heldout_gain,
        }

    def __repr__(self) -> str:
        return f"Candidate({self.effect}: score {self.score:.3g}, p {self.p_value:.2g})"


@dataclass(frozen=True)
class RecordingFault:
    """Wrong unit or reversed sign of recorded signals that explains nearly all of the misfit.

    Attributes:
        signals: Channels and inputs that are concerned.
        factor: Factor by which the SI values of the first one have to be multiplied.
        unit: Actual unit of its values; None if only its sign or factor is wrong.
        says: What is wrong, and the change of the description that corrects it.
        lines: For each signal, its table in the description and the keys to set.
        error_before: RMS residual of the base model on the fitted runs, in units of the noise; None
            if not measured.
        error_after: RMS residual with the correction, in units of the noise; None if not measured.
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

    def document(self) -> JsonDocument:
        """Return the fault as in verdict.json."""
        return {
            "signals": list(self.signals),
            "factor": self.factor,
            "unit": self.unit,
            "says": self.says,
            "lines": list(self.lines),
            "error_before": self.error_before,
            "error_after": self.error_after,
            "alternatives": list(self.alternatives),
        }

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> RecordingFault:
        """Build a fault from its entry in verdict.json."""
        lists = ("signals", "lines", "alternatives")
        return cls(**{**document, **{name: tuple(document[name]) for name in lists}})


@dataclass(frozen=True, repr=False)
class Verdict:
    """Verdict of explain.

    Attributes:
        verdict: One of six words.
        system: System of the recording.
        engine: Engine of the simulator; ``its own`` for a simulator with its own integrator.
        causes: Effects that the simulator lacks, strongest first.
        parameters: Base parameters with their 95 % intervals, by name.
        heldout: Gain on held-out runs, or on runs left out in turn; None if there are neither, or
            the simulation failed.
        candidates: Effects of the library, best score first; empty if nothing was scored.
        next_experiment: Proposed next experiment; None if nothing is open.
        simulations: Number of simulations made.
        seconds: Duration of the diagnosis in seconds.
        cut: Early stop of the search, with the questions it skipped; None if the search was
            complete.
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
    recording_faults: tuple[RecordingFault, ...] = ()
    recording_notes: tuple[str, ...] = ()

    @property
    def meaning(self) -> str:
        """Meaning of the verdict in one sentence."""
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
        """Base parameters at a bound of their range, if they make the verdict `partial`."""
        if self.verdict != "partial" or not self.causes:
            return {}
        numbers = self.parameters.items()
        return {
            name: number
            for name, number in numbers
            if number.at_bound is not None and not number.is_result
        }

    def to_document(self) -> JsonDocument:
        """Return the content of verdict.json."""
        # The keys keep the order of the documentation and of older files.
        next_run = self.next_experiment
        faults = [fault.document() for fault in self.recording_faults]
        return {
            "verdict": self.verdict,
            "system": self.system,
            "engine": self.engine,
            "causes": [cause.to_document() for cause in self.causes],
            "parameters": _convert_estimates(self.parameters),
            "heldout": self.heldout.to_document() if self.heldout is not None else None,
            "candidates": [candidate.to_document() for candidate in self.candidates],
            "next_experiment": next_run.to_document() if next_run is not None else None,
            "simulations": self.simulations,
            "seconds": self.seconds,
            "cut": self.cut.to_document() if self.cut is not None else None,
            **({"recording_faults": faults} if faults else {}),
            **({"recording_notes": list(self.recording_notes)} if self.recording_notes else {}),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Verdict:
        """Build a verdict from the content of a verdict.json that explain has written."""
        # Null means that there is no value.
        heldout, next_run = document["heldout"], document["next_experiment"]
        # Older files do not have this key.
        early_stop = document.get("cut")
        return cls(
            verdict=document["verdict"],
            system=document["system"],
            engine=document["engine"],
            causes=tuple(Cause.from_document(cause) for cause in document["causes"]),
            parameters=_read_estimates(document["parameters"]),
            heldout=HeldOutResult(**heldout) if heldout is not None else None,
            candidates=tuple(Candidate(**candidate) for candidate in document["candidates"]),
            next_experiment=DiscriminatingRun(**next_run) if next_run is not None else None,
            simulations=document["simulations"],
            seconds=document["seconds"],
            cut=EarlyStop.from_document(early_stop) if early_stop is not None else None,
            recording_faults=tuple(
                RecordingFault.of(fault) for fault in document.get("recording_faults", ())
            ),
            recording_notes=tuple(document.get("recording_notes", ())),
        )

    def __repr__(self) -> str:
        names = ", ".join(" or ".join([c.effect, *c.alternatives]) for c in self.causes)
        cause_text = f": {names}" if names else ""
        return f"Verdict({self.verdict}{cause_text}; {self.system}, {self.simulations} simulations)"


def to_finite_or_none(value: float) -> float | None:
    """Return a number for JSON; None for NaN and infinite values."""
    # NaN is not valid JSON: strict readers would refuse the whole file.
    return value if np.isfinite(value) else None


def _convert_estimates(numbers: Mapping[str, FittedValue]) -> JsonDocument:
    """Return numbers as in verdict.json, by name."""
    return {name: _convert_estimate(number) for name, number in numbers.items()}


def _convert_estimate(number: FittedValue) -> JsonDocument:
    """Return a fitted value as a JSON object with value, unit and interval."""
    document: JsonDocument = {key: getattr(number, key) for key in ("value", "unit", "low", "high")}
    # Empty fields are left out.
    for key in ("at_bound", "stated", "total", "total_unit"):
        if (value := getattr(number, key)) not in (None, ""):
            document[key] = value
    if number.usual_range is not None:
        document["usual_range"] = list(number.usual_range)
    return document


def _read_estimates(document: Mapping[str, Any]) -> dict[str, FittedValue]:
    return {name: _read_estimate(estimate) for name, estimate in document.items()}


def _read_estimate(estimate: Mapping[str, Any]) -> FittedValue:
    """Build a fitted value from its JSON object, in which the usual range is a list."""
    usual_range = estimate.get("usual_range")
    ends = (float(usual_range[0]), float(usual_range[1])) if usual_range is not None else None
    return FittedValue(**{**estimate, "usual_range": ends})


def _format_value(number: FittedValue) -> str:
    return f"{number.value:.3g} {number.unit}"


def _format_number(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"
